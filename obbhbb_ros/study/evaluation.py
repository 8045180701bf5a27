# SPDX-License-Identifier: Apache-2.0
"""All methods side by side: figures by protocol, by tilt, by aspect ratio, by class."""

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
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.converter import half_extents
from obbhbb_ros.converter import to_xyxy
from obbhbb_ros.files import write_text
from obbhbb_ros.methods import METHODS
from obbhbb_ros.study.metrics import PROTOCOLS
from obbhbb_ros.study.metrics import Overlap
from obbhbb_ros.study.metrics import area
from obbhbb_ros.study.metrics import overlap_with_hbb
from obbhbb_ros.study.metrics import overlap_with_obb
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.summary import text_table

# The paper's best-found parameters (Table "Best mixing parameters").
PAPER_RULE = HullRule('shape_aware', q=2.2, f=0.9, s=1.0)
DEFAULT_RULES: MappingProxyType[str, HullRule] = MappingProxyType(
    {name: PAPER_RULE if name == 'shape_aware' else HullRule(name) for name in METHODS}
)

ALL = 'all'
TILT_BANDS = ((0.0, 15.0), (15.0, 30.0), (30.0, 45.0))
ASPECT_BANDS = ((1.0, 3.0), (3.0, 5.0), (5.0, 7.0), (7.0, np.inf))
TILTED = 10.0
_CONFIDENCE = 0.95
# Draws at a time, to bound the memory of many images.
_BATCH = 50


