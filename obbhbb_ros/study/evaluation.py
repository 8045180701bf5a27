# SPDX-License-Identifier: Apache-2.0
"""Score methods side by side: all ships, bands of tilt and aspect ratio, classes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import asdict
from dataclasses import dataclass
from dataclasses import field
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.files import write_text
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study import metrics
from obbhbb_ros.study.bootstrap import Interval
from obbhbb_ros.study.bootstrap import bootstrap_intervals
from obbhbb_ros.study.bootstrap import median_intervals
from obbhbb_ros.study.rules import DEFAULT_RULES
from obbhbb_ros.study.ships import Ships

ALL = 'all'
# A band includes its lower end and excludes its upper end; tilt is 45° at most.
TILT_BANDS = {'tilt 0-15°': (0.0, 15.0), 'tilt 15-30°': (15.0, 30.0), 'tilt 30-45°': (30.0, np.inf)}
ASPECT_BANDS = {
    'L/W 1-3': (1.0, 3.0),
    'L/W 3-5': (3.0, 5.0),
    'L/W 5-7': (5.0, 7.0),
    'L/W >= 7': (7.0, np.inf),
}
TILTED = 10.0
# A hull counts as kept from this share of its area on.
HULL_KEPT = 0.99
# IoU .50:.05:.95, as average precision has it.
_THRESHOLDS = np.arange(50, 100, 5) / 100.0
# An offset is significant if its interval, rounded to these decimals of a pixel, excludes zero.
_OFFSET_DIGITS = 2


@dataclass(frozen=True)
class EvaluationSettings:
    """
    Settings of an evaluation.

    Attributes
    ----------
    threshold : float
        Lowest IoU of a match, in (0, 1].
    keep : float
        Share of the reference that a box must contain, in (0, 1].
    bootstrap, seed : int
        Bootstrap samples for the confidence intervals, 0 for none, and their seed.

    Raises
    ------
    ValueError
        If a value is out of range; the message names it.
    """

    threshold: float = 0.5
    keep: float = 0.95
    bootstrap: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every value."""
        for name in ('threshold', 'keep'):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f'{name} must be in (0, 1], not {getattr(self, name)}')
        if self.bootstrap < 0:
            raise ValueError(f'bootstrap must be 0 or more, not {self.bootstrap}')


DEFAULT_SETTINGS = EvaluationSettings()


@dataclass(frozen=True, eq=False)
class Scored:
    """N ships, their boxes, (N, 4), and how both overlap: what metrics are computed from."""

    ships: Ships
    xyxy: FloatArray
    overlap: metrics.Overlap
    settings: EvaluationSettings


ShipValues: TypeAlias = Callable[[Scored], FloatArray]


@dataclass(frozen=True)
class Metric:
    """
    A metric of boxes.

    Attributes
    ----------
    title : str
        Heading in tables, with `{threshold}` and `{keep}` of the settings in it.
    values : callable
        Computes it for each ship, (N,); NaN where it is unknown.
    form : str
        Format of its mean.
    """

    title: str
    values: ShipValues
    form: str = '.4f'

    def heading(self, settings: EvaluationSettings) -> str:
        """Return the title under some settings."""
        return self.title.format(threshold=settings.threshold * 100.0, keep=settings.keep)


def _metric(title: str, values: ShipValues, form: str = '.4f') -> dict[str, Metric]:
    """Describe a field of `Score` that is the mean of a metric."""
    return {'metric': Metric(title, values, form)}


def _overlap(name: str) -> ShipValues:
    """Read a property of the overlap."""
    return attrgetter(f'overlap.{name}')


def _matches(threshold: float | None = None) -> ShipValues:
    """Count the ships with an IoU of at least a threshold, by default that of the settings."""
    return lambda scored: scored.overlap.match(threshold or scored.settings.threshold).astype(float)


def _kept(scored: Scored) -> FloatArray:
    """Count the ships whose box contains enough of their reference."""
    return (scored.overlap.coverage >= scored.settings.keep).astype(float)


