# SPDX-License-Identifier: Apache-2.0
"""Annotations have the fields of the installed foxglove_msgs; another reader reads them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from obbhbb_ros.wire.image_annotations import MESSAGES
from obbhbb_ros.wire.image_annotations import AnnotationWriter
from obbhbb_ros.wire.image_annotations import Caption
from obbhbb_ros.wire.image_annotations import Stroke
from obbhbb_ros.wire.image_annotations import UnknownFieldsError

typesys = pytest.importorskip('rosbags.typesys')

DEFINITIONS = Path(__file__).parents[2] / 'interfaces' / 'foxglove_msgs' / 'msg'
RED, GREEN, BLACK = (255, 0, 0), (0, 255, 0), (0, 0, 0)
STROKES = (
    Stroke(RED, 2, np.array([[[1.5, 2.5], [3.5, 4.5]], [[-5.0, 6.0], [7.0, 8.0]]])),
    Stroke(GREEN, 4, np.empty((0, 2, 2))),
)
CAPTIONS = (
    Caption('tanker 0.88', (10.0, 20.0), 16, RED, BLACK),
    Caption('', (0.0, 0.0), 10, BLACK, GREEN),
    Caption('tübingen', (1.0, 2.0), 10, BLACK, GREEN),
)


def definitions(with_metadata: bool) -> dict[str, str]:
    """Read the definitions; before foxglove_msgs 3.2.6 there was less in them."""
    texts = {path.stem: path.read_text() for path in DEFINITIONS.glob('*.msg')}
    if with_metadata:
        return texts
    texts = {
        name: text.replace('foxglove_msgs/KeyValuePair[] metadata\n', '')
        for name, text in texts.items()
    }
    image = texts['ImageAnnotations']
    texts['ImageAnnotations'] = image.replace('builtin_interfaces/Time timestamp\n', '')
    return texts


def fields_of(text: str) -> dict[str, str]:
    """List the fields of a definition as rclpy does."""
    pairs = [line.split() for line in text.splitlines() if line and '=' not in line]
    return {name: f'sequence<{kind[:-2]}>' if kind.endswith('[]') else kind for kind, name in pairs}


def read(data: bytes, texts: dict[str, str]) -> Any:
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in texts.items():
        types.update(typesys.get_types_from_msg(text, f'foxglove_msgs/msg/{name}'))
    store.register(types)
    return store.deserialize_cdr(data, 'foxglove_msgs/msg/ImageAnnotations')


@pytest.mark.parametrize('with_metadata', [True, False], ids=['today', 'before 3.2.6'])
def test_another_reader_reads_what_is_written(with_metadata: bool) -> None:
    texts = definitions(with_metadata)
    writer = AnnotationWriter({name: fields_of(texts[name]) for name in MESSAGES})
    message = read(writer.write((7, 8), STROKES, CAPTIONS), texts)
    assert hasattr(message, 'timestamp') == with_metadata
    every = [*message.points, *message.texts, *([message] if with_metadata else [])]
    assert {(each.timestamp.sec, each.timestamp.nanosec) for each in every} == {(7, 8)}
    assert [len(each.points) for each in message.points] == [4, 0]
    points = [(point.x, point.y) for point in message.points[0].points]
    assert points == [(1.5, 2.5), (3.5, 4.5), (-5.0, 6.0), (7.0, 8.0)]
    assert [each.type for each in message.points] == [4, 4]
    assert [each.thickness for each in message.points] == [2.0, 4.0]
    assert [rgba(each.outline_color) for each in message.points] == [(1, 0, 0, 1), (0, 1, 0, 1)]
    assert [rgba(each.fill_color) for each in message.points] == [(0, 0, 0, 0)] * 2
    assert [each.text for each in message.texts] == ['tanker 0.88', '', 'tübingen']
    first = message.texts[0]
    assert (first.position.x, first.position.y, first.font_size) == (10.0, 20.0, 16.0)
    assert (rgba(first.text_color), rgba(first.background_color)) == ((1, 0, 0, 1), (0, 0, 0, 1))
    assert not message.circles


def rgba(color: Any) -> tuple[float, ...]:
    return color.r, color.g, color.b, color.a


def test_an_unknown_sequence_is_sent_empty() -> None:
    texts = definitions(True)
    texts['TextAnnotation'] += 'foxglove_msgs/KeyValuePair[] more\n'
    writer = AnnotationWriter({name: fields_of(texts[name]) for name in MESSAGES})
    message = read(writer.write((7, 8), STROKES, CAPTIONS), texts)
    assert [each.text for each in message.texts] == ['tanker 0.88', '', 'tübingen']


@pytest.mark.parametrize(
    ('old', 'new', 'reason'),
    [
        ('float64 thickness\n', '', 'PointsAnnotation has no thickness'),
        ('float64 thickness\n', 'float64 thickness\nstring id\n', 'PointsAnnotation has id'),
    ],
)
def test_fields_that_are_not_known_are_refused_by_name(old: str, new: str, reason: str) -> None:
    texts = definitions(True)
    texts['PointsAnnotation'] = texts['PointsAnnotation'].replace(old, new)
    with pytest.raises(UnknownFieldsError, match=reason):
        AnnotationWriter({name: fields_of(texts[name]) for name in MESSAGES})
