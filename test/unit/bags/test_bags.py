# SPDX-License-Identifier: Apache-2.0
"""The command `obbhbb bag`, without ROS. `test/ros/test_bag.py` compares it with the node."""

from __future__ import annotations

import math
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from collections.abc import Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import LATCHED
from recordings import TYPES
from recordings import Recorded
from recordings import build
from recordings import camera_info
from recordings import detections
from recordings import messages_of
from recordings import on
from recordings import pack
from recordings import real_ships
from recordings import record
from recordings import typestore

pytest.importorskip('mcap')

import lz4.frame
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores
from rosbags.typesys import get_types_from_msg
from rosbags.typesys import get_typestore

from obbhbb_ros.bags import replay
from obbhbb_ros.bags.rescue import storage_files
from obbhbb_ros.bags.rescue import unpack_chunk
from obbhbb_ros.bags.topics import OUTPUT_HASH
from obbhbb_ros.bags.topics import OUTPUT_TYPE
from obbhbb_ros.cli import main
from obbhbb_ros.pipeline.batch import Batch
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.wire.layouts import INPUT_TYPES

SIZE = (1200, 800)
SECOND = 10**9
SHIPS = [row for image in real_ships() for row in image]
ROWS = [SHIPS[i : i + 4] for i in range(0, 40, 4)]
NOTE = pack('String', build('String', data='note'))
WAYS = [
    ('mcap', 'none'),
    ('mcap', 'file'),
    ('mcap', 'message'),
    ('mcap', 'storage'),
    ('sqlite3', 'none'),
    ('sqlite3', 'file'),
    ('sqlite3', 'message'),
]
TOPICS = {'/camera_info': 'CameraInfo', '/detections': 'Detection2DArray', '/note': 'String'}


def scene(
    kind: str = 'Detection2DArray', topic: str = '/detections', little_endian: bool = True
) -> list[Recorded]:
    """Give a camera info, real ships, and something else between them."""
    namespace = topic.rpartition('/')[0]
    found = [Recorded(f'{namespace}/camera_info', SECOND, camera_info(*SIZE))]
    for i, rows in enumerate(ROWS):
        time = 2 * SECOND + i
        found.append(Recorded(topic, time, detections(kind, rows, i, little_endian)))
        found.append(Recorded('/note', time, NOTE))
    return found


def expected(
    messages: Sequence[Recorded],
    kind: str = 'Detection2DArray',
    topic: str = '/detections',
    size: tuple[int, int] | None = SIZE,
    **values: Any,
) -> tuple[list[tuple[int, bytes]], list[tuple[int, bytes]]]:
    """Give what has to be on the topics of the boxes and of the crop regions."""
    batches = [
        (time, Batch(data, INPUT_TYPES[kind], OBB_TO_HBB.settings(values), size))
        for time, data in on(topic, messages)
    ]
    boxes = [(time, batch.boxes_message()) for time, batch in batches]
    if not size:
        return boxes, []
    plans = [(time, batch, batch.plan_crops()) for time, batch in batches]
    return boxes, [(time, batch.crop_regions_message(plan)) for time, batch, plan in plans]


def answers(path: Path, namespace: str = '') -> tuple[list[Any], list[Any]]:
    """Read both topics of answers."""
    found = messages_of(path)
    return on(f'{namespace}/boxes', found), on(f'{namespace}/crop_regions', found)


@pytest.fixture
def run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command from `in` to `out`; give exit code and output."""

    def run(*options: object, source: Path | None = None) -> tuple[int, str, str]:
        words = ['bag', source or tmp_path / 'in', tmp_path / 'out', *options]
        code = main([str(word) for word in words])
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of ships."""
    return record(tmp_path / 'in', TOPICS, scene())


# What comes out ---------------------------------------------------------------------------------


@pytest.mark.parametrize(('storage', 'compression'), WAYS)
def test_a_bag_comes_out_stored_as_it_was_with_boxes_and_crop_regions(
    tmp_path: Path, run: Any, storage: str, compression: str
) -> None:
    source, target = tmp_path / 'in', tmp_path / 'out'
    record(source, TOPICS, scene(), storage, compression, {'flight': '7'})
    code, out, err = run()
    assert (code, err) == (0, '')
    assert 'messages copied: 21' in out
    given, made = messages_of(source), messages_of(target)
    assert [each for each in made if each.topic in TOPICS] == given
    assert answers(target) == expected(given)
    with Reader(source) as before, Reader(target) as after:
        assert (after.compression_mode, after.storage.metadata.custom) == (
            before.compression_mode,
            {'flight': '7'},
        )
        for old, new in zip(before.connections, after.connections, strict=False):
            assert (new.topic, new.msgtype, new.msgdef, new.digest, new.ext) == (
                old.topic,
                old.msgtype,
                old.msgdef,
                old.digest,
                old.ext,
            )
            assert new.ext.offered_qos_profiles == [LATCHED]
    assert {path.suffixes[0] for path in target.iterdir()} == {
        path.suffixes[0] for path in source.iterdir()
    }
    if (storage, compression) in (('mcap', 'none'), ('mcap', 'storage')):
        with (target / 'out.mcap').open('rb') as stream:
            chunks = make_reader(stream).get_summary().chunk_indexes
        assert {each.compression for each in chunks} == {'' if compression == 'none' else 'zstd'}


