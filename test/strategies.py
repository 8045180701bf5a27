# SPDX-License-Identifier: Apache-2.0
"""What hypothesis draws from: oriented boxes as people and detectors give them."""

import numpy as np
from hypothesis import strategies as st

COORDINATE = st.floats(-1e5, 1e5, allow_subnormal=False)
SIDE = st.floats(1e-2, 1e4)
ANGLE = st.floats(-10.0, 10.0, allow_subnormal=False)
Q = st.one_of(st.floats(1.0, 50.0), st.sampled_from([1.0, 2.0, 3.0, np.inf]))
FACTOR = st.floats(0.05, 2.0)


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
