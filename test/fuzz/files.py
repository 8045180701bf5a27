# SPDX-License-Identifier: Apache-2.0
"""
Feed damaged files to what reads files on the ground: labels, galleries, bags.

    python test/fuzz/files.py --inputs 2000             # of each kind

Whatever the bytes are, the documented errors alone are raised, and soon. A kind is a format of
labels, or `gallery`, `picture`, `bag`.
"""

from __future__ import annotations

import argparse
import io
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr
from contextlib import redirect_stdout
from pathlib import Path

from wire import run_mutations

sys.path.insert(0, str(Path(__file__).parents[1]))

from outboxes import make_outbox

from obbhbb_ros.bags.replay import ReplayOptions
from obbhbb_ros.bags.replay import add_boxes
from obbhbb_ros.cli import main as convert
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.formats import FORMATS
from obbhbb_ros.study.gallery import gallery_page
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.received import read_received

BAG = Path(__file__).parents[1] / 'data/real_ships_bag/real_ships_bag.mcap'
SIZE = (2000, 1000)

Check = Callable[[bytes], str]


def label_kind(name: str, folder: Path) -> tuple[bytes, Check]:
    """Write a file of a format, and read what becomes of it."""
    form = FORMATS[name]
    suffix = min(form.suffixes)
    path = folder / f'labels{suffix}'
    write_labels(folder / 'ships.csv', [harbour()])
    if form.write:
        write_labels(path, [harbour()], name)
    elif form.write_boxes:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            convert(['convert', str(folder / 'ships.csv'), str(path), '--to', name])
    # Where the harbour cannot be written, another format is as good as damage.
    seed = path.read_bytes() if path.is_file() else (folder / 'ships.csv').read_bytes()

    def check(data: bytes) -> str:
        path.write_bytes(data)
        try:
            labels = read_labels(path, name, image_size=SIZE, on_error=bool)
            return 'read' if any(len(image.class_ids) for image in labels) else 'empty'
        except (ObbhbbError, ValueError, OSError):
            return 'refused'

    return seed, check


def gallery_kind(folder: Path) -> tuple[bytes, Check]:
    """Make the JSON of a chip, and show what becomes of it."""
    (record,) = make_outbox(folder / 'box', 1, 'jpeg2000')

    def check(data: bytes) -> str:
        record.write_bytes(data)
        received = read_received(folder / 'box')
        gallery_page(received, folder, 'chips')
        return f'{len(received.chips)} shown'

    return record.read_bytes(), check


def picture_kind(folder: Path) -> tuple[bytes, Check]:
    """Make a chip that has to be converted, and show what becomes of it."""
    (record,) = make_outbox(folder / 'box', 1, 'jpeg2000')
    chip = record.with_suffix('.jp2')

    def check(data: bytes) -> str:
        chip.write_bytes(data)
        received = read_received(folder / 'box')
        page = gallery_page(received, folder, 'chips')
        return 'shown' if '<img' in page else 'no picture'

    return chip.read_bytes(), check


def bag_kind(folder: Path) -> tuple[bytes, Check]:
    """Read a bag, and convert what becomes of it."""
    source = folder / 'in.mcap'

    def check(data: bytes) -> str:
        source.write_bytes(data)
        shutil.rmtree(folder / 'out', ignore_errors=True)
        try:
            tally = add_boxes(source, folder / 'out', ReplayOptions(), lambda text: None)
        except (ObbhbbError, ValueError, OSError):
            return 'refused'
        return 'whole' if tally.complete else 'in part'

    return BAG.read_bytes(), check


OTHERS: dict[str, Callable[[Path], tuple[bytes, Check]]] = {
    'gallery': gallery_kind,
    'picture': picture_kind,
    'bag': bag_kind,
}


def main() -> None:
    """Fuzz."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--inputs', type=int, default=2000, help='of each kind')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--kinds', nargs='+', choices=[*FORMATS, *OTHERS])
    options = parser.parse_args()
    for kind in options.kinds or [*FORMATS, *OTHERS]:
        print(f'{kind}: ', end='', flush=True)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            seed, check = OTHERS[kind](folder) if kind in OTHERS else label_kind(kind, folder)
            run_mutations(options.inputs, options.seed, lambda source, seed=seed: seed, check)


if __name__ == '__main__':
    main()
