# SPDX-License-Identifier: Apache-2.0
"""The process of a node, or of several: executor, signals, watchdog, state file."""
