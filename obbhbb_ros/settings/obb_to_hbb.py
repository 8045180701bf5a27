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
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.settings.common import COMMON_WITH_INPUT
from obbhbb_ros.settings.common import IMAGE_SIZE
from obbhbb_ros.settings.detection_input import DETECTION_INPUT
from obbhbb_ros.settings.detection_input import input_frame
from obbhbb_ros.settings.parameters import MAX_CLASSES
from obbhbb_ros.settings.parameters import Parameter
from obbhbb_ros.settings.parameters import ParameterTable
from obbhbb_ros.settings.parameters import rows_of
from obbhbb_ros.settings.parameters import settings_of


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
    bow: bool
    input_frame: InputFrame
    clip_boxes: bool
    keep_invalid: bool
    crop: CropSettings
    crop_rules: tuple[HullRule | None, ...]
    weights: FloatArray
    min_scores: FloatArray
    compare_outer: bool


# A class with this value for its crop regions has that of the node.
_OF_NODE = -1.0


@dataclass(frozen=True)
class ClassSettings(CheckedSettings):
    """The parameters of a class; ValueError if a value is out of range."""

    method: str = setting(
        '', "method of this class. Empty: the node's.", Choices(('', *ONBOARD_METHODS))
    )
    q: float = setting(0.0, "q of this class. 0: the node's.", Range(0.0, Q_RANGE.high))
    q_bow: float = setting(0.0, "q_bow of this class. 0: the node's.", Range(0.0, Q_RANGE.high))
    q_stern: float = setting(0.0, "q_stern of this class. 0: the node's.", Range(0.0, Q_RANGE.high))
    f: float = setting(0.0, "f of this class. 0: the node's.", Range(0.0, F_RANGE.high))
    s: float = setting(0.0, "s of this class. 0: the node's.", Range(0.0, S_RANGE.high))
    crop_q: float = setting(
        _OF_NODE,
        "crop.q of this class. -1: the node's, 0: the box alone.",
        Range(_OF_NODE, Q_RANGE.high),
    )
    min_score: float = setting(
        _OF_NODE,
        "crop.min_score of this class. -1: the node's, 0: any score.",
        Range(_OF_NODE, 1e6),
    )
    weight: float = setting(
        1.0,
        'Factor on the scores of this class when crop regions are ranked. 0: no crop regions.',
        Range(0.0, 1e6),
    )

    def __post_init__(self) -> None:
        """Check every value; the only negative one is -1."""
        super().__post_init__()
        for name, value in (('crop_q', self.crop_q), ('min_score', self.min_score)):
            if _OF_NODE < value < 0.0:
                raise ValueError(f'{name} must be -1, or 0 or more, not {value}')
        _require_crop_q('crop_q', self.crop_q)


def _conversion_settings(values: Mapping[str, Any]) -> ConversionSettings:
    """Make settings for `obb_to_hbb`."""
    class_ids = list(filter(None, values['class_ids']))
    prefixes = [f'classes.{class_id}.' for class_id in class_ids]
    classes = [settings_of(ClassSettings, values, prefix) for prefix in prefixes]
    min_scores = [values['crop.min_score'], *(of_class.min_score for of_class in classes)]
    return ConversionSettings(
        rules=(_rule(values), *(_rule(values, prefix) for prefix in prefixes)),
        rule_of_class={class_id: number for number, class_id in enumerate(class_ids, 1)},
        caps=_caps(values),
        image_size=(values['image_width'], values['image_height']),
        bow=values['heading'] == 'theta',
        input_frame=input_frame(values),
        clip_boxes=values['clip_boxes'],
        keep_invalid=values['invalid_policy'] == 'keep',
        crop=settings_of(CropSettings, values, 'crop.'),
        crop_rules=_crop_rules(values['crop.q'], classes),
        weights=np.array([1.0, *(of_class.weight for of_class in classes)]),
        min_scores=np.array(_with_values_of_node(min_scores)),
        compare_outer=values['crop.compare_outer'],
    )


def _rule(values: Mapping[str, Any], prefix: str = '') -> HullRule:
    """Make the rule of the node, or of a class, which has the node's values where it has none."""
    names = [field.name for field in fields(HullRule)]
    merged = {prefix + name: values[prefix + name] or values[name] or None for name in names}
    return settings_of(HullRule, merged, prefix)


def _crop_rules(q_of_node: float, classes: Sequence[ClassSettings]) -> tuple[HullRule | None, ...]:
    """Make the hulls that crop regions enclose, None where they enclose the box alone."""
    _require_crop_q('crop.q', q_of_node)
    qs = _with_values_of_node([q_of_node, *(of_class.crop_q for of_class in classes)])
    return tuple(HullRule(q=q) if q else None for q in qs) if any(qs) else ()


def _require_crop_q(name: str, q: float) -> None:
    """Raise ValueError with the name if a shape exponent is between 0 and 1."""
    if 0.0 < q < Q_RANGE.low:
        raise ValueError(f'{name} must be 0, or {Q_RANGE}, not {q}')


def _with_values_of_node(values: Sequence[float]) -> list[float]:
    """Give the classes the value of the node, the first one, where they have none."""
    return [values[0] if value == _OF_NODE else value for value in values]


def _caps(values: Mapping[str, Any]) -> Caps:
    """Return the caps in pixels."""
    metres_per_pixel = values['ground_sample_distance'] or 1.0
    maxima = (values['max_length'], values['max_width'])
    return Caps(*(maximum / metres_per_pixel if maximum else None for maximum in maxima))


_ROWS = (
    *COMMON_WITH_INPUT,
    *DETECTION_INPUT,
    Parameter('method', HullRule.method, 'Conversion rule.', Choices(ONBOARD_METHODS)),
    *(row for row in rows_of(HullRule) if row.name in ('q', 'f', 's')),
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
    *IMAGE_SIZE,
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
    *rows_of(CropSettings, 'crop.'),
    Parameter(
        'crop.compare_outer',
        False,
        'Also plan the crops of the outer boxes, and report in the diagnostics how many pixels are '
        'saved compared with them.',
    ),
)
OBB_TO_HBB = ParameterTable(_ROWS, _conversion_settings, rows_of(ClassSettings, 'classes.<id>.'))
"""Parameters of the node `obb_to_hbb`."""
