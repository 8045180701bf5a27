# SPDX-License-Identifier: Apache-2.0
"""Parameters and settings of the node `obb_to_hbb`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import fields
from typing import Any

import numpy as np

from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import F_RANGE
from obbhbb_ros.geometry.converter import Q_RANGE
from obbhbb_ros.geometry.converter import S_RANGE
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.geometry.methods import ONBOARD_METHODS
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.detection_input import DETECTION_INPUT
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.detection_input import theta_scale
from obbhbb_ros.settings.parameters import MAX_CLASSES
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterGroup
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import parameter_of
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT


@dataclass(frozen=True)
class ConversionSettings:
    """
    How one message is converted.

    Attributes
    ----------
    rules : tuple of HullRule
        The rules; the first applies to classes without a rule of their own.
    rule_of_class : mapping of str to int
        Index into `rules` of each class with a rule of its own.
    caps : Caps
        Bounds of the boxes, pixels.
    image_size : tuple of int
        Width and height from the parameters, pixels; 0 where `camera_info` decides.
    theta_scale : float
        Factor from the input's angle unit to radians.
    bow : bool
        Whether the angles of the input point to the bow.
    input_frame : InputFrame
        Coordinates of the input.
    clip_boxes : bool
        Whether boxes are clipped to the image.
    keep_invalid : bool
        Whether detections that cannot be converted are published unchanged.
    crop : CropSettings
        How boxes become crop regions.
    crop_rules : tuple of HullRule or None
        The hulls that crop regions enclose in addition to the boxes, in the order of `rules`; empty
        if there are none.
    weights, min_scores : ndarray, shape (number of rules,)
        Factor on the score of a detection, and minimum score for a crop region, in the order of
        `rules`.
    compare_outer : bool
        Whether to compare the crop plan with that of the outer boxes.
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


_CROP = ParameterGroup(CropSettings, 'crop.')
# A class with this value for its crop regions has that of the node.
_OF_NODE = -1.0


def _conversion_settings(values: Mapping[str, Any]) -> ConversionSettings:
    """Make settings for `obb_to_hbb`."""
    class_ids = list(filter(None, values['class_ids']))
    prefixes = [f'classes.{class_id}.' for class_id in class_ids]
    min_scores = [_crop_value(values, prefix, 'min_score') for prefix in prefixes]
    return ConversionSettings(
        rules=(_rule(values), *(_rule(values, prefix) for prefix in prefixes)),
        rule_of_class={class_id: number for number, class_id in enumerate(class_ids, 1)},
        caps=_caps(values),
        image_size=(values['image_width'], values['image_height']),
        theta_scale=theta_scale(values),
        bow=values['heading'] == 'theta',
        input_frame=input_frame(values),
        clip_boxes=values['clip_boxes'],
        keep_invalid=values['invalid_policy'] == 'keep',
        crop=_CROP.build(values),
        crop_rules=_crop_rules(values, prefixes),
        weights=np.array([1.0, *(values[f'{prefix}weight'] for prefix in prefixes)]),
        min_scores=np.array([values['crop.min_score'], *min_scores]),
        compare_outer=values['crop.compare_outer'],
    )


def _rule(values: Mapping[str, Any], prefix: str = '') -> HullRule:
    """Make the rule of the node, or of a class, which has the node's values where it has none."""
    names = [field.name for field in fields(HullRule)]
    arguments = {name: values[prefix + name] or values[name] for name in names}
    for name in ('q_bow', 'q_stern'):
        arguments[name] = arguments[name] or None
    try:
        return HullRule(**arguments)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None


def _crop_value(values: Mapping[str, Any], prefix: str, name: str) -> float:
    """Return the minimum score or shape exponent for the crop regions of a class."""
    value: float = values[prefix + name]
    if _OF_NODE < value < 0.0:
        raise ValueError(f'{prefix}{name} must be -1, or 0 or more, not {value}')
    return values[f'crop.{name.removeprefix("crop_")}'] if value == _OF_NODE else value


def _crop_rules(values: Mapping[str, Any], prefixes: Sequence[str]) -> tuple[HullRule | None, ...]:
    """Make the hulls that crop regions enclose, None where they enclose the box alone."""
    qs = {f'{prefix}crop_q': _crop_value(values, prefix, 'crop_q') for prefix in prefixes}
    rules = []
    for name, q in {'crop.q': values['crop.q'], **qs}.items():
        if 0.0 < q < Q_RANGE.low:
            raise ValueError(f'{name} must be 0, or {Q_RANGE}, not {q}')
        rules.append(HullRule(q=q) if q else None)
    return tuple(rules) if any(rules) else ()


