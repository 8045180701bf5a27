# SPDX-License-Identifier: Apache-2.0
"""What nodes are made of: transitions, topics, parameters, diagnostics."""