@pytest.mark.parametrize(('storage', 'compression'), WAYS)
def test_storage_and_compression_can_be_chosen(
    bag: Path, tmp_path: Path, run: Any, storage: str, compression: str
) -> None:
    assert run('--storage', storage, '--compression', compression)[0] == 0
    assert answers(tmp_path / 'out') == expected(messages_of(bag))
    name = {'mcap': 'out.mcap', 'sqlite3': 'out.db3'}[storage]
    assert (tmp_path / 'out' / (f'{name}.zstd' if compression == 'file' else name)).exists()


@pytest.mark.parametrize('little_endian', [True, False])
@pytest.mark.parametrize('kind', INPUT_TYPES)
def test_every_input_type_is_found_by_its_type(
    tmp_path: Path, run: Any, kind: str, little_endian: bool
) -> None:
    given = scene(kind, '/any/name', little_endian)
    topics = {'/any/camera_info': 'CameraInfo', '/any/name': kind, '/note': 'String'}
    record(tmp_path / 'in', topics, given)
    assert run()[0] == 0
    assert answers(tmp_path / 'out', '/any') == expected(given, kind, '/any/name')


@pytest.mark.parametrize('kind', INPUT_TYPES)
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_the_type_of_the_boxes_is_described_in_full(
    tmp_path: Path, run: Any, storage: str, kind: str
) -> None:
    topics = {'/camera_info': 'CameraInfo', '/detections': kind, '/note': 'String'}
    record(tmp_path / 'in', topics, scene(kind), storage)
    assert run()[0] == 0
    with Reader(tmp_path / 'out') as reader:
        found = [each for each in reader.connections if each.topic in ('/boxes', '/crop_regions')]
        assert {(each.msgtype, each.digest) for each in found} == {(OUTPUT_TYPE, OUTPUT_HASH)}
        for each in found:
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(each.msgdef.data, each.msgtype))
            assert store.hash_rihs01(each.msgtype) == OUTPUT_HASH
        read = [
            store.deserialize_cdr(data, each.msgtype) for each, _, data in reader.messages(found)
        ]
    assert {box.bbox.center.theta for message in read for box in message.detections} == {0.0}


def test_the_type_of_the_boxes_is_that_of_the_interface() -> None:
    assert typestore().hash_rihs01(TYPES['Detection2DArray']) == OUTPUT_HASH


def test_processes_of_their_own_give_the_same_bag(
    bag: Path, tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay, 'FEW_MESSAGES', 0)
    monkeypatch.setattr(replay, 'STRETCH_BYTES', 5000)
    monkeypatch.setattr(replay, 'MAX_WAITING_STRETCHES', 2)
    monkeypatch.setattr(replay.os, 'cpu_count', lambda: 2)
    assert run()[0] == 0
    assert answers(tmp_path / 'out') == expected(messages_of(bag))


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_storage_file_alone_is_a_bag(tmp_path: Path, run: Any, storage: str) -> None:
    bag = record(tmp_path / 'in', TOPICS, scene(), storage)
    (file,) = (path for path in bag.iterdir() if path.suffix != '.yaml')
    assert run(source=file)[0] == 0
    assert answers(tmp_path / 'out') == expected(scene())
    with Reader(bag) as before, Reader(tmp_path / 'out') as after:
        assert [each.digest for each in after.connections[:3]] == [
            each.digest for each in before.connections
        ]


def test_a_bag_of_humble_gets_the_definitions_that_it_lacks(tmp_path: Path, run: Any) -> None:
    bag = record(tmp_path / 'in', TOPICS | {'/odd': 'String'}, scene(), 'sqlite3')
    with sqlite3.connect(bag / 'in.db3') as base:
        base.executescript("""
            UPDATE schema SET schema_version = 3;
            UPDATE topics SET type = 'odd_msgs/msg/Odd' WHERE name = '/odd';
            DROP TABLE message_definitions;
            ALTER TABLE topics DROP COLUMN type_description_hash;
        """)
    base.close()
    assert run(source=bag / 'in.db3')[0] == 0
    with Reader(tmp_path / 'out') as reader:
        known = {each.topic: (each.digest, each.msgdef.data) for each in reader.connections}
    assert known['/camera_info'][0] == typestore().hash_rihs01(TYPES['CameraInfo'])
    assert 'float64[9] k' in known['/camera_info'][1]
    assert known['/odd'] == (f'RIHS00_{64 * "0"}', '')


# Which topics -----------------------------------------------------------------------------------


