# SPDX-License-Identifier: Apache-2.0
"""
Which q, f and s fly: the paper's grid search (Algorithm 2), and what it lacks.

`Bench` lays ships out so that a setting costs little: the reach of the hulls is computed once for
all settings, and the shrink factor only scales extents that are there already.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.converter import F_RANGE
from obbhbb_ros.converter import S_RANGE
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.methods import get_method
from obbhbb_ros.study.metrics import Overlap
from obbhbb_ros.study.metrics import area
from obbhbb_ros.study.ships import Ships

OBJECTIVES = {
    'mean_iou': 'the largest mean IoU',
    'match50': 'the most ships with an IoU of 0.5 or more, then the largest mean IoU',
    'coverage': 'the smallest mean area that keeps enough of enough ships',
}

Fit: TypeAlias = Callable[[Ships], HullRule]
# u, f and s; u = 1 - 1/q runs from 0 for the rhombus to 1 for the rectangle.
_Point: TypeAlias = tuple[float, float, float]
_LOWEST: _Point = (0.0, 0.05, 0.05)
_HIGHEST: _Point = (1.0, F_RANGE[1], S_RANGE[1])
_FIRST_STEP = 0.08
_LAST_STEP = 5e-4
_HALVINGS = 40
_DIGITS = 4
_AROUND = 0.03
_SHARES = 5


@dataclass(frozen=True)
class Grid:
    """
    Settings to try.

    Attributes
    ----------
    q, f, s : tuple of float
        Candidate values, all combinations of which are tried.
    """

    q: tuple[float, ...]
    f: tuple[float, ...]
    s: tuple[float, ...]

    @property
    def size(self) -> int:
        """How many settings."""
        return len(self.q) * len(self.f) * len(self.s)


GRIDS: MappingProxyType[str, Grid] = MappingProxyType({
    # The paper's search space, 120 settings.
    'paper': Grid(
        q=(1.5, 1.8, 2.0, 2.2, 2.4, 2.6),
        f=(0.7, 0.8, 0.9, 1.0, 1.1),
        s=(0.95, 1.0, 1.05, 1.1),
    ),
    # Where real ships turned out to lie beyond it.
    'wide': Grid(
        q=(1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0),
        f=(0.8, 0.9, 1.0, 1.1, 1.2),
        s=(0.9, 0.95, 1.0, 1.05, 1.1),
    ),
})


class Bench:
    """
    Ships laid out for trying many settings of one method.

    Parameters
    ----------
    ships : Ships
        N ships with reference boxes.
    method : str
        A tunable method.

    Raises
    ------
    ValueError
        If a ship has no reference box, or the method has nothing to tune.
    """

    def __init__(self, ships: Ships, method: str = 'superellipse') -> None:
        if not ships.with_reference.all():
            raise ValueError('calibration needs a reference box for every ship')
        self._rule = get_method(method)
        if not self._rule.tunable:
            raise ValueError(f'{method} has no parameters to calibrate')
        self._along = np.abs(ships.boxes.long_axis)
        self._across = np.abs(ships.boxes.short_axis)
        self._low = ships.reference[:, :2].T - ships.boxes.center
        self._high = ships.reference[:, 2:].T - ships.boxes.center
        self._reference_area = area(ships.reference)
        self._outer_area = 4.0 * np.prod(self._along + self._across, axis=0)

    def extents(self, q: float, f: float) -> FloatArray:
        """Compute half-extents before shrinking, pixels, shape (2, N)."""
        return self._rule.half_extents(self._along, self._across * f, q)

    def overlap(self, extents: FloatArray) -> Overlap:
        """Lay the boxes of some half-extents beside the references."""
        shared = self._shared(extents)
        return Overlap(shared, 4.0 * extents[0] * extents[1], self._reference_area)

    def relative_area(self, extents: FloatArray) -> FloatArray:
        """Compare the boxes' areas with those of the outer boxes, shape (N,)."""
        return 4.0 * extents[0] * extents[1] / self._outer_area

    def needed_shrink(self, extents: FloatArray, keep: float) -> FloatArray:
        """
        Find for each ship the smallest s that keeps enough of its reference box.

        What is kept never falls as s grows, so bisection finds it.

        Parameters
        ----------
        extents : ndarray, shape (2, N)
            Half-extents at s = 1, pixels.
        keep : float
            Part of the reference's area, in (0, 1].

        Returns
        -------
        ndarray, shape (N,)
            s to within 1e-11; infinity where the largest s there is does not keep so much.
        """
        enough = keep * self._reference_area * (1.0 - 1e-12)
        low, high = np.zeros(extents.shape[1]), np.full(extents.shape[1], S_RANGE[1])
        reachable = self._shared(extents * high) >= enough
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            kept = self._shared(extents * middle) >= enough
            high = np.where(kept, middle, high)
            low = np.where(kept, low, middle)
        return np.where(reachable, high, np.inf)

    def _shared(self, extents: FloatArray) -> FloatArray:
        """Compute the area shared with the references, (N,)."""
        sides = np.minimum(self._high, extents) - np.maximum(self._low, -extents)
        np.maximum(sides, 0.0, out=sides)
        return sides[0] * sides[1]


