# SPDX-License-Identifier: Apache-2.0
"""The offline half: hulls, metrics, evaluation, calibration, plots. No ROS here."""
