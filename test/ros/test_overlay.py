# SPDX-License-Identifier: Apache-2.0
"""The overlay node over DDS: what is drawn, what waits, what is counted, and who pays."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import Counts
from harness import Node
from harness import OverlayNode
from harness import Site
from harness import values_of
from lifecycle_msgs.msg import Transition
from numpy.typing import NDArray
from PIL import Image as Picture
from polygon_msgs.msg import Point2D
from polygon_msgs.msg import Polygon2D
from polygon_msgs.msg import Polygon2DCollection
from sensor_msgs.msg import CompressedImage
from sensor_msgs.msg import Image
from ships import detections
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray
from visualization_msgs.msg import ImageMarker

from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.nodes.player_messages import image_message

# Long; what depends on the versions of NumPy and Pillow is tested without DDS as well.
pytestmark = pytest.mark.once

GREY = np.full((100, 200, 3), 128, np.uint8)
LAYERS = ('detections', 'boxes', 'crop_regions')
# Upright boxes around (100, 50): the middle of the left edge of each is at its own x.
ROWS = {
    'detections': [(100, 50, 40, 20, 0)],
    'boxes': [(100, 50, 80, 40, 0)],
    'crop_regions': [(100, 50, 120, 60, 0)],
}
LEFT_EDGES = {'detections': 80, 'boxes': 60, 'crop_regions': 40}


@pytest.fixture
def start(site: Site) -> Iterator[Callable[..., OverlayNode]]:
    """Starts nodes that end with the test."""
    with ExitStack() as stack:
        yield lambda look=True, **parameters: stack.enter_context(
            OverlayNode(site, parameters, look)
        )


@pytest.fixture(scope='module')
def shared(site: Site) -> Iterator[OverlayNode]:
    with OverlayNode(site, {'quality': 95}) as node:
        node.connect(*LAYERS)
        yield node


@pytest.fixture
def node(shared: OverlayNode) -> OverlayNode:
    """The module's node, with a sharp picture and all layers published."""
    shared.set({'max_wait': 30.0, 'max_age': 30.0, 'layers': list(LAYER_COLORS), 'scale': 1.0})
    # What waits from the test before is drawn or overtaken when this one is drawn.
    shared.picture_of(shared.send(GREY, 'rgb8', **ROWS))
    shared.pictures.clear()
    return shared


def pixels_of(picture: CompressedImage) -> NDArray[np.uint8]:
    with Picture.open(io.BytesIO(picture.data.tobytes())) as file:
        assert file.format == 'JPEG'
        return np.asarray(file)


def shows(pixels: NDArray[np.uint8], layer: str) -> bool:
    """Tell whether the left edge of the layer's box has the layer's colour, perhaps in dashes."""
    color = [int(LAYER_COLORS[layer][i : i + 2], 16) for i in (1, 3, 5)]
    edge = pixels[44:57, LEFT_EDGES[layer]].astype(int)
    return bool((np.abs(edge - color).max(axis=1) < 40).any())


def test_all_layers_are_drawn_in_their_colours_whatever_the_order_of_arrival(
    node: OverlayNode,
) -> None:
    header = node.header()
    for layer in LAYERS:
        node.send_layer(layer, ROWS[layer], header)
    node.send_image(GREY, header, 'rgb8')
    picture = node.picture_of(header)
    assert picture.format == 'rgb8; jpeg compressed bgr8'
    pixels = pixels_of(picture)
    assert pixels.shape == GREY.shape
    assert all(shows(pixels, layer) for layer in LAYERS)


def test_a_layer_of_another_frame_is_drawn_counted_and_said(node: OverlayNode) -> None:
    before = node.counts()
    header = node.header()
    node.send_image(np.zeros((8, 8), np.uint8), header)
    for layer in LAYER_COLORS:
        frame_id = 'other' if layer == 'boxes' else header.frame_id
        node.send_layer(layer, (), Header(stamp=header.stamp, frame_id=frame_id))
    node.picture_of(header)
    assert node.counts().since(before, 'frame_ids') == {'frame_ids_differ.boxes': 1}
    assert "image of frame 'bow_camera', but boxes of frame 'other'" in node.process.log