def _average_match(scored: Scored) -> FloatArray:
    """Average the matches over IoU .50:.05:.95."""
    return np.asarray(np.mean([scored.overlap.match(low) for low in _THRESHOLDS], axis=0))


def _hull_kept(scored: Scored) -> FloatArray:
    """Find the ships that keep their hull; NaN where no hull is known."""
    share = metrics.hull_share(scored.xyxy, scored.ships.outlines)
    # Allow for rounding in the areas.
    return np.where(np.isnan(share), np.nan, share >= HULL_KEPT - 1e-9)


def _area(scored: Scored) -> FloatArray:
    """Compare the areas with those of the outer boxes."""
    outer = metrics.area(convert_by_rule(scored.ships.boxes, HullRule('outer')))
    return scored.overlap.predicted / outer


@dataclass(frozen=True)
class Score:
    """
    The mean metrics of one method on some ships under one protocol.

    From `iou` on they are means over the ships; each ship counts the same.

    Attributes
    ----------
    protocol : str
        A key of `PROTOCOLS`.
    stratum : str
        Which ships, a key of `strata`.
    method, q, f, s, q_bow, q_stern
        The rule.
    ships, images : int
        Number of ships and of their images.
    iou, iou_low, iou_high : float
        Mean IoU and its 95 % bootstrap interval; NaN without bootstrap, or with one image.
    match : float
        Share of ships with an IoU of at least the threshold (Match50 at 0.5): the recall of a
        detector that finds every ship.
    overshoot, undershoot, average_error, area_error : float
        See `obbhbb_ros.study.metrics.Overlap`; the last is Eq. relerr.
    coverage : float
        Mean share of the reference inside the box.
    kept : float
        Share of ships with at least the required coverage.
    area : float
        Mean area relative to the outer box of the same ship.
    match75, match90 : float
        Share of ships with an IoU of at least 0.75 and 0.9.
    match_average : float
        Mean share of ships with an IoU of at least 0.50, 0.55, … 0.95.
    hull_kept : float
        Share of ships with at least 99 % of the area of their hull inside the box, among those
        whose hull is known; NaN without any.
    """

    protocol: str
    stratum: str
    method: str
    q: float
    f: float
    s: float
    q_bow: float | None
    q_stern: float | None
    ships: int
    images: int
    iou: float = field(metadata=_metric('mean IoU', _overlap('iou')))
    iou_low: float
    iou_high: float
    match: float = field(metadata=_metric('match{threshold:g}', _matches()))
    overshoot: float = field(metadata=_metric('overshoot', _overlap('overshoot')))
    undershoot: float = field(metadata=_metric('undershoot', _overlap('undershoot')))
    average_error: float = field(metadata=_metric('avg. error', _overlap('average_error')))
    area_error: float = field(metadata=_metric('area error', _overlap('relative_error')))
    coverage: float = field(metadata=_metric('coverage', _overlap('coverage')))
    kept: float = field(metadata=_metric('keep {keep:.0%}', _kept, '.1%'))
    area: float = field(metadata=_metric('area/outer', _area))
    match75: float = field(metadata=_metric('match75', _matches(0.75)))
    match90: float = field(metadata=_metric('match90', _matches(0.9)))
    match_average: float = field(metadata=_metric('match50:95', _average_match))
    hull_kept: float = field(metadata=_metric(f'hull {HULL_KEPT:.0%}', _hull_kept, '.1%'))


METRICS: MappingProxyType[str, Metric] = MappingProxyType(
    {column.name: column.metadata['metric'] for column in fields(Score) if column.metadata}
)


