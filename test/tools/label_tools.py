# SPDX-License-Identifier: Apache-2.0
"""
Label files of real tools, converted by us; our files, loaded by the tools: a table of both.

    python test/tools/label_tools.py --environment tools --against ../older_checkout

Takes the tools from PyPI into an environment of their own (`--environment`, made if it is missing;
Ultralytics needs PyTorch). Each tool writes ships whose boxes are known; `obbhbb convert` of each
checkout reads them, and what it writes is compared. Then the tools load what we write.

right: all boxes and classes. classes: all boxes, but other classes. reported: some right, the rest
named. refused: an error that says why. unknown: the format cannot be detected. other: an error of
another format. wrong: exit code 0, nothing said, and a box is wrong.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import venv
from collections import Counter
from functools import partial
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

TOOLS = (
    'datumaro', 'supervision', 'pycocotools', 'labelme<7', 'label-studio-sdk', 'ultralytics',
    'geopandas', 'pyarrow', 'globox', 'pylabel', 'sahi',
    'x-anylabeling-cvhub',
)  # fmt: skip
HERE = Path(__file__).resolve().parent
SIZE = (640, 480)
Q = 3.0
# Pixels by which a box may differ: tools round, and masks consist of whole pixels.
TOLERANCE, MASK_TOLERANCE = 0.6, 3.0
# Errors of readers that name their own format alone.
FOREIGN = re.compile(r'not (COCO|GeoJSON|CSV|DOTA)|neither <bndbox>|missing columns|fields')

Row = tuple[str, str, float, float, float, float]


def prepare(environment: Path) -> Path:
    """Install the tools, unless the environment is there, and return its Python."""
    python = environment / 'bin' / 'python'
    if not python.exists():
        venv.create(environment, with_pip=True)
        subprocess.run([python, '-m', 'pip', 'install', '--quiet', *TOOLS], check=True)
    return python


# In the environment of the tools --------------------------------------------------------------


def make_fleet(folder: Path) -> dict[str, Any]:
    """Write ships of all angles in three images."""
    import cv2
    import numpy as np

    random = np.random.default_rng(5)
    ships: dict[str, list[Any]] = {}
    for image in range(3):
        rows = []
        for place in range(4):
            center = 100 + place * 145 + random.uniform(-5, 5), random.uniform(110, 370)
            sides = random.uniform(60, 140), random.uniform(14, 36)
            theta = (4 * image + place) * 0.51 + 0.12
            rows.append([('ship', 'tug')[(image + place) % 2], *center, *sides, theta])
        ships[f'P{image + 1}'] = rows
    pictures = folder / 'pictures'
    pictures.mkdir(parents=True)
    for name in ships:
        cv2.imwrite(str(pictures / f'{name}.png'), np.zeros((*SIZE[::-1], 3), np.uint8))
    fleet = {'names': ['ship', 'tug'], 'size': SIZE, 'ships': ships}
    (folder / 'fleet.json').write_text(json.dumps(fleet))
    return fleet


def expected_boxes(sample: dict[str, str], fleet: Any) -> list[Row]:
    """Return the boxes that the sample must become: superellipses, or upright boxes as they are."""
    import numpy as np

    p, rows = Q / (Q - 1), []
    for image, ships in fleet.ships.items():
        for ship in ships:
            if sample['carries'] in ('box', 'pose'):
                rows.append((image, ship.name, *ship.bounds))
                continue
            parts = np.array([ship.length, ship.width])[:, None] / 2
            cos, sin = np.abs(np.cos(ship.theta)), np.abs(np.sin(ship.theta))
            half = ((parts * [[cos, sin], [sin, cos]]) ** p).sum(axis=0) ** (1 / p)
            center = np.array([ship.x, ship.y])
            rows.append((image, ship.name, *(center - half).tolist(), *(center + half).tolist()))
    if 'metres' not in sample['form'] and 'degrees' not in sample['form']:
        return rows
    return [_on_map(row) for row in rows]


def _on_map(row: Row) -> Row:
    image, name, x1, y1, x2, y2 = row
    return image, name, 500_000 + x1, 6_650_000 - y2, 500_000 + x2, 6_650_000 - y1


def in_metres(rows: list[Row]) -> list[Row]:
    """Project boxes in degrees."""
    from pyproj import Transformer

    project = Transformer.from_crs('EPSG:4326', 'EPSG:32633', always_xy=True).transform
    return [(*row[:2], *project(*row[2:4]), *project(*row[4:])) for row in rows]


def read_table(path: Path) -> list[Row]:
    """Read the boxes that we wrote."""
    with path.open(newline='') as stream:
        table = list(csv.DictReader(stream))
    bounds = ('x_min', 'y_min', 'x_max', 'y_max')
    # An image without boxes has a row without numbers.
    filled = [row for row in table if row['x_min']]
    return [(row['image'], row['class'], *(float(row[name]) for name in bounds)) for row in filled]


def judge(got: list[Row], expected: list[Row], tolerance: float) -> tuple[int, int, int]:
    """Count boxes that are right, that have another class, and that are wrong."""
    waiting, right, renamed = list(expected), 0, 0
    for row in got:
        near = [
            one
            for one in waiting
            if max(abs(a - b) for a, b in zip(one[2:], row[2:], strict=True)) <= tolerance
        ]
        if not near:
            continue
        waiting.remove(near[0])
        right += near[0][1] == row[1]
        renamed += near[0][1] != row[1]
    return right, renamed, len(got) - right - renamed


def verdict(sample: dict[str, str], fleet: Any, checkout: Path, python: str) -> tuple[str, str]:
    """Convert a sample as a user would, and say what became of it."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder, 'out.csv')
        done = run(python, checkout, 'convert', sample['path'], target, '--image-size', *SIZE)
        message = done.stderr.strip().split('\n')[-1]
        if 'Traceback' in done.stderr:
            return 'crash', message
        if done.returncode or not target.exists():
            return refusal(done.stderr), message
        got = read_table(target)
    if 'degrees' in sample['form']:
        got = in_metres(got)
    expected = expected_boxes(sample, fleet)
    tolerance = MASK_TOLERANCE if sample['carries'] == 'mask' else TOLERANCE
    if sample['form'].lower().startswith('voc'):
        # supervision counts from 1, X-AnyLabeling cuts to whole numbers; we do neither.
        tolerance += 1.0
    right, renamed, wrong = judge(got, expected, tolerance)
    counts = f'{right} right, {renamed} of another class, {wrong} wrong of {len(expected)}'
    if wrong:
        return 'wrong', counts
    if right + renamed < len(expected):
        return ('reported' if done.stderr.strip() else 'wrong'), f'{counts}: {message}'
    return ('classes' if renamed else 'right'), counts