def test_frames_that_overlap_in_time_are_not_mixed(node: OverlayNode) -> None:
    first, second = node.header(), node.header()
    for header, layers in ((first, LAYERS[:2]), (second, LAYERS), (first, LAYERS[2:])):
        for layer in layers:
            node.send_layer(layer, ROWS[layer] if header is first else [], header)
    for header in (second, first):
        node.send_image(GREY, header, 'rgb8')
    assert all(shows(pixels_of(node.picture_of(first)), layer) for layer in LAYERS)
    assert not any(shows(pixels_of(node.picture_of(second)), layer) for layer in LAYERS)


def test_an_image_is_drawn_without_a_layer_that_does_not_come_and_that_is_said(
    node: OverlayNode,
) -> None:
    # The layers that come may do so after a pause.
    node.set({'max_wait': 2.0})
    before = node.counts()
    header = node.send(GREY, 'rgb8', detections=ROWS['detections'], boxes=ROWS['boxes'])
    pixels = pixels_of(node.picture_of(header))
    assert [shows(pixels, layer) for layer in LAYERS] == [True, True, False]
    # In the log it may stand of another frame, of seconds before.
    text = f'{header.stamp.sec}.{header.stamp.nanosec:09d} without crop_regions'
    node.wait(lambda: any(text in each.status[0].message for each in node.reports()), 'the warning')
    assert node.counts().since(before, 'layers_missing.') == {'layers_missing.crop_regions': 1}
    # There it is said of one frame in five seconds.
    node.send_until(
        lambda: node.send(GREY, 'rgb8', detections=ROWS['detections'], boxes=ROWS['boxes']),
        lambda: re.search(r'stamp \d+\.\d+ without crop_regions', node.process.log),
        'the log',
    )


def test_an_image_is_drawn_after_its_wait_while_a_simulated_clock_stands_still(
    start: Callable[..., OverlayNode],
) -> None:
    node = start(use_sim_time=True, max_wait=0.5)
    node.connect('boxes')
    node.picture_of(node.send(GREY, 'rgb8'))


def test_layers_without_an_image_and_what_a_later_frame_overtook_are_dropped_and_counted(
    node: OverlayNode,
) -> None:
    node.set({'max_age': 0.5, 'max_wait': 3.0})
    before = node.counts()
    node.send_layer('boxes', ROWS['boxes'], node.header())
    node.send(GREY, 'rgb8')
    node.picture_of(node.send(GREY, 'rgb8', **ROWS))
    node.wait(
        lambda: (
            node.counts().since(before, 'frames_dropped.')
            == {'frames_dropped.no_image': 1, 'frames_dropped.overtaken': 1}
        ),
        'both are counted',
    )
    assert len(node.pictures) == 1


def test_only_complete_frames_are_drawn_if_asked_for_however_slow_the_detector(
    start: Callable[..., OverlayNode],
) -> None:
    node = start(complete_only=True, max_age=60.0)
    node.connect('boxes')
    headers: list[Header] = []
    node.send_until(
        lambda: headers.append(node.send(GREY, 'rgb8')),
        lambda: any(Counts(report.status[0])['frames_waiting'] >= 30 for report in node.reports()),
        'thirty images',
    )
    node.send_layer('boxes', ROWS['boxes'], headers[3])
    assert shows(pixels_of(node.picture_of(headers[3])), 'boxes')
    assert len(node.pictures) == 1
    node.set({'max_age': 0.5})
    node.wait(lambda: not node.counts()['frames_waiting'], 'the others to be dropped')
    assert node.counts()['frames_dropped.incomplete'] >= 29
    assert len(node.pictures) == 1


def test_a_layer_that_comes_too_late_names_the_limit(start: Callable[..., OverlayNode]) -> None:
    node = start(max_wait=0.2)
    node.connect('boxes')
    header = node.send(GREY, 'rgb8')
    node.picture_of(header)
    node.send_layer('boxes', ROWS['boxes'], header)
    line = node.wait_for_log('boxes came')
    assert line.endswith('drawn without them or dropped: it waited longer than max_wait')
    assert node.counts()['layers_late.boxes'] == 1


