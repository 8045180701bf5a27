# SPDX-License-Identifier: Apache-2.0
"""
`obbhbb convert` of a million boxes against the plain script for the same job.

Both read the same file in turn, in processes of their own, and write boxes that are compared. The
figures are medians of processor seconds and of peak memory, and ratios of one run. `obbhbb` also
runs as if pyarrow were not installed. `python test/benchmarks/labels.py --help`
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

CORNERS = ['x1', 'y1', 'x2', 'y2', 'x3', 'y3', 'x4', 'y4']
BOUNDS = ['x_min', 'y_min', 'x_max', 'y_max']
NAMES = ['image', 'instance', 'class']
CLASSES = np.array(['ship', 'tanker', 'tug', 'ferry'])
PER_IMAGE = 100
Q = 3.0
# The scripts take the edges at the first corner, obbhbb the means of opposite ones.
TOLERANCE = 0.05
# What stands before the command line of a process.
WITHOUT_ARROW = "import sys; sys.modules['pyarrow'] = None; "
# Starts a process and says what it cost. A small one, as the peak memory of a process on Linux is
# at least that of the one which starts it.
MEASURE = """
import os, sys
to = os.open(os.devnull, os.O_WRONLY), 1
process = os.posix_spawn(sys.executable, [sys.executable, *sys.argv[1:]], os.environ,
                         file_actions=[(os.POSIX_SPAWN_DUP2, *to)])
_, status, usage = os.wait4(process, 0)
print(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)
sys.exit(status != 0)
"""
COMMAND = 'import sys; from obbhbb_ros.cli import main; sys.exit(main(sys.argv[1:]))'


def axis_aligned(corners: np.ndarray) -> np.ndarray:
    """Convert corners (N, 8) as a script does: the superellipse of half edges, (N, 4)."""
    corners = corners.reshape(-1, 4, 2)
    first, second = (np.abs(corners[:, i + 1] - corners[:, i]) / 2 for i in (0, 1))
    p = Q / (Q - 1)
    half = (first**p + second**p) ** (1 / p)
    center = corners.mean(axis=1)
    return np.hstack((center - half, center + half))


def fleet(count: int) -> Iterator[tuple[str, np.ndarray, list[str]]]:
    """Make images with their corners, (N, 8), to a hundredth of a pixel, and classes."""
    random = np.random.default_rng(1)
    for number, start in enumerate(range(0, count, PER_IMAGE)):
        size = min(PER_IMAGE, count - start)
        angle = random.uniform(0, np.pi, size)
        along = np.stack((np.cos(angle), np.sin(angle)), axis=1)
        across = np.stack((-along[:, 1], along[:, 0]), axis=1)
        first = along * random.uniform(20, 300, (size, 1)) / 2
        second = across * random.uniform(5, 60, (size, 1)) / 2
        center = random.uniform(0, 4096, (size, 2))
        corners = [center + i * first + j * second for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        yield (
            f'P{number:06d}',
            np.stack(corners, axis=1).reshape(-1, 8).round(2),
            CLASSES[random.integers(len(CLASSES), size=size)].tolist(),
        )


def make_csv(path: Path, count: int) -> None:
    """Write a table of corners."""
    with path.open('w') as stream:
        stream.write(','.join((*NAMES, *CORNERS)) + '\n')
        for image, corners, classes in fleet(count):
            for instance, (row, name) in enumerate(zip(corners.tolist(), classes, strict=True)):
                stream.write(f'{image},{instance},{name},{",".join(map(str, row))}\n')


def make_dota(path: Path, count: int) -> None:
    """Write a folder of labelTxt files."""
    path.mkdir()
    for image, corners, classes in fleet(count):
        rows = zip(corners.tolist(), classes, strict=True)
        lines = (f'{" ".join(map(str, row))} {name} 0\n' for row, name in rows)
        (path / f'{image}.txt').write_text(''.join(lines))


def make_coco(path: Path, count: int) -> None:
    """Write a COCO file with a polygon of four corners for each ship."""
    images, annotations = [], []
    names = CLASSES.tolist()
    for number, (image, corners, classes) in enumerate(fleet(count), start=1):
        images.append({'id': number, 'file_name': f'{image}.png', 'width': 4096, 'height': 4096})
        for row, name in zip(corners.tolist(), classes, strict=True):
            low = min(row[::2]), min(row[1::2])
            size = max(row[::2]) - low[0], max(row[1::2]) - low[1]
            annotations.append(
                {
                    'id': len(annotations) + 1,
                    'image_id': number,
                    'category_id': names.index(name) + 1,
                    'segmentation': [row],
                    'bbox': [*low, *(round(side, 2) for side in size)],
                    'area': round(size[0] * size[1], 2),
                    'iscrowd': 0,
                }
            )
    categories = [{'id': number, 'name': name} for number, name in enumerate(names, start=1)]
    document = {'images': images, 'categories': categories, 'annotations': annotations}
    path.write_text(json.dumps(document))


def make_parquet(path: Path, count: int) -> None:
    """Write a Parquet file of corners, in row groups of 2^17 rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    images = list(fleet(count))
    columns = {
        'image': [image for image, _, classes in images for _ in classes],
        'instance': [str(row) for _, _, classes in images for row in range(len(classes))],
        'class': [name for _, _, classes in images for name in classes],
    }
    corners = np.concatenate([corners for _, corners, _ in images]).T
    columns |= dict(zip(CORNERS, corners, strict=True))
    pq.write_table(pa.table(columns), path, row_group_size=1 << 17)


