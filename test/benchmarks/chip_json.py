# SPDX-License-Identifier: Apache-2.0
"""What each key in the JSON of a chip costs the link, bytes: full, and compact."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from outboxes import a_chip
from spooled import CAMERA

from obbhbb_ros.spool.compact_json import CameraFile
from obbhbb_ros.spool.compact_json import compact_bytes
from obbhbb_ros.spool.compact_json import shortened
from obbhbb_ros.spool.compact_json import without_camera
from obbhbb_ros.spool.outbox import json_bytes
from obbhbb_ros.text_tables import aligned

# As nodes write them: a score of 32 bits, boxes in radians and fractions of a pixel.
MEASURED = {
    'id': '1764285402_123456789_3fa9c2_1017',
    'frame_id': 'camera_optical_frame',
    'score': 0.8730000257492065,
    'value': 0.8730000257492065,
    'detection_ids': ['5f3a91c2-17'],
    'obb': [1033.4821166992188, 512.0739135742188, 88.1402587890625, 17.90234375, -0.7351],
    'camera': CAMERA,
    'object': '5f3a91c2-17',
    'view': 1,
    'rank': 0.8730000257492065,
}
POSITION = {
    'lat': 54.1837214,
    'lon': 12.0903481,
    'course': 231.4,
    'course_ambiguous': False,
    'length_m': 132.2,
    'width_m': 26.9,
    'sigma_m': [14.21, 9.87, 33.1],
    'look_deg': 21.37,
    'pose_age': 0.043,
}


def main() -> None:
    """Print a table."""
    full, _ = a_chip(**MEASURED)
    short, camera = without_camera(shortened(full))
    rows = [('key', 'full', 'compact')]
    for key in full:
        rows.append((key, str(cost(full, key, json_bytes)), str(cost(short, key, compact_bytes))))
    rows.append(('all, with digest', str(len(json_bytes(full))), str(len(compact_bytes(short)))))
    print('\n'.join(aligned(rows)))
    assert isinstance(camera, CameraFile)
    placed = {**full, 'position': POSITION}, {**short, 'position': POSITION}
    costs = cost(placed[0], 'position', json_bytes), cost(placed[1], 'position', compact_bytes)
    print(f'with a pose, position costs {costs[0]} and {costs[1]} bytes')
    print(f'the camera once: {len(camera.content)} bytes and {len(camera.json_bytes())} of JSON')


def cost(chip: dict[str, Any], key: str, written: Callable[[dict[str, Any]], bytes]) -> int:
    """Count the bytes that a key adds."""
    rest = {name: value for name, value in chip.items() if name != key}
    return len(written(chip)) - len(written(rest))


if __name__ == '__main__':
    main()