def test_layers_scale_and_colours_follow_the_parameters(node: OverlayNode) -> None:
    node.set({'layers': ['boxes'], 'scale': 0.5, 'color.boxes': '#FF0000', 'line_width': 1})
    header = node.send(GREY, 'rgb8', boxes=ROWS['boxes'], detections=ROWS['detections'])
    pixels = pixels_of(node.picture_of(header))
    node.set({'color.boxes': LAYER_COLORS['boxes'], 'line_width': 0})
    assert pixels.shape == (50, 100, 3)
    red, green, _ = pixels[25, 30].astype(int)
    assert red - green > 80


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('layers', ['hulls'], 'layers can be crop_regions, boxes, detections, not hulls'),
        ('color.boxes', 'green', "color.boxes must be #rrggbb, not 'green'"),
        ('input_fit', 'stretch', 'input_fit stretch needs input_width and input_height'),
    ],
)
def test_settings_that_cannot_be_used_are_refused_with_a_reason(
    node: OverlayNode, name: str, value: Any, reason: str
) -> None:
    result = node.set_atomically({name: value})
    assert not result.successful
    assert reason in result.reason


def test_markers_hold_the_edges_of_each_layer_in_pixels_of_the_image(node: OverlayNode) -> None:
    node.set({'scale': 0.5})
    markers = node.peer.collect(ImageMarker, 'overlay/markers')
    alone = node.peer.collect(ImageMarker, 'overlay/markers/boxes')
    sent: list[Header] = []
    node.send_until(
        lambda: sent.append(node.send(GREY, 'rgb8', **ROWS)),
        lambda: len(markers) >= 3 and alone,
        'markers',
    )
    header = sent[-1]
    node.wait(
        lambda: (
            sum(each.header == header for each in markers) == 3
            and any(each.header == header for each in alone)
        ),
        'all markers of the last frame',
    )
    found = {each.ns: each for each in markers if each.header == header}
    assert set(found) == set(LAYERS)
    assert len({each.id for each in found.values()}) == 3
    for layer, marker in found.items():
        assert (marker.type, marker.action) == (ImageMarker.LINE_LIST, ImageMarker.ADD)
        x, y, width, height, _ = ROWS[layer][0]
        points = {(point.x, point.y) for point in marker.points}
        assert len(marker.points) == 8
        assert points == {(x + i * width / 2, y + j * height / 2) for i in (-1, 1) for j in (-1, 1)}
        assert color_of(marker.outline_color) == LAYER_COLORS[layer]
        assert (marker.outline_color.a, marker.scale) == (1.0, 1.0)
    assert {each.ns for each in alone} == {'boxes'}


def color_of(color: Any) -> str:
    rgb = [round(255 * value) for value in (color.r, color.g, color.b)]
    return '#' + bytes(rgb).hex()


def test_annotations_hold_the_layers_with_labels_and_legend(
    start: Callable[..., OverlayNode],
) -> None:
    foxglove = pytest.importorskip('foxglove_msgs.msg')
    # Nothing else has a subscriber at first.
    node = start(look=False, annotations=True, layers=['boxes', 'detections'], scale=0.5)
    annotations = node.peer.collect(foxglove.ImageAnnotations, 'overlay/annotations')
    publishers = {layer: node.peer.publisher(Detection2DArray, layer) for layer in ROWS}
    images = node.peer.publisher(Image, 'image')
    pixels, headers = np.full((400, 400, 3), 128, np.uint8), []

    def send() -> None:
        headers.append(node.header())
        for layer, rows in (ROWS | {'boxes': ()}).items():
            message = detections(rows, class_id='tanker')
            message.header = headers[-1]
            publishers[layer].publish(message)
        images.publish(image_message('rgb8', pixels, headers[-1]))

    node.send_until(send, lambda: annotations, 'annotations')
    (message,) = annotations[:1]
    every = [*message.points, *message.texts]
    stamps = [each.timestamp for each in (message, *every) if hasattr(each, 'timestamp')]
    assert all(stamp in [header.stamp for header in headers] for stamp in stamps)
    assert all(stamp == stamps[0] for stamp in stamps)
    # A layer without boxes has lines without points.
    assert [len(each.points) for each in message.points] == [0, 0, 8, 8]
    rim, line = message.points[2:]
    assert line.type == foxglove.PointsAnnotation.LINE_LIST
    assert (color_of(rim.outline_color), color_of(line.outline_color)) == ('#ffffff', '#000000')
    corners = np.array([(point.x, point.y) for point in line.points])
    np.testing.assert_allclose(corners.mean(axis=0), (100, 50))
    np.testing.assert_allclose(np.ptp(corners, axis=0), (40, 20), atol=1.0)
    assert [each.text for each in message.texts] == ['boxes', 'detections', 'tanker 0.50']
    label = message.texts[2]
    assert 78 <= label.position.x <= 80
    assert label.position.y < 41
    assert color_of(label.background_color) == LAYER_COLORS['detections']
    counts = node.counts()
    assert counts['annotations_sent']
    assert not counts.get('pictures_sent')
    assert not counts.get('markers_sent')