@dataclass(frozen=True, eq=False)
class Surface:
    """
    What a grid search found.

    Attributes
    ----------
    grid : Grid
        The settings.
    mean_iou, match50, relative_error : ndarray, shape (Q, F, S)
        Mean IoU, share of ships with IoU of 0.5 or more, mean relative error (Eq. relerr).
    """

    grid: Grid
    mean_iou: FloatArray
    match50: FloatArray
    relative_error: FloatArray

    def best(self, objective: str = 'mean_iou') -> tuple[float, float, float]:
        """Give q, f and s of the best setting, the first of equals, as Algorithm 2 does."""
        target = self.mean_iou
        if objective == 'match50':
            target = np.where(self.match50 == self.match50.max(), self.mean_iou, -1.0)
        i, j, k = np.unravel_index(int(np.argmax(target)), target.shape)
        return self.grid.q[i], self.grid.f[j], self.grid.s[k]


def search(bench: Bench, grid: Grid) -> Surface:
    """
    Try every setting of a grid (Algorithm 2).

    Parameters
    ----------
    bench : Bench
        The ships.
    grid : Grid
        The settings.

    Returns
    -------
    Surface
        The figures of each.
    """
    figures = np.empty((3, len(grid.q), len(grid.f), len(grid.s)))
    for i, q in enumerate(grid.q):
        for j, f in enumerate(grid.f):
            extents = bench.extents(q, f)
            for k, s in enumerate(grid.s):
                found = bench.overlap(extents * s)
                overlap = found.iou
                figures[:, i, j, k] = (
                    overlap.mean(), np.mean(overlap >= 0.5), found.relative_error.mean()
                )
    return Surface(grid, *figures)


