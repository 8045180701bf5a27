# SPDX-License-Identifier: Apache-2.0
"""Score methods side by side: all ships, bands of tilt and aspect ratio, classes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import asdict
from dataclasses import dataclass
from dataclasses import fields
from pathlib import Path
from typing import Any
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.files import write_text
from obbhbb_ros.study import metrics
from obbhbb_ros.study.rules import DEFAULT_RULES
from obbhbb_ros.study.ships import Ships

ALL = 'all'
# A band includes its lower end and excludes its upper end; tilt is 45° at most.
TILT_BANDS = {'tilt 0-15°': (0.0, 15.0), 'tilt 15-30°': (15.0, 30.0), 'tilt 30-45°': (30.0, np.inf)}
ASPECT_BANDS = {
    'L/W 1-3': (1.0, 3.0), 'L/W 3-5': (3.0, 5.0), 'L/W 5-7': (5.0, 7.0), 'L/W >= 7': (7.0, np.inf)
}
TILTED = 10.0
_TAIL = (1.0 - 0.95) / 2.0
# Number of draws at once, to limit the memory for many images.
_BATCH = 50


@dataclass(frozen=True)
class Score:
    """
    Figures of one method on some ships under one protocol.

    All but `ships` and `images` are means over the ships; each ship counts the same.

    Attributes
    ----------
    protocol : str
        A key of `PROTOCOLS`.
    stratum : str
        Which ships, a key of `strata`.
    method, q, f, s
        The rule.
    ships, images : int
        Number of ships and of their images.
    iou, iou_low, iou_high : float
        Mean IoU and its 95 % bootstrap interval; NaN without bootstrap.
    match : float
        Share of ships with an IoU of at least the threshold (Match50 at 0.5).
    overshoot, undershoot, average_error, area_error : float
        See `obbhbb_ros.study.metrics.Overlap`; the last is Eq. relerr.
    coverage : float
        Mean share of the reference inside the box.
    kept : float
        Share of ships with at least the required coverage.
    area : float
        Mean area relative to the outer box of the same ship.
    """

    protocol: str
    stratum: str
    method: str
    q: float
    f: float
    s: float
    ships: int
    images: int
    iou: float
    iou_low: float
    iou_high: float
    match: float
    overshoot: float
    undershoot: float
    average_error: float
    area_error: float
    coverage: float
    kept: float
    area: float


@dataclass(frozen=True)
class Settings:
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


DEFAULT_SETTINGS = Settings()


class Interval(NamedTuple):
    """A 95 % confidence interval."""

    low: float
    high: float


def strata(ships: Ships) -> dict[str, NDArray[np.bool_]]:
    """
    Sort ships into bands of tilt and aspect ratio, and by class if there are several classes.

    The members of each stratum that has any are marked in an array of shape (N,).
    """
    found = {
        ALL: np.ones(len(ships), dtype=bool),
        **in_bands(ships.tilt, TILT_BANDS),
        f'tilt > {TILTED:g}°': ships.tilt > TILTED,
        **in_bands(ships.aspect, ASPECT_BANDS),
    }
    classes = np.unique(ships.class_ids).tolist()
    if len(classes) > 1:
        found |= {f'class {each}': ships.class_ids == each for each in classes}
    return {name: rows for name, rows in found.items() if rows.any()}


def in_bands(
    values: FloatArray, bands: Mapping[str, tuple[float, float]]
) -> dict[str, NDArray[np.bool_]]:
    """Find the members of each band, (N,), among N values."""
    return {name: (values >= low) & (values < high) for name, (low, high) in bands.items()}


def evaluate(
    ships: Ships,
    rules: Mapping[str, HullRule] = DEFAULT_RULES,
    protocols: Sequence[str] = tuple(metrics.PROTOCOLS),
    settings: Settings = DEFAULT_SETTINGS,
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
    settings : Settings
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
        found = {
            name: figures(chosen, convert_by_rule(chosen.boxes, rule), protocol, settings)
            for name, rule in rules.items()
        }
        for stratum, rows in strata(chosen).items():
            images = chosen.image_of[rows]
            intervals = bootstrap_intervals(
                [each['iou'][rows] for each in found.values()], images,
                settings.bootstrap, settings.seed,
            )
            for (name, rule), (low, high) in zip(rules.items(), intervals, strict=True):
                means = {key: float(value[rows].mean()) for key, value in found[name].items()}
                scores.append(Score(
                    protocol=protocol, stratum=stratum, method=name, q=rule.q, f=rule.f, s=rule.s,
                    ships=len(images), images=len(np.unique(images)),
                    iou_low=low, iou_high=high, **means,
                ))
    return scores


def nested(scores: Iterable[Score]) -> dict[str, dict[str, dict[str, Score]]]:
    """Arrange scores by protocol, stratum and method, in their order."""
    found: dict[str, dict[str, dict[str, Score]]] = {}
    for score in scores:
        by_stratum = found.setdefault(score.protocol, {})
        by_stratum.setdefault(score.stratum, {})[score.method] = score
    return found


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
        known = ', '.join(metrics.PROTOCOLS)
        raise ValueError(f'protocol must be one of {known}, not {protocol!r}')
    if protocol == 'obb':
        return ships
    if not ships.with_reference.any():
        raise ValueError(
            'no ship has a reference box: give labels that contain them, or a reference file'
        )
    return ships.take(ships.with_reference)


def figures(
    ships: Ships, xyxy: FloatArray, protocol: str, settings: Settings = DEFAULT_SETTINGS
) -> dict[str, FloatArray]:
    """Compute all figures of N ships and their boxes, (N, 4), named as their means in `Score`."""
    found = overlap(ships, xyxy, protocol)
    return {
        'iou': found.iou,
        'match': found.match(settings.threshold).astype(float),
        'overshoot': found.overshoot,
        'undershoot': found.undershoot,
        'average_error': found.average_error,
        'area_error': found.relative_error,
        'coverage': found.coverage,
        'kept': (found.coverage >= settings.keep).astype(float),
        'area': found.predicted / metrics.area(convert_by_rule(ships.boxes, HullRule('outer'))),
    }


def bootstrap_intervals(
    values: Sequence[FloatArray], images: NDArray[np.intp], samples: int = 1000, seed: int = 0
) -> list[Interval]:
    """
    Compute 95 % intervals of means over the same ships, by drawing whole images with replacement.

    Ships in one image resemble each other; drawing single ships would make the intervals too
    narrow. The draws are the same for all means.

    Parameters
    ----------
    values : sequence of ndarray, each of shape (N,)
        One value per ship, for each mean.
    images : ndarray of int, shape (N,)
        Image of each ship.
    samples, seed : int
        Number of draws and their seed; without draws the intervals are NaN.
    """
    if not samples:
        return [Interval(np.nan, np.nan)] * len(values)
    _, index = np.unique(images, return_inverse=True)
    counts = np.bincount(index).astype(float)
    sums = np.stack([np.bincount(index, weights=each) for each in values], axis=1)
    random = np.random.default_rng(seed)
    means = []
    for start in range(0, samples, _BATCH):
        batch = min(_BATCH, samples - start)
        drawn = random.integers(len(counts), size=(batch, len(counts)))
        # How often each image was drawn: the means are then two products of matrices.
        offset = np.arange(batch)[:, None] * len(counts)
        times = np.bincount((drawn + offset).ravel(), minlength=drawn.size)
        weights = times.reshape(drawn.shape).astype(float)
        means.append(weights @ sums / (weights @ counts)[:, None])
    ends = np.quantile(np.concatenate(means), (_TAIL, 1.0 - _TAIL), axis=0)
    return [Interval(low, high) for low, high in ends.T.tolist()]


def write_json(path: Path, scores: Iterable[Score], settings: Settings) -> None:
    """
    Write the settings, the meaning of the protocols and the scores of `evaluate` as JSON.

    NaN is written as null, infinity as the text "inf".
    """
    document = {
        'settings': asdict(settings),
        'protocols': metrics.PROTOCOLS,
        'scores': [{k: _plain(v) for k, v in asdict(score).items()} for score in scores],
    }
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + '\n')


def _plain(value: Any) -> Any:
    """Replace a number that JSON cannot hold."""
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