def test_annotations_without_their_package_are_a_reason_not_to_start(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / 'foxglove_msgs.py').write_text('raise ModuleNotFoundError("no foxglove_msgs")')
    paths = [str(tmp_path), *filter(None, [os.environ.get('PYTHONPATH')])]
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(paths))
    with Node(site, 'overlay') as node:
        node.start(parameters={'annotations': True})
        assert node.process.wait() == 1
        reason = 'cannot start: ImageAnnotations needs the ROS package foxglove_msgs'
        assert reason in node.process.log


def test_a_layer_without_boxes_sends_a_marker_without_lines(node: OverlayNode) -> None:
    markers = node.peer.collect(ImageMarker, 'overlay/markers/boxes')
    empty: dict[str, Any] = dict.fromkeys(LAYERS, ())
    node.send_until(lambda: node.send(GREY, 'rgb8', **empty), lambda: markers, 'a marker')
    assert not markers[0].points


def test_what_cannot_be_read_shown_or_dated_is_counted_and_the_node_goes_on(
    node: OverlayNode,
) -> None:
    before = node.counts()
    node.publish('image', b'\0\1\0\0' + bytes(5))
    node.publish('boxes', b'\0\1\0\0' + bytes(5))
    node.send_image(GREY, Header(), 'rgb8')
    empty: dict[str, Any] = dict.fromkeys(LAYERS, ())
    node.send(GREY, '32FC1', **empty)
    node.wait_for_log("encoding '32FC1' cannot be shown")
    bad = [(np.nan, 0, 1, 1, 0), (50, 50, 0, 0, 0), (1e30, 50, 10, 10, 0), *ROWS['boxes']]
    header = node.send(GREY, 'rgb8', **(ROWS | {'boxes': bad}))
    assert all(shows(pixels_of(node.picture_of(header)), layer) for layer in LAYERS)
    changed = node.counts().since(before)
    assert changed['messages_unreadable'] == 2
    assert changed['messages_without_stamp'] == changed['images_refused'] == 1
    assert changed['boxes_not_drawn'] == 2


@pytest.mark.parametrize(
    ('encoding', 'kind'), [('mono8', np.uint8), ('mono16', np.uint16), ('bayer_rggb8', np.uint8)]
)
def test_grey_images_are_shown_in_grey(node: OverlayNode, encoding: str, kind: Any) -> None:
    ramp = np.tile(np.arange(200, dtype=kind), (100, 1))
    empty: dict[str, Any] = dict.fromkeys(LAYERS, ())
    pixels = pixels_of(node.picture_of(node.send(ramp, encoding, **empty))).astype(int)
    assert np.ptp(pixels, axis=2).max() <= 3
    assert (np.diff(pixels[50, ::20, 0]) > 10).all()


def test_without_publishers_of_layers_the_image_is_drawn_at_once(
    start: Callable[..., OverlayNode],
) -> None:
    node = start(max_wait=60.0)
    node.connect()
    node.picture_of(node.send(GREY, 'rgb8'))
    assert 'layers_missing.boxes' not in node.counts()


