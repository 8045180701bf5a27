# SPDX-License-Identifier: Apache-2.0
"""Spools and outboxes of chips that are cut from the synthetic harbour."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from hashlib import sha256
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import convert
from obbhbb_ros.downlink.chips import CODECS
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.spool.chip_rows import NewChip
from obbhbb_ros.spool.outbox import JSON_SUFFIX
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.outbox import level_of
from obbhbb_ros.spool.writer import SpoolWriter
from obbhbb_ros.study.chip_costs import render
from obbhbb_ros.study.harbour import harbour

FIRST_STAMP = 1764285402
# Chips worth less go to the next folder.
LEVELS = (0.8, 0.5)


def make_outbox(folder: Path, count: int = 24, codec: str = 'jpeg', depth: int = 8) -> list[Path]:
    """Fill an outbox with chips of as many frames as that takes; return the JSON files."""
    made = []
    frame = 0
    while len(made) < count:
        for facts, chip in _chips_of(frame, codec, depth):
            if len(made) < count:
                made.append(put(folder, facts, chip))
        frame += 1
    return made


def make_placed_outbox(folder: Path, count: int = 24) -> list[Path]:
    """Fill an outbox with chips of ships with ids and places, 1 m a pixel; return the JSON."""
    made = []
    for number, (facts, chip) in enumerate(islice(_chips_of(0), count)):
        length, width, theta = (facts['obb'][index] for index in (2, 3, 4))
        position = {
            'lat': round(36.13 - facts['obb'][1] / 110_956.0, 7),
            'lon': round(-5.43 + facts['obb'][0] / 90_020.0, 7),
            'course': round(math.degrees(theta) % 180.0, 1),
            'course_ambiguous': True,
            'length_m': round(length, 1),
            'width_m': round(width, 1),
            'sigma_m': [4.2, 3.1, 30.0],
            'look_deg': 12.5,
            'pose_age': 0.01,
        }
        ship = {'object': f'5f3a91c2-{number}', 'view': 1, 'rank': facts['value']}
        made.append(put(folder, facts | ship | {'position': position}, chip))
    return made


def make_spool(folder: Path, count: int = 24) -> None:
    """Fill a spool with the same chips."""
    writer = SpoolWriter(folder, print)
    chips = list(islice((each for frame in range(count) for each in _chips_of(frame)), count))
    writer.store(
        writer.plan(count),
        [
            NewChip(facts['value'], facts['class_id'], tuple(facts['stamp'].values()), facts, data)
            for facts, data in chips
        ],
        {},
    )
    writer.close()


def put(folder: Path, facts: dict[str, Any], chip: bytes) -> Path:
    """Put a chip and its facts into an outbox; return the JSON file."""
    level = level_of(facts['value'], LEVELS)
    folder.mkdir(parents=True, exist_ok=True)
    Outbox(folder).put(facts['id'], CODECS[facts['codec']].suffix, chip, facts, level)
    return folder / str(level) / f'{facts["id"]}{JSON_SUFFIX}'


def a_chip(codec: str = 'jpeg', **facts: Any) -> tuple[dict[str, Any], bytes]:
    """Give the most valuable chip of the first frame, with some facts changed."""
    first, chip = next(_chips_of(0, codec, 8))
    return first | facts, chip


def _chips_of(
    frame: int, codec: str = 'jpeg', depth: int = 8
) -> Iterator[tuple[dict[str, Any], bytes]]:
    """Cut one frame, most valuable first; each frame has other scores."""
    labels, pixels = _scene(depth)
    boxes = OrientedBoxes.from_corners(labels.corners)
    scores = np.random.default_rng(frame).uniform(0.25, 1.0, len(boxes)).round(3)
    plan = plan_crops(convert(boxes), scores, labels.size, CropSettings(padding=0.1))
    settings = CodecSettings(codec)
    for number, (region, rows) in enumerate(zip(plan.regions, plan.groups(), strict=True)):
        (x0, y0, x1, y1), first = region.tolist(), rows[0]
        chip = encode(pixels[y0:y1, x0:x1], settings)
        second, nanosecond = FIRST_STAMP + 5 * frame, 123456789
        shape = (
            *boxes.center[first],
            *(each[first] for each in (boxes.length, boxes.width, boxes.theta)),
        )
        yield (
            {
                'id': f'{second}_{nanosecond}_3fa9c2_{number}',
                'stamp': {'sec': second, 'nanosec': nanosecond},
                'frame_id': 'camera',
                'roi': [x0, y0, x1 - x0, y1 - y0],
                'image_size': list(labels.size),
                'class_id': labels.class_ids[first],
                'score': float(scores[first]),
                'value': float(scores[rows].sum()),
                'detection_ids': [labels.ids[row] for row in rows],
                'obb': [float(number) for number in shape],
                'codec': codec,
                'bytes': len(chip),
                'sha256': sha256(chip).hexdigest(),
                'camera': None,
            },
            chip,
        )


@cache
def _scene(depth: int) -> tuple[ImageLabels, NDArray[Any]]:
    """Draw the harbour, in colours of 8 bits or in grey of 12 bits in 16."""
    labels = harbour()
    pixels = render(labels)
    return labels, pixels if depth == 8 else pixels[..., :1].astype(np.uint16) * 16
