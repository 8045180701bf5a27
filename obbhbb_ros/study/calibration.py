# SPDX-License-Identifier: Apache-2.0
"""Calibrate a rule on labelled ships: for best IoU, most matches, or guaranteed coverage."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import S_RANGE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.geometry.methods import METHODS
from obbhbb_ros.study import grid_search
from obbhbb_ros.study.grid_search import Bench
from obbhbb_ros.study.grid_search import Point
from obbhbb_ros.study.metrics import overlap_with_hbb
from obbhbb_ros.study.ships import Ships

# A smaller gain on held-out images is none.
LEAST_GAIN = 0.002
# Ships below this number are too few for a rule of their own.
FEWEST = 30
# What to fit beside q: f and s if they gain, always, or never.
FITS = ('auto', 'all', 'q')
_FOLDS = 5
_DIGITS = 4
_AROUND = 0.03
_SHARES = 5


@dataclass(frozen=True)
class Objective:
    """What to optimise: a figure of `evaluation.figures`, which is to grow if `sign` is 1."""

    summary: str
    figure: str
    unit: str
    sign: float = 1.0


OBJECTIVES: MappingProxyType[str, Objective] = MappingProxyType(
    {
        'mean_iou': Objective(summary='the largest mean IoU', figure='iou', unit='mean IoU'),
        'match50': Objective(
            summary='the most ships with an IoU of 0.5 or more, then the largest mean IoU',
            figure='match',
            unit='match50',
        ),
        'coverage': Objective(
            summary='the smallest mean area that covers the required share of ships',
            figure='area',
            unit='relative area',
            sign=-1.0,
        ),
    }
)


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
        Whether to refine the best setting of the grid continuously; if not, all of q, f and s are
        fitted, as Algorithm 2 has it.
    fit : str
        Whether to fit f and s beside q: `auto`: if they gain `LEAST_GAIN` or more on held-out
        images; `all`: always; `q`: never. With `coverage`, s is always fitted.
    ends : bool or None
        Whether to fit q_bow and q_stern where the bow is known; None: if they gain that much.
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
    fit: str = 'auto'
    ends: bool | None = None
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
        if self.fit not in FITS:
            raise ValueError(f'fit must be one of {", ".join(FITS)}, not {self.fit!r}')
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
        The rule, its parameters rounded to four decimals; those that are not fitted are 1, or None
        for q_bow and q_stern. With the objective `coverage` it has
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
    plan, _ = decide(ships, plan)
    if plan.objective == 'coverage':
        return _covering_rule(ships, plan)
    point = _fitted(Bench(ships, plan.method), plan, plan.fit == 'all')
    rule = HullRule(plan.method, *(round(each, _DIGITS) for each in (point.q, point.f, point.s)))
    if plan.ends and ships.with_bow.any():
        return fit_ends(ships.take(ships.with_bow), rule, plan)
    return rule


class Trials(NamedTuple):
    """Gains on held-out images that decide what is fitted; None: not tried."""

    over_q: float | None = None
    ends: float | None = None


def decide(ships: Ships, plan: Plan) -> tuple[Plan, Trials]:
    """
    Decide what to fit beside q, where a plan leaves that open.

    Returns the plan with `fit` and `ends` decided, and what they gained over q alone, see
    `gain_over_q` and `bow_gain`.
    """
    over_q = ends = None
    if plan.fit == 'auto' and plan.refine:
        # With `coverage` the second half serves the guarantee alone.
        half = split(ships, plan.seed)[0] if plan.objective == 'coverage' else ships
        over_q = gain_over_q(half, plan)
    fit = plan.fit
    if fit == 'auto':
        fit = 'all' if over_q is None or over_q >= LEAST_GAIN else 'q'
    if plan.ends is None and plan.refine and has_ends(ships, plan):
        ends = bow_gain(ships, replace(plan, fit=fit))
    chosen = ends is not None and ends >= LEAST_GAIN if plan.ends is None else plan.ends
    return replace(plan, fit=fit, ends=chosen), Trials(over_q, ends)


def has_ends(ships: Ships, plan: Plan) -> bool:
    """Check whether q_bow and q_stern can be fitted: enough ships, in two images, and a use."""
    if plan.objective == 'coverage' or not METHODS[plan.method].two_ended:
        return False
    known = ships.image_of[ships.with_bow]
    return len(known) >= FEWEST and len(np.unique(known)) >= 2


def _value(bench: Bench, plan: Plan) -> Callable[[Point], tuple[float, ...]]:
    """Return what is to be maximised: first the figure of the objective, then what breaks ties."""
    if plan.objective == 'coverage':
        return _covering_value(bench, plan)

    def value(point: Point) -> tuple[float, ...]:
        found = bench.overlap(bench.extents(point.q, point.f) * point.s)
        mean = float(found.iou.mean())
        return (float(found.match(0.5).mean()), mean) if plan.objective == 'match50' else (mean,)

    return value


def _fitted(bench: Bench, plan: Plan, everything: bool) -> Point:
    """Fit q alone or everything: q, f and s, without s for `coverage`, which has a use for it."""
    grid = plan.grid if everything else plan.grid.q_alone()
    value = _value(bench, plan)
    if plan.objective == 'coverage':
        best = max((Point(1.0 - 1.0 / q, f, 1.0) for q in grid.q for f in grid.f), key=value)
    else:
        q, f, s = grid_search.search(bench, grid).best(plan.objective)
        best = Point(1.0 - 1.0 / q, f, s)
    if not plan.refine:
        return best
    free = (2 if plan.objective == 'coverage' else 3) if everything else 1
    return grid_search.refine(best, value, free)


def gain_over_q(ships: Ships, plan: Plan) -> float:
    """
    Measure what f and s gain over q alone on held-out images, in the figure of the objective.

    They are hardly identifiable: along a ridge of q, f and s the boxes are nearly the same. For
    `coverage` it is f alone, as s is always fitted. 0 if there are fewer than two images.
    """
    folds = min(_FOLDS, ships.image_count)
    if folds < 2:
        return 0.0
    fold, gain = folds_of(ships, folds, plan.seed), 0.0
    for index in range(folds):
        known = Bench(ships.take(fold != index), plan.method)
        value = _value(Bench(ships.take(fold == index), plan.method), plan)
        points = (_fitted(known, plan, everything) for everything in (True, False))
        more, base = (value(point)[0] for point in points)
        # Without any ship in reach the difference is that of two infinities.
        gain += (more - base) * float(np.mean(fold == index)) if more > -np.inf else -np.inf
    return gain


def fit_ends(ships: Ships, rule: HullRule, plan: Plan) -> HullRule:
    """
    Fit q_bow and q_stern to ships whose bow is known, beginning at the q of a rule.

    f and s are those of the rule. Raises ValueError if the method has no ends.
    """
    if not METHODS[rule.method].two_ended:
        raise ValueError(f'{rule.method} has no q_bow and q_stern')

    def ends(point: Point) -> HullRule:
        q_bow, q_stern = (
            round(1.0 / (1.0 - u), _DIGITS) if u < 1.0 else np.inf for u in (point.u, point.f)
        )
        return replace(rule, q_bow=q_bow, q_stern=q_stern)

    def value(point: Point) -> tuple[float, ...]:
        if point.f > 1.0:
            return (-np.inf,)
        return tuple(float(each.mean()) for each in _figures(ships, ends(point), plan))

    u = 1.0 - 1.0 / rule.q
    # The second coordinate is that of the stern.
    return ends(grid_search.refine(Point(u, u, 1.0), value, 2))


def _figures(ships: Ships, rule: HullRule, plan: Plan) -> tuple[FloatArray, FloatArray]:
    """Compute the figure of an objective without guarantee, (N,), and the IoU, (N,)."""
    found = overlap_with_hbb(convert_by_rule(ships.boxes, rule), ships.reference)
    match = found.match(0.5).astype(float)
    return (match if plan.objective == 'match50' else found.iou), found.iou


def bow_gain(ships: Ships, plan: Plan) -> float:
    """
    Measure what q_bow and q_stern gain over q on held-out images, on ships whose bow is known.

    f and s are the same for both, as `plan.fit` has it.

    Raises ValueError if there are fewer than two images of such ships.
    """
    known = ships.take(ships.with_bow)
    folds = min(_FOLDS, known.image_count)
    single = replace(plan, ends=False)
    fold, gain = folds_of(known, folds, plan.seed), np.zeros(len(known))
    for index in range(folds):
        mine = fold == index
        base = calibrate(known.take(~mine), single)
        ends = fit_ends(known.take(~mine), base, plan)
        new = known.take(mine)
        gain[mine] = _figures(new, ends, plan)[0] - _figures(new, base, plan)[0]
    return float(gain.mean())


def _covering_rule(ships: Ships, plan: Plan) -> HullRule:
    """Choose q and f on one half of the images, and on the other the s that keeps enough ships."""
    shaping, scaling = split(ships, seed=plan.seed)
    point = _fitted(Bench(shaping, plan.method), plan, plan.fit == 'all')
    # Rounded first, so that s belongs to exactly the shape that is written to a file.
    q, f = round(point.q, _DIGITS), round(point.f, _DIGITS)
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


def _covering_value(bench: Bench, plan: Plan) -> Callable[[Point], tuple[float, ...]]:
    """
    Return how small the boxes of a shape are that cover enough ships, negative.

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

    return value


