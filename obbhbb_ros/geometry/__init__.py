# SPDX-License-Identifier: Apache-2.0
"""Oriented box to axis-aligned box, as the paper has it. NumPy and shapely alone."""
