# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `play_detections`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from obbhbb_ros.labels import FORMATS
from obbhbb_ros.labels.image_labels import BOW_SOURCES
from obbhbb_ros.labels.image_labels import BowSource
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.settings.detection_input import TOPICS
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import rows_of
from obbhbb_ros.settings.parameters import settings_of
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT
from obbhbb_ros.wire.layouts import INPUT_TYPES

_SIDE = Range(0, IMAGE_SIZE_LIMIT)


@dataclass(frozen=True)
class PlayerSettings(CheckedSettings):
    """What the player publishes, and how; ValueError if values are out of range or in conflict."""

    path: str = setting(
        '', 'Label file, or folder of label files. Empty: a synthetic harbour.', read_only=True
    )
    format: str = setting(
        '',
        'Format of the labels. Empty: detected from the files.',
        Choices(('', *FORMATS)),
        read_only=True,
    )
    rate: float = setting(1.0, 'Images per second.', Range(0.001, 10_000.0), read_only=True)
    loop: bool = setting(False, 'Start again after the last image, instead of ending.')
    output_type: str = setting(
        next(iter(INPUT_TYPES)),
        f'Message type. The topic is {TOPICS}. A PolygonStamped holds one box.',
        Choices(tuple(INPUT_TYPES)),
        read_only=True,
    )
    bow: BowSource = setting(
        'none',
        'Publish theta as the heading: from the `labels`, or assuming the `first-edge` of each '
        'box is the bow. Use with `heading: theta` of obb_to_hbb.',
        Choices(BOW_SOURCES),
    )
    images: bool = setting(
        True,
        'Also publish the images, on `image`, if they are in the folder of the labels, or in '
        'images/ beside a folder labels/. Needs Pillow.',
    )
    pass_height: int = setting(
        0,
        'Play a pass of a moving camera over every image: a window of this height moves down it, '
        'pixels. Detections then have no ids. 0: the whole image at once.',
        _SIDE,
        read_only=True,
    )
    pass_step: int = setting(
        40,
        'How far that window moves from image to image, pixels; not more than its height. The last '
        'step of an image may be shorter.',
        Range(1, IMAGE_SIZE_LIMIT),
        read_only=True,
    )
    pass_altitude: float = setting(
        0.0,
        'Altitude of that camera above the ellipsoid, metres: its pose is on `camera_pose`, its '
        'focal length in `camera_info`. It looks straight down and flies south. 0: no pose.',
        Range(0.0, 1e8),
        read_only=True,
    )
    pass_latitude: float = setting(
        0.0,
        'Latitude of the middle of every image, degrees. North is up in the image.',
        Range(-90.0, 90.0),
        read_only=True,
    )
    pass_longitude: float = setting(
        0.0,
        'Longitude of the middle of every image, degrees.',
        Range(-180.0, 180.0),
        read_only=True,
    )
    pass_ground_sample_distance: float = setting(
        1.0, 'Size of a pixel on the ground, metres.', Range(1e-4, 1e4), read_only=True
    )
    frame_id: str = setting('camera', 'frame_id of every header.')
    image_width: int = setting(
        0, 'Width of every image, pixels. 0: from the labels or images.', _SIDE, read_only=True
    )
    image_height: int = setting(
        0, 'Height of every image, pixels. 0: from the labels or images.', _SIDE, read_only=True
    )
    wait_for_subscribers: int = setting(
        1,
        'Wait for this many subscribers before publishing the first image, so that none misses it.',
        Range(0, 1000),
        read_only=True,
    )

    def __post_init__(self) -> None:
        """Check every value and their combination."""
        super().__post_init__()
        if bool(self.image_width) != bool(self.image_height):
            raise ValueError('image_width and image_height must be given together')
        if self.pass_height and self.pass_step > self.pass_height:
            raise ValueError('pass_step must not exceed pass_height: ships would be missed')
        if self.pass_altitude and not self.pass_height:
            raise ValueError('pass_altitude needs a pass: set pass_height')


PLAY_DETECTIONS = ParameterTable(rows_of(PlayerSettings), partial(settings_of, PlayerSettings))
"""Parameters of the node `play_detections`."""
