# SPDX-License-Identifier: Apache-2.0
"""Calibration for coverage: the smallest boxes that keep a required share of the ships."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import replace

import numpy as np

from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.converter import S_RANGE
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.study.bootstrap import Interval
from obbhbb_ros.study.folds import split
from obbhbb_ros.study.grid_search import Bench
from obbhbb_ros.study.objectives import Objective
from obbhbb_ros.study.ships import Ships

_DRAWS = 1000
# s is rounded up to four decimals.
_S_SCALE = 1e4
# The area of a shape is averaged over this many shares, up to this far from the required one.
_SHARES = 5
_SHARE_MARGIN = 0.03


@dataclass(frozen=True)
class Coverage(Objective):
    """
    The smallest mean area that covers the required share of ships.

    q and f come from one half of the images, and s from the other half, so that the rule has the
    guarantee of `conformal_rank`.

    Attributes
    ----------
    keep : float
        Share of the reference box that a box must contain, in (0, 1].
    share : float
        Share of ships whose box must contain that much, in (0, 1).
    per_image : int
        Maximum number of ships per image, see `conformal_rank`; 1 if the ships are exchangeable.

    Raises
    ------
    ValueError
        If a value is out of range; the message names it.
    """

    share: float = 0.95
    per_image: int = 1
    name = 'coverage'
    summary = 'the smallest mean area that covers the required share of ships'
    metric = 'area'
    unit = 'relative area'
    sign = -1.0
    parameters = ('q', 'f')

    def __post_init__(self) -> None:
        """Check every value."""
        super().__post_init__()
        if not 0.0 < self.share < 1.0:
            raise ValueError(f'share must be in (0, 1), not {self.share}')
        if self.per_image < 1:
            raise ValueError(f'per_image must be 1 or more, not {self.per_image}')

    def value(self, bench: Bench, extents: FloatArray) -> tuple[float, ...]:
        """
        Rate half-extents before shrinking, (2, N), by the area that covers enough ships, negative.

        The area is averaged over shares around the required one: with a single quantile, which
        depends on a few dozen ships, chance would choose the shape.
        """
        margin = min(_SHARE_MARGIN, 0.6 * (1.0 - self.share))
        shares = np.linspace(self.share - margin, self.share + margin, _SHARES)
        needed = np.quantile(bench.needed_shrink(extents, self.keep), shares, method='higher')
        if not np.isfinite(needed).all():
            return (-np.inf,)
        return (-float(np.mean(needed**2) * bench.relative_area(extents).mean()),)

    def shaping_ships(self, ships: Ships, seed: int) -> Ships:
        """Select the half of the ships that q and f are fitted to."""
        return split(ships, seed)[0]

    def finish(self, rule: HullRule, ships: Ships, seed: int) -> HullRule:
        """
        Choose the smallest s, rounded up, that keeps enough of the half that gives s.

        Raises ValueError if the ships are too few, or no s in its range keeps enough.
        """
        scaling = split(ships, seed)[1]
        needed = np.sort(self._needed(scaling, rule))
        s = float(needed[conformal_rank(len(scaling), self.share, self.per_image) - 1])
        if not np.isfinite(s):
            raise ValueError(
                f'no s up to {S_RANGE.high:g} keeps {self.keep:g} of {self.share:g} of the ships: '
                'are the reference boxes those of the same ships?'
            )
        return replace(rule, s=min(float(np.ceil(s * _S_SCALE) / _S_SCALE), S_RANGE.high))

    def is_enough(self, ships: Ships, seed: int) -> bool:
        """Check whether the half that gives s has enough ships for the guarantee."""
        return _misses(len(split(ships, seed)[1]), self.share, self.per_image) >= 0

    def scatter(self, ships: Ships, rule: HullRule, seed: int, draws: int = _DRAWS) -> Interval:
        """
        Estimate how the share of ships that keep enough scatters from calibration to calibration.

        The images that gave s are drawn with replacement twice: the first draw gives an s, by the
        rank of `conformal_rank`, and the second one stands for as many new images, whose ships are
        counted.

        Parameters
        ----------
        ships : Ships
            The ships of the calibration.
        rule : HullRule
            Its result.
        seed : int
            Its seed.
        draws : int
            Number of draws.

        Returns
        -------
        Interval
            95 % interval of the share of new ships that keep enough.
        """
        scaling = split(ships, seed)[1]
        needed = self._needed(scaling, rule)
        order = np.argsort(needed, kind='stable')
        needed, image_of = needed[order], scaling.image_of[order]
        random, images, shares = np.random.default_rng(seed), scaling.image_count, []
        for _ in range(draws):
            first, second = (
                np.bincount(random.integers(images, size=images), minlength=images)[image_of]
                for _ in range(2)
            )
            count = int(first.sum())
            # The largest s there is, if the draw has too few ships.
            rank = count - max(_misses(count, self.share, self.per_image), 0)
            kept = needed <= needed[np.searchsorted(np.cumsum(first), rank)]
            shares.append(float(second[kept].sum() / second.sum()))
        return Interval(*np.quantile(shares, (0.025, 0.975)).tolist())

    def _needed(self, ships: Ships, rule: HullRule) -> FloatArray:
        """Find the s that each ship needs under the q and f of a rule, (N,)."""
        bench = Bench(ships, rule.method)
        return bench.needed_shrink(bench.extents(rule.q, rule.f), self.keep)


def conformal_rank(count: int, share: float, per_image: int = 1) -> int:
    """
    Compute the rank of the calibration ship whose needed scale guarantees a share of new ships.

    With `per_image` 1 this is split conformal prediction, rank ``ceil((n + 1) share)``: if the n
    calibration ships and a new one are exchangeable, the new one keeps enough with a probability
    of at least `share`, whatever their distribution and however bad the shape (Vovk et al. 2005;
    Lei et al. 2018). The probability is over the draw of the calibration ships as well: one
    calibration may land some percent lower. How much depends on the number of images rather than
    of ships, see `Coverage.scatter`.

    Ships of one image resemble each other. With `per_image` M, the maximum number of ships in
    an image, only the images need be exchangeable: the number of ships of an image that miss, less
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
        needed = int(np.ceil(share * per_image / (1.0 - share) - 1e-9))
        raise ValueError(
            f'{count} ships are too few to calibrate a share of {share:g}: '
            f'it takes {needed} or more'
        )
    return count - misses


def _misses(count: int, share: float, per_image: int) -> int:
    """Count the ships that may miss, see `conformal_rank`; negative if there are too few."""
    # Allow for rounding: 0.05 * 20 - 0.95 is not quite 0.05 in binary.
    return int(np.floor((1.0 - share) * count - share * per_image + 1e-9))