def test_answers_and_camera_info_are_in_the_namespace_of_the_input(
    tmp_path: Path, run: Any
) -> None:
    given = scene(topic='/payload/left/ships')
    given.insert(1, Recorded('/camera_info', SECOND, camera_info(9, 9)))
    topics = {
        '/payload/left/camera_info': 'CameraInfo',
        '/payload/left/ships': 'Detection2DArray',
        '/camera_info': 'CameraInfo',
        '/note': 'String',
    }
    record(tmp_path / 'in', topics, given)
    assert run()[0] == 0
    assert answers(tmp_path / 'out', '/payload/left') == expected(
        given, topic='/payload/left/ships'
    )


def test_the_camera_info_can_be_that_of_another_name(tmp_path: Path, run: Any) -> None:
    topics = {'/camera/info': 'CameraInfo'} | TOPICS
    given = [Recorded('/camera/info', 1, camera_info(1000, 900)), *scene()]
    record(tmp_path / 'in', topics, given)
    assert run('--camera-info', 'camera/info')[0] == 0
    assert answers(tmp_path / 'out') == expected(given, size=(1000, 900))


def test_a_camera_info_that_is_not_there_is_an_error(bag: Path, run: Any) -> None:
    code, _, err = run('--camera-info', '/note')
    assert code == 1
    assert '/note is no topic of sensor_msgs/msg/CameraInfo; the bag has /camera_info' in err


def test_of_several_inputs_one_has_to_be_named(tmp_path: Path, run: Any) -> None:
    topics = TOPICS | {'/yolo/detections': 'DetectionArray'}
    given = [*scene(), Recorded('/yolo/detections', SECOND, detections('DetectionArray', ROWS[0]))]
    record(tmp_path / 'in', topics, given)
    code, _, err = run()
    assert code == 1
    assert 'choose one by --topic: /detections, /yolo/detections' in err
    assert run('--topic', 'yolo/detections')[0] == 0
    found, _ = answers(tmp_path / 'out', '/yolo')
    assert found == expected(given, 'DetectionArray', '/yolo/detections', size=None)[0]


def test_what_the_tracker_says_is_taken_instead_of_what_it_read(tmp_path: Path, run: Any) -> None:
    tracked = Recorded('/tracked_detections', SECOND, detections('Detection2DArray', ROWS[0]))
    topics = TOPICS | {'/tracked_detections': 'Detection2DArray'}
    record(tmp_path / 'in', topics, [*scene(), tracked])
    code, out, _ = run()
    assert code == 0
    assert out.startswith('/tracked_detections (')
    shutil.rmtree(tmp_path / 'out')
    assert run('--topic', 'detections')[1].startswith('/detections (')


def test_a_tracker_that_said_nothing_is_not_taken_instead(tmp_path: Path, run: Any) -> None:
    topics = TOPICS | {'/tracked_detections': 'Detection2DArray'}
    record(tmp_path / 'in', topics, scene())
    code, out, _ = run()
    assert code == 0
    assert out.startswith('/detections (')
    assert answers(tmp_path / 'out') == expected(scene())


def test_of_topics_without_messages_the_tracker_is_taken(tmp_path: Path, run: Any) -> None:
    record(tmp_path / 'in', TOPICS | {'/tracked_detections': 'Detection2DArray'}, [])
    assert run()[1].startswith('/tracked_detections (')


def test_the_tracker_of_one_camera_says_nothing_of_another(tmp_path: Path, run: Any) -> None:
    topics = TOPICS | {'/left/tracked_detections': 'Detection2DArray'}
    tracked = detections('Detection2DArray', ROWS[0])
    record(
        tmp_path / 'in', topics, [*scene(), Recorded('/left/tracked_detections', SECOND, tracked)]
    )
    assert 'choose one by --topic: /detections, /left/tracked_detections' in run()[2]


@pytest.mark.parametrize('made', ['/chip/detections', '/crop_sources'])
def test_what_the_nodes_make_of_detections_is_no_input_unless_it_is_named(
    tmp_path: Path, run: Any, made: str
) -> None:
    given = [*scene(), Recorded(made, SECOND, detections('Detection2DArray', ROWS[0]))]
    record(tmp_path / 'in', TOPICS | {made: 'Detection2DArray'}, given)
    assert run()[0] == 0
    assert answers(tmp_path / 'out') == expected(given)
    shutil.rmtree(tmp_path / 'out')
    code, out, _ = run('--topic', made)
    assert code == 0
    assert out.startswith(f'{made} (')


def test_a_bag_without_detections_is_an_error_that_lists_what_it_has(
    tmp_path: Path, run: Any
) -> None:
    record(tmp_path / 'in', {'/note': 'String'}, [Recorded('/note', 1, NOTE)])
    code, _, err = run()
    assert code == 1
    assert 'no topic that can be converted; the bag has /note (std_msgs/msg/String)' in err
    assert '/none is no topic that can be converted' in run('--topic', 'none')[2]


