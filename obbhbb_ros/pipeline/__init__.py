# SPDX-License-Identifier: Apache-2.0
"""What happens to a message: bytes and settings in, bytes and counts out, without ROS."""
