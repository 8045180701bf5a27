# SPDX-License-Identifier: Apache-2.0
"""
Feed damaged files to what reads files on the ground: labels, galleries, bags.

    python test/fuzz/files.py --inputs 2000             # of each kind

Whatever the bytes are, the documented errors alone are raised, soon and within bounded memory. A
kind is a format of labels, `class_names` or `image_size` (beside labels), `gallery`, `camera`,
`picture`, `ships` (the JSON of a chip with a place), `list` (of ships) or `bag`.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import resource
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
from PIL import Image
from text_damage import damaged_text
from wire import mutated
from wire import run_mutations

sys.path.insert(0, str(Path(__file__).parents[1]))

from outboxes import make_outbox
from outboxes import make_placed_outbox
from sound_labels import SOUND
from spooled import CAMERA

from obbhbb_ros.bags.replay import ReplayOptions
from obbhbb_ros.bags.replay import add_boxes
from obbhbb_ros.cli import main as convert
from obbhbb_ros.errors import ObbhbbError
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.ground.gallery import gallery_page
from obbhbb_ros.ground.received import read_received
from obbhbb_ros.labels import detect_format
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.axis_aligned import convert_image
from obbhbb_ros.labels.formats import FORMATS
from obbhbb_ros.reports.ship_geojson import ship_geojson
from obbhbb_ros.reports.ship_list import LIST_SUFFIXES
from obbhbb_ros.reports.ship_message import ship_message
from obbhbb_ros.reports.ship_report import ShipReport
from obbhbb_ros.spool.compact_json import camera_id
from obbhbb_ros.spool.compact_json import compact_bytes
from obbhbb_ros.spool.compact_json import without_camera
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.spool.seals import sealed
from obbhbb_ros.study.harbour import harbour

BAG = Path(__file__).parents[1] / 'data/real_ships_bag/real_ships_bag.mcap'
OF_TOOLS = Path(__file__).parents[1] / 'data/labels'
SIZE = (2000, 1000)
MAX_BYTES = 1 << 30

Check = Callable[[bytes], str]
Kind = tuple[list[bytes], Check]
"""Sound files, and what holds a damaged one against what must hold."""


def label_kind(name: str, folder: Path) -> Kind:
    """Write files of a format, and convert what becomes of them."""
    form = FORMATS[name]
    path = folder / f'labels{min(form.suffixes)}'
    seeds = _written(folder, name, path)
    if name in SOUND:
        seeds.append(SOUND[name].encode())
    seeds += [file.read_bytes() for file in sorted(OF_TOOLS.rglob('*.*')) if _is(file, name)]

    def check(data: bytes) -> str:
        path.write_bytes(data)
        return _converted(path, name, SIZE)

    return seeds, check


def _is(file: Path, name: str) -> bool:
    try:
        return file.is_file() and detect_format(file) == name
    except ValueError:
        return False


def _written(folder: Path, name: str, path: Path) -> list[bytes]:
    """Write the harbour, if the format can be written."""
    table = folder / 'ships.csv'
    write_labels(table, [harbour()])
    files = []
    if FORMATS[name].write:
        write_labels(path, [harbour()], name)
        files.append(path.read_bytes())
    if FORMATS[name].write_boxes:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            convert(['convert', str(table), str(path), '--to', name])
        files += [path.read_bytes()] if path.is_file() else []
    return files


def _converted(path: Path, name: str, size: tuple[int, int] | None) -> str:
    """Read labels and convert them; say what came of it."""
    boxes = 0
    try:
        for labels in read_labels(path, name, image_size=size, on_error=bool):
            assert np.isfinite(labels.corners).all()
            assert np.isfinite(labels.scores).all()
            boxes += len(convert_image(labels, HullRule()).boxes.class_ids)
    except (ObbhbbError, ValueError, OSError):
        return 'refused'
    return 'converted' if boxes else 'empty'


def class_names_kind(folder: Path) -> Kind:
    """Read labels beside a damaged file of class names."""
    names, path = folder / 'data.yaml', folder / 'labels.txt'
    path.write_text(SOUND['yolo'])

    def check(data: bytes) -> str:
        names.write_bytes(data)
        return _converted(path, 'yolo', SIZE)

    seeds = 'path: .\nnc: 2\nnames: [ship, tug]\n', 'names:\n  0: ship\n  1: &a tug\n  2: *a\n'
    return [seed.encode() for seed in seeds], check


def image_size_kind(folder: Path) -> Kind:
    """Read labels beside a damaged image."""
    path = folder / 'labels.txt'
    path.write_text(SOUND['yolo'])
    image = folder / 'labels.png'
    seeds = []
    for form in ('PNG', 'JPEG', 'TIFF', 'BMP', 'WEBP'):
        stream = io.BytesIO()
        Image.new('RGB', (40, 30)).save(stream, form)
        seeds.append(stream.getvalue())

    def check(data: bytes) -> str:
        image.write_bytes(data)
        return _converted(path, 'yolo', None)

    return seeds, check


def gallery_kind(folder: Path) -> Kind:
    """Make the JSON of a chip, and show what becomes of it."""
    (record,) = make_outbox(folder / 'box', 1, 'jpeg2000')

    def check(data: bytes) -> str:
        record.write_bytes(data)
        received = read_received(folder / 'box')
        gallery_page(received, folder, 'chips')
        return f'{len(received.chips)} shown'

    of_ship = json.loads(record.read_bytes())
    of_ship |= {'object': '5f3a91c2-17', 'view': 2, 'rank': 0.07, 'camera': CAMERA}
    return [record.read_bytes(), json_bytes(of_ship)], check


def camera_kind(folder: Path) -> Kind:
    """Make the file of a camera that a chip names, and show what becomes of it."""
    (record,) = make_outbox(folder / 'box', 1)
    short, camera = without_camera(json.loads(record.read_bytes()) | {'camera': CAMERA})
    assert camera is not None

    def check(data: bytes) -> str:
        named = camera._replace(id=camera_id(data))
        record.write_bytes(compact_bytes(short | {'camera': short['camera'] | {'id': named.id}}))
        file = record.with_name(f'{named.id}.camera')
        file.write_bytes(data)
        received = read_received(folder / 'box')
        gallery_page(received, folder, 'chips')
        file.unlink()
        return f'{sum(chip.facts["camera"] is not None for chip in received.chips)} with camera'

    return [camera.content], check


def picture_kind(folder: Path) -> Kind:
    """Make a chip that has to be converted, and show what becomes of it."""
    (record,) = make_outbox(folder / 'box', 1, 'jpeg2000')
    chip = record.with_suffix('.jp2')

    def check(data: bytes) -> str:
        chip.write_bytes(data)
        received = read_received(folder / 'box')
        page = gallery_page(received, folder, 'chips')
        return 'shown' if '<img' in page else 'no picture'

    return [chip.read_bytes()], check


def ships_kind(folder: Path) -> Kind:
    """Make the JSON of a chip with a place, and write a table of what becomes of it."""
    (record,) = make_placed_outbox(folder / 'box', 1)
    seed = record.read_bytes()

    def check(data: bytes) -> str:
        # Damage that the digest would not show.
        record.write_bytes(sealed(data))
        return _table_of_ships(folder)

    return [seed.partition(b', "digest"')[0] + b'}'], check


def list_kind(folder: Path) -> Kind:
    """Make ship lists, and write a table of what becomes of them."""
    ships = [
        ShipReport(
            id=f'5f3a91c2-{number}',
            latitude=36.1,
            longitude=-5.4 + number,
            course=12.0,
            course_ambiguous=False,
            length_m=30.0,
            width_m=9.0,
            sigma_m=(4.2, 3.1, 30.0),
            class_id='tug',
            score=0.5,
            first=number * 10**9,
            last=number * 10**9,
        )
        for number in range(3)
    ]
    path = folder / 'box' / f'list.{LIST_SUFFIXES["geojson"]}'
    path.parent.mkdir()
    plain = gzip.decompress(ship_geojson(ships))

    def check(data: bytes) -> str:
        # What is packed is damaged in itself, and as a file.
        path.write_bytes(gzip.compress(data, 1) if data[:1] == b'{' else data)
        return _table_of_ships(folder)

    return [plain, ship_geojson(ships), ship_message(ships, 340).content], check


def _table_of_ships(folder: Path) -> str:
    """Write a table of the ships in a folder; say what came of it."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        code = convert(['ships', str(folder / 'box'), '-o', str(folder / 'ships.geojson')])
    assert code in (0, 1)
    return 'refused' if code else 'written'


