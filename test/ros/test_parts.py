# SPDX-License-Identifier: Apache-2.0
"""What a managed node tells its parts, and when."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from harness import Site
from rclpy.lifecycle import TransitionCallbackReturn

from obbhbb_ros.nodes.lifecycle.managed import ManagedNode
from obbhbb_ros.nodes.lifecycle.parts import Part
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB

# These tests depend on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Noted(Part):
    """A part that notes what it is told."""

    def __init__(self, name: str, notes: list[str], node: ManagedNode) -> None:
        self._name, self._notes, self._node = name, notes, node
        self.error = ''

    def configure(self) -> None:
        self._note('configure')
        if self.error:
            raise ValueError(self.error)

    def activate(self) -> None:
        self._note('activate')

    def deactivate(self) -> None:
        self._note('deactivate')

    def cleanup(self) -> None:
        self._note('cleanup')

    def _note(self, transition: str) -> None:
        self._notes.append(
            f'{transition} {self._name}' + ' while active' * self._node.topics.is_active
        )


class TwoParts(ManagedNode):
    """A node with two parts besides those of all nodes."""

    def __init__(self, site: Site) -> None:
        super().__init__('two_parts', OBB_TO_HBB, ('messages_received',), context=site.context)
        self.notes: list[str] = []
        self.first, self.second = (Noted(name, self.notes, self) for name in ('first', 'second'))
        self.parts += [self.first, self.second]

    def configure(self) -> None:
        self.notes.append('configure node')

    def cleanup(self) -> None:
        self.notes.append('cleanup node')

    def told(self) -> list[str]:
        notes, self.notes[:] = list(self.notes), []
        return notes


@pytest.fixture
def node(site: Site) -> Iterator[TwoParts]:
    node = TwoParts(site)
    yield node
    node.destroy_node()


def test_parts_are_told_in_order_and_cleaned_up_in_reverse(node: TwoParts) -> None:
    assert node.trigger_configure() == SUCCESS
    assert node.told() == ['configure first', 'configure second', 'configure node']
    # The topics come before: while the node works, messages arrive.
    assert node.trigger_activate() == SUCCESS
    assert node.told() == ['activate first while active', 'activate second while active']
    assert node.trigger_deactivate() == SUCCESS
    assert node.told() == ['deactivate first', 'deactivate second']
    assert node.trigger_cleanup() == SUCCESS
    assert node.told()[-3:] == ['cleanup node', 'cleanup second', 'cleanup first']


def test_after_a_failed_configure_everything_is_cleaned_up_and_it_may_be_tried_again(
    node: TwoParts,
) -> None:
    node.first.error = 'no such folder'
    assert node.trigger_configure() == FAILURE
    assert node.told()[0] == 'configure first'
    assert not list(node.subscriptions)
    assert node.trigger_configure() == FAILURE
    assert 'configure second' not in node.told()
    node.first.error = ''
    assert node.trigger_configure() == SUCCESS
    assert node.told() == ['configure first', 'configure second', 'configure node']


def test_a_shutdown_deactivates_and_cleans_up_whatever_the_state(node: TwoParts) -> None:
    assert node.trigger_configure() == SUCCESS
    assert node.trigger_activate() == SUCCESS
    node.told()
    assert node.trigger_shutdown() == SUCCESS
    assert node.told() == [
        'deactivate first',
        'deactivate second',
        'cleanup node',
        'cleanup second',
        'cleanup first',
    ]