def script_csv(source: str, target: str) -> None:
    """Convert a table with pandas."""
    import pandas as pd

    table = pd.read_csv(source)
    boxes = table[NAMES].copy()
    boxes[BOUNDS] = axis_aligned(table[CORNERS].to_numpy())
    boxes.to_csv(target, index=False)


def script_dota(source: str, target: str) -> None:
    """Convert a folder of labelTxt files with NumPy, and write a table with pandas."""
    import pandas as pd

    images, classes, rows = [], [], []
    for file in sorted(Path(source).glob('*.txt')):
        image = file.stem
        for line in file.read_text().splitlines():
            fields = line.split()
            if len(fields) >= 9:
                images.append(image)
                classes.append(fields[8])
                rows.append([float(field) for field in fields[:8]])
    boxes = pd.DataFrame({'image': images, 'instance': '', 'class': classes})
    boxes[BOUNDS] = axis_aligned(np.array(rows))
    boxes.to_csv(target, index=False)


def script_coco(source: str, target: str) -> None:
    """Convert a COCO file with json."""
    document = json.loads(Path(source).read_text())
    annotations = document['annotations']
    boxes = axis_aligned(np.array([entry.pop('segmentation')[0] for entry in annotations]))
    boxes[:, 2:] -= boxes[:, :2]
    for entry, (x, y, width, height) in zip(annotations, boxes.tolist(), strict=True):
        entry['bbox'] = [x, y, width, height]
        entry['area'] = width * height
    Path(target).write_text(json.dumps(document))


def script_parquet(source: str, target: str) -> None:
    """Convert a Parquet file with pyarrow and NumPy."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(source)
    corners = np.column_stack([table[name].to_numpy() for name in CORNERS])
    bounds = dict(zip(BOUNDS, axis_aligned(corners).T, strict=True))
    pq.write_table(pa.table({**{name: table[name] for name in NAMES}, **bounds}), target)


def boxes_of(path: Path) -> np.ndarray:
    """Read the boxes that one of the two wrote, (N, 4)."""
    if path.suffix == '.csv':
        import pandas as pd

        return pd.read_csv(path)[BOUNDS].to_numpy()
    if path.suffix == '.parquet':
        import pyarrow.parquet as pq

        table = pq.read_table(path)
        return np.column_stack([table[name].to_numpy() for name in BOUNDS])
    annotations = json.loads(path.read_text())['annotations']
    boxes = np.array([entry['bbox'] for entry in annotations])
    boxes[:, 2:] += boxes[:, :2]
    return boxes


class Job(NamedTuple):
    """What is converted: how its input is made, the script, the names of input and output."""

    make: Callable[[Path, int], None]
    script: Callable[[str, str], None]
    source: str
    target: str


JOBS = {
    'csv': Job(make_csv, script_csv, 'ships.csv', 'boxes.csv'),
    'dota': Job(make_dota, script_dota, 'labelTxt', 'boxes.csv'),
    'coco': Job(make_coco, script_coco, 'ships.json', 'boxes.json'),
    'parquet': Job(make_parquet, script_parquet, 'ships.parquet', 'boxes.parquet'),
}


class Cost(NamedTuple):
    """Processor seconds and peak memory in megabytes of a process."""

    seconds: float
    megabytes: float


def run(*arguments: str) -> Cost:
    """Run Python with these arguments, and return what the process cost."""
    # As installed: both with their bytecode.
    environment = {**os.environ, 'PYTHONDONTWRITEBYTECODE': ''}
    measure = [sys.executable, '-c', MEASURE, *arguments]
    done = subprocess.run(measure, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return Cost(*map(float, done.stdout.split()))


def measure(name: str, folder: Path, count: int, rounds: int) -> None:
    """Run script and command in turn, and print what they cost."""
    job = JOBS[name]
    source, target = folder / job.source, folder / job.target
    job.make(source, count)
    to = [str(source), str(target), *(['--to', 'coco'] if target.suffix == '.json' else [])]
    candidates = {
        'script': [__file__, '--script', name, str(source), str(target)],
        'obbhbb': ['-c', COMMAND, 'convert', *to],
        'obbhbb without pyarrow': ['-c', WITHOUT_ARROW + COMMAND, 'convert', *to],
    }
    if name == 'parquet':
        del candidates['obbhbb without pyarrow']
    costs: dict[str, list[Cost]] = {label: [] for label in candidates}
    boxes = {}
    for _ in range(rounds):
        for label, arguments in candidates.items():
            costs[label].append(run(*arguments))
            if label not in boxes:
                boxes[label] = boxes_of(target)
    medians = {
        label: Cost(*map(statistics.median, zip(*runs, strict=True)))
        for label, runs in costs.items()
    }
    script = medians['script']
    for label, cost in medians.items():
        difference = float(np.abs(boxes[label] - boxes['script']).max())
        assert difference < TOLERANCE, difference
        print(
            f'{name:8} {label:23} {cost.seconds:6.2f} s {cost.megabytes:6.0f} MB   '
            f'{cost.seconds / script.seconds:5.2f} {cost.megabytes / script.megabytes:5.2f}   '
            f'{difference:.4f} px',
            flush=True,
        )


def main() -> None:
    """Measure and print, or run one of the scripts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--boxes', type=int, default=1_000_000)
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--jobs', nargs='+', default=list(JOBS), choices=JOBS)
    parser.add_argument('--script', nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.script:
        name, source, target = options.script
        JOBS[name].script(source, target)
        return
    print('job      candidate                  CPU   memory   times the script: CPU, memory')
    for name in options.jobs:
        with tempfile.TemporaryDirectory() as folder:
            measure(name, Path(folder), options.boxes, options.rounds)


if __name__ == '__main__':
    main()
