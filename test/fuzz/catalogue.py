# SPDX-License-Identifier: Apache-2.0
"""
Flips the bits of a small catalogue, one at a time: the nodes must go on, and nothing be wrong.

`python test/fuzz/catalogue.py` takes all of them, which is a matter of an hour or two;
`--every 100` every hundredth. `--lists` takes the catalogue of ship lists instead of the chips'.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from flips import ChipFlips
from flips import ListFlips


def main() -> None:
    """Flip, and print how often which outcome came."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--every', type=int, default=1)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--lists', action='store_true', help='the catalogue of ship lists')
    options = parser.parse_args()
    # In memory, where there is one: the disk is not what is tested.
    memory = Path('/dev/shm')
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        flips = (ListFlips if options.lists else ChipFlips)(Path(folder))
        outcomes: Counter[str] = Counter()
        wrong = 0
        for bit in range(options.first, flips.bits, options.every):
            try:
                outcomes[flips.check(bit)] += 1
            except Exception as error:
                wrong += 1
                print(f'bit {bit} of byte {bit // 8}: {error!r}'[:600], flush=True)
    print(f'{flips.bits} bits, {outcomes.total() + wrong} flipped, {wrong} wrong')
    for outcome, number in sorted(outcomes.items()):
        print(f'{number:7} times {outcome}')
    sys.exit(1 if wrong else 0)


if __name__ == '__main__':
    main()
