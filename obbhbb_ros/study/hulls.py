# SPDX-License-Identifier: Apache-2.0
"""
Synthetic hulls: the paper's four families at its four levels of fullness.

The paper names the families and prints a table of their mean relative errors; it does not publish
the polygons. So they are rebuilt here. What was chosen, by looking at that table: a hull touches
its oriented box at bow, stern and amidships, whatever its fullness, and the fullness narrows its
ends (narrowing the whole hull instead misses the rows below 1.00 by three times as much); aspect
ratios run from 3 to 7, angles evenly over a quarter turn. What was fitted: one number a family,
the width of its ends, so that the row "N" at fullness 1.00 comes out (`fit_ends`). Everything else
that the hulls give is a prediction, and `paper_comparison` sets all of it beside the paper's.

`python -m obbhbb_ros.study.hulls [PICTURE]` prints the comparison and draws the hulls.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from obbhbb_ros.boxes import FloatArray
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.study.evaluation import PAPER_RULE
from obbhbb_ros.study.metrics import overlap_with_hbb
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.summary import text_table

FULLNESS = (0.60, 0.75, 0.85, 1.00)
ASPECT_RANGE = (3.0, 7.0)
LENGTH = 100.0
_POINTS = 9
_SPACING = 1.5 * LENGTH


@dataclass(frozen=True)
class Family:
    """
    A hull form.

    Attributes
    ----------
    name : str
        As the paper has it.
    bow, stern : float
        Half the width of the ends at fullness 1, relative to that amidships, in [0, 1].
    curve : float
        Exponent of the sides between amidships and an end: 1 is straight, above is fuller.
    """

    name: str
    bow: float
    stern: float
    curve: float = 1.0

    def outline(self, fullness: float = 1.0) -> FloatArray:
        """
        Draw the hull in the unit box, bow at +x.

        Parameters
        ----------
        fullness : float
            Scales the width of the ends, in (0, 1].

        Returns
        -------
        ndarray, shape (K, 2)
            Vertices in order, touching all four sides of [-1, 1]^2.

        Raises
        ------
        ValueError
            If `fullness` is out of range.
        """
        if not 0.0 < fullness <= 1.0:
            raise ValueError(f'fullness must be in (0, 1], not {fullness}')
        points = 2 if self.curve == 1.0 else _POINTS
        x = np.linspace(0.0, 1.0, points)
        forward = 1.0 - (1.0 - self.bow * fullness) * x**self.curve
        aft = 1.0 - (1.0 - self.stern * fullness) * x**self.curve
        side = np.stack((np.concatenate((-x[:0:-1], x)), np.concatenate((aft[:0:-1], forward))))
        return np.concatenate((side.T, side.T[::-1] * [1.0, -1.0]))


# The ends are what `fit_ends` gives; a test holds them equal.
FAMILIES: MappingProxyType[str, Family] = MappingProxyType({
    family.name: family
    for family in (
        Family('rectangular', bow=1.0, stern=1.0),
        Family('tapered', bow=0.4415, stern=0.4415),
        Family('bow_stern', bow=0.6795, stern=1.0),
        Family('fine', bow=0.4548, stern=0.4548, curve=1.5),
    )
})

# Table 1 of the paper: by family, rows N (outer), M (midpoint) and S (shape-aware), columns by
# fullness in the order of `FULLNESS`.
PAPER_TABLE: MappingProxyType[str, tuple[tuple[float, ...], ...]] = MappingProxyType({
    'rectangular': (
        (0.211, 0.127, 0.073, 0.000), (0.218, 0.267, 0.298, 0.342), (0.264, 0.293, 0.310, 0.333)
    ),
    'tapered': (
        (0.421, 0.376, 0.347, 0.305), (0.104, 0.128, 0.143, 0.167), (0.174, 0.187, 0.195, 0.208)
    ),
    'bow_stern': (
        (0.277, 0.199, 0.148, 0.077), (0.191, 0.234, 0.261, 0.301), (0.234, 0.258, 0.272, 0.290)
    ),
    'fine': (
        (0.413, 0.366, 0.335, 0.290), (0.108, 0.133, 0.150, 0.175), (0.175, 0.188, 0.195, 0.207)
    ),
})
PAPER_ROWS: MappingProxyType[str, HullRule] = MappingProxyType(
    {'N': HullRule('outer'), 'M': HullRule('midpoint'), 'S': PAPER_RULE}
)


def class_name(family: str, fullness: float) -> str:
    """Name the class of the synthetic ships of a family and fullness."""
    return f'{family} {fullness:.2f}'


def synthetic_ships(
    families: Sequence[Family] = tuple(FAMILIES.values()),
    fullness: Sequence[float] = FULLNESS,
    aspects: int = 5,
    angles: int = 90,
    seed: int | None = 0,
) -> Ships:
    """
    Draw hulls at many aspect ratios and angles, each in an image of its own.

    Parameters
    ----------
    families : sequence of Family
        Hull forms.
    fullness : sequence of float
        Levels of fullness, in (0, 1].
    aspects : int
        How many aspect ratios, evenly over `ASPECT_RANGE`; a single one is its middle.
    angles : int
        How many angles, one in each of so many equal parts of [0, 90) degrees.
    seed : int or None
        Seed of the place of each angle in its part; None for the middle.

    Returns
    -------
    Ships
        Families × fullness × aspects × angles ships of `LENGTH` pixels, class "family fullness".
        The reference is the bounds of the hull.

    Raises
    ------
    ValueError
        If there is nothing to draw or a fullness is out of range.
    """
    if min(len(families), len(fullness), aspects, angles) < 1:
        raise ValueError('families, fullness, aspects and angles must be one or more each')
    low, high = ASPECT_RANGE
    ratios = np.linspace(low, high, aspects) if aspects > 1 else np.array([(low + high) / 2.0])
    sorts = len(families) * len(fullness)
    count = sorts * aspects * angles
    center = np.stack((np.arange(count) * _SPACING, np.zeros(count)))
    aspect = np.tile(np.repeat(ratios, angles), sorts)
    theta = _angles(angles, count, seed)
    long_axis = np.stack((np.cos(theta), np.sin(theta))) * (LENGTH / 2.0)
    short_axis = np.stack((-np.sin(theta), np.cos(theta))) * (LENGTH / 2.0 / aspect)
    names, hulls = [], []
    for index, (family, full) in enumerate((a, b) for a in families for b in fullness):
        rows = slice(index * aspects * angles, (index + 1) * aspects * angles)
        names += [class_name(family.name, full)] * (aspects * angles)
        axes = np.stack((long_axis[:, rows], short_axis[:, rows]))
        placed = np.einsum('ka,axn->nkx', family.outline(full), axes)
        hulls += list(placed + center[:, rows].T[:, None, :])
    bounds = [np.concatenate((hull.min(axis=0), hull.max(axis=0))) for hull in hulls]
    return Ships(
        boxes=OrientedBoxes(center, long_axis, short_axis, np.zeros(count, np.uint8)),
        reference=np.array(bounds),
        class_ids=np.array(names),
        image_of=np.arange(count),
        names=tuple(
            f'{name} L/W {ratio:.1f} {degrees:.0f}°'
            for name, ratio, degrees in zip(names, aspect, np.degrees(theta), strict=True)
        ),
        hulls=tuple(hulls),
    )


def _angles(angles: int, count: int, seed: int | None) -> FloatArray:
    """Spread angles over a quarter turn, again and again, radians, (count,)."""
    if seed is None:
        offset = np.full(count, 0.5)
    else:
        offset = np.random.default_rng(seed).uniform(size=count)
    return (np.arange(count) % angles + offset) / angles * (np.pi / 2.0)


def relative_errors(ships: Ships, rule: HullRule) -> dict[str, float]:
    """
    Compute the mean relative error (Eq. relerr) of a rule by class.

    Parameters
    ----------
    ships : Ships
        Ships with reference boxes.
    rule : HullRule
        The rule.

    Returns
    -------
    dict of str to float
        By class, in alphabetical order.
    """
    found = overlap_with_hbb(convert_by_rule(ships.boxes, rule), ships.reference)
    errors = found.relative_error
    return {
        name: float(errors[ships.class_ids == name].mean())
        for name in np.unique(ships.class_ids).tolist()
    }


@dataclass(frozen=True)
class Comparison:
    """
    One number of the paper's Table 1 and ours.

    Attributes
    ----------
    family, row, fullness
        Where it stands; `row` is N, M or S.
    paper, ours : float
        Mean relative error.
    fitted : bool
        Whether the family was shaped to give this number.
    """

    family: str
    row: str
    fullness: float
    paper: float
    ours: float
    fitted: bool

    @property
    def deviation(self) -> float:
        """Ours minus the paper's."""
        return self.ours - self.paper


