# SPDX-License-Identifier: Apache-2.0
"""What hypothesis draws from: oriented boxes as people and detectors give them."""

import numpy as np
from hypothesis import strategies as st

from obbhbb_ros.reports.ship_report import ShipReport

COORDINATE = st.floats(-1e5, 1e5, allow_subnormal=False)
SIDE = st.floats(1e-2, 1e4)
ANGLE = st.floats(-10.0, 10.0, allow_subnormal=False)
Q = st.one_of(st.floats(1.0, 50.0), st.sampled_from([1.0, 2.0, 3.0, np.inf]))
FACTOR = st.floats(0.05, 2.0)
# Stamps, as builtin_interfaces/Time holds them: nanoseconds.
TIME = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)


@st.composite
def xywhr(draw, max_boxes=8):
    """Draw an (N, 5) array of valid boxes."""
    row = st.tuples(COORDINATE, COORDINATE, SIDE, SIDE, ANGLE)
    return np.array(draw(st.lists(row, min_size=1, max_size=max_boxes)))


def sides_differ(rows):
    """
    Tell whether it is beyond doubt which side of each box, (N, 5), is the long one.

    Where they are all but equal it is a matter of rounding, and with f other than 1 so is the
    axis-aligned box.
    """
    return (np.abs(rows[:, 2] - rows[:, 3]) > 1e-6 * rows[:, 2]).all()


@st.composite
def ship_reports(draw):
    """Draw a ship of a ship list."""
    is_ambiguous = draw(st.booleans())
    first, last = sorted(draw(st.tuples(TIME, TIME)))
    number = st.one_of(st.none(), st.floats(0.0, 1e3))
    return ShipReport(
        id=draw(st.one_of(st.from_regex('[0-9a-f]{8}-[0-9]{1,7}', fullmatch=True), st.text())),
        latitude=draw(st.floats(-90.0, 90.0)),
        longitude=draw(st.floats(-180.0, 180.0)),
        course=draw(st.floats(0.0, 180.0 if is_ambiguous else 360.0, exclude_max=True)),
        course_ambiguous=is_ambiguous,
        length_m=draw(st.floats(0.0, 2000.0)),
        width_m=draw(st.floats(0.0, 200.0)),
        sigma_m=draw(
            st.one_of(
                st.none(),
                st.tuples(st.floats(0.0, 1e6), st.floats(0.0, 1e6), st.floats(0.0, 180.0)),
            )
        ),
        class_id=draw(st.one_of(st.sampled_from(['', 'ship', 'tug']), st.text())),
        score=draw(st.one_of(st.none(), st.floats(0.0, 1.0))),
        first=first,
        last=last,
        views=draw(st.integers(1, 2**40)),
        speed=draw(number),
        speed_sigma=draw(number),
        course_over_ground=draw(st.one_of(st.none(), st.floats(0.0, 360.0))),
        course_over_ground_sigma=draw(number),
    )
