# SPDX-License-Identifier: Apache-2.0
"""From box to what goes to the ground: crop plan, chips, budget. No ROS in here."""
