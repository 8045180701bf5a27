# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy allows what the running nodes do, and nothing more."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from harness import Peer
from harness import Site
from sensor_msgs.msg import CompressedImage

from obbhbb_ros.settings.all_nodes import NODE_TABLES

# What it tests depends on rclpy, which is the same in all environments.
pytestmark = pytest.mark.once

POLICY = ElementTree.parse(Path(__file__).parents[2] / 'config' / 'security' / 'policy.xml')
MANAGED = ('obb_to_hbb', 'chip_extractor', 'downlink', 'overlay')
NODES = (*MANAGED, 'play_detections')


def allowed(node: str, kind: str, action: str) -> set[str]:
    """Read the absolute names that the policy lists for a node."""
    (profile,) = POLICY.iterfind(f".//profile[@node='{node}']")
    names = [each.text or '' for each in profile.iterfind(f'{kind}s[@{action}="ALLOW"]/{kind}')]
    assert len(names) == len(set(names))
    return {absolute(name, node) for name in names}


def absolute(name: str, node: str) -> str:
    return f'/{node}/{name[2:]}' if name.startswith('~/') else f'/{name.lstrip("/")}'


@pytest.mark.parametrize('node', NODES)
def test_the_policy_has_the_names_of_the_running_node(
    site: Site, node: str, tmp_path: Path
) -> None:
    # With everything that a node may use.
    folders = {'spool.path': tmp_path / 'spool', 'outbox.path': tmp_path / 'outbox'}
    parameters = {
        name: path for name, path in folders.items() if name in NODE_TABLES[node].parameters()
    }
    with site.start(node, parameters=parameters), Peer(site.context, '/watching') as peer:
        graph = peer.node
        # The overlay subscribes to nothing before somebody looks.
        peer.collect(CompressedImage, '/overlay/compressed')
        lists: dict[tuple[str, str], Callable[..., Any]] = {
            ('topic', 'publish'): graph.get_publisher_names_and_types_by_node,
            ('topic', 'subscribe'): graph.get_subscriber_names_and_types_by_node,
            ('service', 'reply'): graph.get_service_names_and_types_by_node,
            ('service', 'request'): graph.get_client_names_and_types_by_node,
        }
        peer.spin_until(lambda: (node, '/') in graph.get_node_names_and_namespaces(), node)
        for (kind, action), names in lists.items():
            expected = allowed(node, kind, action)
            peer.spin_until(
                lambda names=names, expected=expected: {n for n, _ in names(node, '/')} == expected,
                f'{expected} in the graph, not {names(node, "/")}',
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
            for node in (*MANAGED, 'camera', 'detector', 'operator')
        )
    )
    for node in (*MANAGED, 'detector'):
        assert allowed(node, 'topic', 'subscribe') <= published


def test_the_tools_of_the_operator_may_describe_their_types() -> None:
    # Every node of Jazzy has this service, those of `ros2 param` and the like as well.
    assert allowed('operator', 'service', 'reply') == {'/_ros2cli_*/get_type_description'}
