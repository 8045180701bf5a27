# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy allows what the running nodes do, and nothing more."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from harness import Peer
from harness import Site
from PIL import Image as Picture
from sensor_msgs.msg import CompressedImage

from obbhbb_ros.limits import Choices
from obbhbb_ros.settings.all_nodes import NODE_TABLES

# What it tests depends on rclpy, which is the same in all environments.
pytestmark = pytest.mark.once

POLICY = ElementTree.parse(Path(__file__).parents[2] / 'config' / 'security' / 'policy.xml')
MANAGED = ('obb_to_hbb', 'chip_extractor', 'downlink', 'overlay', 'ship_tracker')
NODES = (*MANAGED, 'play_detections')
# On these the topics of a node depend.
TOPIC_PARAMETERS = ('input_type', 'output_type', 'image_transport', 'pose_type')


def allowed(node: str, kind: str, action: str) -> set[str]:
    """Read the absolute names that the policy lists for a node."""
    (profile,) = POLICY.iterfind(f".//profile[@node='{node}']")
    names = [each.text or '' for each in profile.iterfind(f'{kind}s[@{action}="ALLOW"]/{kind}')]
    assert len(names) == len(set(names))
    return {absolute(name, node) for name in names}


def absolute(name: str, node: str) -> str:
    return f'/{node}/{name[2:]}' if name.startswith('~/') else f'/{name.lstrip("/")}'


def variants(node: str) -> list[dict[str, Any]]:
    """List parameters with which a node uses all the topics that it can use."""
    missing = () if find_spec('yolo_msgs') else ('DetectionArray',)
    choices: dict[str, Any] = {
        row.name: [value for value in row.limits.words if value not in missing]
        for row in NODE_TABLES[node].rows
        if isinstance(row.limits, Choices) and row.name in TOPIC_PARAMETERS
    }
    if node == 'overlay' and find_spec('foxglove_msgs'):
        choices['annotations'] = (True,)
    return [
        {name: values[i % len(values)] for name, values in choices.items()}
        for i in range(max(map(len, choices.values()), default=1))
    ]


@pytest.mark.parametrize('node', NODES)
def test_the_policy_has_the_names_of_the_running_node_whatever_its_parameters(
    site: Site, node: str, tmp_path: Path
) -> None:
    folders = {'spool.path': tmp_path / 'spool', 'outbox.path': tmp_path / 'outbox'}
    used = {name: path for name, path in folders.items() if name in NODE_TABLES[node].parameters()}
    if node == 'play_detections':
        # It publishes images if there are some.
        Picture.new('L', (40, 30)).save(tmp_path / 'P1.png')
        used['path'] = tmp_path / 'P1.txt'
        used['path'].write_text('10 20 30 20 30 25 10 25 ship 0\n')
        # With a pose there is one more topic.
        used |= {'pass_height': 20, 'pass_step': 5, 'pass_altitude': 1000.0, 'rate': 0.01}
    if node == 'ship_tracker':
        used['camera_mount'] = [0.0, 0.0, 0.0, 1.0]
    spaces = {f'/variant{i}': given for i, given in enumerate(variants(node))}
    with ExitStack() as stack:
        peer = stack.enter_context(Peer(site.context, '/watching'))
        graph = peer.node
        for space, given in spaces.items():
            stack.enter_context(site.start(node, parameters=used | given, namespace=space))
            # The overlay subscribes to nothing before somebody looks.
            peer.collect(CompressedImage, f'{space}/overlay/compressed')
        lists: dict[tuple[str, str], Callable[..., Any]] = {
            ('topic', 'publish'): graph.get_publisher_names_and_types_by_node,
            ('topic', 'subscribe'): graph.get_subscriber_names_and_types_by_node,
            ('service', 'reply'): graph.get_service_names_and_types_by_node,
            ('service', 'request'): graph.get_client_names_and_types_by_node,
        }

        def names(kind: str, action: str) -> set[str]:
            """Return the names of all variants, as without namespace."""
            return {
                name.removeprefix(space)
                for space in spaces
                for name, _ in lists[kind, action](node, space)
            }

        def all_run() -> bool:
            running = graph.get_node_names_and_namespaces()
            return all((node, space) in running for space in spaces)

        peer.spin_until(all_run, f'{len(spaces)} times {node}')
        for kind, action in lists:
            expected = allowed(node, kind, action)
            if not find_spec('foxglove_msgs'):
                expected.discard('/overlay/annotations')
            peer.spin_until(
                lambda kind=kind, action=action, expected=expected: names(kind, action) == expected,
                f'{expected} in the graph, not {names(kind, action)}',
            )


def test_the_operator_may_ask_for_every_service_and_nobody_else_for_any() -> None:
    replies = set().union(*(allowed(node, 'service', 'reply') for node in MANAGED))
    assert allowed('operator', 'service', 'request') == replies
    requests = POLICY.findall('.//services[@request="ALLOW"]')
    assert len(requests) == 1


def test_every_input_has_somebody_who_may_publish_it() -> None:
    published = set().union(
        *(
            allowed(node, 'topic', 'publish')
            for node in (*MANAGED, 'camera', 'detector', 'navigator', 'operator')
        )
    )
    for node in (*MANAGED, 'detector'):
        assert allowed(node, 'topic', 'subscribe') <= published


def test_the_tools_of_the_operator_may_describe_their_types() -> None:
    # Every node of Jazzy has this service, those of `ros2 param` and the like as well.
    assert allowed('operator', 'service', 'reply') == {'/_ros2cli_*/get_type_description'}
