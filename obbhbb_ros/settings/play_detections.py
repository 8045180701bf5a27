# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `play_detections`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels.image_labels import BOW_SOURCES
from obbhbb_ros.labels.image_labels import BowSource
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.detection_input import TOPICS
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


def _player_settings(values: Mapping[str, Any]) -> PlayerSettings:
    """Make settings for `play_detections`."""
    if bool(values['image_width']) != bool(values['image_height']):
        raise ValueError('image_width and image_height must be given together')
    return PlayerSettings(values['loop'], values['images'], values['frame_id'], values['bow'])


PLAY_DETECTIONS = ParameterTable(
    (
        Parameter(
            'path',
            '',
            'Label file, or folder of label files. Empty: a synthetic harbour.',
            read_only=True,
        ),
        Parameter(
            'format',
            '',
            'Format of the labels. Empty: detected from the files.',
            Choices(('', *FORMATS)),
            read_only=True,
        ),
        Parameter('rate', 1.0, 'Images per second.', Range(0.001, 10_000.0), read_only=True),
        Parameter('loop', False, 'Start again after the last image, instead of ending.'),
        Parameter(
            'output_type',
            next(iter(INPUT_TYPES)),
            f'Message type. The topic is {TOPICS}. A PolygonStamped holds one box.',
            Choices(tuple(INPUT_TYPES)),
            read_only=True,
        ),
        Parameter(
            'bow',
            'none',
            'Publish theta as the heading: from the `labels`, or assuming the `first-edge` of each '
            'box is the bow. Use with `heading: theta` of obb_to_hbb.',
            Choices(BOW_SOURCES),
        ),
        Parameter(
            'images',
            True,
            'Also publish the images, on `image`, if they are in the folder of the labels, or in '
            'images/ beside a folder labels/. Needs Pillow.',
        ),
        Parameter('frame_id', 'camera', 'frame_id of every header.'),
        *(
            Parameter(
                f'image_{side}',
                0,
                f'{side.capitalize()} of every image, pixels. 0: from the labels or images.',
                Range(0, IMAGE_SIZE_LIMIT),
                read_only=True,
            )
            for side in ('width', 'height')
        ),
        Parameter(
            'wait_for_subscribers',
            1,
            'Wait for this many subscribers before publishing the first image, so that none misses '
            'it.',
            Range(0, 1000),
            read_only=True,
        ),
    ),
    _player_settings,
)
"""Parameters of the node `play_detections`."""
