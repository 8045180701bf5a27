# SPDX-License-Identifier: Apache-2.0
"""The link between bus and ground, UDP that loses datagrams, and the two CFDP entities."""

from __future__ import annotations

import random
import socket
from typing import Any

from cfdppy import CfdpUserBase
from cfdppy import IndicationConfig
from cfdppy import LocalEntityConfig
from cfdppy import RemoteEntityConfig
from cfdppy import RemoteEntityConfigTable
from cfdppy.mib import CheckTimerProvider
from cfdppy.mib import DefaultFaultHandlerBase
from spacepackets.cfdp import ChecksumType
from spacepackets.cfdp import TransmissionMode
from spacepackets.cfdp.pdu.helper import GenericPduPacket
from spacepackets.cfdp.pdu.helper import PduFactory
from spacepackets.util import ByteFieldU8

BUS, GROUND = ByteFieldU8(1), ByteFieldU8(2)
PORT = 4556
# Bytes of a PDU.
_LARGEST = 1024
# Repetitions of what is not acknowledged, before a transaction is given up.
_REPETITIONS = 10


class Link:
    """
    One end of a UDP link that loses each datagram it sends with a probability of `loss`.

    Without a peer, it answers to where the last PDU came from.
    """

    def __init__(
        self,
        local: tuple[str, int],
        peer: tuple[str, int] | None = None,
        loss: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(local)
        self.address: tuple[str, int] = self._socket.getsockname()
        self._peer, self._answers = peer, peer is None
        self._loss, self._random = loss, random.Random(seed)
        self.sent = self.lost = 0

    def send(self, pdu: GenericPduPacket) -> None:
        """Send a PDU, or lose it."""
        if self._random.random() < self._loss:
            self.lost += 1
        elif self._peer is not None:
            self.sent += 1
            self._socket.sendto(pdu.pack(), self._peer)

    def receive(self, seconds: float) -> GenericPduPacket | None:
        """Wait for a PDU; None if none comes, or something that is none."""
        self._socket.settimeout(seconds)
        try:
            data, sender = self._socket.recvfrom(65536)
        except (TimeoutError, ConnectionRefusedError):
            # Refused: nobody listens at the other end, which a radio would not tell.
            return None
        try:
            pdu = PduFactory.from_raw(data)
        except Exception:
            # Any exception: the parser raises whatever noise leads it to.
            return None
        if self._answers:
            self._peer = sender
        return pdu

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def local_entity(entity: ByteFieldU8) -> LocalEntityConfig:
    """Configure one end."""
    return LocalEntityConfig(entity, IndicationConfig(), Faults())


def remote_entity(entity: ByteFieldU8, timeout: float) -> RemoteEntityConfigTable:
    """Configure what one end knows of the other: class 2, and `timeout` seconds to answer."""
    return RemoteEntityConfigTable(
        [
            RemoteEntityConfig(
                entity_id=entity,
                max_file_segment_len=None,
                max_packet_len=_LARGEST,
                closure_requested=True,
                crc_on_transmission=True,
                default_transmission_mode=TransmissionMode.ACKNOWLEDGED,
                crc_type=ChecksumType.CRC_32,
                positive_ack_timer_interval_seconds=timeout,
                positive_ack_timer_expiration_limit=_REPETITIONS,
                nak_timer_interval_seconds=timeout,
                nak_timer_expiration_limit=_REPETITIONS,
            )
        ]
    )


def _ignore(*_: Any) -> None:
    pass


class User(CfdpUserBase):
    """The user of an entity, to whom it reports; a subclass has what it wants to hear."""

    transaction_indication = eof_sent_indication = transaction_finished_indication = _ignore
    metadata_recv_indication = file_segment_recv_indication = report_indication = _ignore
    suspended_indication = resumed_indication = fault_indication = _ignore
    abandoned_indication = eof_recv_indication = _ignore


class Faults(DefaultFaultHandlerBase):
    """No action on faults: what is not confirmed is sent again in any case."""

    notice_of_suspension_cb = notice_of_cancellation_cb = abandoned_cb = ignore_cb = _ignore


class NoTimers(CheckTimerProvider):
    """Only unacknowledged transfers need these timers."""

    provide_check_timer = _ignore
