# SPDX-License-Identifier: Apache-2.0
"""Bags (rosbag2): what the node would send for recorded messages. Needs the extra `bags`."""
