# SPDX-License-Identifier: Apache-2.0
"""What a node says that has no input."""

from __future__ import annotations

import pytest

from obbhbb_ros.nodes.lifecycle.input_advice import advice_on_loss
from obbhbb_ros.nodes.lifecycle.input_advice import advice_on_silence
from obbhbb_ros.nodes.lifecycle.input_advice import advice_on_type
from obbhbb_ros.wire.layouts import INPUT_TYPES

PLAIN = INPUT_TYPES['Detection2DArray']


@pytest.mark.parametrize(
    ('topic', 'kind', 'read', 'carried', 'advice'),
    [
        ('/d', PLAIN, PLAIN.name, 'DetectionArray', 'set input_type to DetectionArray'),
        (
            '/d',
            PLAIN,
            PLAIN.name,
            'PolygonStamped',
            'set input_type to PolygonStamped and remap polygons to /d',
        ),
        (
            '/camera/image/compressed',
            None,
            'Image',
            'CompressedImage',
            'set image_transport to compressed, which reads /camera/image/compressed, '
            'and remap image to /camera/image',
        ),
        (
            '/image',
            None,
            'Image',
            'CompressedImage',
            'set image_transport to compressed, which reads /image/compressed',
        ),
        (
            '/image',
            None,
            'CompressedImage',
            'Image',
            'set image_transport to raw, and remap image to this topic',
        ),
        ('/d', PLAIN, PLAIN.name, 'Image', 'remap it to a topic that carries Detection2DArray'),
        # `input_type` does not decide on `boxes`.
        ('/b', None, PLAIN.name, 'DetectionArray', 'remap it to a topic that carries '),
    ],
)
def test_the_parameter_or_remap_that_fits_another_type_is_named(
    topic: str, kind: object, read: str, carried: str, advice: str
) -> None:
    assert advice_on_type(topic, kind, read, carried).startswith(advice)


@pytest.mark.parametrize(
    ('topic', 'carriers', 'advice'),
    [
        ('/image', {}, ''),
        (
            '/image',
            {'/image/compressed': 'CompressedImage', '/x': 'Image'},
            '; set image_transport to compressed to read /image/compressed',
        ),
        (
            '/image/compressed',
            {'/image': 'Image'},
            '; set image_transport to raw to read /image',
        ),
        (
            '/detections',
            dict.fromkeys(('/z', '/yolo/detections'), PLAIN.name),
            '; remap it to /yolo/detections or /z?',
        ),
    ],
)
def test_other_topics_are_named_if_nobody_publishes(
    topic: str, carriers: dict[str, str], advice: str
) -> None:
    assert advice_on_silence(topic, carriers) == advice


def test_lost_messages_are_explained_by_what_is_not_in_force_yet() -> None:
    reliable = advice_on_loss('/d', 10, True, True, 900_000)
    assert 'qos_overrides./d.subscription.depth above 10' in reliable
    assert 'MB' not in reliable
    assert 'reliability' not in reliable
    small = advice_on_loss('/camera_info', 10, False, False, 400)
    assert 'up to 400 bytes' in small
    assert 'MB' not in small
    assert 'a reliable one loses none' in small
    fixed = advice_on_loss('/d', 10, False, True, 400)
    assert 'remove qos_overrides./d.subscription.reliability' in fixed
    unknown = advice_on_loss('/image', 10, False, False, 0)
    assert 'config/fastdds_large.xml at the publisher' in unknown
    large = advice_on_loss('/image', 10, False, False, 900_000)
    assert 'config/fastdds_large.xml at the publisher' in large
