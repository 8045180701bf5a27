# SPDX-License-Identifier: Apache-2.0
"""
The nodes' parameters as plain data, and the settings that they amount to. No ROS in here.

Each parameter is one row of a table: name, default, meaning, range. Declaration, descriptors,
validation, the YAML files in `config/` and the tables in `doc/` all follow from it. Values are
validated as a whole before any is applied: a set that is rejected changes nothing.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import fields
from dataclasses import replace
from typing import Any
from typing import Generic
from typing import TypeVar

import numpy as np

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.pairing import PairingLimits
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import F_RANGE
from obbhbb_ros.geometry.converter import Q_RANGE
from obbhbb_ros.geometry.converter import S_RANGE
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.input_frame import FITS
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.overlay.collector import CollectorLimits
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.parameter_file import Value
from obbhbb_ros.spool.release import ReleaseSettings
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT
from obbhbb_ros.wire.layouts import INPUT_TYPES

SettingsT = TypeVar('SettingsT')

# Each declares nine parameters
MOST_CLASSES = 256
# The largest integer that Qt's tools take, rqt_reconfigure among them.
INT_LIMIT = 2**31 - 1
_MOST_BYTES = 1e12

# What the middleware keeps through a stall, 1.6 s of images at 10 Hz, and then hands over at once,
# images and plans in any order: the cache holds as much.
IMAGES_KEPT = 16
PLANS_KEPT = 100


@dataclass(frozen=True)
class Parameter:
    """
    One row of a parameter table.

    Attributes
    ----------
    name : str
        Parameter name; `<id>` in it stands for each class id.
    default : bool, int, float, str, or a list of str or float that is not empty
        Its type is the parameter's type.
    meaning : str
        One sentence with the unit.
    low, high : float, optional
        Bounds of a number, both included.
    choices : tuple of str
        Allowed strings; any where empty.
    read_only : bool
        Whether it can only be given at start.
    """

    name: str
    default: Value
    meaning: str
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = False

    @property
    def type_name(self) -> str:
        """Name of the type in ROS documentation."""
        if isinstance(self.default, list):
            return 'double[]' if isinstance(self.default[0], float) else 'string[]'
        return {bool: 'bool', int: 'int', float: 'double', str: 'string'}[type(self.default)]

    @property
    def range_text(self) -> str:
        """The accepted values, for people."""
        if self.choices:
            return ', '.join(f'`{choice}`' if choice else '`""`' for choice in self.choices)
        if self.low is None or self.high is None:
            return ''
        return f'{self.low:.10g} to {self.high:.10g}'

    def check(self, value: Value) -> None:
        """
        Check one value.

        Raises
        ------
        ValueError
            If it has another type than the default, is out of range, or is none of the choices;
            the message names the parameter.
        """
        if not self._has_type(value):
            raise ValueError(f'{self.name} must be a {self.type_name}, not {value!r}')
        if self.choices and value not in self.choices:
            raise ValueError(f'{self.name} must be one of {self.range_text}, not {value!r}')
        if self.low is None or self.high is None or isinstance(value, (str, list)):
            return
        if math.isnan(value) or not self.low <= value <= self.high:
            raise ValueError(f'{self.name} must be {self.range_text}, not {value}')

    def _has_type(self, value: Value) -> bool:
        """Tell whether a value has the type of the default, in a list each of its elements."""
        if isinstance(value, list) and isinstance(self.default, list):
            return all(type(each) is type(self.default[0]) for each in value)
        return type(value) is type(self.default)


@dataclass(frozen=True)
class ParameterTable(Generic[SettingsT]):
    """
    The parameters of a node.

    Attributes
    ----------
    rows : tuple of Parameter
        Parameters that are always there.
    build : callable
        Makes settings of all values by name; raises ValueError where they do not fit together.
    class_rows : tuple of Parameter
        Parameters of each class in `class_ids`, with `<id>` in their names.
    """

    rows: tuple[Parameter, ...]
    build: Callable[[Mapping[str, Any]], SettingsT]
    class_rows: tuple[Parameter, ...] = ()

    def parameters(self, class_ids: Iterable[str] = ()) -> dict[str, Parameter]:
        """List all parameters by name, those of some classes included."""
        own = (
            replace(row, name=row.name.replace('<id>', class_id))
            for class_id in class_ids
            for row in self.class_rows
        )
        return {row.name: row for row in (*self.rows, *own)}

    def class_ids(self, values: Mapping[str, Value]) -> list[str]:
        """
        List the classes with parameters of their own.

        Raises
        ------
        ValueError
            If there are more than `MOST_CLASSES`.
        """
        listed = values.get('class_ids', [])
        names = listed if isinstance(listed, list) else []
        found = [class_id for class_id in names if class_id and isinstance(class_id, str)]
        if len(found) > MOST_CLASSES:
            raise ValueError(f'class_ids has {len(found)} classes, the maximum is {MOST_CLASSES}')
        return found

    def mentioned_classes(self, names: Iterable[str]) -> list[str]:
        """List the class ids in some parameter names."""
        found: dict[str, None] = {}
        for row in self.class_rows:
            before, _, after = row.name.partition('<id>')
            for name in names:
                long_enough = len(name) > len(before) + len(after)
                if long_enough and name.startswith(before) and name.endswith(after):
                    found.setdefault(name[len(before) : len(name) - len(after)])
        return list(found)

    def settings(self, values: Mapping[str, Value]) -> SettingsT:
        """
        Check values, each by itself and all together, and make settings of them.

        Parameters
        ----------
        values : mapping of str to value
            Values by parameter name; the default is taken where there is none.

        Returns
        -------
        SettingsT
            The settings.

        Raises
        ------
        ValueError
            If a value cannot be used; the message names the parameter.
        """
        parameters = self.parameters(self.class_ids(values))
        complete = {
            name: values.get(name, parameter.default) for name, parameter in parameters.items()
        }
        for name, value in complete.items():
            parameters[name].check(value)
        return self.build(complete)


AUTOSTART = Parameter(
    'autostart',
    True,
    'Configure and activate the node at start. If false, a lifecycle manager does it.',
    read_only=True,
)
LOCK = Parameter(
    'lock_parameters',
    False,
    'Refuse every parameter change after start. Anyone on the DDS domain can make one.',
    read_only=True,
)
INPUT_TIMEOUT = Parameter(
    'input_timeout',
    0.0,
    'Seconds without input after which the diagnostics report ERROR, and after three times as long '
    'STALE (0: never).',
    0.0,
    1e6,
)
HARDWARE_ID = Parameter(
    'hardware_id',
    '',
    "hardware_id in the diagnostics (empty: the node's full name).",
)
STATE_PATH = Parameter(
    'state.path',
    '',
    'File that tells the next run how this one ended, and its counters, as an absolute path; each '
    'node needs one of its own (empty: none).',
    read_only=True,
)
WATCHDOG = Parameter(
    'watchdog_timeout',
    0.0,
    'Seconds without a turn of the executor, 2 or more, after which the process ends with exit '
    'code 70, to be started again (0: never).',
    0.0,
    1e6,
    read_only=True,
)
_INPUT_TYPE = Parameter(
    'input_type',
    next(iter(INPUT_TYPES)),
    'Message type of the input; the topic is '
    + ', '.join(f'`{each.topic}` for {each.name}' for each in INPUT_TYPES.values())
    + '.',
    choices=tuple(INPUT_TYPES),
    read_only=True,
)
_INPUT_COORDINATES = (
    Parameter(
        'angle_unit', 'rad', 'Unit of bbox.center.theta in the input.', choices=('rad', 'deg')
    ),
    Parameter(
        'input_width',
        0,
        "Width of the network's input, pixels, if detections are in its coordinates.",
        0,
        IMAGE_SIZE_LIMIT,
    ),
    Parameter(
        'input_height',
        0,
        "Height of the network's input, pixels, if detections are in its coordinates.",
        0,
        IMAGE_SIZE_LIMIT,
    ),
    Parameter(
        'input_fit',
        'none',
        'How the image was fitted to the input of the network: not at all, stretched, or '
        'scaled with equal margins on two sides.',
        choices=FITS,
    ),
)


@dataclass(frozen=True)
class Settings:
    """
    What one message is converted under.

    Attributes
    ----------
    rules : tuple of HullRule
        The rules in use; the first is for every class that has none of its own.
    rule_of_class : mapping of str to int
        Index into `rules` of each class with a rule of its own.
    caps : Caps
        Bounds of the boxes, pixels.
    image_size : tuple of int
        Width and height as parameters give them, pixels; 0 where they leave it to `camera_info`.
    theta_scale : float
        Factor from the input's angle unit to radians.
    bow : bool
        Whether the angles of the input point to the bow.
    input_frame : InputFrame
        Coordinates of the input.
    clip_boxes : bool
        Whether boxes end at the border of the image.
    keep_invalid : bool
        Whether detections that cannot be converted are passed on unchanged.
    crop : CropSettings
        How boxes become crop regions.
    crop_rules : tuple of HullRule or None
        The hulls that crop regions enclose besides the boxes, in the order of `rules`; empty if
        there are none.
    weights, min_scores : ndarray, shape (number of rules,)
        Factor on the score of a detection, and minimum score for a crop region, by rule.
    compare_outer : bool
        Whether the crop plan is compared with that of the outer boxes.
    """

    rules: tuple[HullRule, ...]
    rule_of_class: Mapping[str, int]
    caps: Caps
    image_size: tuple[int, int]
    theta_scale: float
    bow: bool
    input_frame: InputFrame
    clip_boxes: bool
    keep_invalid: bool
    crop: CropSettings
    crop_rules: tuple[HullRule | None, ...]
    weights: FloatArray
    min_scores: FloatArray
    compare_outer: bool


def _settings(values: Mapping[str, Any]) -> Settings:
    """Make settings for `obb_to_hbb`."""
    rules = [_rule(values)]
    crop_qs, weights, min_scores = [values['crop.q']], [1.0], [values['crop.min_score']]
    rule_of_class = {}
    for class_id in filter(None, values['class_ids']):
        rule_of_class[class_id] = len(rules)
        prefix = f'classes.{class_id}.'
        rules.append(_rule(values, prefix))
        crop_qs.append(values[f'{prefix}crop_q'] or values['crop.q'])
        weights.append(values[f'{prefix}weight'])
        min_scores.append(values[f'{prefix}min_score'] or values['crop.min_score'])
    return Settings(
        rules=tuple(rules),
        rule_of_class=rule_of_class,
        caps=_caps(values),
        image_size=(values['image_width'], values['image_height']),
        theta_scale=_theta_scale(values),
        bow=values['heading'] == 'theta',
        input_frame=_input_frame(values),
        clip_boxes=values['clip_boxes'],
        keep_invalid=values['invalid_policy'] == 'keep',
        crop=_group(CropSettings, values, 'crop.'),
        crop_rules=_crop_rules(crop_qs),
        weights=np.array(weights),
        min_scores=np.array(min_scores),
        compare_outer=values['crop.compare_outer'],
    )


def _theta_scale(values: Mapping[str, Any]) -> float:
    """Return the factor from the input's angle unit to radians."""
    return math.pi / 180.0 if values['angle_unit'] == 'deg' else 1.0


