# SPDX-License-Identifier: Apache-2.0
"""Recorded messages (rosbag2): what the node would send for them, without ROS. Extra `bags`."""
