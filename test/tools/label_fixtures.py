# SPDX-License-Identifier: Apache-2.0
"""
Write the small label files of real tools that the tests read.

    python test/tools/label_fixtures.py --environment tools --folder test/data/labels

Two ships in one image, as `label_writers.py` has the tools write them; only small files, and no
images. `index.json` says which tool wrote what.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from label_tools import HERE
from label_tools import prepare

FLEET = {
    'names': ['ship', 'tug'],
    'size': [64, 48],
    'ships': {'P1': [['ship', 20.25, 16.5, 24.0, 8.0, 0.52], ['tug', 44.0, 30.0, 16.0, 6.5, 2.2]]},
}
IMAGE_SUFFIXES = ('.jpg', '.png', '.meta')
MAX_BYTES = 2500


def write_samples(python: Path, root: Path) -> list[dict[str, Any]]:
    """Let the tools write the fleet below a folder; the paths of the samples are relative to it."""
    from PIL import Image

    (root / 'pictures').mkdir()
    Image.new('RGB', tuple(FLEET['size'])).save(root / 'pictures' / 'P1.png')
    (root / 'fleet.json').write_text(json.dumps(FLEET))
    # Relative, since some tools write the path of an image into the file.
    command = [python, HERE / 'label_writers.py', 'fleet.json', 'samples']
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root)
    return list(json.loads(done.stdout))


def keep_small(root: Path, sample: dict[str, Any], folder: Path) -> dict[str, Any] | None:
    """Copy the label files of a sample; None if one is too large for a repository."""
    source = root / sample['path']
    top = root.joinpath(*Path(sample['path']).parts[:2])
    files = [path for path in top.rglob('*') if path.suffix not in IMAGE_SUFFIXES]
    files = [path for path in files if path.is_file()]
    if max(path.stat().st_size for path in files) > MAX_BYTES:
        return None
    name = f'{sample["tool"]}_{sample["form"]}'.replace(', ', '_').replace(' ', '_')
    for path in files:
        target = folder / name / path.relative_to(top)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    return sample | {'path': str(Path(name, source.relative_to(top)))}


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.strip().split('\n')[0])
    parser.add_argument('--environment', type=Path, default=Path('tools'))
    parser.add_argument('--folder', type=Path, default=HERE.parent / 'data' / 'labels')
    options = parser.parse_args()
    python = prepare(options.environment.absolute())
    shutil.rmtree(options.folder, ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        samples = write_samples(python, Path(name))
        kept = []
        for sample in samples:
            if 'problem' in sample:
                print(f'{sample["tool"]}: {sample["form"]}: {sample["problem"]}', file=sys.stderr)
            elif entry := keep_small(Path(name), sample, options.folder):
                kept.append(entry)
    index = {**FLEET, 'samples': kept}
    (options.folder / 'index.json').write_text(f'{json.dumps(index, indent=1)}\n')
    print(f'{len(kept)} samples')


if __name__ == '__main__':
    main()
