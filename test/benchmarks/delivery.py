# SPDX-License-Identifier: Apache-2.0
"""The chart of `passes.py`: value delivered over the day. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from obbhbb_ros.geometry.boxes import FloatArray

LINES = ('#1f5fbf', '#0b7d3e', '#e08a00', '#b0389b', '#5f6a72')


def delivery_figure(
    delivered: Mapping[str, tuple[FloatArray, FloatArray]],
    best: float,
    contacts: Sequence[tuple[float, float]],
    hours: float,
    title: str,
) -> Figure:
    """
    Draw the value delivered by each strategy over some hours.

    Parameters
    ----------
    delivered : mapping of str to two ndarrays of shape (N,)
        Time of each delivery, hours, ascending, and its value.
    best : float
        Value of the best that fits all contacts.
    contacts : sequence of two floats
        Start and end of each contact, hours.
    hours : float
        End of the time axis.
    title : str
        Where the data come from.
    """
    figure = Figure(figsize=(8.4, 4.0), layout='constrained')
    axes = figure.subplots()
    for window in contacts:
        axes.axvspan(*window, color='#9ecae1', alpha=0.6, lw=0.0)
    axes.axhline(best, color='black', lw=1.0, ls=(0, (4, 3)))
    text = f'the most valuable that fit all contacts: {best:,.0f}'
    axes.annotate(text, (0.0, best), (4, 4), textcoords='offset points', fontsize=9)
    for color, (name, (times, values)) in zip(LINES, delivered.items(), strict=False):
        total = values.sum()
        x = np.concatenate(([0.0], times, [hours]))
        y = np.concatenate(([0.0], np.cumsum(values), [total]))
        axes.step(x, y, where='post', color=color, lw=2.0)
        axes.annotate(
            f'{name}:\n{total:,.0f}',
            (hours, total),
            (6, 0),
            textcoords='offset points',
            va='center',
            color=color,
            fontsize=9,
            annotation_clip=False,
        )
    axes.set(
        xlim=(0.0, hours),
        ylim=(0.0, 1.1 * best),
        xlabel='hours (shaded: contact)',
        ylabel='value delivered',
        title=title,
    )
    axes.xaxis.set_major_locator(MaxNLocator(8, steps=(1, 2, 3, 5, 10)))
    return figure