def refusal(message: str) -> str:
    """Classify an error."""
    if 'cannot detect the label format' in message and 'it fits' not in message:
        return 'unknown'
    return 'other' if FOREIGN.search(message) else 'refused'


def run(python: str, checkout: Path, *options: object) -> subprocess.CompletedProcess[str]:
    """Run `obbhbb` of a checkout."""
    command = [python, '-m', 'obbhbb_ros.cli', *map(str, options)]
    environment = {**os.environ, 'PYTHONPATH': str(checkout)}
    # Not here, since Python would take the package of this folder.
    return subprocess.run(
        command, env=environment, cwd='/', capture_output=True, text=True, check=False
    )


OUTPUTS = {
    'COCO': ('out.json', '--to', 'coco'),
    'COCO, rectangles': ('rectangles.json', '--to', 'coco', '--variant', 'rectangles'),
    'VOC': ('voc', '--to', 'voc'),
    'VOC, integers': ('voc_integers', '--to', 'voc', '--variant', 'integers'),
    'VOC, one-based': ('voc_one_based', '--to', 'voc', '--variant', 'one-based'),
    'VOC, devkit': ('voc_devkit', '--to', 'voc', '--variant', 'devkit'),
    'YOLO': ('yolo/labels', '--to', 'yolo'),
    'GeoJSON': ('out.geojson',),
    'GeoPackage': ('out.gpkg',),
    'shapefile': ('out.shp',),
    'CSV': ('out.csv',),
}


def write_outputs(root: Path, fleet: Any, checkout: Path, python: str) -> dict[str, Path]:
    """Convert DOTA labels, one ship of which is beyond the border, with images beside them."""
    source = root / 'pictures'
    shutil.copytree(fleet.pictures, source)
    for image, ships in fleet.ships.items():
        lines = [f'{" ".join(map(str, ship.flat))} {ship.name} 0\n' for ship in ships]
        beyond = '-60 50 20 50 20 70 -60 70 ship 0\n' if image == 'P2' else ''
        (source / f'{image}.txt').write_text(''.join([*lines, beyond]))
    done = {}
    for form, (name, *options) in OUTPUTS.items():
        run(python, checkout, 'convert', source, root / name, *options)
        done[form] = root / name
    (root / 'yolo').mkdir(exist_ok=True)
    shutil.copytree(fleet.pictures, root / 'yolo' / 'images')
    done['YOLO'] = root / 'yolo'
    return done


