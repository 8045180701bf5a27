# SPDX-License-Identifier: Apache-2.0
"""The downlink node: releases chips from the spool into the outbox while there is contact."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from rclpy.qos import DurabilityPolicy
from std_msgs.msg import Bool

from obbhbb_ros.downlink.contact_watch import ContactWatch
from obbhbb_ros.nodes.list_report import list_facts
from obbhbb_ros.nodes.managed import ManagedNode
from obbhbb_ros.nodes.node_topics import reliable
from obbhbb_ros.nodes.reporter import plain_yaml
from obbhbb_ros.nodes.spool_report import SpoolReport
from obbhbb_ros.nodes.spool_report import kind_of
from obbhbb_ros.settings.downlink import DOWNLINK
from obbhbb_ros.settings.downlink import DownlinkSettings
from obbhbb_ros.spool.catalogue import SpoolError
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.feeder import FeederThread
from obbhbb_ros.spool.list_spool import ListSpool
from obbhbb_ros.wire.contact import read_contact

# Seconds after which a thread that gives no sign is reported; it may wait for another process.
_MAX_SILENCE = 6.0


class Downlink(ManagedNode[DownlinkSettings]):
    """
    Managed node `downlink`.

    Subscribes to `contact`, publishes `/diagnostics`, moves chips from the spool to the outbox.
    Topics and parameters: `doc/downlink.md`.

    Parameters
    ----------
    **kwargs
        Passed to `rclpy.lifecycle.LifecycleNode`.

    Raises
    ------
    ValueError, rclpy.exceptions.ParameterException
        If the parameters given at start cannot be used.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('downlink', DOWNLINK, ('contacts_received',), **kwargs)
        self._worker: FeederThread | None = None
        self._books: SpoolConsole | None = None
        self._spool_report: SpoolReport | None = None
        self._lists: ListSpool | None = None
        self._contact = ContactWatch()
        self._contact_in = self.topics.input(
            Bool, 'contact', self._on_contact, qos=reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
        )
        self.parameters.on_change = self._steer
        self.reporter.add_facts(self._facts)

    def configure(self) -> None:
        """Open the spool, and start the thread that releases chips; so far there is no contact."""
        self._contact = ContactWatch()
        settings = self.parameters.settings
        self._books = SpoolConsole(Path(settings.spool_path), self._warn_of_spool)
        self._spool_report = SpoolReport(self.reporter, self._books)
        self._lists = ListSpool(Path(settings.spool_path), self._warn_of_spool)
        self._worker = FeederThread(
            Path(settings.spool_path), Path(settings.outbox_path), settings.release
        )

    def activate(self) -> None:
        """Start releasing."""
        self._steer()

    def deactivate(self) -> None:
        """Stop releasing."""
        self._steer()

    def cleanup(self) -> None:
        """Stop the thread, and close the spool."""
        if self._worker is not None:
            self._worker.stop()
            self._worker = None
        if self._books is not None:
            self._books.close()
            self._books = self._spool_report = None
        if self._lists is not None:
            self._lists.close()
            self._lists = None

    def worker_sign(self) -> int | None:
        """Return how many signs of life the releasing thread has given."""
        worker = self._worker
        return None if worker is None else worker.feeder.signs

    def _steer(self) -> None:
        """Tell the thread which settings are in force and whether there is contact."""
        if self._worker is not None:
            settings = self.parameters.settings
            has_contact = settings.always_in_contact or self._contact.is_contact
            self._worker.steer(settings.release, self.topics.is_active and has_contact)

    def destroy_node(self) -> None:
        """Stop the thread with the node."""
        if self._worker is not None:
            self._worker.stop()
        super().destroy_node()

    def _on_contact(self, data: bytes) -> None:
        """Learn whether there is contact."""
        self.monitor.add('contacts_received')
        is_contact = read_contact(data)
        if self.parameters.settings.always_in_contact:
            self.reporter.warn_once(
                f'{self._contact_in.topic_name} has no effect while the parameter contact is '
                'always; set it to topic'
            )
        elif self._contact.is_lost:
            self.get_logger().info(f'{self._contact_in.topic_name} is back')
        self._contact.hear(is_contact, time.monotonic())
        self._steer()

    def _watch_contact(self) -> None:
        """End contact that is not renewed in time, and warn until the topic is heard again."""
        settings, now = self.parameters.settings, time.monotonic()
        is_ending = self._contact.expire(now, settings.contact_timeout)
        if is_ending:
            self._steer()
        if not self._contact.is_lost or settings.always_in_contact:
            return
        text = (
            f'contact lost: no message on {self._contact_in.topic_name} for '
            f'{self._contact.silence(now):.0f} s, see contact_timeout'
        )
        if is_ending:
            self.monitor.add('contacts_lost')
            self.reporter.warn('contact lost', text)
        else:
            self.reporter.raise_level('contact lost', text)

    def _facts(self) -> dict[str, str]:
        """Report what the node releases, what stalls it, and the books of the spool."""
        if self._worker is None or self._spool_report is None:
            return {}
        self._watch_contact()
        for text in self._worker.take_troubles():
            self._warn_of_spool(text)
        feeder, stalled_by = self._worker.feeder, self._worker.feeder.stalled_by
        if (silence := self._worker.silence()) > _MAX_SILENCE:
            stalled_by = f'no answer from the disk of spool or outbox for {silence:.0f} s'
            self.reporter.warn('no answer', stalled_by)
        facts = {
            'contact': plain_yaml(feeder.is_contact),
            'stalled_by': stalled_by,
            'budget_available': f'{feeder.available:.0f}',
            'cameras_released': str(feeder.cameras),
        }
        try:
            facts.update(self._spool_report.facts())
            if self._lists is not None and self._lists.exists:
                facts.update(list_facts(self._lists))
        except SpoolError as error:
            self._warn_of_spool(str(error))
        return facts

    def _warn_of_spool(self, text: str) -> None:
        """Report trouble with spool or outbox."""
        self.monitor.add('troubles')
        self.reporter.warn(kind_of(text), text)
