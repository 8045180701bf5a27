# SPDX-License-Identifier: Apache-2.0
"""Detections, boxes and crop regions drawn over their image: pictures and markers."""