def test_nobody_pays_for_a_node_that_nobody_looks_at_and_it_misses_no_input(
    start: Callable[..., OverlayNode],
) -> None:
    node = start(look=False, input_timeout=0.1)
    graph = node.peer.node
    name = f'{node.namespace}/image'
    node.next_report()
    report = node.next_report()
    assert (values_of(report)['watched'], report.message) == ('false', 'active')
    assert not graph.count_subscribers(name)
    viewer = graph.create_subscription(CompressedImage, 'overlay/compressed', print, 10)
    node.wait(lambda: graph.count_subscribers(name), 'the subscriptions')
    node.wait(lambda: 'no input' in node.next_report().message, 'the error')
    graph.destroy_subscription(viewer)
    node.wait(lambda: not graph.count_subscribers(name), 'the end of the subscriptions')
    node.peer.collect(CompressedImage, 'overlay/compressed')
    node.wait(lambda: graph.count_subscribers(name), 'the subscriptions again')


def test_an_override_of_an_input_counts_when_somebody_looks(site: Site) -> None:
    override = 'qos_overrides./seldom_seen/image.subscription.depth'
    with Node(site, 'overlay', '/seldom_seen') as node:
        node.start(parameters={override: 3})
        node.wait(node.reports, 'diagnostics')
        assert 'WARN' not in node.process.log
        node.peer.collect(CompressedImage, 'overlay/compressed')
        node.wait(lambda: node.get(override) == [3], 'the subscription')


def test_polygons_are_drawn_in_place_of_boxes(start: Callable[..., OverlayNode]) -> None:
    node = start(input_type='Polygon2DCollection', quality=95)
    node.connect()
    publisher = node.peer.publisher(Polygon2DCollection, 'polygons')
    corners = ((80.0, 40.0), (120.0, 40.0), (120.0, 60.0), (80.0, 60.0))
    message = Polygon2DCollection(
        polygons=[Polygon2D(points=[Point2D(x=x, y=y) for x, y in corners])]
    )

    def send() -> None:
        message.header = node.header()
        publisher.publish(message)
        node.send_image(GREY, message.header, 'rgb8')

    node.send_until(
        send,
        lambda: any(shows(pixels_of(each), 'detections') for each in node.pictures),
        'a picture with the polygon',
    )


def test_a_deactivated_node_draws_nothing_and_forgets(start: Callable[..., OverlayNode]) -> None:
    node = start(max_wait=60.0)
    node.connect('boxes')
    node.send(GREY, 'rgb8')
    node.wait(lambda: node.counts()['frames_waiting'] == 1, 'an image that waits')
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    node.send(GREY, 'rgb8', boxes=ROWS['boxes'])
    node.wait(lambda: node.counts()['messages_while_inactive'] == 2, 'both are counted')
    assert node.counts()['frames_dropped.deactivated'] == 1
    assert not node.pictures
    assert node.change_state(Transition.TRANSITION_ACTIVATE)
    node.picture_of(node.send(GREY, 'rgb8', boxes=ROWS['boxes']))
    assert node.change_state(Transition.TRANSITION_DEACTIVATE)
    assert node.change_state(Transition.TRANSITION_CLEANUP)
    assert node.change_state(Transition.TRANSITION_CONFIGURE)
    assert node.change_state(Transition.TRANSITION_ACTIVATE)
    sent: list[Header] = []
    node.send_until(
        lambda: sent.append(node.send(GREY, 'rgb8', boxes=ROWS['boxes'])),
        lambda: any(each.header == sent[-1] for each in node.pictures),
        'a picture after the second configuration',
    )


# Images that travel as files -------------------------------------------------------------------


def test_a_picture_of_an_image_that_travels_as_a_file(site: Site) -> None:
    with OverlayNode(site, {'image_transport': 'compressed'}) as node:
        images = node.peer.publisher(CompressedImage, 'image/compressed')
        pixels = np.full((48, 64, 3), (200, 100, 50), np.uint8)
        data = encode(pixels, CodecSettings('png'))

        def send(data: bytes) -> None:
            images.publish(CompressedImage(header=node.header(), format='png', data=data))

        node.send_until(lambda: send(data), lambda: node.pictures, 'a picture')
        with Picture.open(io.BytesIO(node.pictures[0].data.tobytes())) as file:
            shown = np.asarray(file).astype(int)
        assert np.abs(shown - pixels).max() < 5
        before = node.counts()
        node.send_until(
            lambda: send(b'no picture'),
            lambda: node.counts().since(before).get('messages_unreadable'),
            'the damaged file to be counted',
        )