@dataclass(frozen=True)
class Offset:
    """
    Where the boxes of one method lie, measured from the reference boxes, over all ships.

    Attributes
    ----------
    method : str
        Name of the rule.
    x, y : float
        Median offset of the centre, pixels; positive to the right and down.
    x_interval, y_interval : Interval
        Their 95 % bootstrap intervals; NaN without bootstrap, or with one image.
    left, top, right, bottom : float
        Median offset of each side, pixels; positive to the right and down.
    """

    method: str
    x: float
    y: float
    x_interval: Interval
    y_interval: Interval
    left: float
    top: float
    right: float
    bottom: float

    @property
    def significant_axes(self) -> dict[str, tuple[float, Interval]]:
        """The axes, with offset and interval, whose interval excludes zero, rounded to 0.01 px."""
        axes = {'x': (self.x, self.x_interval), 'y': (self.y, self.y_interval)}
        # Comparisons with NaN are false.
        return {
            axis: (value, interval)
            for axis, (value, interval) in axes.items()
            if round(interval.low, _OFFSET_DIGITS) > 0.0
            or round(interval.high, _OFFSET_DIGITS) < 0.0
        }


def strata(ships: Ships) -> dict[str, NDArray[np.bool_]]:
    """
    Sort ships into bands of tilt and aspect ratio, and by class if there are several classes.

    The members of each stratum that has any are marked in an array of shape (N,).
    """
    members = {
        ALL: np.ones(len(ships), dtype=bool),
        **in_bands(ships.tilt, TILT_BANDS),
        f'tilt > {TILTED:g}°': ships.tilt > TILTED,
        **in_bands(ships.aspect, ASPECT_BANDS),
    }
    classes = np.unique(ships.class_ids).tolist()
    if len(classes) > 1:
        members |= {f'class {class_id}': ships.class_ids == class_id for class_id in classes}
    return {name: rows for name, rows in members.items() if rows.any()}


def in_bands(
    values: FloatArray, bands: Mapping[str, tuple[float, float]]
) -> dict[str, NDArray[np.bool_]]:
    """Find the members of each band, (N,), among N values."""
    return {name: (values >= low) & (values < high) for name, (low, high) in bands.items()}


def evaluate(
    ships: Ships,
    rules: Mapping[str, HullRule] = DEFAULT_RULES,
    protocols: Sequence[str] = tuple(metrics.PROTOCOLS),
    settings: EvaluationSettings = DEFAULT_SETTINGS,
) -> list[Score]:
    """
    Score rules on ships.

    Parameters
    ----------
    ships : Ships
        The ships. Those without a reference box are left out of the protocol `hbb`.
    rules : mapping of str to HullRule
        The rules by name.
    protocols : sequence of str
        Keys of `PROTOCOLS`.
    settings : EvaluationSettings
        Threshold, required coverage and bootstrap samples.

    Returns
    -------
    list of Score
        Ordered by protocol, then by stratum, then by rule.

    Raises
    ------
    ValueError
        If a protocol is unknown, or no ship has the reference box it needs.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import synthetic_ships
    >>> ships = synthetic_ships(aspects=2, angles=9, seed=None)
    >>> scores = evaluate(ships, protocols=['hbb'])
    >>> {score.method: round(score.iou, 2) for score in scores[:3]}
    {'superellipse': 0.89, 'shape_aware': 0.8, 'outer': 0.81}
    """
    scores: list[Score] = []
    for protocol in protocols:
        chosen = ships_for(ships, protocol)
        values = {
            name: ship_metrics(chosen, convert_by_rule(chosen.boxes, rule), protocol, settings)
            for name, rule in rules.items()
        }
        for stratum, rows in strata(chosen).items():
            images = chosen.image_of[rows]
            counts = {'ships': len(images), 'images': len(np.unique(images))}
            ious = [of_rule['iou'][rows] for of_rule in values.values()]
            intervals = bootstrap_intervals(ious, images, settings.bootstrap, settings.seed)
            for (name, rule), (low, high) in zip(rules.items(), intervals, strict=True):
                facts: dict[str, Any] = asdict(rule) | {'method': name} | counts
                facts |= {key: mean(value[rows]) for key, value in values[name].items()}
                scores.append(Score(protocol, stratum, iou_low=low, iou_high=high, **facts))
    return scores


def nested(scores: Iterable[Score]) -> dict[str, dict[str, dict[str, Score]]]:
    """Arrange scores by protocol, stratum and method, in their order."""
    tree: dict[str, dict[str, dict[str, Score]]] = {}
    for score in scores:
        tree.setdefault(score.protocol, {}).setdefault(score.stratum, {})[score.method] = score
    return tree


