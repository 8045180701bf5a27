# SPDX-License-Identifier: Apache-2.0
"""
Reading and writing of label files: one module per format, one reader and one writer for all.

See `read_labels`, `write_labels` and `write_boxes`.
"""

from __future__ import annotations

from obbhbb_ros.labels.formats import FORMATS
from obbhbb_ros.labels.formats import detect_format
from obbhbb_ros.labels.formats import read_labels
from obbhbb_ros.labels.formats import write_boxes
from obbhbb_ros.labels.formats import write_labels
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import OnError
from obbhbb_ros.labels.label_format import Format

__all__ = [
    'FORMATS',
    'Format',
    'ImageBoxes',
    'ImageLabels',
    'LabelError',
    'OnError',
    'detect_format',
    'read_labels',
    'write_boxes',
    'write_labels',
]
