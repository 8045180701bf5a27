# SPDX-License-Identifier: Apache-2.0
"""Calibrate a rule on labelled ships: for best IoU, most matches, or guaranteed coverage."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.converter import S_RANGE
from obbhbb_ros.converter import HullRule
from obbhbb_ros.study import grid_search
from obbhbb_ros.study.grid_search import Bench
from obbhbb_ros.study.grid_search import Point
from obbhbb_ros.study.ships import Ships

_DIGITS = 4
_AROUND = 0.03
_SHARES = 5


@dataclass(frozen=True)
class Objective:
    """What to optimise: a figure of `evaluation.figures`, which is to grow if `sign` is 1."""

    summary: str
    figure: str
    sign: float = 1.0


OBJECTIVES: MappingProxyType[str, Objective] = MappingProxyType({
    'mean_iou': Objective(summary='the largest mean IoU', figure='iou'),
    'match50': Objective(
        summary='the most ships with an IoU of 0.5 or more, then the largest mean IoU',
        figure='match',
    ),
    'coverage': Objective(
        summary='the smallest mean area that covers the required share of ships',
        figure='area', sign=-1.0,
    ),
})


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
        Whether to refine the best setting of the grid continuously.
    keep : float
        `coverage`: share of the reference box that a box must contain, in (0, 1].
    share : float
        `coverage`: share of ships whose box must contain that much, in (0, 1).
    per_image : int
        `coverage`: maximum number of ships per image, see `conformal_rank`; 1 if the ships are
        exchangeable.
    seed : int
        `coverage`: seed of the split into a half for q and f and a half for s.

    Raises
    ------
    ValueError
        If a value is out of range; the message names it.
    """

    method: str = 'superellipse'
    objective: str = 'mean_iou'
    grid: grid_search.Grid = grid_search.GRIDS['paper']
    refine: bool = True
    keep: float = 0.95
    share: float = 0.95
    per_image: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        """Check every value."""
        grid_search.tunable(self.method)
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
    Find the best rule for ships.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    plan : Plan
        Objective and search space.

    Returns
    -------
    HullRule
        The rule, its parameters rounded to four decimals. With the objective `coverage` it has
        the guarantee of `conformal_rank`: q and f come from one half of the images, and s from
        the other half.

    Raises
    ------
    ValueError
        If a ship has no reference box, there are too few ships for the required coverage, or no s
        in its range gives it.

    Examples
    --------
    >>> from obbhbb_ros.study.hulls import FAMILIES, synthetic_ships
    >>> boxy = synthetic_ships([FAMILIES['rectangular']], [1.0], aspects=2, angles=9)
    >>> calibrate(boxy).q > 50
    True
    """
    if plan.objective == 'coverage':
        return _covering_rule(ships, plan)
    bench = Bench(ships, plan.method)

    def value(point: Point) -> tuple[float, ...]:
        found = bench.overlap(bench.extents(point.q, point.f) * point.s)
        mean = float(found.iou.mean())
        return (float(found.match(0.5).mean()), mean) if plan.objective == 'match50' else (mean,)

    q, f, s = grid_search.search(bench, plan.grid).best(plan.objective)
    if plan.refine:
        point = grid_search.refine(Point(1.0 - 1.0 / q, f, s), value)
        q, f, s = point.q, point.f, point.s
    return HullRule(plan.method, *(round(each, _DIGITS) for each in (q, f, s)))


def _covering_rule(ships: Ships, plan: Plan) -> HullRule:
    """Choose q and f on one half of the images, and on the other the s that keeps enough ships."""
    shaping, scaling = split(ships, seed=plan.seed)
    # Rounded first, so that s belongs to exactly the shape that is written to a file.
    q, f = (round(each, _DIGITS) for each in _covering_shape(Bench(shaping, plan.method), plan))
    bench = Bench(scaling, plan.method)
    needed = np.sort(bench.needed_shrink(bench.extents(q, f), plan.keep))
    s = float(needed[conformal_rank(len(scaling), plan.share, plan.per_image) - 1])
    if not np.isfinite(s):
        raise ValueError(
            f'no s up to {S_RANGE[1]:g} keeps {plan.keep:g} of {plan.share:g} of the ships: '
            'are the reference boxes those of the same ships?'
        )
    scale = 10.0**_DIGITS
    return HullRule(plan.method, q, f, min(float(np.ceil(s * scale) / scale), S_RANGE[1]))


def _covering_shape(bench: Bench, plan: Plan) -> tuple[float, float]:
    """
    Choose q and f for the smallest boxes that cover enough ships.

    The area is averaged over shares around the required one: with a single quantile, which depends
    on a few dozen ships, chance would choose the shape.
    """
    around = min(_AROUND, 0.6 * (1.0 - plan.share))
    shares = np.linspace(plan.share - around, plan.share + around, _SHARES)

    def value(point: Point) -> tuple[float, ...]:
        extents = bench.extents(point.q, point.f)
        needed = np.quantile(bench.needed_shrink(extents, plan.keep), shares, method='higher')
        if not np.isfinite(needed).all():
            return (-np.inf,)
        return (-float(np.mean(needed**2) * bench.relative_area(extents).mean()),)

    candidates = [Point(1.0 - 1.0 / q, f, 1.0) for q in plan.grid.q for f in plan.grid.f]
    best = max(candidates, key=value)
    if plan.refine:
        best = grid_search.refine(best, value)
    return best.q, best.f


def conformal_rank(count: int, share: float, per_image: int = 1) -> int:
    """
    Compute the rank of the calibration ship whose needed scale guarantees a share of new ships.

    With `per_image` 1 this is split conformal prediction, rank ``ceil((n + 1) share)``: if the n
    calibration ships and a new one are exchangeable, the new one keeps enough with a probability
    of at least `share`, whatever their distribution and however bad the shape (Vovk et al. 2005;
    Lei et al. 2018). The probability is over the draw of the calibration ships as well: one
    calibration may land some percent lower, by about ``sqrt(share (1 - share) / n)``.

    Ships of one image resemble each other. With `per_image` M, the most ships that an image can
    hold, only the images need be exchangeable: the number of ships of an image that miss, less
    (1 - share) times its ships, falls as s grows and is at most ``share * M``, so conformal risk
    control (Angelopoulos et al. 2022) applies to it at level 0. It needs ``misses + share * M <=
    (1 - share) n`` and gives, for a new image, E[misses] <= (1 - share) E[ships]. For M = 1 the
    two are the same.

    Neither holds for ships of another kind than those in the calibration.

    Parameters
    ----------
    count : int
        n, the calibration ships.
    share : float
        Share of new ships that have to keep enough, in (0, 1).
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

    Examples
    --------
    >>> conformal_rank(199, 0.95)
    190
    """
    # Allow for rounding: 0.05 * 20 - 0.95 is not quite 0.05 in binary.
    misses = int(np.floor((1.0 - share) * count - share * per_image + 1e-9))
    if misses < 0:
        least = int(np.ceil(share * per_image / (1.0 - share) - 1e-9))
        raise ValueError(
            f'{count} ships are too few to calibrate a share of {share:g}: it takes {least} or more'
        )
    return count - misses


def split(ships: Ships, seed: int = 0) -> tuple[Ships, Ships]:
    """Split the ships of two or more images into two halves by image, see `folds_of`."""
    fold = folds_of(ships, 2, seed)
    return ships.take(fold == 0), ships.take(fold == 1)


def folds_of(ships: Ships, folds: int, seed: int = 0) -> NDArray[np.intp]:
    """
    Find the fold of each of N ships, (N,), so that no image lies in two folds.

    Raises ValueError if there are fewer than two folds, or fewer images than folds.
    """
    images = ships.image_count
    if not 2 <= folds <= images:
        raise ValueError(
            f'{images} images cannot be split into {folds} folds: give 2 or more, at most one per '
            'image'
        )
    order = np.random.default_rng(seed).permutation(images)
    return np.asarray(order[ships.image_of] % folds)


def enough(ships: Ships, plan: Plan, least: int = 30) -> bool:
    """
    Check whether a group of ships is large enough for a rule of its own.

    It needs `least` ships, and for the objective `coverage` enough of them for its guarantee.
    """
    if len(ships) < least or ships.image_count < 2:
        return False
    if plan.objective != 'coverage':
        return True
    scaling = len(split(ships, plan.seed)[1])
    return (1.0 - plan.share) * scaling + 1e-9 >= plan.share * plan.per_image