def bag_kind(folder: Path) -> Kind:
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

    return [BAG.read_bytes()], check


OTHERS: dict[str, Callable[[Path], Kind]] = {
    'class_names': class_names_kind,
    'image_size': image_size_kind,
    'gallery': gallery_kind,
    'camera': camera_kind,
    'picture': picture_kind,
    'ships': ships_kind,
    'list': list_kind,
    'bag': bag_kind,
}


def main() -> None:
    """Fuzz."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--inputs', type=int, default=2000, help='of each kind')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--kinds', nargs='+', choices=[*FORMATS, *OTHERS])
    options = parser.parse_args()
    limit_memory(MAX_BYTES)
    warnings.simplefilter('error')
    for kind in options.kinds or [*FORMATS, *OTHERS]:
        print(f'{kind}: ', end='', flush=True)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            seeds, check = OTHERS[kind](folder) if kind in OTHERS else label_kind(kind, folder)
            damage = damaged_text if is_text(seeds[0]) else mutated
            run_mutations(
                options.inputs,
                options.seed,
                lambda source, seeds=seeds: source.choice(seeds),
                check,
                damage,
            )


def is_text(data: bytes) -> bool:
    """Tell text from binary files."""
    try:
        return '\0' not in data.decode()
    except UnicodeDecodeError:
        return False


def limit_memory(size: int) -> None:
    """Let everything fail that takes more than `size` bytes beyond what is taken now."""
    with open('/proc/self/statm') as stream:
        pages = int(stream.read().split()[0])
    limit = pages * resource.getpagesize() + size
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


if __name__ == '__main__':
    main()