def test_boxes_of_before_are_no_input_and_stay_unless_they_are_replaced(
    bag: Path, tmp_path: Path, run: Any
) -> None:
    assert run()[0] == 0
    before = (tmp_path / 'out').rename(tmp_path / 'before')
    code, _, err = run(source=before)
    assert code == 1
    assert 'has /boxes and /crop_regions already; --replace leaves them out' in err
    params = tmp_path / 'params.yaml'
    params.write_text('obb_to_hbb: {ros__parameters: {q: 5.0}}')
    assert run('--replace', '--params-file', params, source=before)[0] == 0
    assert answers(tmp_path / 'out') == expected(messages_of(bag), q=5.0)


def test_boxes_themselves_can_be_no_input(tmp_path: Path, run: Any) -> None:
    given = [Recorded('/boxes', 1, detections('Detection2DArray', ROWS[0]))]
    record(tmp_path / 'in', {'/boxes': 'Detection2DArray'}, given)
    assert '/boxes cannot be converted' in run('--topic', '/boxes')[2]


# Parameters -------------------------------------------------------------------------------------


def test_parameters_are_those_of_the_node_in_the_namespace(tmp_path: Path, run: Any) -> None:
    given = scene(topic='/payload/detections')
    topics = {
        '/payload/camera_info': 'CameraInfo',
        '/payload/detections': 'Detection2DArray',
        '/note': 'String',
    }
    record(tmp_path / 'in', topics, given)
    params = tmp_path / 'params.yaml'
    params.write_text("""
        /payload/obb_to_hbb: {ros__parameters: {q: 2.0, crop: {padding: 0.5}, typo: 1}}
        /other/obb_to_hbb: {ros__parameters: {q: 4.0}}
    """)
    code, _, err = run('--params-file', params)
    assert code == 0
    assert 'unknown parameters, ignored: typo' in err
    values = {'q': 2.0, 'crop.padding': 0.5}
    assert answers(tmp_path / 'out', '/payload') == expected(
        given, topic='/payload/detections', **values
    )
    shutil.rmtree(tmp_path / 'out')
    assert run('--params-file', params, '--node', '/other/obb_to_hbb')[0] == 0
    assert answers(tmp_path / 'out', '/payload') == expected(
        given, topic='/payload/detections', q=4.0
    )


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('obb_to_hbb: {ros__parameters: {q: 0.5}}', 'q must be 1 to'),
        ('obb_to_hbb: {ros__parameters: {class_ids: [a, 5]}}', 'class_ids must be a string[]'),
        ('obb_to_hbb: {ros__parameters: 5}', 'must be names and values, not 5'),
        ('obb_to_hbb: {ros__parameters: {q: three}}', 'q must be a double'),
        ('other: {ros__parameters: {q: 2.0}}', 'no parameters for /obb_to_hbb'),
        ('{', 'params.yaml'),
    ],
)
def test_parameters_that_cannot_be_used_end_it_before_anything_is_written(
    bag: Path, tmp_path: Path, run: Any, text: str, complaint: str
) -> None:
    params = tmp_path / 'params.yaml'
    params.write_text(text)
    code, _, err = run('--params-file', params)
    assert code == 1
    assert complaint in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ['in', 'params.yaml']


def test_parameters_of_ros_itself_are_not_unknown(bag: Path, tmp_path: Path, run: Any) -> None:
    params = tmp_path / 'params.yaml'
    params.write_text("""
        payload:
          obb_to_hbb:
            ros__parameters:
              use_sim_time: true
              qos_overrides./boxes.publisher.depth: 5
              qos_overrides: {/parameter_events: {publisher: {depth: 5}}}
              q: 2e0
    """)
    code, _, err = run('--params-file', params, '--node', 'payload/obb_to_hbb')
    assert (code, err) == (0, '')
    assert answers(tmp_path / 'out') == expected(messages_of(bag), q=2.0)


# What is reported -------------------------------------------------------------------------------


def test_crop_regions_begin_with_the_first_camera_info_as_in_the_node(
    tmp_path: Path, run: Any
) -> None:
    given = scene()
    given[0] = given[0]._replace(time=2 * SECOND + 4)
    record(tmp_path / 'in', TOPICS, sorted(given, key=lambda each: each.time))
    code, out, err = run()
    assert code == 0
    assert err.count('no crop regions without the size of the image') == 1
    assert 'message 1 on /detections: no crop regions' in err
    assert 'messages_without_image_size: 4' in out
    boxes, regions = expected(given)
    assert answers(tmp_path / 'out') == (boxes, regions[4:])


def test_detections_have_the_size_of_the_camera_info_of_their_stamp(
    tmp_path: Path, run: Any
) -> None:
    sizes = [(2000, 1500), (1000, 750), (500, 375)]
    cameras = [
        Recorded('/camera_info', SECOND + i, camera_info(*size, stamp=7 + i))
        for i, size in enumerate(sizes)
    ]
    # All cameras come before the first detections; one of these has none of its stamp.
    inputs = [
        Recorded('/detections', 2 * SECOND + i, detections('Detection2DArray', ROWS[0], stamp))
        for i, stamp in enumerate((7, 8, 9, 20))
    ]
    record(tmp_path / 'in', TOPICS, [*cameras, *inputs])
    code, out, _ = run()
    assert code == 0
    _, regions = answers(tmp_path / 'out')
    expected_regions = []
    for message, size in zip(inputs, [*sizes, sizes[-1]], strict=True):
        expected_regions += expected([message], size=size)[1]
    assert regions == expected_regions
    assert 'camera_info_by_stamp: 3' in out
    assert 'camera_info_latest: 1' in out


