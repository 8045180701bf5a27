# SPDX-License-Identifier: Apache-2.0
"""
Label files <-> boxes: one module a format, behind one reader and one writer.

>>> from obbhbb_ros.labels import read_labels, write_labels
>>> write_labels('ships.csv', read_labels('labelTxt/'))  # doctest: +SKIP
"""

from __future__ import annotations

from obbhbb_ros.labels.converted import ConvertedImage
from obbhbb_ros.labels.format import Format
from obbhbb_ros.labels.reader import read_labels
from obbhbb_ros.labels.records import ImageLabels
from obbhbb_ros.labels.records import LabelError
from obbhbb_ros.labels.records import OnError
from obbhbb_ros.labels.registry import FORMATS
from obbhbb_ros.labels.registry import detect_format
from obbhbb_ros.labels.writer import write_boxes
from obbhbb_ros.labels.writer import write_labels

__all__ = [
    'FORMATS',
    'ConvertedImage',
    'Format',
    'ImageLabels',
    'LabelError',
    'OnError',
    'detect_format',
    'read_labels',
    'write_boxes',
    'write_labels',
]
