# SPDX-License-Identifier: Apache-2.0
"""
The bus: sends what is in an outbox to the ground by CFDP, class 2, and removes what has arrived.

`bus.py OUTBOX --to HOST:PORT` serves an outbox until Ctrl-C, `--once` until it is empty.
"""

from __future__ import annotations

import argparse
import glob
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from cfdppy import CfdpState
from cfdppy import PutRequest
from cfdppy.exceptions import InvalidNakPdu
from cfdppy.exceptions import InvalidPduDirection
from cfdppy.exceptions import InvalidTransactionSeqNum
from cfdppy.exceptions import PduIgnoredForSource
from cfdppy.handler import SourceHandler
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
from spacepackets.cfdp import TransmissionMode
from spacepackets.cfdp.pdu.finished import DeliveryCode
from spacepackets.seqcount import ProvidesSeqCount

# PDUs that belong to an earlier transaction, or come too early.
_STALE = (InvalidNakPdu, InvalidPduDirection, InvalidTransactionSeqNum, PduIgnoredForSource)


def waiting(outbox: Path) -> list[Path]:
    """List the JSON files of complete chips: level 0 first, in a level in the order of release."""
    levels = sorted(
        (each for each in outbox.iterdir() if each.name.isdecimal()),
        key=lambda level: int(level.name),
    )
    return [path for level in levels for path in sorted(_complete(level), key=_age)]


def _complete(level: Path) -> Iterator[Path]:
    return (path for path in level.glob('*.json') if not path.name.startswith('.'))


def _name(path: Path) -> str:
    """Give the name of a file on the ground."""
    return f'{path.parent.name}/{path.name}'


def _age(path: Path) -> tuple[int, str]:
    return path.stat().st_mtime_ns, path.name


class Bus:
    """
    The sending entity: one file after the other, each a transaction of its own.

    Parameters
    ----------
    link : Link
        The link to the ground.
    timeout : float
        Seconds until what is not acknowledged is sent again.
    pace : float
        Seconds between two PDUs; the rate of the link.
    """

    def __init__(self, link: Link, timeout: float = 1.0, pace: float = 0.002) -> None:
        self._link, self._pace = link, pace
        self._patience = 5.0 * timeout
        self._remote = remote_entity(GROUND, timeout)
        self._numbers = _Numbers()

    def deliver(self, outbox: Path) -> bool:
        """Deliver the chip that is next; False if none is waiting, or it did not arrive."""
        for record in waiting(outbox)[:1]:
            chips = [
                each
                for each in record.parent.glob(f'{glob.escape(record.stem)}.*')
                if each != record
            ]
            files = [*chips, record]
            # Without its chip, it has arrived: removing both was interrupted after the first.
            if chips and not all(self.send(each, _name(each)) for each in files):
                return False
            for each in files:
                each.unlink()
            return True
        return False

    def send(self, file: Path, name: str) -> bool:
        """Send a file; return whether the ground confirms that all of it is there under `name`."""
        user = _Sender()
        handler = SourceHandler(local_entity(BUS), user, self._remote, NoTimers(), self._numbers)
        handler.put_request(
            PutRequest(GROUND, file, Path(name), TransmissionMode.ACKNOWLEDGED, True)
        )
        heard, pdu = time.monotonic(), None
        while handler.state != CfdpState.IDLE:
            with suppress(*_STALE):
                handler.state_machine(pdu)
            while handler.packets_ready:
                self._link.send(handler.get_next_packet().pdu)
            pdu = self._link.receive(self._pace)
            if pdu is not None:
                heard = time.monotonic()
            elif time.monotonic() - heard > self._patience:
                # The library has no timer for inactivity. The next try is a new transaction.
                return False
        return user.arrived


class _Sender(User):
    arrived = False

    def transaction_finished_indication(self, params: TransactionFinishedParams) -> None:
        end = params.finished_params
        self.arrived = (end.condition_code, end.delivery_code) == (
            ConditionCode.NO_ERROR,
            DeliveryCode.DATA_COMPLETE,
        )


class _Numbers(ProvidesSeqCount):
    """Transaction numbers that are not used again after a restart."""

    max_bit_width = 32

    def __init__(self) -> None:
        self._next = time.time_ns() // 1_000_000

    def get_and_increment(self) -> int:
        self._next += 1
        return self._next % 2**self.max_bit_width


def main() -> None:
    """Serve an outbox."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('outbox', type=Path)
    parser.add_argument('--to', default=f'127.0.0.1:{PORT}', metavar='HOST:PORT')
    parser.add_argument('--loss', type=float, default=0.0, help='probability, for tests')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--timeout', type=float, default=1.0, help='seconds to acknowledge')
    parser.add_argument('--once', action='store_true', help='end when the outbox is empty')
    options = parser.parse_args()
    host, _, port = options.to.rpartition(':')
    link = Link(('', 0), (host, int(port)), options.loss, options.seed)
    bus = Bus(link, options.timeout)
    delivered = 0
    while waiting(options.outbox) or not options.once:
        if bus.deliver(options.outbox):
            delivered += 1
        else:
            time.sleep(options.timeout)
    print(f'{delivered} chips delivered, {link.lost} of {link.sent + link.lost} PDUs lost')


if __name__ == '__main__':
    main()
