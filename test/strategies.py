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
