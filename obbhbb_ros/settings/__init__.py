# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes as plain data, and the settings made of them. No ROS in here."""
