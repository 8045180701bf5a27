# SPDX-License-Identifier: Apache-2.0
"""Which ship is it: ids for the oriented boxes of a camera that moves; NumPy alone."""