def overlap(ships: Ships, xyxy: FloatArray, protocol: str) -> metrics.Overlap:
    """Compare N boxes, (N, 4), with the reference that a protocol prescribes."""
    if protocol == 'obb':
        return metrics.overlap_with_obb(xyxy, ships.boxes)
    return metrics.overlap_with_hbb(xyxy, ships.reference)


def ships_for(ships: Ships, protocol: str) -> Ships:
    """
    Select the ships that a protocol can score: `obb` all, `hbb` those with a reference box.

    Raises ValueError if the protocol is unknown, or there is no such ship.
    """
    if protocol not in metrics.PROTOCOLS:
        names = ', '.join(metrics.PROTOCOLS)
        raise ValueError(f'protocol must be one of {names}, not {protocol!r}')
    if protocol == 'obb':
        return ships
    if not ships.with_reference.any():
        raise ValueError(
            'no ship has a reference box: give labels that contain them, or a reference file'
        )
    return ships.take(ships.with_reference)


def ship_metrics(
    ships: Ships, xyxy: FloatArray, protocol: str, settings: EvaluationSettings = DEFAULT_SETTINGS
) -> dict[str, FloatArray]:
    """Compute every metric of N ships and their boxes, (N, 4), named as its mean in `Score`."""
    scored = Scored(ships, xyxy, overlap(ships, xyxy, protocol), settings)
    return {name: metric.values(scored) for name, metric in METRICS.items()}


def mean(values: FloatArray) -> float:
    """Average a metric over the ships, (N,), where it is known; NaN if it is known for none."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else np.nan


def offsets(
    ships: Ships,
    rules: Mapping[str, HullRule] = DEFAULT_RULES,
    settings: EvaluationSettings = DEFAULT_SETTINGS,
) -> list[Offset]:
    """
    Measure where the boxes of each rule lie, from the reference boxes.

    A constant offset between two annotators costs more IoU than the choice of the rule. Ships
    without a reference box are left out; ValueError if there is no other.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import synthetic_ships
    >>> ships = synthetic_ships(aspects=2, angles=9, seed=None)
    >>> [offset.significant_axes for offset in offsets(ships, {'outer': HullRule('outer')})]
    [{}]
    """
    chosen = ships_for(ships, 'hbb')
    measured = []
    for name, rule in rules.items():
        # Without the rounding errors of each method, so that equal offsets are equal.
        sides = np.round(convert_by_rule(chosen.boxes, rule) - chosen.reference, 6)
        centers = np.round((sides[:, :2] + sides[:, 2:]) / 2.0, 5)
        x, y = median_intervals(list(centers.T), chosen.image_of, settings.bootstrap, settings.seed)
        dx, dy = np.median(centers, axis=0).tolist()
        left, top, right, bottom = np.median(sides, axis=0).tolist()
        measured.append(Offset(name, dx, dy, x, y, left, top, right, bottom))
    return measured


def write_json(
    path: Path,
    scores: Iterable[Score],
    settings: EvaluationSettings,
    offsets: Iterable[Offset] = (),
) -> None:
    """
    Write settings, meaning of the protocols, scores of `evaluate` and `offsets` as JSON.

    NaN is written as null, infinity as the text "inf".
    """
    document = {
        'settings': asdict(settings),
        'protocols': metrics.PROTOCOLS,
        'scores': [_plain(asdict(score)) for score in scores],
        'offsets': [_plain(asdict(offset)) for offset in offsets],
    }
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + '\n')


def _plain(value: Any) -> Any:
    """Replace numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not np.isfinite(value):
        return 'inf' if value > 0 else None
    return value


def write_csv(path: Path, scores: Iterable[Score]) -> None:
    """Write the scores of `evaluate` as CSV, columns named as the attributes of `Score`."""
    file = io.StringIO()
    writer = csv.DictWriter(file, [field.name for field in fields(Score)], lineterminator='\n')
    writer.writeheader()
    writer.writerows(asdict(score) for score in scores)
    write_text(path, file.getvalue())