def test_a_message_that_cannot_be_read_is_reported_by_its_number_and_kept(
    tmp_path: Path, run: Any
) -> None:
    given = scene()
    places = [i for i, each in enumerate(given) if each.topic == '/detections']
    for number, cut in ((3, 60), (7, 2)):
        at = places[number - 1]
        given[at] = given[at]._replace(data=given[at].data[: -cut * 4])
    given.append(Recorded('/camera_info', 3 * SECOND, b'\0\1\0\0'))
    record(tmp_path / 'in', TOPICS, given)
    code, out, err = run('--strict')
    assert code == 1
    for topic in ('message 3 on /detections', 'message 7 on /detections'):
        assert f'{topic}: cannot be read' in err
    assert 'message 2 on /camera_info cannot be read' in err
    assert 'messages_unreadable: 3' in out
    whole = [each for i, each in enumerate(given) if i not in (places[2], places[6])]
    assert answers(tmp_path / 'out') == expected(whole)
    assert len(messages_of(tmp_path / 'out')) == len(given) + 16


def test_detections_that_cannot_be_converted_are_counted_and_the_first_is_reported(
    tmp_path: Path, run: Any
) -> None:
    rows = [[*ROWS[0][0][:4], math.nan], *ROWS[0]]
    given = [
        Recorded('/camera_info', 1, camera_info(*SIZE)),
        *(Recorded('/detections', 2 + i, detections('Detection2DArray', rows)) for i in range(3)),
    ]
    record(tmp_path / 'in', TOPICS, given)
    code, out, err = run()
    assert code == 0
    assert err.count('dropped 1 of 5 detections') == 1
    assert 'detections_dropped.not_finite: 3' in out
    shutil.rmtree(tmp_path / 'out')
    assert run('--strict')[0] == 1


def test_a_bag_that_exists_is_not_overwritten(bag: Path, tmp_path: Path, run: Any) -> None:
    (tmp_path / 'out').mkdir()
    code, _, err = run()
    assert code == 1
    assert f'exists: {str(tmp_path / "out")!r}' in err
    assert not list((tmp_path / 'out').iterdir())


def test_compression_of_chunks_is_not_for_sqlite3(bag: Path, run: Any) -> None:
    assert 'needs mcap, not sqlite3' in run('--storage', 'sqlite3', '--compression', 'storage')[2]