@dataclass(frozen=True)
class Score:
    """
    How one method does on some ships under one protocol.

    All but `ships` and `images` are means over the ships, so that each ship counts the same.

    Attributes
    ----------
    protocol : str
        A key of `PROTOCOLS`.
    stratum : str
        Which ships, a key of `strata`.
    method, q, f, s
        The rule.
    ships, images : int
        How many, and in how many images.
    iou, iou_low, iou_high : float
        Mean IoU and its 95 % bootstrap interval, images drawn with replacement; NaN without.
    match : float
        Share of ships with an IoU of at least the threshold (Match50 at 0.5).
    overshoot, undershoot, average_error, area_error : float
        As in `obbhbb_ros.study.metrics.Overlap`; the last is Eq. relerr.
    coverage : float
        Mean part of the reference that is kept.
    kept : float
        Share of ships that keep at least the asked part of their reference.
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
    What an evaluation counts by.

    Attributes
    ----------
    threshold : float
        IoU from which a box matches, in (0, 1].
    keep : float
        Part of the reference that a ship has to keep, in (0, 1].
    bootstrap : int
        Samples of the images for the confidence intervals; 0 for none.
    seed : int
        Seed of the samples.

    Raises
    ------
    ValueError
        If one of them is out of range; the message names it.
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


def choose_rules(
    methods: Sequence[str] | None = None,
    q: float | None = None,
    f: float | None = None,
    s: float | None = None,
) -> dict[str, HullRule]:
    """
    Give methods their rules.

    Parameters
    ----------
    methods : sequence of str, optional
        Keys of `METHODS`; all by default.
    q, f, s : float, optional
        For the tunable methods, instead of their own: the package's defaults for `superellipse`,
        the paper's best-found for `shape_aware`.

    Returns
    -------
    dict of str to HullRule
        By method.

    Raises
    ------
    ValueError
        If there is no such method or a parameter is out of range.
    """
    unknown = [name for name in methods or () if name not in METHODS]
    if unknown:
        raise ValueError(f'no method {unknown[0]!r}; there are {", ".join(METHODS)}')
    rules = {}
    for name in methods or METHODS:
        own = DEFAULT_RULES[name]
        rules[name] = HullRule(
            name,
            own.q if q is None else q,
            own.f if f is None else f,
            own.s if s is None else s,
        ) if METHODS[name].tunable else own
    return rules


def convert_by_class(
    ships: Ships, rule: HullRule, rule_of_class: Mapping[str, HullRule]
) -> FloatArray:
    """
    Convert ships as the node does, some classes under rules of their own.

    Parameters
    ----------
    ships : Ships
        N ships.
    rule : HullRule
        For every class that has none of its own.
    rule_of_class : mapping of str to HullRule
        By class.

    Returns
    -------
    ndarray, shape (N, 4)
        Boxes, pixels.
    """
    rule_of = np.zeros(len(ships), dtype=np.intp)
    for index, class_id in enumerate(rule_of_class, start=1):
        rule_of[ships.class_ids == class_id] = index
    extents = half_extents(ships.boxes, [rule, *rule_of_class.values()], rule_of)
    return to_xyxy(ships.boxes.center, extents)


def strata(ships: Ships) -> dict[str, NDArray[np.bool_]]:
    """
    Sort ships into bands of tilt and aspect ratio, and by class.

    Parameters
    ----------
    ships : Ships
        N ships.

    Returns
    -------
    dict of str to ndarray of bool, shape (N,)
        Who is in which; those without ships are left out. Classes only where there are several.
    """
    tilt, aspect = ships.tilt, ships.aspect
    found = {ALL: np.ones(len(ships), dtype=bool)}
    for low, high in TILT_BANDS:
        # The last band has its upper end.
        found[tilt_band(low, high)] = (tilt >= low) & ((tilt < high) | (high == 45.0))
    found[f'tilt > {TILTED:g}°'] = tilt > TILTED
    for low, high in ASPECT_BANDS:
        name = f'L/W {low:g}-{high:g}' if np.isfinite(high) else f'L/W >= {low:g}'
        found[name] = (aspect >= low) & (aspect < high)
    classes = np.unique(ships.class_ids).tolist()
    if len(classes) > 1:
        found |= {f'class {each}': ships.class_ids == each for each in classes}
    return {name: rows for name, rows in found.items() if rows.any()}


def tilt_band(low: float, high: float) -> str:
    """Name a band of tilt."""
    return f'tilt {low:g}-{high:g}°'


def evaluate(
    ships: Ships,
    rules: Mapping[str, HullRule] = DEFAULT_RULES,
    protocols: Sequence[str] = tuple(PROTOCOLS),
    settings: Settings = DEFAULT_SETTINGS,
) -> list[Score]:
    """
    Score rules on ships.

    Parameters
    ----------
    ships : Ships
        The ships. Those without a reference box are left out of the protocol `hbb`.
    rules : mapping of str to HullRule
        By the name to call them.
    protocols : sequence of str
        Keys of `PROTOCOLS`.
    settings : Settings
        What to count by.

    Returns
    -------
    list of Score
        By protocol, then by stratum, then by rule.

    Raises
    ------
    ValueError
        If there is no such protocol, or no ship has the reference box it asks for.
    """
    scores: list[Score] = []
    for protocol in protocols:
        chosen = ships_for(ships, protocol)
        tables = {
            name: figures(chosen, convert_by_rule(chosen.boxes, rule), protocol, settings)
            for name, rule in rules.items()
        }
        for stratum, rows in strata(chosen).items():
            images = chosen.image_of[rows]
            overlaps = np.stack([table[0, rows] for table in tables.values()])
            ends = bootstrap_intervals(overlaps, images, settings.bootstrap, settings.seed)
            scores += [
                _score((protocol, stratum, name), rules[name], table[:, rows], images, interval)
                for (name, table), interval in zip(tables.items(), ends.T, strict=True)
            ]
    return scores


def overlap(ships: Ships, xyxy: FloatArray, protocol: str) -> Overlap:
    """
    Lay boxes beside what a protocol compares them with.

    Parameters
    ----------
    ships : Ships
        N ships.
    xyxy : ndarray, shape (N, 4)
        Boxes, pixels.
    protocol : str
        A key of `PROTOCOLS`.

    Returns
    -------
    Overlap
        NaN for a ship without reference, under the protocol `hbb`.
    """
    if protocol == 'obb':
        return overlap_with_obb(xyxy, ships.boxes)
    return overlap_with_hbb(xyxy, ships.reference)


def ships_for(ships: Ships, protocol: str) -> Ships:
    """
    Select the ships that a protocol can score.

    Parameters
    ----------
    ships : Ships
        Ships.
    protocol : str
        A key of `PROTOCOLS`.

    Returns
    -------
    Ships
        Those with a reference box, or all for the protocol `obb`.

    Raises
    ------
    ValueError
        If there is no such protocol, or no ship it can score.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f'protocol must be one of {", ".join(PROTOCOLS)}, not {protocol!r}')
    if protocol == 'obb':
        return ships
    if not ships.with_reference.any():
        raise ValueError(
            'no ship has a reference box: give labels that hold them, or their file as reference'
        )
    return ships.take(ships.with_reference)


