"""The ROS 2 side: nodes, their parameters, messages and diagnostics."""
