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
from obbhbb_ros.settings.common import COMMON
from obbhbb_ros.settings.common import INPUT_TIMEOUT
from obbhbb_ros.settings.detection_input import INPUT_COORDINATES
from obbhbb_ros.settings.detection_input import INPUT_TYPE
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.detection_input import theta_scale
from obbhbb_ros.settings.parameters import MAX_CLASSES
from obbhbb_ros.settings.parameters import MAX_INT
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import group_of
from obbhbb_ros.wire.image import IMAGE_SIZE_LIMIT


@dataclass(frozen=True)
class ConversionSettings:
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


def _settings(values: Mapping[str, Any]) -> ConversionSettings:
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
    return ConversionSettings(
        rules=tuple(rules),
        rule_of_class=rule_of_class,
        caps=_caps(values),
        image_size=(values['image_width'], values['image_height']),
        theta_scale=theta_scale(values),
        bow=values['heading'] == 'theta',
        input_frame=input_frame(values),
        clip_boxes=values['clip_boxes'],
        keep_invalid=values['invalid_policy'] == 'keep',
        crop=group_of(CropSettings, values, 'crop.'),
        crop_rules=_crop_rules(crop_qs),
        weights=np.array(weights),
        min_scores=np.array(min_scores),
        compare_outer=values['crop.compare_outer'],
    )


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


OBB_TO_HBB = ParameterTable(
    (
        *COMMON,
        INPUT_TIMEOUT,
        INPUT_TYPE,
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
            f'Classes with parameters of their own, under classes.<id>, {MAX_CLASSES} at most; '
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
        *INPUT_COORDINATES,
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
            MAX_INT,
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