@dataclass(frozen=True)
class Plan:
    """
    How to calibrate.

    Attributes
    ----------
    method : str
        A tunable method.
    objective : str
        A key of `OBJECTIVES`.
    grid : Grid
        Where to search.
    refine : bool
        Whether to go on from the best setting of the grid, continuously.
    keep : float
        `coverage`: part of the reference box that a ship has to keep, in (0, 1].
    share : float
        `coverage`: share of ships that have to keep so much, in (0, 1).
    per_image : int
        `coverage`: ships that one image may hold, see `conformal_rank`; 1 takes the ships
        themselves as exchangeable.
    seed : int
        `coverage`: seed of the split into a half that shapes and a half that scales.

    Raises
    ------
    ValueError
        If one of them is out of range; the message names it.
    """

    method: str = 'superellipse'
    objective: str = 'mean_iou'
    grid: Grid = GRIDS['paper']
    refine: bool = True
    keep: float = 0.95
    share: float = 0.95
    per_image: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every value."""
        if not get_method(self.method).tunable:
            raise ValueError(f'{self.method} has no parameters to calibrate')
        if self.objective not in OBJECTIVES:
            raise ValueError(
                f'objective must be one of {", ".join(OBJECTIVES)}, not {self.objective!r}'
            )
        if not 0.0 < self.keep <= 1.0:
            raise ValueError(f'keep must be in (0, 1], not {self.keep}')
        if not 0.0 < self.share < 1.0:
            raise ValueError(f'share must be in (0, 1), not {self.share}')
        if self.per_image < 1:
            raise ValueError(f'per_image must be 1 or more, not {self.per_image}')


DEFAULT_PLAN = Plan()


def calibrate(ships: Ships, plan: Plan = DEFAULT_PLAN) -> HullRule:
    """
    Find the rule that does best on ships.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    plan : Plan
        What to look for, and where.

    Returns
    -------
    HullRule
        The rule, its parameters rounded to four decimals. Under the objective `coverage` it
        carries the guarantee of `conformal_rank`: one half of the images shapes it (q and f), the
        other half, which the shape has not seen, gives the scale s.

    Raises
    ------
    ValueError
        If a ship has no reference box, or there are too few ships for the asked coverage.
    """
    if plan.objective == 'coverage':
        shaping, scaling = split(ships, seed=plan.seed)
        # Rounded first, so that s belongs to the very shape that is written to a file.
        q, f = (round(x, _DIGITS) for x in _coverage_shape(Bench(shaping, plan.method), plan))
        s = conformal_shrink(scaling, plan, q, f)
        scale = 10.0**_DIGITS
        return HullRule(plan.method, q, f, min(float(np.ceil(s * scale) / scale), S_RANGE[1]))
    bench = Bench(ships, plan.method)
    start = search(bench, plan.grid).best(plan.objective)
    if plan.refine:
        start = _refined(start, _objective(bench, plan.objective))
    return HullRule(plan.method, *(round(value, _DIGITS) for value in start))


def _objective(bench: Bench, objective: str) -> Callable[[_Point], tuple[float, ...]]:
    """Make the function of (u, f, s) that is to grow."""

    def value(point: _Point) -> tuple[float, ...]:
        u, f, s = point
        overlap = bench.overlap(bench.extents(_q_of(u), f) * s).iou
        mean = float(overlap.mean())
        return (float(np.mean(overlap >= 0.5)), mean) if objective == 'match50' else (mean,)

    return value


def _refined(
    start: tuple[float, float, float], value: Callable[[_Point], tuple[float, ...]]
) -> tuple[float, float, float]:
    """
    Climb from a setting, one coordinate at a time with halving steps (compass search).

    It needs no derivative, which medians and shares do not have, and never ends below its start.
    """
    q, f, s = start
    point: _Point = (1.0 - 1.0 / q, f, s)
    best = value(point)
    step = _FIRST_STEP
    while step >= _LAST_STEP:
        moved = False
        for axis in range(3):
            for sign in (1.0, -1.0):
                other = _moved(point, axis, sign * step)
                found = value(other)
                if found > best:
                    point, best, moved = other, found, True
        if not moved:
            step /= 2.0
    u, f, s = point
    return _q_of(u), f, s


def _moved(point: _Point, axis: int, step: float) -> _Point:
    """Move along one coordinate, within the bounds."""
    values = list(point)
    values[axis] = min(max(values[axis] + step, _LOWEST[axis]), _HIGHEST[axis])
    return values[0], values[1], values[2]


def _q_of(u: float) -> float:
    """Give the shape exponent of u = 1 - 1/q."""
    return 1.0 / (1.0 - u) if u < 1.0 else float('inf')


def _coverage_shape(bench: Bench, plan: Plan) -> tuple[float, float]:
    """
    Choose q and f so that the boxes that cover enough ships are smallest, (q, f).

    The area is averaged over shares around the asked one: a single quantile of some dozen ships
    that matter would let chance choose the shape.
    """
    around = min(_AROUND, 0.6 * (1.0 - plan.share))
    shares = np.linspace(plan.share - around, plan.share + around, _SHARES)

    def value(point: _Point) -> tuple[float, ...]:
        u, f, _ = point
        extents = bench.extents(_q_of(u), f)
        needed = np.quantile(bench.needed_shrink(extents, plan.keep), shares, method='higher')
        if not np.isfinite(needed).all():
            return (-np.inf,)
        return (-float(np.mean(needed**2) * bench.relative_area(extents).mean()),)

    candidates = [(q, f, 1.0) for q in plan.grid.q for f in plan.grid.f]
    start = max(candidates, key=lambda each: value((1.0 - 1.0 / each[0], each[1], 1.0)))
    q, f, _ = _refined(start, value) if plan.refine else start
    return q, f


def conformal_rank(count: int, share: float, per_image: int = 1) -> int:
    """
    Tell which of the calibration ships' needed scales, sorted, guarantees a share of new ships.

    With `per_image` 1 this is split conformal prediction, rank ``ceil((n + 1) share)``: if the n
    calibration ships and a new one are exchangeable, the new one keeps enough with a probability
    of at least `share`, whatever their distribution and however bad the shape (Vovk et al. 2005;
    Lei et al. 2018). The probability is over the draw of the calibration ships as well: one
    calibration may land some percent lower, by about ``sqrt(share (1 - share) / n)``.

    Ships of one image resemble each other. With `per_image` M, the most ships that an image can
    hold, only the images need be exchangeable: the count of ships of an image that miss, less
    (1 - share) times its ships, falls as s grows and is at most ``share * M``, so conformal risk
    control (Angelopoulos et al. 2022) applies to it at level 0. It asks for ``misses + share * M <=
    (1 - share) n`` and gives, for a new image, E[misses] <= (1 - share) E[ships]. For M = 1 the
    two are the same.

    Neither holds for ships of another kind than those calibrated on.

    Parameters
    ----------
    count : int
        n, the calibration ships.
    share : float
        Share of new ships that shall keep enough, in (0, 1).
    per_image : int
        M.

    Returns
    -------
    int
        Rank from 1 (smallest) to n.

    Raises
    ------
    ValueError
        If there are too few ships for any guarantee.
    """
    # Allow for rounding: 0.05 * 20 - 0.95 is not quite 0.05 in binary.
    misses = int(np.floor((1.0 - share) * count - share * per_image + 1e-9))
    if misses < 0:
        least = int(np.ceil(share * per_image / (1.0 - share) - 1e-9))
        raise ValueError(
            f'{count} ships are too few to calibrate a share of {share:g}: it takes {least} or more'
        )
    return count - misses


def conformal_shrink(ships: Ships, plan: Plan, q: float, f: float) -> float:
    """
    Scale a shape so that the asked share of new ships keeps enough.

    Parameters
    ----------
    ships : Ships
        Ships that had no part in choosing q and f.
    plan : Plan
        `method`, `keep`, `share` and `per_image` are used.
    q, f : float
        The shape.

    Returns
    -------
    float
        s.

    Raises
    ------
    ValueError
        If there are too few ships, or no s in its range keeps enough of them.
    """
    bench = Bench(ships, plan.method)
    needed = np.sort(bench.needed_shrink(bench.extents(q, f), plan.keep))
    s = float(needed[conformal_rank(len(ships), plan.share, plan.per_image) - 1])
    if not np.isfinite(s):
        raise ValueError(
            f'no s up to {S_RANGE[1]:g} keeps {plan.keep:g} of {plan.share:g} of the ships: '
            'are the reference boxes those of the same ships?'
        )
    return s


def split(ships: Ships, seed: int = 0) -> tuple[Ships, Ships]:
    """
    Halve ships by image.

    Parameters
    ----------
    ships : Ships
        Ships of two or more images.
    seed : int
        Seed of the split.

    Returns
    -------
    tuple of Ships
        The ships of one half of the images and of the other.

    Raises
    ------
    ValueError
        If there is only one image.
    """
    fold = folds_of(ships, 2, seed)
    return ships.take(fold == 0), ships.take(fold == 1)


def folds_of(ships: Ships, folds: int, seed: int = 0) -> NDArray[np.intp]:
    """
    Deal images out to folds, so that no image lies in two.

    Parameters
    ----------
    ships : Ships
        N ships.
    folds : int
        How many, 2 or more.
    seed : int
        Seed of the deal.

    Returns
    -------
    ndarray of int, shape (N,)
        The fold of each ship.

    Raises
    ------
    ValueError
        If there are fewer than two folds, or fewer images than folds.
    """
    images = ships.image_count
    if not 2 <= folds <= images:
        raise ValueError(f'{images} images cannot be dealt out to {folds} folds; 2 to {images} can')
    order = np.random.default_rng(seed).permutation(images)
    return np.asarray(order[ships.image_of] % folds)


def held_out_boxes(
    ships: Ships, fit: Callable[[Ships, Ships], FloatArray], folds: int = 5, seed: int = 0
) -> FloatArray:
    """
    Convert each ship by what was learnt from other images.

    Parameters
    ----------
    ships : Ships
        N ships with reference boxes.
    fit : callable
        Gets the ships to learn from and the ships to convert; gives the boxes of the latter, xyxy.
    folds : int
        In how many parts to leave out the images.
    seed : int
        Seed of the parts.

    Returns
    -------
    ndarray, shape (N, 4)
        Boxes, pixels.
    """
    fold = folds_of(ships, folds, seed)
    xyxy = np.empty((len(ships), 4))
    for index in range(folds):
        mine = fold == index
        xyxy[mine] = fit(ships.take(~mine), ships.take(mine))
    return xyxy


def one_rule(plan: Plan) -> Callable[[Ships, Ships], FloatArray]:
    """Make the `fit` of `held_out_boxes` that calibrates one rule for all ships."""

    def fit(known: Ships, new: Ships) -> FloatArray:
        return convert_by_rule(new.boxes, calibrate(known, plan))

    return fit


def rule_by_group(
    plan: Plan, groups: Callable[[Ships, Ships], tuple[NDArray[np.intp], NDArray[np.intp]]]
) -> Callable[[Ships, Ships], FloatArray]:
    """
    Make the `fit` of `held_out_boxes` that calibrates each group of ships by itself.

    Parameters
    ----------
    plan : Plan
        How.
    groups : callable
        Gets the ships to learn from and those to convert; gives the number of each one's group,
        negative where it shall have the rule of all.

    Returns
    -------
    callable
        The `fit`.
    """

    def fit(known: Ships, new: Ships) -> FloatArray:
        xyxy = convert_by_rule(new.boxes, calibrate(known, plan))
        of_known, of_new = groups(known, new)
        for group in np.unique(of_new[of_new >= 0]):
            rows = of_known == group
            if rows.any() and enough(known.take(rows), plan):
                rule = calibrate(known.take(rows), plan)
                mine = of_new == group
                xyxy[mine] = convert_by_rule(new.boxes.take(mine), rule)
        return xyxy

    return fit


def aspect_edges(ships: Ships, bands: int) -> FloatArray:
    """Cut ships into bands of aspect ratio of equal count; the inner edges, shape (bands - 1,)."""
    return np.asarray(np.quantile(ships.aspect, np.arange(1, bands) / bands))


def aspect_groups(
    bands: int,
) -> Callable[[Ships, Ships], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Make the `groups` of `rule_by_group` that are bands of aspect ratio."""

    def groups(known: Ships, new: Ships) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        edges = aspect_edges(known, bands)
        return np.searchsorted(edges, known.aspect), np.searchsorted(edges, new.aspect)

    return groups


def class_groups(
    classes: Sequence[str],
) -> Callable[[Ships, Ships], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Make the `groups` of `rule_by_group` that are classes; others have the rule of all."""

    def number(ships: Ships) -> NDArray[np.intp]:
        found = np.full(len(ships), -1, dtype=np.intp)
        for index, name in enumerate(classes):
            found[ships.class_ids == name] = index
        return found

    return lambda known, new: (number(known), number(new))


def enough(ships: Ships, plan: Plan, least: int = 30) -> bool:
    """
    Tell whether a group of ships is large enough for a rule of its own.

    Parameters
    ----------
    ships : Ships
        The group.
    plan : Plan
        How it would be calibrated.
    least : int
        Ships that it has to have under any objective.

    Returns
    -------
    bool
        False too where `coverage` could not be guaranteed from so few.
    """
    if len(ships) < least or ships.image_count < 2:
        return False
    if plan.objective != 'coverage':
        return True
    scaling = len(split(ships, plan.seed)[1])
    return (1.0 - plan.share) * scaling + 1e-9 >= plan.share * plan.per_image