def test_an_end_on_the_way_leaves_nothing(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(messages: Any, total: int) -> Any:
        yield next(iter(messages))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replay.add_boxes(bag, tmp_path / 'new' / 'out', replay.ReplayOptions(), progress=stop)
    assert not list((tmp_path / 'new').iterdir())


# Damage -----------------------------------------------------------------------------------------


@cache
def long_scene() -> Sequence[Recorded]:
    """Give enough for many chunks and pages, in noise that does not compress well."""
    random = np.random.default_rng(1)
    found = [Recorded('/camera_info', 1, camera_info(*SIZE))]
    for i in range(30):
        rows = np.abs(random.normal(SHIPS, 5.0))
        rows[:, 4] %= math.pi
        data = detections('Detection2DArray', np.tile(rows, (5, 1)), i)
        found.append(Recorded('/detections', 10 + i, data))
    return found


@pytest.mark.parametrize(('storage', 'compression'), WAYS)
def test_a_bag_without_metadata_is_read_all_the_same(
    tmp_path: Path, run: Any, storage: str, compression: str
) -> None:
    bag = record(tmp_path / 'in', TOPICS, scene(), storage, compression)
    (bag / 'metadata.yaml').unlink()
    code, _, err = run('--strict')
    assert code == 0
    assert err.endswith('in is damaged: no metadata.yaml; converting what can be read\n')
    assert err.count('\n') == 1
    assert answers(tmp_path / 'out') == expected(scene())
    with Reader(tmp_path / 'out') as reader:
        assert reader.connections[0].ext.offered_qos_profiles == [LATCHED]
        assert reader.connections[0].digest == typestore().hash_rihs01(TYPES['CameraInfo'])


@pytest.mark.parametrize('name', ['run[1]', 'a*b'])
def test_a_damaged_bag_may_have_any_name(tmp_path: Path, run: Any, name: str) -> None:
    bag = record(tmp_path / name, TOPICS, scene(), 'sqlite3')
    (bag / 'metadata.yaml').unlink()
    bag.rename(tmp_path / 'in')
    code, _, _ = run('--strict')
    assert code == 0
    assert answers(tmp_path / 'out') == expected(scene())


def test_a_folder_in_a_bag_is_no_part_of_it(tmp_path: Path, run: Any) -> None:
    bag = record(tmp_path / 'in', TOPICS, scene())
    (bag / 'older.mcap').mkdir()
    code, _, _ = run('--strict')
    assert code == 0
    assert answers(tmp_path / 'out') == expected(scene())


def test_storage_files_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    names = ['b_1.db3', 'b_1²0.mcap', 'b_2.db3.zstd', 'b_10.db3']
    for name in (*names, 'metadata.yaml', 'b_1.db3-wal', 'b.zstd', '.mcap'):
        (tmp_path / name).touch()
    assert [path.name for path in storage_files(tmp_path)] == names


def test_of_a_damaged_lz4_chunk_all_before_the_damage_is_read() -> None:
    content = np.random.default_rng(0).integers(0, 4, 200_000).astype(np.uint8).tobytes()
    packed = bytearray(lz4.frame.compress(content, block_size=lz4.frame.BLOCKSIZE_MAX64KB))
    packed[len(packed) * 3 // 4] ^= 0xFF
    unpacked = unpack_chunk('lz4', bytes(packed))
    assert 60_000 < len(unpacked) < len(content)
    assert content.startswith(unpacked[:60_000])


def truncate(bag: Path) -> None:
    """Take the last third of the storage file away."""
    (file,) = (path for path in bag.iterdir() if path.suffix != '.yaml')
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 7 // 10])


@pytest.mark.parametrize(('storage', 'compression'), WAYS)
def test_of_a_truncated_bag_all_that_is_there_is_converted(
    tmp_path: Path, run: Any, storage: str, compression: str
) -> None:
    bag = record(tmp_path / 'in', TOPICS, long_scene(), storage, compression)
    truncate(bag)
    (bag / 'metadata.yaml').unlink()
    code, out, err = run('--strict')
    assert code == 1
    assert 'in is damaged: ' in err
    assert 'messages or parts lost: ' in out
    kept = len(on('/detections', messages_of(tmp_path / 'out')))
    assert 10 <= kept < 30
    assert answers(tmp_path / 'out') == expected(long_scene()[: kept + 1])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_what_is_missing_is_counted_where_metadata_say_how_much_there_was(
    tmp_path: Path, run: Any, storage: str
) -> None:
    truncate(record(tmp_path / 'in', TOPICS, long_scene(), storage))
    code, out, err = run()
    assert code == 0
    missing = 30 - len(on('/detections', messages_of(tmp_path / 'out')))
    assert f'obbhbb: {missing} messages are missing' in err
    assert f'messages or parts lost: {missing}' in out


@pytest.mark.parametrize('compression', ['none', 'storage'])
def test_a_damaged_chunk_costs_no_other(tmp_path: Path, run: Any, compression: str) -> None:
    bag = record(tmp_path / 'in', TOPICS, long_scene(), 'mcap', compression)
    path = bag / 'in.mcap'
    with path.open('rb') as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    assert len(chunks) > 2
    data = bytearray(path.read_bytes())
    middle = chunks[1].chunk_start_offset + chunks[1].chunk_length // 2
    data[middle : middle + 2000] = bytes(255 for _ in range(2000))
    path.write_bytes(data)
    code, _, err = run('--strict')
    assert code == 1
    given, made = long_scene(), messages_of(tmp_path / 'out')
    good = [each for each in on('/detections', made) if each in on('/detections', given)]
    assert len(good) >= 15
    boxes, _ = expected(given)
    assert sum(each in boxes for each in on('/boxes', made)) >= len(good)
    assert 'message' in err


def record_as_rosbag2(
    path: Path, messages: Sequence[Recorded], compression: str = 'NONE', publishers: int = 1
) -> None:
    """Write an MCAP file with checksums and with the hash of each type at its topic."""
    store = typestore()
    with path.open('wb') as stream:
        writer = McapWriter(
            stream, chunk_size=100_000, compression=CompressionType[compression], enable_crcs=True
        )
        writer.start(profile='ros2', library='test')
        channels = {}
        for topic, kind in TOPICS.items():
            text, _ = store.generate_msgdef(TYPES[kind], ros_version=2)
            schema = writer.register_schema(TYPES[kind], 'ros2msg', text.encode())
            metadata = {'topic_type_hash': store.hash_rihs01(TYPES[kind])}
            channels[topic] = [
                writer.register_channel(topic, 'cdr', schema, metadata) for _ in range(publishers)
            ]
        for i, each in enumerate(messages):
            channel = channels[each.topic][i % publishers]
            writer.add_message(channel, each.time, each.data, each.time - 1)
        writer.finish()


@pytest.mark.parametrize('compression', ['NONE', 'LZ4', 'ZSTD'])
def test_a_wrong_checksum_is_reported_and_the_rest_is_kept(
    tmp_path: Path, run: Any, compression: str
) -> None:
    given, bag = long_scene(), tmp_path / 'in.mcap'
    record_as_rosbag2(bag, given, compression)
    code, _, err = run('--strict', source=bag)
    assert (code, err) == (0, '')
    assert answers(tmp_path / 'out') == expected(given)
    shutil.rmtree(tmp_path / 'out')
    with bag.open('rb') as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[3]
    data = bytearray(bag.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 300] ^= 1
    bag.write_bytes(data)
    code, _, err = run('--strict', source=bag)
    assert code == 1
    assert f'from byte {chunk.chunk_start_offset} on is damaged' in err
    kept = set(on('/detections', messages_of(tmp_path / 'out')))
    assert len(kept & set(on('/detections', given))) >= 24
    with Reader(tmp_path / 'out') as reader:
        assert [each.digest for each in reader.connections if each.topic in TOPICS] == [
            typestore().hash_rihs01(TYPES[kind]) for kind in ('CameraInfo', 'Detection2DArray')
        ]


def test_a_topic_of_several_channels_is_one(tmp_path: Path, run: Any) -> None:
    record_as_rosbag2(tmp_path / 'in.mcap', scene(), publishers=2)
    assert run(source=tmp_path / 'in.mcap')[0] == 0
    assert answers(tmp_path / 'out') == expected(scene())


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path: Path, storage: str) -> None:
    bag = record(tmp_path / 'in', TOPICS, long_scene(), storage)
    program = (
        'import resource, sys; from obbhbb_ros.cli import main; '
        'resource.setrlimit(resource.RLIMIT_FSIZE, (5_000_000, 5_000_000)); sys.exit(main())'
    )
    words = [sys.executable, '-c', program, 'bag', bag, tmp_path / 'out']
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert re.fullmatch('obbhbb: .*(too large|full|I/O error).*\n', done.stderr)
    assert [path.name for path in tmp_path.iterdir()] == ['in']


def test_a_process_that_ends_is_an_error(
    bag: Path, tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay, 'FEW_MESSAGES', 0)
    monkeypatch.setattr(replay.os, 'cpu_count', lambda: 2)
    monkeypatch.setattr(replay, 'answers_to', fail)
    code, _, err = run()
    assert code == 1
    assert 'a process that converts messages has died' in err
    assert [path.name for path in tmp_path.iterdir()] == ['in']


def fail(*_: object) -> None:
    """End the process, as the kernel does where memory runs out."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_damage_within_sqlite3_costs_only_what_is_damaged(tmp_path: Path, run: Any) -> None:
    bag = record(tmp_path / 'in', TOPICS, long_scene(), 'sqlite3')
    data = bytearray((bag / 'in.db3').read_bytes())
    middle = len(data) // 2 // 4096 * 4096
    data[middle : middle + 2 * 4096] = bytes(255 for _ in range(2 * 4096))
    (bag / 'in.db3').write_bytes(data)
    code, _, err = run('--strict')
    assert code == 1
    made = messages_of(tmp_path / 'out')
    assert len(set(on('/detections', made)) & set(on('/detections', long_scene()))) >= 25
    assert 'in.db3: message' in err


@pytest.mark.parametrize('places', [(600, 1400), (0, 1000, 1999)])
def test_messages_between_damaged_places_of_sqlite3_are_kept(
    tmp_path: Path, run: Any, places: Sequence[int]
) -> None:
    given = [
        Recorded('/note', i, pack('String', build('String', data=f'note {i:04}')))
        for i in range(2000)
    ]
    given.insert(700, Recorded('/detections', 700, detections('Detection2DArray', ROWS[0])))
    bag = record(tmp_path / 'in', TOPICS, given, 'sqlite3')
    data = bytearray((bag / 'in.db3').read_bytes())
    for place in places:
        start = data.index(f'note {place:04}'.encode()) // 4096 * 4096
        data[start : start + 4096] = bytes(255 for _ in range(4096))
    (bag / 'in.db3').write_bytes(data)
    code, _, err = run()
    assert code == 0
    found = re.findall(r'in.db3: messages (\d+) (?:to (\d+)|and on) are lost', err)
    # Numbers begin with 1.
    lost = [range(int(first) - 1, int(last or len(given))) for first, last in found]
    assert len(lost) == len(places)
    assert max(map(len, lost)) < 200
    kept = [each for i, each in enumerate(given) if not any(i in part for part in lost)]
    assert [each for each in messages_of(tmp_path / 'out') if each.topic in TOPICS] == kept
    assert f'{len(given) - len(kept)} messages are missing' in err


def first_page_of(path: Path, table: str) -> int:
    """Find where the first page of a table begins."""
    with closing(sqlite3.connect(path)) as base:
        (page,) = base.execute(
            'SELECT rootpage FROM sqlite_master WHERE name = ?', (table,)
        ).fetchone()
    return int(page - 1) * 4096


def text_of_a_definition(path: Path) -> None:
    """Damage a byte of a definition."""
    data = bytearray(path.read_bytes())
    data[data.index(b'std_msgs/Header header')] = 255
    path.write_bytes(data)


def table_of_definitions(path: Path) -> None:
    """Damage all definitions."""
    start, data = first_page_of(path, 'message_definitions'), bytearray(path.read_bytes())
    data[start : start + 4096] = bytes(255 for _ in range(4096))
    path.write_bytes(data)


def name_of_a_column(path: Path) -> None:
    """Damage the name of a column."""
    path.write_bytes(path.read_bytes().replace(b'topic_type TEXT', b'topik_type TEXT'))


def text_of_a_column(path: Path) -> None:
    """Damage the name of a column beyond what is text."""
    path.write_bytes(path.read_bytes().replace(b'topic_type TEXT', b'topi\xff_type TEXT'))


@pytest.mark.parametrize(
    ('damage', 'complaint'),
    [
        (text_of_a_definition, ''),
        (table_of_definitions, 'in.db3: the definitions of the types are lost: '),
        (name_of_a_column, "are lost: 'topic_type' is missing"),
        (text_of_a_column, 'in.db3: the definitions of the types are lost: '),
    ],
)
def test_damaged_definitions_cost_no_message_of_sqlite3(
    tmp_path: Path, run: Any, damage: Callable[[Path], None], complaint: str
) -> None:
    bag = record(tmp_path / 'in', TOPICS, scene(), 'sqlite3')
    damage(bag / 'in.db3')
    code, _, err = run()
    assert code == 0
    assert complaint in err
    assert 'messages are missing' not in err
    assert answers(tmp_path / 'out') == expected(scene())
    assert [each for each in messages_of(tmp_path / 'out') if each.topic in TOPICS] == scene()


def test_a_damaged_table_of_topics_is_an_error_that_names_what_is_missing(
    tmp_path: Path, run: Any
) -> None:
    bag = record(tmp_path / 'in', TOPICS, scene(), 'sqlite3')
    path = bag / 'in.db3'
    path.write_bytes(path.read_bytes().replace(b'type TEXT', b'tipe TEXT'))
    code, _, err = run()
    assert code == 1
    assert "in.db3: nothing can be read: 'type' is missing" in err


@pytest.mark.parametrize(
    ('values', 'complaint'),
    [
        ("data = 'text'", 'it is damaged'),
        ('data = NULL', 'it is damaged'),
        ("timestamp = 'noon'", 'it is damaged'),
        ('timestamp = -1', 'it is damaged'),
        ('topic_id = 77', 'it is of an unknown topic'),
    ],
)
def test_a_row_that_is_no_message_any_more_costs_only_itself(
    tmp_path: Path, run: Any, values: str, complaint: str
) -> None:
    bag = record(tmp_path / 'in', TOPICS, scene(), 'sqlite3')
    with closing(sqlite3.connect(bag / 'in.db3')) as base:
        base.executescript(f"""
            CREATE TABLE loose AS SELECT * FROM messages;
            DROP TABLE messages;
            ALTER TABLE loose RENAME TO messages;
            UPDATE messages SET {values} WHERE id = 4;
        """)
    (bag / 'metadata.yaml').unlink()
    code, out, err = run()
    assert code == 0
    assert f'in.db3: message 4 is lost: {complaint}\n' in err
    assert 'messages or parts lost: 1' in out
    given = scene()
    assert answers(tmp_path / 'out') == expected([*given[:3], *given[4:]])


def test_what_sqlite3_had_not_moved_into_its_file_is_not_lost(tmp_path: Path, run: Any) -> None:
    given = scene()
    bag = record(tmp_path / 'whole', TOPICS, given[:-2], 'sqlite3')
    (bag / 'metadata.yaml').unlink()
    # A recorder that was killed.
    base = sqlite3.connect(bag / 'whole.db3')
    base.execute('PRAGMA journal_mode = WAL')
    base.executemany(
        'INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)',
        [(2 + (each.topic == '/note'), each.time, each.data) for each in given[-2:]],
    )
    base.commit()
    shutil.copytree(bag, tmp_path / 'in')
    base.close()
    assert run()[0] == 0
    assert answers(tmp_path / 'out') == expected(given)


def test_the_files_of_a_split_bag_are_read_in_their_order(tmp_path: Path, run: Any) -> None:
    given = scene()
    (tmp_path / 'in').mkdir()
    parts = [given[:5], given[5:9], *([each] for each in given[9:])]
    for i, part in enumerate(parts):
        path = record(tmp_path / f'part_{i}', TOPICS, part)
        (path / f'part_{i}.mcap').rename(tmp_path / 'in' / f'in_{i}.mcap')
    assert run()[0] == 0
    assert answers(tmp_path / 'out') == expected(given)


@pytest.mark.parametrize('name', ['in.mcap', 'in.db3', 'in.txt', 'metadata.yaml'])
def test_what_is_no_bag_is_an_error_that_names_it(tmp_path: Path, run: Any, name: str) -> None:
    (tmp_path / 'in').mkdir()
    (tmp_path / 'in' / name).write_bytes(b'no bag at all' * 100)
    code, out, err = run()
    assert (code, out) == (1, '')
    assert str(tmp_path / 'in') in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ['in']


def test_a_bag_that_is_not_there_is_an_error(tmp_path: Path, run: Any) -> None:
    assert f'no bag: {tmp_path / "in"}' in run()[2]
