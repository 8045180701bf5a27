# SPDX-License-Identifier: Apache-2.0
"""What the tests over DDS have in common."""

from __future__ import annotations

import os
from collections.abc import Callable
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from harness import Converter
from harness import Site
from harness import site_at

# Higher domains run into the ports that Linux hands out to programs.
DOMAINS = 100

# Without multicast, which `LOCALHOST` does without, Fast DDS tries again every three seconds only.
PROFILES = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="found_soon" is_default_profile="true">
    <rtps><builtin><discovery_config>
      <initialAnnouncements>
        <count>50</count><period><nanosec>100000000</nanosec></period>
      </initialAnnouncements>
      <leaseAnnouncement><nanosec>200000000</nanosec></leaseAnnouncement>
    </discovery_config></builtin></rtps>
  </participant>
</profiles>
"""


@pytest.fixture(scope='session')
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A place that hears nothing of everything else that speaks ROS."""
    folder = tmp_path_factory.mktemp('ros')
    profiles = folder / 'profiles.xml'
    profiles.write_text(PROFILES)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(1 + os.getpid() % DOMAINS))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(profiles))
        patch.setenv('ROS_LOG_DIR', str(folder))
        patch.setenv('RCUTILS_COLORIZED_OUTPUT', '0')
        with site_at(folder) as site:
            yield site


@pytest.fixture
def start(site: Site) -> Iterator[Callable[..., Converter]]:
    """Starts nodes that end with the test."""
    with ExitStack() as stack:
        yield lambda **kwargs: stack.enter_context(Converter(site, **kwargs))


@pytest.fixture(scope='module')
def shared_node(site: Site) -> Iterator[Converter]:
    """A node for all tests of a module that do not need one of their own."""
    with Converter(site) as node:
        node.connect()
        yield node


@pytest.fixture
def node(shared_node: Converter) -> Converter:
    """The module's node, converting, with default parameters."""
    shared_node.reset()
    return shared_node