def _input_frame(values: Mapping[str, Any]) -> InputFrame:
    """Make the coordinates of the input."""
    return InputFrame((values['input_width'], values['input_height']), values['input_fit'])


def _rule(values: Mapping[str, Any], prefix: str = '') -> HullRule:
    """Make the rule of the node, or of a class; the node's values apply where it has none."""
    own = {field.name: values[field.name] for field in fields(HullRule)}
    if prefix:
        own = {name: values[prefix + name] or value for name, value in own.items()}
    for name in ('q_bow', 'q_stern'):
        own[name] = own[name] or None
    try:
        return HullRule(**own)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None


def _crop_rules(qs: Sequence[float]) -> tuple[HullRule | None, ...]:
    """Make the hulls that crop regions enclose, None where they enclose the box alone."""
    try:
        rules = tuple(HullRule(q=q) if q else None for q in qs)
    except ValueError as error:
        raise ValueError(f'crop.q or crop_q of a class: {error}, or 0') from None
    return rules if any(rules) else ()


def _caps(values: Mapping[str, Any]) -> Caps:
    """Turn the caps into pixels."""
    metres_per_pixel = values['ground_sample_distance'] or 1.0
    return Caps(
        *(
            values[name] / metres_per_pixel if values[name] else None
            for name in ('max_length', 'max_width')
        )
    )