def paper_comparison(ships: Ships | None = None) -> list[Comparison]:
    """
    Set the paper's Table 1 beside what the hulls of this module give.

    Parameters
    ----------
    ships : Ships, optional
        Synthetic ships of all families and levels; `synthetic_ships(seed=None)` by default.

    Returns
    -------
    list of Comparison
        48, by family, row, fullness; 4 of them fitted.
    """
    ships = synthetic_ships(seed=None) if ships is None else ships
    errors = {row: relative_errors(ships, rule) for row, rule in PAPER_ROWS.items()}
    return [
        Comparison(
            family, row, full, paper, errors[row][class_name(family, full)],
            fitted=row == 'N' and full == 1.0,
        )
        for family, table in PAPER_TABLE.items()
        for row, numbers in zip(PAPER_ROWS, table, strict=True)
        for full, paper in zip(FULLNESS, numbers, strict=True)
    ]


def fit_ends(family: Family) -> Family:
    """
    Shape a family so that the paper's row "N" at fullness 1.00 comes out.

    Parameters
    ----------
    family : Family
        Its ends below 1 are replaced by one number, found by bisection to 1e-5.

    Returns
    -------
    Family
        The fitted form; a rectangle is returned as it is.
    """
    target = PAPER_TABLE[family.name][0][FULLNESS.index(1.0)]
    low, high = 0.0, 1.0
    fitted = family
    while high - low > 1e-5:
        end = (low + high) / 2.0
        fitted = replace(
            family,
            bow=end if family.bow < 1.0 else 1.0,
            stern=end if family.stern < 1.0 else 1.0,
        )
        ships = synthetic_ships([fitted], [1.0], seed=None)
        if next(iter(relative_errors(ships, PAPER_ROWS['N']).values())) > target:
            low = end
        else:
            high = end
    return fitted


