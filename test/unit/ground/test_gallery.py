# SPDX-License-Identifier: Apache-2.0
"""obbhbb gallery: what came down, best first, whatever the files are like."""

import base64
import io
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from outboxes import FIRST_STAMP
from outboxes import a_chip
from outboxes import make_outbox
from outboxes import put
from PIL import Image
from spooled import store

from obbhbb_ros.cli import main
from obbhbb_ros.ground.received import read_received
from obbhbb_ros.ground.spools import export
from obbhbb_ros.spool.compact_json import camera_id
from obbhbb_ros.spool.compact_json import compact_bytes
from obbhbb_ros.spool.compact_json import without_camera
from obbhbb_ros.spool.console import ANY_CHIP
from obbhbb_ros.spool.console import SpoolConsole
from obbhbb_ros.spool.outbox import Outbox
from obbhbb_ros.spool.writer import SpoolWriter

pytest.importorskip('jinja2')

HOSTILE = '<script>alert("1")</script>&\'\x1b[31m\ud800'


class Page(HTMLParser):
    """The elements and the text of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ''
        self._quiet = False
        self.feed(path.read_text(encoding='utf-8'))

    def handle_starttag(self, tag, attrs) -> None:
        self.elements.append((tag, dict(attrs)))
        self._quiet = tag in ('style', 'script')

    def handle_endtag(self, tag) -> None:
        self._quiet = False

    def handle_data(self, data) -> None:
        self.text += '' if self._quiet else data

    def all(self, tag: str, class_: str | None = None) -> list[dict[str, str | None]]:
        """Give the attributes of the elements of a kind."""
        return [
            found
            for name, found in self.elements
            if name == tag and class_ in (None, found.get('class'))
        ]


def gallery(folder: Path, *options: str) -> Page:
    """Write the gallery of a folder beside it, and read it."""
    path = folder.parent / 'page' / 'gallery.html'
    assert main(['gallery', str(folder), '-o', str(path), *options]) == 0
    return Page(path)


def test_the_most_valuable_chip_is_first_then_the_oldest(tmp_path) -> None:
    for name, value, second in (('a', 0.5, 3), ('b', 0.9, 9), ('c', 0.5, 2), ('d', 0.5, 2)):
        stamp = {'sec': second, 'nanosec': 0 if name == 'c' else 1}
        put(tmp_path / 'box', *a_chip(id=name, value=value, stamp=stamp))
    links = [each['href'] for each in gallery(tmp_path / 'box').all('a')]
    assert [Path(link).stem for link in links] == ['b', 'c', 'd', 'a']


def views_of_ships(folder: Path) -> None:
    """Put three views of a ship, one of another and a chip without object into an outbox."""
    for name, ship, value, class_id in (
        ('a', 'x-1', 0.2, 'tug'),
        ('b', 'x-1', 0.9, 'cargo'),
        ('c', None, 0.8, 'tug'),
        ('d', 'x-1', 0.5, 'tug'),
        ('e', 'x-2', 0.6, 'tug'),
    ):
        stamp = {'sec': FIRST_STAMP + ord(name), 'nanosec': 0}
        facts = {'object': ship, 'view': 'dba'.find(name) + 1, 'rank': value / 10} if ship else {}
        put(folder, *a_chip(id=name, value=value, class_id=class_id, stamp=stamp, **facts))


def test_a_ship_has_one_card_with_its_best_view_and_the_others_behind_it(tmp_path, capsys) -> None:
    views_of_ships(tmp_path / 'box')
    page = gallery(tmp_path / 'box')
    links = [each['href'] for each in page.all('a')]
    assert [Path(link).stem for link in links] == ['b', 'd', 'a', 'c', 'e']
    assert [card['data-views'] for card in page.all('div', 'card')] == ['3', '1', '1']
    assert len(page.all('details')) == 1
    text = ' '.join(page.text.split())
    assert '5 chips, 4 of them of 2 ships, ' in text
    assert 'shipx-1, view 2, rank 0.09' in text
    assert 'tug, value 0.5, view 1, rank 0.05' in text
    assert '2 more views' in text
    # By ship, not by chip.
    assert 'tug 2, cargo 1' in text
    assert 'chips: 5, problems: 0\nships: 2\n' in capsys.readouterr().out


def test_a_whole_view_of_a_ship_is_better_than_one_that_the_border_cuts(tmp_path) -> None:
    ship = {'object': 'x-1', 'view': 1, 'rank': 0.1}
    for name, value, x in (('cut', 0.9, 0.0), ('whole', 0.6, 30.0)):
        obb = [x, 30.0, 20.0, 5.0, 0.0]
        put(tmp_path / 'box', *a_chip(id=name, value=value, obb=obb, **ship))
    page = gallery(tmp_path / 'box')
    assert [Path(link['href']).stem for link in page.all('a')] == ['whole', 'cut']


def test_the_limit_counts_ships(tmp_path) -> None:
    views_of_ships(tmp_path / 'box')
    page = gallery(tmp_path / 'box', '--limit', '2')
    assert [Path(each['href']).stem for each in page.all('a')] == ['b', 'd', 'a', 'c']
    assert 'the first 2 are shown' in page.text


def test_a_view_whose_file_is_missing_is_behind_those_that_came(tmp_path) -> None:
    views_of_ships(tmp_path / 'box')
    next((tmp_path / 'box').glob('*/b.jpg')).unlink()
    page = gallery(tmp_path / 'box')
    assert [Path(each['href']).stem for each in page.all('a')] == ['d', 'a', 'c', 'e']
    assert len(page.all('span', 'none')) == 1


def test_the_time_from_stamp_to_folder_is_told_chip_by_chip_and_for_all(tmp_path) -> None:
    for name, seconds in (('a', 30.0), ('b', 7200.0), ('c', -5.0), ('d', 2e9)):
        stamp = {'sec': FIRST_STAMP, 'nanosec': 0}
        record = put(tmp_path / 'box', *a_chip(id=name, stamp=stamp))
        os.utime(record, (FIRST_STAMP + seconds,) * 2)
    text = ' '.join(gallery(tmp_path / 'box').text.split())
    assert 'UTC latency30.0 s stamp' in text
    assert 'UTC latency2.0 h stamp' in text
    # Those of another clock have none.
    assert text.count('latency') == 2
    assert 'half of them within 30.0 s, nine tenths within 30.0 s' in text


def test_a_card_states_the_facts_and_draws_the_place_in_the_frame(tmp_path) -> None:
    put(
        tmp_path / 'box',
        *a_chip(
            id='of_it',
            class_id='tug',
            score=0.25,
            value=1.75,
            detection_ids=['1', '2'],
            roi=[10, 20, 30, 40],
            image_size=[200, 100],
            obb=[50, 60, 40, 20, 0.0],
            stamp={'sec': FIRST_STAMP, 'nanosec': 5_999_999},
        ),
    )
    page = gallery(tmp_path / 'box')
    text = ' '.join(page.text.split())
    assert 'tug, score 0.250, value 1.75, 2 detections' in text
    assert '2025-11-27 23:16:42.005 UTC' in text
    assert '1764285402.005999999 camera' in text
    assert 'of_it' in text
    (drawing,) = page.all('svg')
    assert drawing['viewbox'] == '0 0 200 100'
    image, roi = page.all('rect')
    assert (image['width'], image['height']) == ('200', '100')
    assert [roi[key] for key in ('x', 'y', 'width', 'height')] == ['10', '20', '30', '40']
    (obb,) = page.all('polygon')
    corners = {tuple(map(float, each.split(','))) for each in obb['points'].split()}
    assert corners == {(30.0, 50.0), (70.0, 50.0), (70.0, 70.0), (30.0, 70.0)}


@pytest.mark.parametrize(
    'changed', [{'score': None}, {'obb': None}, {'obb': [5.0, 5.0, 0.0, 0.0, 0.0]}], ids=str
)
def test_a_chip_without_score_or_oriented_box_is_shown(tmp_path, changed) -> None:
    put(tmp_path / 'box', *a_chip(**changed))
    page = gallery(tmp_path / 'box')
    assert len(page.all('img')) == 1
    assert ('unknown' in page.text) == ('score' in changed)
    assert len(page.all('polygon')) == ('score' in changed)


@pytest.mark.parametrize('codec', ['jpeg', 'png', 'webp'])
def test_what_browsers_show_is_linked_and_loaded_only_when_it_is_seen(tmp_path, codec) -> None:
    box = tmp_path / 'a box #1?'
    make_outbox(box, 3, codec)
    pictures = gallery(box).all('img')
    assert len(pictures) == 3
    for picture in pictures:
        assert picture['loading'] == 'lazy'
        with Image.open(tmp_path / 'page' / unquote(picture['src'])) as chip:
            assert (picture['width'], picture['height']) == tuple(map(str, chip.size))


@pytest.mark.parametrize(
    ('codec', 'depth'), [('jpeg2000', 8), ('jpeg2000', 16), ('png', 16)], ids=str
)
def test_what_browsers_do_not_show_is_converted_and_embedded(tmp_path, codec, depth) -> None:
    make_outbox(tmp_path / 'box', 2, codec, depth)
    for picture in gallery(tmp_path / 'box').all('img'):
        kind, _, content = picture['src'].partition(',')
        assert kind == 'data:image/jpeg;base64'
        with Image.open(io.BytesIO(base64.b64decode(content))) as shown:
            # Of 12 bits, the darkest are black and the lightest white.
            low, high = shown.convert('L').getextrema()
            assert max(shown.size) <= 256
        assert high - low > 200 or depth == 8


def test_a_large_chip_is_embedded_small(tmp_path) -> None:
    file = io.BytesIO()
    Image.new('RGB', (1500, 600)).save(file, 'jpeg2000')
    facts, _ = a_chip(codec='jpeg2000', roi=[0, 0, 1500, 600])
    put(tmp_path / 'box', facts, file.getvalue())
    (picture,) = gallery(tmp_path / 'box').all('img')
    with Image.open(io.BytesIO(base64.b64decode(picture['src'].partition(',')[2]))) as shown:
        assert shown.size == (256, 102)


def test_the_summary_counts_chips_classes_bytes_and_spans_the_time(tmp_path) -> None:
    for number, class_id in enumerate(['tug', 'cargo', 'tug']):
        facts, chip = a_chip(
            id=str(number), class_id=class_id, stamp={'sec': 60 * number, 'nanosec': 0}
        )
        put(tmp_path / 'box', facts | {'bytes': 1000, 'sha256': ''}, chip.ljust(1000)[:1000])
    text = ' '.join(gallery(tmp_path / 'box').text.split())
    assert (
        '3 chips, 3,000 bytes, 1970-01-01 00:00:00.000 UTC to 1970-01-01 00:02:00.000 UTC.' in text
    )
    assert 'tug 2, cargo 1' in text


def test_a_limit_shows_the_most_valuable_and_counts_all(tmp_path, capsys) -> None:
    make_outbox(tmp_path / 'box', 5)
    page = gallery(tmp_path / 'box', '--limit', '2')
    assert len(page.all('img')) == 2
    assert '5 chips' in page.text
    assert 'the first 2 are shown' in page.text
    assert 'are shown' not in gallery(tmp_path / 'box', '--limit', '0').text
    assert main(['gallery', str(tmp_path / 'box'), '--limit', '-1']) == 1
    assert 'limit must be 0 or more, not -1' in capsys.readouterr().err


def test_folders_are_searched_and_files_that_are_not_complete_left_out(tmp_path, capsys) -> None:
    make_outbox(tmp_path / 'box' / 'pass 7' / 'station', 2)
    make_outbox(tmp_path / 'box' / '.incoming', 1)
    (tmp_path / 'box' / '.partial.json').write_text('{')
    os.mkfifo(tmp_path / 'box' / 'pipe.json')
    assert len(gallery(tmp_path / 'box').all('img')) == 2
    assert 'chips: 2, problems: 0' in capsys.readouterr().out


def test_links_to_folders_are_followed_and_each_folder_is_searched_once(tmp_path, capsys) -> None:
    box = tmp_path / 'box'
    make_outbox(tmp_path / 'other disk', 2)
    make_outbox(tmp_path / 'beside', 1)
    make_outbox(box / 'own', 3)
    (box / '0').symlink_to(tmp_path / 'other disk' / '0')
    (box / 'again').symlink_to(box / 'own')
    (box / 'own' / 'loop').symlink_to(box)
    (box / 'own' / 'up').symlink_to(tmp_path)
    (box / 'self').symlink_to('self')
    (box / 'gone').symlink_to('nowhere')
    pictures = gallery(box).all('img')
    assert len(pictures) == 5
    for picture in pictures:
        assert (tmp_path / 'page' / unquote(picture['src'])).is_file()
    assert 'chips: 5, problems: 0' in capsys.readouterr().out


def test_hostile_texts_are_shown_as_they_are_and_do_nothing(tmp_path, capsys) -> None:
    facts, chip = a_chip(id='plain', class_id=HOSTILE, frame_id=HOSTILE)
    record = put(tmp_path / 'box', facts, chip)
    record.write_text(json.dumps(facts | {'id': HOSTILE}))
    (record.parent / '"><script>.json').write_text('{}')
    os.mkdir(os.fsencode(record.parent) + b'/\xff')
    (record.parent / os.fsdecode(b'\xff') / '\x1b[2J.jpg').write_bytes(b'')
    page = gallery(tmp_path / 'box')
    assert len(page.all('script')) == 1
    shown = '<script>alert("1")</script>&\'\\x1b[31m\\ud800'
    assert page.text.count(shown) == 5
    assert page.all('img')[0]['alt'] == shown
    for said in (page.text, capsys.readouterr().err):
        assert "0/\"><script>.json: key 'id' is missing" in said
        assert '0/\\udcff/\\x1b[2J.jpg: no usable JSON; 1 such files in all' in said


CAMERA = {
    'size': [8, 8],
    'k': None,
    'model': 'plumb_bob',
    'd': [],
    'roi': [0, 0, 8, 8],
    'binning': [1, 1],
}
PLACE = {
    'lat': 36.1,
    'lon': -5.4,
    'course': 12.0,
    'course_ambiguous': True,
    'length_m': 30.0,
    'width_m': 9.0,
    'sigma_m': None,
}
WRONG = [
    ('id', 5),
    ('stamp', 1.5),
    ('stamp', {'sec': 1}),
    ('stamp', {'sec': 1, 'nanosec': 2**32}),
    ('stamp', {'sec': 2**31, 'nanosec': 0}),
    ('stamp', {'sec': 0, 'nanosec': -1}),
    ('stamp', {'sec': True, 'nanosec': 0}),
    ('frame_id', None),
    ('roi', [1, 2, 3]),
    ('roi', [1, 2, 3, 0]),
    ('roi', [1, 2, 3.5, 4]),
    ('roi', {}),
    ('image_size', [0, 5]),
    ('image_size', '10x10'),
    ('class_id', ['tug']),
    ('score', '0.5'),
    ('score', float('nan')),
    ('value', None),
    ('value', float('inf')),
    ('value', 10**400),
    ('value', True),
    ('detection_ids', 'a'),
    ('detection_ids', [1]),
    ('obb', [1, 2, 3, 4]),
    ('obb', [1, 2, 3, 4, None]),
    ('codec', 'gif'),
    ('codec', ['png']),
    ('bytes', -1),
    ('sha256', 7),
    ('object', 5),
    ('view', -1),
    ('rank', 'high'),
    ('camera', [1.0]),
    ('camera', {'size': [8, 8]}),
    ('camera', CAMERA | {'k': [1.0]}),
    ('camera', CAMERA | {'roi': [0, 0, 8]}),
    ('position', [36.1, -5.4]),
    ('position', {'lat': 36.1, 'lon': -5.4}),
    ('position', PLACE | {'lat': 90.1}),
    ('position', PLACE | {'lat': '36.1'}),
    ('position', PLACE | {'lon': -180.1}),
    ('position', PLACE | {'course': float('nan')}),
    ('position', PLACE | {'course_ambiguous': 1}),
    ('position', PLACE | {'length_m': -1.0}),
    ('position', PLACE | {'sigma_m': [1.0, 2.0]}),
]


@pytest.mark.parametrize(('key', 'value'), WRONG, ids=str)
def test_a_wrong_type_is_a_problem_that_names_file_and_key(tmp_path, capsys, key, value) -> None:
    put(tmp_path / 'box', *a_chip(id='good'))
    record = put(tmp_path / 'box', *a_chip(id='bad'))
    record.write_text(json.dumps(a_chip(id='bad')[0] | {key: value}))
    page = gallery(tmp_path / 'box')
    assert len(page.all('img')) == 1
    for said in (page.text, capsys.readouterr().err):
        assert re.search(rf"0/bad\.json: key '{key}' is not \w", said)
        assert '0/bad.jpg: no usable JSON; 1 such files in all' in said


def put_compact(folder: Path, **facts) -> Path:
    """Put a chip with compact JSON and the file of its camera into a folder; return the JSON."""
    described, chip = a_chip(**facts)
    short, camera = without_camera(described)
    outbox = Outbox(folder)
    (folder / '0').mkdir(parents=True, exist_ok=True)
    outbox.add(described['id'], 'jpg', chip, compact_bytes(short), 0)
    outbox.add(camera.id, 'camera', camera.content, camera.json_bytes(), 0)
    outbox.finish()
    return folder / '0' / f'{described["id"]}.json'


def test_cameras_in_files_of_their_own_are_read_and_counted_apart(tmp_path, capsys) -> None:
    box = tmp_path / 'box'
    put_compact(box, id='a', camera=CAMERA)
    put_compact(box / 'next pass', id='b', camera=CAMERA | {'roi': [2, 2, 4, 4]})
    put(box, *a_chip(id='full', camera=CAMERA))
    assert len(gallery(box).all('img')) == 3
    assert 'chips: 3, problems: 0\ncameras: 1\n' in capsys.readouterr().out
    read = {chip.facts['id']: chip.facts['camera'] for chip in read_received(box).chips}
    assert read == {'a': CAMERA, 'b': CAMERA | {'roi': [2, 2, 4, 4]}, 'full': CAMERA}


def test_a_camera_that_did_not_come_or_is_damaged_is_a_problem(tmp_path, capsys) -> None:
    box = tmp_path / 'box'
    for name in 'ab':
        record = put_compact(box, id=name, camera=CAMERA)
    (camera,) = record.parent.glob('*.camera')
    content = camera.read_bytes()
    camera.write_bytes(content.replace(b'plumb', b'plomb'))
    assert len(gallery(box).all('img')) == 2
    problems = capsys.readouterr().err
    assert f'0/{camera.name}: damaged: its name is not that of its content' in problems
    assert f'obbhbb: {camera.stem}: missing; chips of this camera: 2' in problems
    camera.unlink()
    gallery(box)
    assert f'obbhbb: {camera.stem}: missing; chips of this camera: 2' in capsys.readouterr().err
    # That its JSON is missing does not matter: its name tells that it is whole.
    camera.write_bytes(content)
    camera.with_suffix('.json').unlink()
    gallery(box)
    assert 'chips: 2, problems: 0' in capsys.readouterr().out


@pytest.mark.parametrize(
    'content', [b'', b'{', b'[]', b'{"size":[8,8]}', b'{"size":8,"k":null,"model":"","d":[]}']
)
def test_the_content_of_a_camera_is_checked_with_the_chips(tmp_path, capsys, content) -> None:
    box = tmp_path / 'box'
    name = camera_id(content)
    put(box, *a_chip(camera={'id': name, 'roi': [0, 0, 8, 8], 'binning': [1, 1]}))
    (box / '0' / f'{name}.camera').write_bytes(content)
    gallery(box)
    problems = capsys.readouterr().err
    assert name in problems or "key 'camera' is not" in problems


def test_a_file_of_an_unknown_kind_is_a_problem(tmp_path, capsys) -> None:
    put(tmp_path / 'box', *a_chip(id='good'))
    put(tmp_path / 'box', *a_chip(id='new', kind='whales'))
    assert len(gallery(tmp_path / 'box').all('img')) == 1
    assert "new.json: key 'kind' is not known" in capsys.readouterr().err


@pytest.mark.parametrize(
    ('sec', 'nanosec', 'stamp', 'utc'),
    [
        (-5, 250_000_000, '-5 s + 250000000 ns', '1969-12-31 23:59:55.250 UTC'),
        (7, 4_000_000_000, '7 s + 4000000000 ns', '1970-01-01 00:00:11.000 UTC'),
        (-(2**31), 0, '-2147483648 s + 0 ns', '1901-12-13 20:45:52.000 UTC'),
        (2**31 - 1, 2**32 - 1, '2147483647 s + 4294967295 ns', '2038-01-19 03:14:11.294 UTC'),
    ],
)
def test_any_stamp_of_an_image_is_shown(tmp_path, sec, nanosec, stamp, utc) -> None:
    put(tmp_path / 'box', *a_chip(stamp={'sec': sec, 'nanosec': nanosec}))
    text = ' '.join(gallery(tmp_path / 'box').text.split())
    assert f'time{utc}' in text
    assert f'stamp{stamp} camera' in text


def test_chips_of_equal_value_are_in_the_order_of_time_whatever_their_stamps(tmp_path) -> None:
    for name, sec, nanosec in (('a', 1, 4 * 10**9), ('b', 2, 0), ('c', -3, 10**9)):
        put(tmp_path / 'box', *a_chip(id=name, stamp={'sec': sec, 'nanosec': nanosec}))
    links = [each['href'] for each in gallery(tmp_path / 'box').all('a')]
    assert [Path(link).stem for link in links] == ['c', 'b', 'a']


@pytest.mark.parametrize(('factor', 'shown'), [(1e308, '1.798e+308'), (-1e308, '-1.798e+308')])
def test_every_value_that_a_spool_can_give_is_shown(tmp_path, capsys, factor, shown) -> None:
    writer = SpoolWriter(tmp_path / 'spool', print)
    store(writer, [5.0, 6.0, 7.0])
    writer.close()
    console = SpoolConsole(tmp_path / 'spool', print)
    assert console.revalue(ANY_CHIP, factor, 0.0) == 3
    assert export(console.files(console.select()), tmp_path / 'box') == 3
    console.close()
    assert f' value {shown}' in gallery(tmp_path / 'box').text
    assert 'chips: 3, problems: 0' in capsys.readouterr().out


@pytest.mark.parametrize('key', a_chip()[0])
def test_a_missing_key_is_a_problem_that_names_file_and_key(tmp_path, capsys, key) -> None:
    facts, chip = a_chip()
    record = put(tmp_path / 'box', facts, chip)
    del facts[key]
    record.write_text(json.dumps(facts))
    gallery(tmp_path / 'box')
    assert f"0/{record.name}: key '{key}' is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    'content', [b'', b'{', b'[]', b'null', b'\xff\xfe', b'[' * 10**5, b'1' * 5000], ids=len
)
def test_a_json_that_cannot_be_read_is_a_problem(tmp_path, capsys, content) -> None:
    put(tmp_path / 'box', *a_chip(id='good'))
    (tmp_path / 'box' / 'bad.json').write_bytes(content)
    assert len(gallery(tmp_path / 'box').all('img')) == 1
    assert 'obbhbb: bad.json: ' in capsys.readouterr().err


def change_json(chip, old, new):
    path = chip.with_suffix('.json')
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))


@pytest.mark.parametrize(
    ('damage', 'message', 'pictures'),
    [
        (lambda path: path.unlink(), 'missing', 0),
        (lambda path: path.write_bytes(b'short'), 'damaged: 5 bytes instead of ', 1),
        (
            lambda path: path.write_bytes(path.read_bytes()[:-1] + b'!'),
            'damaged: sha256 differs',
            1,
        ),
        (
            lambda path: change_json(path, b'"frame_id": "c', b'"frame_id": "b'),
            'damaged: the digest of its JSON differs',
            1,
        ),
        (
            lambda path: change_json(path, b'"digest"', b'"digesu"'),
            'damaged: the digest of its JSON differs or is missing',
            1,
        ),
    ],
    ids=['missing', 'size', 'sha256', 'JSON', 'no digest'],
)
def test_a_damaged_chip_is_marked_and_shown_if_it_can_be(
    tmp_path, capsys, damage, message, pictures
) -> None:
    record = put(tmp_path / 'box', *a_chip())
    damage(record.with_suffix('.jpg'))
    page = gallery(tmp_path / 'box')
    assert len(page.all('img')) == pictures
    assert len(page.all('span', 'damage')) == 1
    assert page.text.count(message) == 2
    assert f'obbhbb: 0/{record.stem}.jpg: {message}' in capsys.readouterr().err


@pytest.mark.parametrize('content', [b'no picture at all', a_chip('jpeg2000')[1]], ids=len)
def test_a_chip_that_cannot_be_converted_has_a_card_without_picture(
    tmp_path, capsys, content
) -> None:
    put(tmp_path / 'box', *a_chip('jpeg2000', id='good'))
    facts, _ = a_chip('jpeg2000', id='bad', roi=[0, 0, 5, 5], value=0.9)
    put(tmp_path / 'box', facts, content)
    page = gallery(tmp_path / 'box')
    assert len(page.all('div', 'card')) == 2
    assert len(page.all('img')) == 1
    assert 'obbhbb: bad.jp2: no picture (' in capsys.readouterr().err


def test_a_folder_where_everything_is_wrong_still_has_a_page(tmp_path, capsys) -> None:
    (tmp_path / 'box').mkdir()
    (tmp_path / 'box' / 'a.webp').write_bytes(b'')
    assert 'Problems: 1' in gallery(tmp_path / 'box').text
    assert 'chips: 0, problems: 1' in capsys.readouterr().out


def test_no_page_is_written_if_nothing_was_found(tmp_path, capsys) -> None:
    (tmp_path / 'notes.txt').touch()
    for folder, message in ((tmp_path, 'no chips found'), (tmp_path / 'none', 'no such folder')):
        assert main(['gallery', str(folder), '-o', str(tmp_path / 'page.html')]) == 1
        assert f'obbhbb: {folder}: {message}' in capsys.readouterr().err
    assert not (tmp_path / 'page.html').exists()


def test_links_lead_from_the_page_to_the_chips_through_symbolic_links(tmp_path) -> None:
    make_outbox(tmp_path / 'deep' / 'down' / 'box', 1)
    (tmp_path / 'box').symlink_to(tmp_path / 'deep' / 'down' / 'box')
    (tmp_path / 'deep' / 'pages').mkdir()
    (tmp_path / 'page').symlink_to(tmp_path / 'deep' / 'pages')
    (picture,) = gallery(tmp_path / 'box').all('img')
    assert (tmp_path / 'deep' / 'pages' / unquote(picture['src'])).is_file()
