# SPDX-License-Identifier: Apache-2.0
"""
The ground: receives files by CFDP, class 2, into a folder.

`ground.py FOLDER` serves until Ctrl-C. Files appear when they are complete.
"""

from __future__ import annotations

import argparse
import os
from contextlib import suppress
from pathlib import Path

from cfdppy import RestrictedFilestore
from cfdppy.exceptions import InvalidDestinationId
from cfdppy.exceptions import InvalidPduDirection
from cfdppy.exceptions import InvalidPduForDestHandler
from cfdppy.exceptions import NoRemoteEntityConfigFound
from cfdppy.exceptions import PduIgnoredForDest
from cfdppy.handler import DestHandler
from cfdppy.handler import DestTransactionStep
from cfdppy.handler import dest
from cfdppy.user import MetadataRecvParams
from cfdppy.user import TransactionFinishedParams
from link import BUS
from link import GROUND
from link import PORT
from link import Link
from link import NoTimers
from link import User
from link import local_entity
from link import remote_entity
from spacepackets.cfdp import ConditionCode
from spacepackets.cfdp.pdu import EofPdu
from spacepackets.cfdp.pdu import MetadataPdu
from spacepackets.cfdp.pdu import TransactionStatus
from spacepackets.cfdp.pdu.finished import DeliveryCode
from spacepackets.cfdp.pdu.helper import GenericPduPacket

_REFUSED = (
    InvalidDestinationId,
    InvalidPduDirection,
    InvalidPduForDestHandler,
    NoRemoteEntityConfigFound,
    PduIgnoredForDest,
)
# The steps in which a handler acknowledges the end of the file by itself.
_ACKNOWLEDGING = (
    DestTransactionStep.IDLE,
    DestTransactionStep.RECEIVING_FILE_DATA,
    DestTransactionStep.WAITING_FOR_METADATA,
)


class Ground:
    """The receiving entity: one transaction at a time, as the bus sends them."""

    def __init__(self, link: Link, folder: Path, timeout: float = 1.0) -> None:
        self._link = link
        self._inbox = Inbox(folder)
        self._remote = remote_entity(BUS, timeout)
        self._transaction: tuple[int, int] | None = None
        self._ended: set[tuple[int, int] | None] = set()
        self._handler = self._new_handler()

    @property
    def arrived(self) -> list[str]:
        """Names of the files, in the order in which they were complete."""
        return self._inbox.arrived

    def serve(self, seconds: float) -> None:
        """Wait for a PDU and answer it, or repeat what has not been answered."""
        pdu = self._link.receive(seconds)
        if pdu is not None and not self._accepts(pdu):
            return
        with suppress(*_REFUSED):
            self._handler.state_machine(pdu)
        while self._handler.packets_ready:
            self._link.send(self._handler.get_next_packet().pdu)

    def _accepts(self, pdu: GenericPduPacket) -> bool:
        """Make the handler ready for a PDU; False if the PDU is not for it."""
        transaction = pdu.source_entity_id.value, pdu.transaction_seq_num.value
        if isinstance(pdu, MetadataPdu) and not self._inbox.prepare(pdu.dest_file_name):
            return False
        if transaction not in self._ended and transaction != self._transaction:
            self._ended.add(self._transaction)
            self._transaction, self._handler = transaction, self._new_handler()
        ended = transaction in self._ended
        if isinstance(pdu, EofPdu) and (ended or self._handler.step not in _ACKNOWLEDGING):
            # Our first acknowledgement was lost, and the handler does not give it twice.
            self._link.send(dest.acknowledge_inactive_eof_pdu(pdu, TransactionStatus.TERMINATED))
            return False
        return not ended

    def _new_handler(self) -> DestHandler:
        # All handlers of a process share this list (cfdp-py 0.7), and an abandoned transaction
        # leaves its missing segments in it.
        dest._AckedModeParams().lost_seg_tracker.reset()
        return DestHandler(local_entity(GROUND), self._inbox, self._remote, NoTimers())


class Inbox(User):
    """The folder, and in it a hidden one for files that are not complete."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._partial = folder, folder / '.incoming'
        super().__init__(RestrictedFilestore(self._partial))
        self._name = ''
        self.arrived: list[str] = []

    def prepare(self, name: str | None) -> bool:
        """Make the folder of a file; False if the file would be outside ours."""
        if not name or Path(name).is_absolute() or '..' in Path(name).parts:
            return False
        (self._partial / name).parent.mkdir(parents=True, exist_ok=True)
        return True

    def metadata_recv_indication(self, params: MetadataRecvParams) -> None:
        self._name = params.dest_file_name

    def transaction_finished_indication(self, params: TransactionFinishedParams) -> None:
        end = params.finished_params
        if (end.condition_code, end.delivery_code) != (
            ConditionCode.NO_ERROR,
            DeliveryCode.DATA_COMPLETE,
        ):
            return
        partial, path = self._partial / self._name, self._folder / self._name
        path.parent.mkdir(parents=True, exist_ok=True)
        # The bus removes its copy as soon as we confirm ours.
        with partial.open('rb') as stream:
            os.fsync(stream.fileno())
        partial.replace(path)
        self.arrived.append(self._name)


def main() -> None:
    """Serve a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--port', type=int, default=PORT, help='0: any that is free')
    parser.add_argument('--loss', type=float, default=0.0, help='probability, for tests')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--timeout', type=float, default=1.0, help='seconds to acknowledge')
    options = parser.parse_args()
    link = Link(('127.0.0.1', options.port), None, options.loss, options.seed)
    print(f'listening on {link.address[0]}:{link.address[1]}', flush=True)
    ground = Ground(link, options.folder, options.timeout)
    while True:
        ground.serve(options.timeout / 4.0)


if __name__ == '__main__':
    main()
