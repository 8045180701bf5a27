# SPDX-License-Identifier: Apache-2.0
"""Where chips wait for the ground: catalogue, release, outbox. No ROS in here."""
