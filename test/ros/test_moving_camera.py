# SPDX-License-Identifier: Apache-2.0
"""The whole chain behind a camera that moves: every ship comes down once before any comes twice."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from harness import Node
from harness import Site
from harness import payload_process
from PIL import Image as Picture

from obbhbb_ros.study.chip_costs import render
from obbhbb_ros.study.harbour import harbour

# It depends on rclpy alone, which is the same in all environments.
pytestmark = pytest.mark.once

SHIPS = len(harbour().class_ids)
LINES = 'image,instance,class,x1,y1,x2,y2,x3,y3,x4,y4,score\n'


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Make a folder with the picture of the harbour and its labels."""
    folder = tmp_path / 'frames'
    folder.mkdir()
    labels = harbour()
    # Grey: beside colour images, of 0.9 MB, the middleware may be seconds late with camera infos.
    Picture.fromarray(render(labels)).convert('L').save(folder / 'harbour.png')
    rows = (
        f'harbour,{row},{name},{",".join(map(str, corners.ravel()))},{score}\n'
        for row, (name, corners, score) in enumerate(
            zip(labels.class_ids, labels.corners, labels.scores, strict=True)
        )
    )
    (folder / 'labels.csv').write_text(LINES + ''.join(rows))
    return folder


def test_every_ship_of_a_pass_comes_down_before_any_comes_twice(
    site: Site, frames: Path, tmp_path: Path
) -> None:
    spool, outbox = {'spool.path': tmp_path / 'spool'}, tmp_path / 'outbox'
    node = Node(site, 'downlink')
    parameters = {
        'ship_tracker': {'ids': 'assign'},
        'obb_to_hbb': {},
        'chip_extractor': spool,
        # The contact comes after the pass.
        'downlink': spool | {'outbox.path': outbox, 'contact': 'topic'},
    }
    behind = ['-r', 'obb_to_hbb:detections:=tracked_detections']
    node.process = payload_process(tmp_path, node.namespace, parameters, arguments=behind)
    player = {'path': frames, 'pass_height': 300, 'pass_step': 40, 'rate': 5.0}
    with node:
        with site.start('play_detections', namespace=node.namespace, parameters=player) as process:
            node.wait(lambda: not process.running, 'the end of the pass')
        planned = node.counts()['spool.planned']
        node.wait(lambda: node.counts()['spool.waiting'] >= 0.9 * planned, 'the chips')
        waiting = node.counts()
        assert waiting['spool.waiting'] > 3 * waiting['spool.objects_waiting']
        assert waiting['spool.objects_waiting'] == pytest.approx(SHIPS, abs=2)
        node.set({'contact': 'always'})
        node.wait(lambda: node.counts()['spool.waiting'] == 0, 'all to be released')
    released = sorted(outbox.glob('*/*.json'), key=lambda path: path.stat().st_mtime_ns)
    facts = [json.loads(path.read_bytes()) for path in released]
    views = np.array([chip['view'] for chip in facts])
    first = [chip['object'] for chip in facts if chip['view'] == 1]
    assert len({*first}) == len(first) == pytest.approx(SHIPS, abs=2)
    # A batch is claimed at once, so that the order within it is not told.
    assert np.median(views[: len(first)]) == 1
    assert views[-len(first) :].min() > 1