def comparison_rows(found: Sequence[Comparison]) -> tuple[list[str], list[list[str]]]:
    """
    Lay the comparison out as a table of text, as the paper does: a row a fullness and rule.

    Parameters
    ----------
    found : sequence of Comparison
        What `paper_comparison` gives.

    Returns
    -------
    tuple of head and rows
        In each cell the paper's number, ours and the deviation; `fitted` instead of that where it
        was fitted.
    """
    families = list(PAPER_TABLE)
    cells = {(c.row, c.fullness, c.family): c for c in found}
    rows = []
    for full in FULLNESS:
        for row in PAPER_ROWS:
            line = [f'{full:.2f} {row}']
            for family in families:
                c = cells[row, full, family]
                verdict = 'fitted' if c.fitted else f'{c.deviation:+.3f}'
                line.append(f'{c.paper:.3f}  {c.ours:.3f}  {verdict}')
            rows.append(line)
    return ['paper, ours, deviation', *families], rows


def mean_deviation(found: Sequence[Comparison], row: str) -> float:
    """Average the absolute deviations of the predicted numbers of a row, N, M or S."""
    return float(np.mean([abs(c.deviation) for c in found if c.row == row and not c.fitted]))


def main(arguments: Sequence[str]) -> None:
    """Print the comparison; draw the panel if a picture file is named."""
    found = paper_comparison()
    print(text_table(*comparison_rows(found)))
    for row, rule in PAPER_ROWS.items():
        print(f'{row} ({rule.method}): mean absolute deviation {mean_deviation(found, row):.4f}')
    for path in arguments:
        from obbhbb_ros.study import charts

        charts.save(charts.hull_panel(), Path(path))
        print(f'picture: {path}')


if __name__ == '__main__':
    main(sys.argv[1:])