def covered_shares(
    ships: Ships, rule: HullRule, plan: Plan, samples: int = 1000
) -> tuple[float, float]:
    """
    Estimate how the share of ships that keep enough scatters from calibration to calibration.

    The images that gave s are drawn with replacement twice: the first draw gives an s, by the rank
    of `conformal_rank`, and the second one stands for as many new images, whose ships are counted.

    Parameters
    ----------
    ships, rule, plan
        What `calibrate` was given and what it returned, with the objective `coverage`.
    samples : int
        Number of draws.

    Returns
    -------
    tuple of float
        95 % interval of the share of new ships that keep enough.
    """
    scaling = split(ships, seed=plan.seed)[1]
    bench = Bench(scaling, plan.method)
    needed = bench.needed_shrink(bench.extents(rule.q, rule.f), plan.keep)
    order = np.argsort(needed, kind='stable')
    needed, image = needed[order], scaling.image_of[order]
    found = []
    random = np.random.default_rng(plan.seed)
    images = scaling.image_count
    for _ in range(samples):
        first, second = (
            np.bincount(random.integers(images, size=images), minlength=images)[image]
            for _ in range(2)
        )
        count = int(first.sum())
        # The largest s there is, if the draw has too few ships.
        rank = count - max(_misses(count, plan.share, plan.per_image), 0)
        kept = needed <= needed[np.searchsorted(np.cumsum(first), rank)]
        found.append(float(second[kept].sum() / second.sum()))
    low, high = np.quantile(found, (0.025, 0.975)).tolist()
    return low, high


