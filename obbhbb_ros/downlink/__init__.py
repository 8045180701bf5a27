# SPDX-License-Identifier: Apache-2.0
"""From axis-aligned boxes to what is sent: crop plan, chips, link budget. No ROS in here."""