def _caps(values: Mapping[str, Any]) -> Caps:
    """Return the caps in pixels."""
    metres_per_pixel = values['ground_sample_distance'] or 1.0
    return Caps(
        *(
            values[name] / metres_per_pixel if values[name] else None
            for name in ('max_length', 'max_width')
        )
    )


_ROWS = (
    *COMMON_WITH_INPUT,
    *DETECTION_INPUT,
    Parameter('method', HullRule.method, 'Conversion rule.', Choices(ONBOARD_METHODS)),
    *(parameter_of(HullRule, name) for name in ('q', 'f', 's')),
    Parameter(
        'heading',
        'none',
        "`theta`: theta is the ship's heading (full circle); q_bow and q_stern apply.",
        Choices(('none', 'theta')),
    ),
    *(
        Parameter(
            f'q_{end}',
            0.0,
            f'Shape exponent of the {end} end of the hull, 1 or more. Only with heading. 0: q.',
            Range(0.0, Q_RANGE.high),
        )
        for end in ('bow', 'stern')
    ),
    *(
        Parameter(
            f'max_{side}',
            0.0,
            f'Maximum {side} of a ship: limits the {longer} side of a box, pixels, or metres with '
            'ground_sample_distance. 0: unlimited.',
            Range(0.0, math.inf),
        )
        for side, longer in (('length', 'longer'), ('width', 'shorter'))
    ),
    Parameter(
        'ground_sample_distance',
        0.0,
        'Metres per pixel. If set, max_length and max_width are in metres. 0: unset.',
        Range(0.0, 1e6),
    ),
    Parameter(
        'class_ids',
        [''],
        f'Classes that have parameters of their own, `classes.<id>.*`, at most {MAX_CLASSES}. '
        'Empty strings are ignored.',
    ),
    *(
        Parameter(
            f'image_{side}',
            0,
            f'{side.capitalize()} of the image, pixels. 0: from `camera_info`.',
            Range(0, IMAGE_SIZE_LIMIT),
        )
        for side in ('width', 'height')
    ),
    Parameter(
        'clip_boxes',
        False,
        'Clip boxes to the image. Boxes outside it cannot be converted: see invalid_policy.',
    ),
    Parameter(
        'invalid_policy',
        'drop',
        'What to do with detections that cannot be converted: `drop` them, or `keep` them '
        'unchanged.',
        Choices(('drop', 'keep')),
    ),
    Parameter(
        'crop.q',
        5.0,
        'Crop regions also enclose the superellipse of this shape exponent, 1 or more, so that '
        'they contain the hull. 0: the box alone.',
        Range(0.0, Q_RANGE.high),
    ),
    *_CROP.rows,
    Parameter(
        'crop.compare_outer',
        False,
        'Also plan the crops of the outer boxes, and report in the diagnostics how many pixels are '
        'saved compared with them.',
    ),
)
_CLASS_ROWS = (
    Parameter(
        'classes.<id>.method',
        '',
        "method of this class. Empty: the node's.",
        Choices(('', *ONBOARD_METHODS)),
    ),
    *(
        Parameter(
            f'classes.<id>.{name}', 0.0, f"{name} of this class. 0: the node's.", Range(0.0, high)
        )
        for name, high in (
            *((name, Q_RANGE.high) for name in ('q', 'q_bow', 'q_stern')),
            ('f', F_RANGE.high),
            ('s', S_RANGE.high),
        )
    ),
    Parameter(
        'classes.<id>.crop_q',
        _OF_NODE,
        "crop.q of this class. -1: the node's, 0: the box alone.",
        Range(_OF_NODE, Q_RANGE.high),
    ),
    Parameter(
        'classes.<id>.min_score',
        _OF_NODE,
        "crop.min_score of this class. -1: the node's, 0: any score.",
        Range(_OF_NODE, 1e6),
    ),
    Parameter(
        'classes.<id>.weight',
        1.0,
        'Factor on the scores of this class when crop regions are ranked. 0: no crop regions.',
        Range(0.0, 1e6),
    ),
)
OBB_TO_HBB = ParameterTable(_ROWS, _conversion_settings, _CLASS_ROWS)
"""Parameters of the node `obb_to_hbb`."""
