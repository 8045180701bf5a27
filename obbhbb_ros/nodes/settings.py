# SPDX-License-Identifier: Apache-2.0
"""
The conversion node's parameter table, and the snapshot that one message is converted under.

No other place states a parameter's name, meaning, default or range.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import fields
from typing import Any

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import Caps
from obbhbb_ros.converter import HullRule
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.methods import ONBOARD_METHODS
from obbhbb_ros.nodes.managed import AUTOSTART
from obbhbb_ros.nodes.parameters import INT_LIMIT
from obbhbb_ros.nodes.parameters import LOCK
from obbhbb_ros.nodes.parameters import MOST_CLASSES
from obbhbb_ros.nodes.parameters import ParameterSpec
from obbhbb_ros.nodes.parameters import Values

DETECTIONS = 'Detection2DArray'
POLYGONS = 'Polygon2DCollection'
POLYGON = 'PolygonStamped'

_INF = math.inf
IMAGE_SIZE_LIMIT = 1_000_000

TABLE: tuple[ParameterSpec, ...] = (
    AUTOSTART,
    LOCK,
    ParameterSpec(
        'input_type', DETECTIONS,
        'Message type of the input: the first on `detections`, the others on `polygons`.',
        choices=(DETECTIONS, POLYGONS, POLYGON), read_only=True,
    ),
    ParameterSpec(
        'method', 'superellipse', 'Conversion rule.', choices=ONBOARD_METHODS,
    ),
    ParameterSpec(
        'q', 3.0,
        'Shape exponent of the hull: 1 a rhombus, 2 an ellipse, .inf the rectangle.',
        1.0, _INF,
    ),
    ParameterSpec(
        'f', 1.0, 'Fullness, scales the half-width of the hull; above 0.', 0.0, 2.0,
    ),
    ParameterSpec(
        's', 1.0, 'Shrink factor, scales the half-extents of the box; above 0.', 0.0, 2.0,
    ),
    ParameterSpec(
        'max_length', 0.0,
        'Cap of the longer side of the box, pixels, or metres with ground_sample_distance; '
        '0 for none.',
        0.0, _INF,
    ),
    ParameterSpec(
        'max_width', 0.0,
        'Cap of the shorter side of the box, pixels, or metres with ground_sample_distance; '
        '0 for none.',
        0.0, _INF,
    ),
    ParameterSpec(
        'ground_sample_distance', 0.0,
        'Metres per pixel; above 0 it makes the caps metres.', 0.0, 1e6,
    ),
    ParameterSpec(
        'class_ids', [''],
        f'Classes with parameters of their own, under classes.<id>, up to {MOST_CLASSES}; an empty '
        'string is no class.',
    ),
    ParameterSpec(
        'image_width', 0,
        'Width of the image, pixels; 0 to take it from `camera_info`.', 0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'image_height', 0,
        'Height of the image, pixels; 0 to take it from `camera_info`.', 0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'angle_unit', 'rad', 'Unit of bbox.center.theta in the input.', choices=('rad', 'deg'),
    ),
    ParameterSpec(
        'invalid_policy', 'drop',
        'Detections that cannot be converted: leave them out, or pass them on unchanged.',
        choices=('drop', 'keep'),
    ),
    ParameterSpec(
        'crop.padding', 0.0,
        'Added to each side of a crop region, as a fraction of the box along that axis.',
        0.0, 100.0,
    ),
    ParameterSpec(
        'crop.padding_px', 0.0,
        'Added to each side of a crop region after that, pixels.', 0.0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'crop.min_size', 0,
        'Crop regions are grown to at least so many pixels a side; 0 for no bound.',
        0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'crop.max_size', 0,
        'Crop regions are cut to at most so many pixels a side; 0 for no bound.',
        0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'crop.multiple_of', 0,
        'Sides of crop regions are multiples of so many pixels, the block of a codec, except where '
        'the whole side of the image is needed; 0 for any.',
        0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'crop.merge_max_size', 0,
        'Overlapping crop regions become one where that takes fewer pixels, up to so many pixels '
        'a side; 0 for no merging.',
        0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'crop.max_count', 0,
        'At most so many crop regions a message, most valuable first; 0 for no bound.',
        0, IMAGE_SIZE_LIMIT,
    ),
    ParameterSpec(
        'crop.max_pixels', 0,
        'Maximum pixels in the crop regions of a message, most valuable first (0: unlimited).',
        0, INT_LIMIT,
    ),
    ParameterSpec(
        'crop.compare_outer', False,
        'Plan the crops of the outer boxes too, and tell in the diagnostics how many pixels fewer '
        'the plan has.',
    ),
)

CLASS_TABLE: tuple[ParameterSpec, ...] = (
    ParameterSpec(
        'classes.<id>.method', '',
        'Conversion rule for this class; empty for that of the node.',
        choices=('', *ONBOARD_METHODS),
    ),
    ParameterSpec(
        'classes.<id>.q', 0.0,
        'Shape exponent for this class, 1 or more; 0 for that of the node.', 0.0, _INF,
    ),
    ParameterSpec(
        'classes.<id>.f', 0.0, 'Fullness for this class; 0 for that of the node.', 0.0, 2.0,
    ),
    ParameterSpec(
        'classes.<id>.s', 0.0, 'Shrink factor for this class; 0 for that of the node.', 0.0, 2.0,
    ),
    ParameterSpec(
        'classes.<id>.weight', 1.0,
        'What the score of this class counts when crop regions are ranked.', 0.0, 1e6,
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
    keep_invalid : bool
        Whether detections that cannot be converted are passed on unchanged.
    crop : CropSettings
        How boxes become crop regions.
    weights : ndarray, shape (number of rules,)
        What the score of a detection counts, by its rule.
    compare_outer : bool
        Whether the crop plan is compared with that of the outer boxes.
    """

    rules: tuple[HullRule, ...]
    rule_of_class: Mapping[str, int]
    caps: Caps
    image_size: tuple[int, int]
    theta_scale: float
    keep_invalid: bool
    crop: CropSettings
    weights: FloatArray
    compare_outer: bool


