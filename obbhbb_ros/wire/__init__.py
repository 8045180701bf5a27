# SPDX-License-Identifier: Apache-2.0
"""Message bytes <-> arrays, without ROS."""
