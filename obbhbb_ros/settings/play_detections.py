# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `play_detections`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels.image_labels import BOW_SOURCES
from obbhbb_ros.labels.image_labels import BowSource
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT
from obbhbb_ros.wire.layouts import INPUT_TYPES


@dataclass(frozen=True)
class PlayerSettings:
    """What may change while the player runs."""

    loop: bool
    images: bool
    frame_id: str
    bow: BowSource


def _settings(values: Mapping[str, Any]) -> PlayerSettings:
    """Make settings for `play_detections`."""
    if bool(values['image_width']) != bool(values['image_height']):
        raise ValueError('image_width and image_height must be given together')
    return PlayerSettings(values['loop'], values['images'], values['frame_id'], values['bow'])


PLAY_DETECTIONS = ParameterTable(
    (
        Parameter(
            'path',
            '',
            'Label file, or folder of label files (empty: a synthetic harbour).',
            read_only=True,
        ),
        Parameter(
            'format',
            '',
            'Format of the labels (empty: detected).',
            choices=('', *FORMATS),
            read_only=True,
        ),
        Parameter('rate', 1.0, 'Images per second.', 0.001, 10000.0, read_only=True),
        Parameter('loop', False, 'Start again after the last image, instead of ending.'),
        Parameter(
            'output_type',
            next(iter(INPUT_TYPES)),
            'Message type; the topic is '
            + ', '.join(f'`{each.topic}` for {each.name}' for each in INPUT_TYPES.values())
            + '. A PolygonStamped holds one box.',
            choices=tuple(INPUT_TYPES),
            read_only=True,
        ),
        Parameter(
            'bow',
            'none',
            'Angles point to the bow: where labels say so, or to the first edge of every box. For '
            'heading of obb_to_hbb.',
            choices=BOW_SOURCES,
        ),
        Parameter(
            'images',
            True,
            'Publish the images on `image` too, if they lie beside the labels, or in images/ '
            'where the labels lie in labels/. Needs Pillow.',
        ),
        Parameter('frame_id', 'camera', 'frame_id of every header.'),
        Parameter(
            'image_width',
            0,
            'Width of every image, pixels (0: from the labels or images).',
            0,
            IMAGE_SIZE_LIMIT,
            read_only=True,
        ),
        Parameter(
            'image_height',
            0,
            'Height of every image, pixels (0: from the labels or images).',
            0,
            IMAGE_SIZE_LIMIT,
            read_only=True,
        ),
        Parameter(
            'wait_for_subscribers',
            1,
            'Wait for this many subscribers before the first image, so that it is not lost.',
            0,
            1000,
            read_only=True,
        ),
    ),
    _settings,
)
"""Parameters of the node `play_detections`."""