def build_settings(values: Values | Mapping[str, Any]) -> Settings:
    """
    Make a snapshot of parameter values.

    Parameters
    ----------
    values : mapping of str to value
        A value for each row of `TABLE`, and of `CLASS_TABLE` for each class in `class_ids`.

    Returns
    -------
    Settings
        The snapshot.

    Raises
    ------
    ValueError
        If the values do not fit together; the message names the parameter.
    """
    v: Mapping[str, Any] = values
    rules = [HullRule(v['method'], v['q'], v['f'], v['s'])]
    rule_of_class = {}
    weights = [1.0]
    for class_id in filter(None, v['class_ids']):
        rule_of_class[class_id] = len(rules)
        rules.append(_class_rule(v, class_id))
        weights.append(v[f'classes.{class_id}.weight'])
    return Settings(
        rules=tuple(rules),
        rule_of_class=rule_of_class,
        caps=_caps(v),
        image_size=(v['image_width'], v['image_height']),
        theta_scale=math.pi / 180.0 if v['angle_unit'] == 'deg' else 1.0,
        keep_invalid=v['invalid_policy'] == 'keep',
        crop=_crop_settings(v),
        weights=np.array(weights),
        compare_outer=v['crop.compare_outer'],
    )


def _class_rule(values: Mapping[str, Any], class_id: str) -> HullRule:
    """Lay a class's own parameters over those of the node."""
    prefix = f'classes.{class_id}.'
    own = {name: values[prefix + name] or values[name] for name in ('method', 'q', 'f', 's')}
    try:
        return HullRule(**own)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None


def _caps(values: Mapping[str, Any]) -> Caps:
    """Turn the caps into pixels."""
    metres_per_pixel = values['ground_sample_distance'] or 1.0
    bounds = {
        name: values[name] / metres_per_pixel if values[name] else None
        for name in ('max_length', 'max_width')
    }
    return Caps(**bounds)


def _crop_settings(values: Mapping[str, Any]) -> CropSettings:
    """Collect what stands under `crop.`."""
    prefix = 'crop.'
    own = {field.name: values[prefix + field.name] for field in fields(CropSettings)}
    try:
        return CropSettings(**own)
    except ValueError as error:
        raise ValueError(f'{prefix}{error}') from None