def _group(group: Any, values: Mapping[str, Any], prefix: str) -> Any:
    """Make a dataclass of the values under a prefix."""
    own = {field.name: values[prefix + field.name] for field in fields(group)}
    try:
        return group(**own)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None


OBB_TO_HBB = ParameterTable(
    (
        AUTOSTART,
        LOCK,
        INPUT_TIMEOUT,
        HARDWARE_ID,
        STATE_PATH,
        WATCHDOG,
        _INPUT_TYPE,
        Parameter('method', HullRule.method, 'Conversion rule.', choices=ONBOARD_METHODS),
        Parameter(
            'q',
            HullRule.q,
            'Shape exponent of the hull: 1 is a rhombus, 2 an ellipse, .inf the rectangle.',
            *Q_RANGE,
        ),
        Parameter(
            'f', HullRule.f, 'Fullness: factor on the half-width of the hull, above 0.', *F_RANGE
        ),
        Parameter(
            's', HullRule.s, 'Shrink factor on the half-extents of the box, above 0.', *S_RANGE
        ),
        Parameter(
            'heading',
            'none',
            'theta: the angles of the input point to the bow, full circle, and q_bow and q_stern '
            'shape the two ends of the hull.',
            choices=('none', 'theta'),
        ),
        Parameter(
            'q_bow',
            0.0,
            'Shape exponent of the end with the bow, 1 or more (0: q). Only with heading.',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'q_stern',
            0.0,
            'Shape exponent of the other end, 1 or more (0: q). Only with heading.',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'max_length',
            0.0,
            'Maximum of the longer side of a box, pixels, or metres with ground_sample_distance '
            '(0: unlimited).',
            0.0,
            math.inf,
        ),
        Parameter(
            'max_width',
            0.0,
            'Maximum of the shorter side of a box, pixels, or metres with ground_sample_distance '
            '(0: unlimited).',
            0.0,
            math.inf,
        ),
        Parameter(
            'ground_sample_distance',
            0.0,
            'Metres per pixel; if above 0, max_length and max_width are in metres.',
            0.0,
            1e6,
        ),
        Parameter(
            'class_ids',
            [''],
            f'Classes with parameters of their own, under classes.<id>, {MOST_CLASSES} at most; '
            'empty strings are ignored.',
        ),
        Parameter(
            'image_width',
            0,
            'Width of the image, pixels (0: taken from `camera_info`).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'image_height',
            0,
            'Height of the image, pixels (0: taken from `camera_info`).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        *_INPUT_COORDINATES,
        Parameter(
            'clip_boxes',
            False,
            'Clip boxes to the image; those outside cannot be converted, see invalid_policy.',
        ),
        Parameter(
            'invalid_policy',
            'drop',
            'Detections that cannot be converted are dropped, or kept unchanged.',
            choices=('drop', 'keep'),
        ),
        Parameter(
            'crop.q',
            5.0,
            'Crop regions also enclose the superellipse of this shape exponent, 1 or more, so that '
            'the hull is kept (0: the box alone).',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'crop.min_score',
            0.0,
            'Minimum score of a detection with a crop region (0: any).',
            0.0,
            1e6,
        ),
        Parameter(
            'crop.padding',
            0.0,
            'Margin on each side of a crop region, as a fraction of the box along that axis.',
            0.0,
            100.0,
        ),
        Parameter(
            'crop.padding_px',
            0.0,
            'Margin on each side of a crop region, pixels, added to that of crop.padding.',
            0.0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'crop.min_size',
            0,
            'Minimum side of a crop region, pixels; smaller regions grow (0: none).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'crop.max_size',
            0,
            'Maximum side of a crop region, pixels; larger regions are cut (0: unlimited).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'crop.multiple_of',
            0,
            'Sides of crop regions are multiples of this, pixels, as the blocks of a codec are; '
            'except for a side as long as the image (0: any).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'crop.merge_max_size',
            0,
            'Crop regions are merged where that saves pixels, up to this side, pixels '
            '(0: never merged).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'crop.max_count',
            0,
            'Maximum crop regions per message, most valuable first (0: unlimited).',
            0,
            IMAGE_SIZE_LIMIT,
        ),
        Parameter(
            'crop.max_pixels',
            0,
            'Maximum pixels in the crop regions of a message, most valuable first (0: unlimited).',
            0,
            INT_LIMIT,
        ),
        Parameter(
            'crop.compare_outer',
            False,
            'Also plan the crops of the outer boxes, and report in the diagnostics how many '
            'pixels are saved against them.',
        ),
    ),
    _settings,
    (
        Parameter(
            'classes.<id>.method',
            '',
            'Conversion rule for this class (empty: that of the node).',
            choices=('', *ONBOARD_METHODS),
        ),
        Parameter(
            'classes.<id>.q',
            0.0,
            'Shape exponent for this class, 1 or more (0: that of the node).',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'classes.<id>.q_bow',
            0.0,
            'q_bow for this class (0: that of the node).',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'classes.<id>.q_stern',
            0.0,
            'q_stern for this class (0: that of the node).',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'classes.<id>.f', 0.0, 'Fullness for this class (0: that of the node).', *F_RANGE
        ),
        Parameter(
            'classes.<id>.s', 0.0, 'Shrink factor for this class (0: that of the node).', *S_RANGE
        ),
        Parameter(
            'classes.<id>.crop_q',
            0.0,
            'crop.q for this class (0: that of the node).',
            0.0,
            Q_RANGE[1],
        ),
        Parameter(
            'classes.<id>.min_score',
            0.0,
            'crop.min_score for this class (0: that of the node).',
            0.0,
            1e6,
        ),
        Parameter(
            'classes.<id>.weight',
            1.0,
            'Factor on the scores of this class when crop regions are ranked (0: no regions).',
            0.0,
            1e6,
        ),
    ),
)
"""Parameters of the node `obb_to_hbb`."""


@dataclass(frozen=True)
class ChipSettings:
    """What one image is cut under: encoding, budget, how long its parts may wait, and the spool."""

    codec: CodecSettings
    budget: BudgetSettings
    pairing: PairingLimits
    spool_path: str
    spool_max_bytes: float


def _chip_settings(values: Mapping[str, Any]) -> ChipSettings:
    """Make settings for `chip_extractor`."""
    return ChipSettings(
        codec=_group(CodecSettings, values, ''),
        budget=_group(BudgetSettings, values, 'budget.'),
        pairing=PairingLimits(
            (values['cache.images'], values['cache.regions']),
            values['cache.max_age'],
            values['cache.slop'],
        ),
        spool_path=_folder(values, 'spool.path'),
        spool_max_bytes=values['spool.max_bytes'],
    )


LINK = (
    Parameter(
        'budget.bytes_per_second',
        0.0,
        'Rate of the link, bytes per second (0: unlimited).',
        0.0,
        _MOST_BYTES,
    ),
    Parameter(
        'budget.burst',
        0.0,
        'Maximum bytes sent at once after a pause (0: one second at the rate of the link).',
        0.0,
        _MOST_BYTES,
    ),
    Parameter(
        'budget.overhead',
        0,
        'Bytes that each chip costs the link besides its file.',
        0,
        1_000_000,
    ),
)
"""Parameters of the link, in every node that sends something over it."""

CHIP_EXTRACTOR = ParameterTable(
    (
        AUTOSTART,
        LOCK,
        INPUT_TIMEOUT,
        HARDWARE_ID,
        STATE_PATH,
        WATCHDOG,
        Parameter('codec', CodecSettings.codec, 'File format of the chips.', choices=tuple(CODECS)),
        Parameter(
            'quality',
            CodecSettings.quality,
            'Quality of jpeg and webp; for jpeg2000, percent of the size of the raw pixels.',
            1,
            100,
        ),
        Parameter(
            'lossless',
            CodecSettings.lossless,
            'Lossless compression; for webp and jpeg2000. png always is lossless.',
        ),
        *LINK,
        Parameter('budget.max_chips', 0, 'Maximum chips per image (0: unlimited).', 0, 1_000_000),
        Parameter('budget.max_bytes', 0, 'Maximum bytes per image (0: unlimited).', 0, INT_LIMIT),
        Parameter(
            'budget.min_quality',
            0,
            'A chip that does not fit is encoded again, down to this quality (0: dropped at once).',
            0,
            100,
        ),
        Parameter(
            'cache.images',
            IMAGES_KEPT,
            'Maximum images that wait for their regions; the oldest is dropped first.',
            1,
            1000,
        ),
        Parameter(
            'cache.regions',
            PLANS_KEPT,
            'Maximum crop plans that wait for their image; the oldest is dropped first.',
            1,
            100_000,
        ),
        Parameter(
            'cache.max_age',
            2.0,
            'How long images and crop plans wait for each other, seconds.',
            0.0,
            3600.0,
        ),
        Parameter(
            'cache.slop',
            0.0,
            'Maximum difference between the stamps of an image and its crop plan, seconds.',
            0.0,
            3600.0,
        ),
        Parameter(
            'spool.path',
            '',
            'Folder in which every planned chip is stored for the node downlink (empty: none).',
            read_only=True,
        ),
        Parameter(
            'spool.max_bytes',
            1e9,
            'Maximum size of the spool, bytes; the least valuable chips are evicted first '
            '(0: unlimited).',
            0.0,
            _MOST_BYTES,
        ),
    ),
    _chip_settings,
)
"""Parameters of the node `chip_extractor`."""


@dataclass(frozen=True)
class DownlinkSettings:
    """Where chips are released from and to, and how."""

    spool_path: str
    outbox_path: str
    always_in_contact: bool
    release: ReleaseSettings


def _folder(values: Mapping[str, Any], name: str) -> str:
    """Return the folder that a parameter names; empty if it names none."""
    path = os.path.expanduser(values[name].strip())
    if path and not os.path.isabs(path):
        raise ValueError(f'{name} must be an absolute path, not {path}')
    return os.path.normpath(path) if path else ''


def _downlink_settings(values: Mapping[str, Any]) -> DownlinkSettings:
    """Make settings for `downlink`."""
    spool, outbox = (_folder(values, name) for name in ('spool.path', 'outbox.path'))
    for name, path in (('spool.path', spool), ('outbox.path', outbox)):
        if not path:
            raise ValueError(f'{name} is missing: name a folder')
    if os.path.commonpath((spool, outbox)) in (spool, outbox):
        raise ValueError(f'outbox.path and spool.path must be apart, not {outbox} and {spool}')
    levels = values['outbox.levels']
    if any(math.isnan(level) for level in levels):
        raise ValueError('outbox.levels must be numbers, not nan')
    return DownlinkSettings(
        spool_path=spool,
        outbox_path=outbox,
        always_in_contact=values['contact'] == 'always',
        release=ReleaseSettings(
            budget=BudgetSettings(
                values['budget.bytes_per_second'],
                values['budget.burst'],
                values['budget.overhead'],
            ),
            levels=tuple(levels),
            removal=values['acknowledge'] == 'removal',
            max_bytes=values['outbox.max_bytes'],
        ),
    )


DOWNLINK = ParameterTable(
    (
        AUTOSTART,
        LOCK,
        HARDWARE_ID,
        STATE_PATH,
        WATCHDOG,
        Parameter(
            'contact',
            'always',
            'When chips are released: always, or while the topic `contact` says so.',
            choices=('always', 'topic'),
        ),
        Parameter(
            'acknowledge',
            'release',
            'When a chip counts as delivered: on its release into the outbox, or on its removal '
            'from there.',
            choices=('release', 'removal'),
        ),
        *LINK,
        Parameter(
            'spool.path', '', 'Folder in which chip_extractor stores the chips.', read_only=True
        ),
        Parameter('outbox.path', '', 'Folder from which the bus takes the chips.', read_only=True),
        Parameter(
            'outbox.levels',
            [0.0],
            'Value thresholds of the priority folders: a chip goes into the folder with the number '
            'of thresholds above its value, 0 for the most valuable.',
        ),
        Parameter(
            'outbox.max_bytes',
            1e9,
            'Maximum bytes in the outbox; when it is full, chips wait in the spool (0: unlimited).',
            0.0,
            _MOST_BYTES,
        ),
    ),
    _downlink_settings,
)
"""Parameters of the node `downlink`."""


@dataclass(frozen=True)
class OverlaySettings:
    """
    What one image is drawn under.

    Attributes
    ----------
    colors : mapping of str to str
        The layers that are drawn and their colours, '#rrggbb', the first below the others.
    style : Style
        How they are drawn.
    theta_scale : float
        Factor from the input's angle unit to radians.
    input_frame : InputFrame
        Coordinates of the detections.
    limits : CollectorLimits
        For how long an image waits for its layers.
    """

    colors: Mapping[str, str]
    style: Style
    theta_scale: float
    input_frame: InputFrame
    limits: CollectorLimits


def _overlay_settings(values: Mapping[str, Any]) -> OverlaySettings:
    """Make settings for `overlay`."""
    layers = [layer for layer in values['layers'] if layer]
    unknown = ', '.join(layer for layer in layers if layer not in LAYER_COLORS)
    if unknown:
        raise ValueError(f'layers can be {", ".join(LAYER_COLORS)}, not {unknown}')
    colors = {layer: values[f'color.{layer}'] for layer in layers}
    for layer, color in colors.items():
        if not re.fullmatch('#[0-9a-fA-F]{6}', color):
            raise ValueError(f'color.{layer} must be #rrggbb, not {color!r}')
    return OverlaySettings(
        colors=colors,
        style=_group(Style, values, ''),
        theta_scale=_theta_scale(values),
        input_frame=_input_frame(values),
        limits=CollectorLimits(values['max_wait'], values['max_age'], values['max_images']),
    )


OVERLAY = ParameterTable(
    (
        AUTOSTART,
        LOCK,
        INPUT_TIMEOUT,
        HARDWARE_ID,
        STATE_PATH,
        WATCHDOG,
        _INPUT_TYPE,
        *_INPUT_COORDINATES,
        Parameter(
            'layers',
            list(LAYER_COLORS),
            'What is drawn, the first below the others; empty strings are ignored.',
        ),
        Parameter(
            'labels',
            Style.labels,
            'Write class and score beside the detections, best score first, where there is room.',
        ),
        Parameter(
            'scale',
            Style.scale,
            'Size of the picture relative to the image; a small one suits a thin link.',
            0.01,
            1.0,
        ),
        Parameter('quality', Style.quality, 'Quality of the JPEG.', 1, 100),
        Parameter(
            'line_width',
            Style.line_width,
            'Line width, pixels of the picture (0: what suits its size).',
            0,
            1000,
        ),
        Parameter(
            'text_size',
            Style.text_size,
            'Text size, pixels of the picture (0: what suits its size).',
            0,
            500,
        ),
        Parameter(
            'max_wait',
            0.5,
            'How long an image waits for its layers, seconds; then it is drawn with those that are '
            'there.',
            0.0,
            60.0,
        ),
        Parameter(
            'max_age',
            5.0,
            'How long layers wait for their image, seconds; a large one takes a while to arrive.',
            0.0,
            3600.0,
        ),
        Parameter(
            'max_images',
            IMAGES_KEPT,
            'Maximum images that wait for their layers; the oldest is dropped first.',
            1,
            1000,
        ),
        *(
            Parameter(f'color.{layer}', color, f'Colour of {layer.replace("_", " ")}, #rrggbb.')
            for layer, color in LAYER_COLORS.items()
        ),
    ),
    _overlay_settings,
)
"""Parameters of the node `overlay`."""
