# SPDX-License-Identifier: Apache-2.0
"""A file of one box in each label format that is text."""

from __future__ import annotations

import json

SOUND = {
    'dota': 'imagesource:x\n10 20 50 20 50 30 10 30 ship 0\n',
    'dota_results': 'P1 0.5 10 20 50 20 50 30 10 30\n',
    'yolo_obb': '0 0.1 0.2 0.5 0.2 0.5 0.3 0.1 0.3 0.9 4\n',
    'yolo': '0 0.3 0.25 0.4 0.1 0.9 4\n',
    'csv': 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4\na,0,s,1,2,9,2,9,4,1,4\n',
    'wkt': 'image,score,wkt\na,0.5,"POLYGON ((1 2, 9 2, 9 4, 1 4, 1 2))"\n',
    'hrsc': (
        '<HRSC_Image><Img_SizeWidth>9</Img_SizeWidth><Img_SizeHeight>9</Img_SizeHeight>'
        '<HRSC_Objects><HRSC_Object><mbox_cx>5</mbox_cx><mbox_cy>3</mbox_cy><mbox_w>8</mbox_w>'
        '<mbox_h>2</mbox_h><mbox_ang>0</mbox_ang></HRSC_Object></HRSC_Objects></HRSC_Image>'
    ),
    'voc': (
        '<annotation><object><name>s</name><bndbox><xmin>1</xmin><ymin>2</ymin><xmax>9</xmax>'
        '<ymax>4</ymax></bndbox></object></annotation>'
    ),
    'cvat': (
        '<annotations><image name="a" width="9" height="9"><mask label="s" rle="1, 8" left="1" '
        'top="2" width="3" height="3"/></image></annotations>'
    ),
    'fair1m': (
        '<annotation><objects><object><possibleresult><name>s</name></possibleresult><points>'
        '<point>1,2</point><point>9,2</point><point>9,4</point><point>1,4</point></points></object>'
        '</objects></annotation>'
    ),
    'coco_results': json.dumps([{
        'image_id': 1, 'category_id': 1, 'score': 0.5, 'bbox': [5, 3, 8, 2, 60],
        'segmentation': {'size': [3, 3], 'counts': [1, 8]},
    }]),
    'datumaro': json.dumps({
        'categories': {'label': {'labels': [{'name': 's'}]}},
        'items': [{
            'id': 'a', 'image': {'size': [9, 9]},
            'annotations': [{
                'id': 1, 'type': 'bbox', 'label_id': 0, 'bbox': [1, 2, 8, 2],
                'attributes': {'rotation': 30, 'is_crowd': False},
            }],
        }],
    }),
    'coco': json.dumps({
        'images': [{'id': 1, 'file_name': 'a', 'width': 9, 'height': 9}],
        'categories': [{'id': 1, 'name': 's'}],
        'annotations': [{
            'id': 1, 'image_id': 1, 'category_id': 1, 'bbox': [1, 2, 8, 2], 'score': 0.5,
            'segmentation': [[1, 2, 9, 2, 9, 4, 1, 4]],
        }],
    }),
    'geojson': json.dumps({
        'type': 'FeatureCollection',
        'features': [{
            'type': 'Feature', 'properties': {'score': 1, 'image': 'a'}, 'id': 5,
            'geometry': {'type': 'Polygon', 'coordinates': [[[1, 2], [9, 2], [9, 4], [1, 2]]]},
        }],
    }),
    'labelme': json.dumps({
        'imagePath': 'a.png', 'imageWidth': 9, 'imageHeight': 9,
        'shapes': [{
            'label': 's', 'shape_type': 'polygon', 'group_id': 5, 'score': 0.5,
            'points': [[1, 2], [9, 2], [9, 4], [1, 4]],
        }],
    }),
    'label_studio': json.dumps([{
        'id': 1, 'data': {'image': '/data/a.png'},
        'annotations': [{'created_at': '2026', 'result': [{
            'id': 'x', 'type': 'rectanglelabels', 'original_width': 9, 'original_height': 9,
            'value': {
                'x': 10, 'y': 20, 'width': 80, 'height': 20, 'rotation': 5,
                'rectanglelabels': ['s'],
            },
        }]}],
    }]),
    'ultralytics': json.dumps([{
        'image_id': 'a', 'file_name': 'a.png', 'category_id': 1, 'score': 0.5,
        'rbox': [5, 3, 8, 2, 0], 'poly': [1, 2, 9, 2, 9, 4, 1, 4],
    }]),
}  # fmt: skip
