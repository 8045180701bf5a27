# SPDX-License-Identifier: Apache-2.0
"""
Feed damaged messages to `obbhbb_ros.wire`, by structured mutation or guided by coverage.

    python test/fuzz/wire.py --inputs 1000000
    python test/fuzz/wire.py --atheris -max_total_time=300      # needs the package atheris

Whatever the bytes are, one of two things must happen: the documented error, or a message that can
be rewritten with changes in its box fields only, and read again.
"""

from __future__ import annotations

import argparse
import random
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import encode

from obbhbb_ros.wire.buffer import WireError
from obbhbb_ros.wire.detections import Detections

WORDS = [0, 1, 2, 3, 4, 5, 7, 8, 0x7F, 0xFF, 0x100, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1]
TEXTS = ['', 'a', 'ship', 'camera', 'größe', 'x' * 63]
SLOWEST = 2.0


def check(data: bytes) -> str:
    """Hold one input against what must hold; tell what became of it."""
    try:
        detections = Detections(data)
    except WireError:
        return 'refused'
    count = len(detections)
    assert count * 64 <= len(data), 'more detections than the bytes can hold'
    assert len(detections.class_ids()) == len(detections.scores()) == count
    rows = np.arange(4.0 * count).reshape(-1, 4) - 0.5
    plain = detections.rewrite(rows, np.zeros(count, bool))
    written, other = detections.rewrite(rows), detections.rewrite(rows + 0.25)
    assert_boxes_alone_differ(plain, written, other, count)
    np.testing.assert_array_equal(Detections(written).xywhr()[:, :4], rows)
    chosen = np.arange(count)[::-2]
    selected = Detections(detections.selected(chosen, rows[chosen]))
    np.testing.assert_array_equal(selected.xywhr()[:, :4], rows[chosen])
    return 'read'


def assert_boxes_alone_differ(plain: bytes, written: bytes, other: bytes, count: int) -> None:
    """Hold a message against two with other boxes: x, y, theta, size x, size y are all changes."""
    assert len(plain) == len(written) == len(other)
    # Doubles start four bytes behind the encapsulation header's start.
    end = 4 + (len(plain) - 4) // 8 * 8
    before, one, two = (
        np.frombuffer(data[4:end], np.uint64).copy() for data in (plain, written, other)
    )
    (places,) = (one != two).nonzero()
    boxes = places.reshape(count, 4)
    np.testing.assert_array_equal(boxes, boxes[:, :1] + [0, 1, 3, 4])
    for message in (before, one, two):
        message[boxes[:, :1] + np.arange(5)] = 0
    assert plain[end:] == written[end:] == other[end:]
    np.testing.assert_array_equal(before, one, 'changed outside the box fields')
    np.testing.assert_array_equal(before, two, 'changed outside the box fields')


def seed_message(source: random.Random) -> bytes:
    """Write a sound message."""
    kinds = [
        Detection(
            frame_id=source.choice(TEXTS),
            id=source.choice(TEXTS),
            results=tuple(
                Hypothesis(source.choice(TEXTS), source.random())
                for _ in range(source.choice([0, 1, 1, 2, 5]))
            ),
        )
        for _ in range(source.randint(1, 3))
    ]
    detections = tuple(source.choice(kinds) for _ in range(source.choice([0, 1, 2, 3, 20, 70])))
    message = Message(frame_id=source.choice(TEXTS), detections=detections)
    return encode(message, source.choice('<>'), source.choice([0, 0xA5]))


def mutated(data: bytearray, source: random.Random) -> bytes:
    """Damage a message once or a few times."""
    for _ in range(source.choice([1, 1, 1, 2, 3, 8])):
        at = source.randrange(len(data) + 1)
        kind = source.randrange(6)
        if kind == 0 and at < len(data):
            data[at] = source.randrange(256)
        elif kind <= 2:
            # Lengths and counts lie at multiples of four.
            at -= at % 4
            data[at : at + 4] = struct.pack(source.choice('<>') + 'I', source.choice(WORDS))
        elif kind == 3:
            del data[at : at + source.choice([1, 4, 8, 40, 400])]
        elif kind == 4:
            data[at:at] = source.randbytes(source.choice([1, 2, 3, 4, 8]))
        else:
            other = source.randrange(len(data) + 1)
            data[at:at] = data[other : other + source.choice([4, 8, 64, 500])]
    return bytes(data[: source.randrange(len(data) + 1)] if source.random() < 0.05 else data)


def run_mutations(
    inputs: int,
    seed: int,
    seed_message: Callable[[random.Random], bytes] = seed_message,
    check: Callable[[bytes], str] = check,
    damage: Callable[[bytearray, random.Random], bytes] = mutated,
) -> None:
    """Try many inputs; on a failure write the input to a file."""
    source = random.Random(seed)
    seeds = [seed_message(source) for _ in range(300)]
    outcomes: Counter[str] = Counter()
    slowest = 0.0
    for i in range(inputs):
        data = damage(bytearray(source.choice(seeds)), source)
        # Of this process, since others may be busy.
        started = time.process_time()
        try:
            outcomes[check(data)] += 1
            taken = time.process_time() - started
            assert taken < SLOWEST, f'took {taken:.1f} s'
        except BaseException:
            Path('wire_failure.bin').write_bytes(data)
            print(f'input {i} of seed {seed} fails: wire_failure.bin', file=sys.stderr)
            raise
        slowest = max(slowest, taken)
    print(f'{inputs} inputs, seed {seed}, slowest {slowest * 1e3:.1f} ms: {dict(outcomes)}')


def run_atheris(arguments: list[str]) -> None:
    """Let atheris look for inputs, guided by coverage."""
    import atheris

    atheris.instrument_all()
    atheris.Setup([sys.argv[0], *arguments], check)
    atheris.Fuzz()


def main() -> None:
    """Fuzz."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--inputs', type=int, default=1_000_000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--atheris', action='store_true', help='further options go to atheris')
    options, rest = parser.parse_known_args()
    if options.atheris:
        run_atheris(rest)
    elif rest:
        parser.error(f'unknown options: {" ".join(rest)}')
    else:
        run_mutations(options.inputs, options.seed)


if __name__ == '__main__':
    main()