def load_outputs(root: Path, fleet: Any, checkout: Path, python: str) -> dict[str, str]:
    """Let the tools load our output; `same` for all boxes and classes, else what is wrong."""
    from label_loaders import LOADERS

    outputs = write_outputs(root, fleet, checkout, python)
    expected = read_table(outputs['CSV'])
    clipped = [(*row[:2], *_clipped(row[2:])) for row in expected]
    answers = {}
    for tool, form, load in LOADERS:
        path, key = outputs[form], f'{form} → {tool}'
        try:
            boxes = load(path) if path.exists() else None
        except Exception as error:
            answers[key] = f'{type(error).__name__}: {error}'.replace('\n', ' ')[:100]
            continue
        if boxes is None:
            answers[key] = 'not written'
            continue
        got = [(image, *row) for image, rows in boxes.items() for row in rows]
        tolerance = 1.01 if form in ('VOC, integers', 'VOC, devkit') else 0.1
        right, renamed, wrong = judge(got, clipped if form == 'YOLO' else expected, tolerance)
        same = (right, renamed, wrong) == (len(expected), 0, 0)
        counts = f'{right} right, {renamed} of another class, {wrong} wrong of {len(expected)}'
        answers[key] = 'same' if same else counts
    return answers


def _clipped(bounds: tuple[float, ...]) -> list[float]:
    pairs = zip(bounds, SIZE * 2, strict=True)
    return [min(max(value, 0.0), float(limit)) for value, limit in pairs]


def print_table(title: str, rows: dict[str, dict[str, str]]) -> None:
    """Print verdicts by row and checkout."""
    columns = list(next(iter(rows.values())))
    print(f'\n| {title} | {" | ".join(columns)} |')
    print(f'| --- | {" | ".join("---" for _ in columns)} |')
    for name, cells in rows.items():
        print(f'| {name} | {" | ".join(cells.values())} |')
    for column in columns:
        counts = Counter(cells[column].split(':')[0].split(',')[0] for cells in rows.values())
        few = {key: number for key, number in counts.most_common() if number > 1 or ' ' not in key}
        print(f'{column}: ' + ', '.join(f'{number} {key}' for key, number in few.items()))


def compare(checkouts: list[Path], python: str, only: str, details: bool) -> None:
    """Write, convert and load all; print the tables."""
    from label_writers import load_fleet

    with tempfile.TemporaryDirectory(prefix='label_tools_') as name, ThreadPool(2) as pool:
        root = Path(name)
        make_fleet(root)
        fleet = load_fleet(root / 'fleet.json')
        command = [sys.executable, HERE / 'label_writers.py', root / 'fleet.json', root / 'samples']
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        read, loaded = {}, {}
        for sample in json.loads(done.stdout):
            row = f'{sample["tool"]}: {sample["form"]} ({sample["carries"]})'
            if only not in row:
                continue
            if 'problem' in sample:
                print(f'not written: {row}: {sample["problem"]}')
                continue
            answers = pool.map(partial(verdict, sample, fleet, python=python), checkouts)
            read[row] = {}
            for checkout, (answer, message) in zip(checkouts, answers, strict=True):
                read[row][checkout.name] = answer
                if details and answer != 'right':
                    line = f'{checkout.name}: {row}: {answer}: {message}'
                    print(line.replace(name, ''), flush=True)
        for number, checkout in enumerate(checkouts):
            answers = load_outputs(root / f'out{number}', fleet, checkout, python)
            for key, answer in answers.items():
                loaded.setdefault(key, {})[checkout.name] = answer
        print_table('a file of', read)
        print_table('our file', loaded)


# ----------------------------------------------------------------------------------------------


def main() -> None:
    """Parse the command line; runs itself again in the environment of the tools."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    add = parser.add_argument
    add('--environment', type=Path, default=Path('tools'), help='default: %(default)s')
    add('--against', type=Path, action='append', default=[], help='another checkout, repeatable')
    add('--only', default='', help='samples whose name has this text')
    add('--details', action='store_true', help='also print the messages')
    add('--python', default='', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.python:
        checkouts = [*options.against, HERE.parents[1]]
        compare(
            [path.resolve() for path in checkouts], options.python, options.only, options.details
        )
        return
    python = prepare(options.environment.absolute())
    command = [python, __file__, *sys.argv[1:], '--python', sys.executable]
    sys.exit(subprocess.run(command, check=False).returncode)


if __name__ == '__main__':
    main()
