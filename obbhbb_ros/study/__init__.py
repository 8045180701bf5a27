# SPDX-License-Identifier: Apache-2.0
"""Offline study without ROS: hulls, metrics, evaluation, calibration, plots."""