FIGURES = (
    'iou', 'match', 'overshoot', 'undershoot', 'average_error', 'area_error', 'coverage', 'kept',
    'area',
)


def figures(
    ships: Ships, xyxy: FloatArray, protocol: str, settings: Settings = DEFAULT_SETTINGS
) -> FloatArray:
    """
    Compute every figure of every ship.

    Parameters
    ----------
    ships : Ships
        N ships.
    xyxy : ndarray, shape (N, 4)
        Their boxes, pixels.
    protocol : str
        A key of `PROTOCOLS`.
    settings : Settings
        What to count by.

    Returns
    -------
    ndarray, shape (9, N)
        Rows in the order of `FIGURES`, which are attributes of `Score`.
    """
    found = overlap(ships, xyxy, protocol)
    outer_area = area(convert_by_rule(ships.boxes, HullRule('outer')))
    return np.stack((
        found.iou, found.match(settings.threshold), found.overshoot, found.undershoot,
        found.average_error, found.relative_error, found.coverage,
        found.coverage >= settings.keep, found.predicted / outer_area,
    ))


def _score(
    names: tuple[str, str, str], rule: HullRule, table: FloatArray, images: NDArray[np.intp],
    interval: FloatArray,
) -> Score:
    """Average the figures of some ships."""
    protocol, stratum, method = names
    means = dict(zip(FIGURES, table.mean(axis=1).tolist(), strict=True))
    return Score(
        protocol=protocol, stratum=stratum, method=method, q=rule.q, f=rule.f, s=rule.s,
        ships=table.shape[1], images=len(np.unique(images)),
        iou_low=float(interval[0]), iou_high=float(interval[1]), **means,
    )


def bootstrap_interval(
    values: FloatArray, images: NDArray[np.intp], samples: int = 1000, seed: int = 0
) -> tuple[float, float]:
    """
    Bound a mean over ships by drawing whole images with replacement.

    Ships of one image resemble each other; drawing ships one by one would make the interval too
    narrow.

    Parameters
    ----------
    values : ndarray, shape (N,)
        One value a ship.
    images : ndarray of int, shape (N,)
        The image of each ship.
    samples : int
        How many draws; 0 gives NaN.
    seed : int
        Seed of the draws.

    Returns
    -------
    tuple of float
        The 2.5th and the 97.5th percentile of the mean.
    """
    (low,), (high,) = bootstrap_intervals(values[None], images, samples, seed)
    return float(low), float(high)


def bootstrap_intervals(
    values: FloatArray, images: NDArray[np.intp], samples: int = 1000, seed: int = 0
) -> FloatArray:
    """
    Bound several means over the same ships, as `bootstrap_interval` does one.

    Parameters
    ----------
    values : ndarray, shape (K, N)
        K values a ship.
    images, samples, seed
        As in `bootstrap_interval`; the draws are the same for all K.

    Returns
    -------
    ndarray, shape (2, K)
        Lower and upper ends.
    """
    if not samples:
        return np.full((2, len(values)), np.nan)
    _, index = np.unique(images, return_inverse=True)
    counts = np.bincount(index).astype(float)
    sums = np.stack([np.bincount(index, weights=row) for row in values], axis=1)
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
    tail = (1.0 - _CONFIDENCE) / 2.0
    return np.asarray(np.quantile(np.concatenate(means), (tail, 1.0 - tail), axis=0))