def conformal_rank(count: int, share: float, per_image: int = 1) -> int:
    """
    Compute the rank of the calibration ship whose needed scale guarantees a share of new ships.

    With `per_image` 1 this is split conformal prediction, rank ``ceil((n + 1) share)``: if the n
    calibration ships and a new one are exchangeable, the new one keeps enough with a probability
    of at least `share`, whatever their distribution and however bad the shape (Vovk et al. 2005;
    Lei et al. 2018). The probability is over the draw of the calibration ships as well: one
    calibration may land some percent lower. How much depends on the number of images rather than
    of ships, see `covered_shares`.

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
    misses = _misses(count, share, per_image)
    if misses < 0:
        least = int(np.ceil(share * per_image / (1.0 - share) - 1e-9))
        raise ValueError(
            f'{count} ships are too few to calibrate a share of {share:g}: it takes {least} or more'
        )
    return count - misses


def _misses(count: int, share: float, per_image: int) -> int:
    """Count the ships that may miss, see `conformal_rank`; negative if there are too few."""
    # Allow for rounding: 0.05 * 20 - 0.95 is not quite 0.05 in binary.
    return int(np.floor((1.0 - share) * count - share * per_image + 1e-9))


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


def enough(ships: Ships, plan: Plan, least: int = FEWEST) -> bool:
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
