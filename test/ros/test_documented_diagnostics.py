# SPDX-License-Identifier: Apache-2.0
"""Every key that a node publishes on /diagnostics is explained on its page."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from harness import ChipNode
from harness import Converter
from harness import OverlayNode
from harness import Site
from harness import unexplained
from harness import values_of
from lifecycle_msgs.msg import Transition
from ships import detections
from ships import fleet
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.nodes.lifecycle.node_topics import message_class

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

NAN, OUTSIDE = (np.nan, 0.0, 1.0, 1.0, 0.0), (1e6, 1e6, 10.0, 5.0, 0.0)


def test_every_key_of_the_conversion_node_is_explained(start: Callable[..., Converter]) -> None:
    node = start()
    node.connect()
    answers: list[Any] = node.peer.collect(Detection2DArray, 'crop_regions')
    # The node may know of the subscriber of crop regions a little later.
    node.send_until(
        lambda: node.send(detections(fleet(3))),
        lambda: node.counts()['messages_without_image_size'],
        'a message without image size',
    )
    node.set(
        {
            'image_width': 1000,
            'image_height': 1000,
            'crop.compare_outer': True,
            'crop.merge_max_size': 1000,
            'crop.max_count': 1,
            'class_ids': ['tug'],
        }
    )
    node.connect(answers)
    node.convert(detections([*fleet(50), NAN, OUTSIDE]))
    node.set({'invalid_policy': 'keep', 'crop.max_count': 0, 'crop.max_pixels': 1})
    node.publisher.publish(b'\0\1\0\0' + bytes(5))
    node.convert(detections([*fleet(3), NAN]))
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    node.send(detections(fleet(3)))
    node.wait(lambda: node.counts()['messages_while_inactive'], 'a message while inactive')
    keys = values_of(node.next_report())
    assert {
        'messages_unreadable',
        'messages_without_image_size',
        'detections_kept.not_finite',
        'crop_pixels.saved_percent',
        'crops_merged_away',
        'crops_left_out.max_count',
    } <= set(keys)
    assert not unexplained(keys, 'obb_to_hbb.md')


def test_every_key_of_the_chip_node_is_explained(site: Site) -> None:
    parameters = {'codec': 'png', 'cache.max_age': 60.0, 'budget.max_chips': 2}
    with ChipNode(site, parameters) as node:
        node.connect()
        pixels = np.zeros((8, 8), np.uint8)
        node.send(pixels, 'mono8', [(0, 0, 4, 4), (100, 100, 104, 104), *[(0, 0, 8, 8)] * 3])
        node.send(pixels, 'strange', [(0, 0, 4, 4)])
        node.images.publish(b'\0\1\0\0' + bytes(5))
        node.send_plan([(0, 0, 4, 4)], node.stamp())
        node.wait(
            lambda: (
                node.counts()['chips_dropped.image_refused']
                and node.counts()['messages_unreadable']
            ),
            'the frames',
        )
        # Not before, as image and plan of a frame may come with a pause.
        node.set({'cache.max_age': 0.5})
        node.wait(lambda: node.counts()['chips_dropped.crop_plan_expired'], 'a lonely plan')
        assert not node.counts()['chips_waiting']
        keys = node.counts()
        assert {
            'messages_unreadable',
            'chips_dropped.image_refused',
            'chips_dropped.frame_max_chips',
            'chips_dropped.outside_image',
            'crop_plans_dropped.expired',
            'budget_available',
        } <= set(keys)
        assert not unexplained(keys, 'chip_extractor.md')


def test_every_key_of_the_overlay_node_is_explained(site: Site) -> None:
    has_foxglove = bool(find_spec('foxglove_msgs'))
    parameters = {'max_wait': 0.1, 'max_age': 0.1, 'annotations': has_foxglove}
    with OverlayNode(site, parameters) as node:
        if has_foxglove:
            kind = message_class('foxglove_msgs', 'ImageAnnotations')
            node.peer.collect(kind, 'overlay/annotations')
        node.connect('boxes', 'crop_regions')
        pixels = np.zeros((8, 8), np.uint8)
        node.send_layer('boxes', [OUTSIDE], node.header())
        node.send(pixels, boxes=[NAN, *[(4.0, 4.0, 2.0, 2.0, 0.0)] * 2])
        node.send(pixels, 'strange')
        node.publish('image', b'\0\1\0\0' + bytes(5))
        node.wait(lambda: node.counts()['frames_dropped.no_image'], 'a lonely layer')
        if has_foxglove:
            node.wait(lambda: node.counts()['annotations_sent'], 'annotations')
        keys = values_of(node.next_report())
        assert {
            'messages_unreadable',
            'images_refused',
            'layers_missing.crop_regions',
            'watched',
            'boxes_not_drawn',
            'labels_left_out',
            'latency_p50_ms',
        } <= set(keys)
        assert not unexplained(keys, 'overlay.md')