def score_tables(scores: Sequence[Score], settings: Settings = DEFAULT_SETTINGS) -> str:
    """
    Write scores as tables for the terminal, the protocol above each.

    Parameters
    ----------
    scores : sequence of Score
        What `evaluate` gives.
    settings : Settings
        What it was given.

    Returns
    -------
    str
        For each protocol all figures over all ships, then mean IoU by stratum.
    """
    return '\n\n'.join(
        f'{title}\n{text_table(head, rows)}'
        for title, head, rows in score_rows(scores, settings)
    )


def score_rows(
    scores: Sequence[Score], settings: Settings = DEFAULT_SETTINGS
) -> list[tuple[str, list[str], list[list[str]]]]:
    """
    Lay scores out as tables of text.

    Parameters
    ----------
    scores : sequence of Score
        What `evaluate` gives.
    settings : Settings
        What it was given.

    Returns
    -------
    list of (title, head, rows)
        Two a protocol.
    """
    tables = []
    for protocol in dict.fromkeys(score.protocol for score in scores):
        mine = [score for score in scores if score.protocol == protocol]
        overall = [score for score in mine if score.stratum == ALL]
        title = (
            f'protocol {protocol}: {PROTOCOLS[protocol]}, '
            f'{overall[0].ships} ships in {overall[0].images} images'
        )
        head = [
            'method', 'q / f / s', 'mean IoU', '95 % interval',
            f'match{settings.threshold * 100:g}', 'overshoot', 'undershoot', 'avg. error',
            'area error', 'coverage', f'keep {settings.keep:.0%}', 'area/outer',
        ]
        tables.append((title, head, [_row(score) for score in overall]))
        tables.append((f'mean IoU by stratum, {title}', *_stratum_rows(mine)))
    return tables


def _row(score: Score) -> list[str]:
    """Write the figures of one method."""
    tunable = METHODS[score.method].tunable if score.method in METHODS else True
    return [
        score.method,
        f'{score.q:.4g} / {score.f:.4g} / {score.s:.4g}' if tunable else '',
        f'{score.iou:.4f}',
        '' if np.isnan(score.iou_low) else f'{score.iou_low:.3f}-{score.iou_high:.3f}',
        f'{score.match:.4f}', f'{score.overshoot:.4f}', f'{score.undershoot:.4f}',
        f'{score.average_error:.4f}', f'{score.area_error:.4f}', f'{score.coverage:.4f}',
        f'{score.kept:.1%}', f'{score.area:.4f}',
    ]


def _stratum_rows(scores: Sequence[Score]) -> tuple[list[str], list[list[str]]]:
    """Write mean IoU, a row a stratum and a column a method."""
    methods = list(dict.fromkeys(score.method for score in scores))
    rows = []
    for stratum in dict.fromkeys(score.stratum for score in scores):
        mine = {score.method: score for score in scores if score.stratum == stratum}
        ships = str(next(iter(mine.values())).ships)
        rows.append([stratum, ships, *(f'{mine[name].iou:.4f}' for name in methods)])
    return ['stratum', 'ships', *methods], rows


def write_json(path: Path, scores: Iterable[Score], settings: Settings) -> None:
    """
    Write scores as JSON: the settings, what the protocols mean, a list of scores.

    Parameters
    ----------
    path : Path
        File to write. What is not a finite number becomes null, infinity the text "inf".
    scores : iterable of Score
        What `evaluate` gives.
    settings : Settings
        What it was given.
    """
    document = {
        'settings': asdict(settings),
        'protocols': PROTOCOLS,
        'scores': [{k: _plain(v) for k, v in asdict(score).items()} for score in scores],
    }
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + '\n')


def _plain(value: Any) -> Any:
    """Give what JSON can hold."""
    if isinstance(value, float) and not np.isfinite(value):
        return 'inf' if value > 0 else None
    return value


def write_csv(path: Path, scores: Iterable[Score]) -> None:
    """
    Write scores as CSV, one a row, columns named as the attributes of `Score`.

    Parameters
    ----------
    path : Path
        File to write.
    scores : iterable of Score
        What `evaluate` gives.
    """
    file = io.StringIO()
    writer = csv.DictWriter(file, [field.name for field in fields(Score)], lineterminator='\n')
    writer.writeheader()
    writer.writerows(asdict(score) for score in scores)
    write_text(path, file.getvalue())
