# SPDX-License-Identifier: Apache-2.0
"""Tell ships apart: ids for the oriented boxes of a camera that moves; needs only NumPy."""
