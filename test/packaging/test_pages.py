# SPDX-License-Identifier: Apache-2.0
"""Links, files, commands, options, topics and diagnostics named on the pages exist."""

import argparse
import doctest
import importlib
import importlib.util
import json
import re
import shlex
from collections.abc import Iterator
from collections.abc import Mapping
from importlib.metadata import entry_points
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from launch_files import launched
from outboxes import make_placed_outbox
from outboxes import make_spool

from obbhbb_ros import OrientedBoxes
from obbhbb_ros import cli
from obbhbb_ros import convert
from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.commands import COMMANDS
from obbhbb_ros.commands import command_line
from obbhbb_ros.downlink.chips import Dropped
from obbhbb_ros.downlink.crops import LeftOut
from obbhbb_ros.downlink.joiner import Unpaired
from obbhbb_ros.geometry.boxes import Defect
from obbhbb_ros.overlay.collector import NotDrawn
from obbhbb_ros.settings.all_nodes import NODE_TABLES
from obbhbb_ros.wire.layouts import INPUT_TYPES

ROOT = Path(__file__).parents[2]
README = ROOT / 'README.md'
DOC = sorted((ROOT / 'doc').glob('*.md'))
FRONT = ['README', 'CONTRIBUTING', 'QUALITY_DECLARATION', 'SECURITY']
PAGES = [*(ROOT / f'{name}.md' for name in FRONT), *DOC]
PARSER = command_line()
EXECUTABLES = {
    each.name
    for each in entry_points(group='console_scripts')
    if each.value.startswith('obbhbb_ros.nodes.')
}
FENCE = re.compile(r'^ *```(\w*)\n(.*?)^ *```$', re.MULTILINE | re.DOTALL)
PLACEHOLDER = re.compile(r'<\w+>')


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def text_of(path: Path) -> str:
    return path.read_text(encoding='utf-8')


def prose(path: Path) -> str:
    """Return a page without its code blocks."""
    return FENCE.sub('', text_of(path))


def named_in(text: str, start: str) -> list[str]:
    """List the code spans in the first column of the first table after `start`."""
    assert start in text, start
    table = re.compile(r'^\|.*\n\| ---.*\n((?:\|.*\n)+)', re.M).search(text, text.index(start))
    return [
        code
        for row in table[1].replace(r'\|', '/').splitlines()
        for code in re.findall('`([^`]+)`', row.split('|')[1])
    ]


def section(text: str, title: str) -> str:
    """Return a section of a page, up to the next one of its level."""
    found = re.search(rf'^## {re.escape(title)}\n(.*?)(?=^## |\Z)', text, re.M | re.S)
    assert found, title
    return found[1]


# Links ----------------------------------------------------------------------------------------


def anchors(path: Path) -> set[str]:
    """List the anchors that GitHub gives the headings of a page."""
    found: set[str] = set()
    for heading in re.findall(r'^#+ (.*)$', prose(path), re.MULTILINE):
        slug = re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-')
        number = 0
        while (anchor := f'{slug}-{number}' if number else slug) in found:
            number += 1
        found.add(anchor)
    return found


LINKS = [
    (page, target)
    for page in PAGES
    for target in re.findall(r'\]\(([^)\s]+)\)', re.sub('`[^`\n]*`', '', prose(page)))
    if not target.startswith('http')
]


@pytest.mark.parametrize(
    ('page', 'target'), LINKS, ids=[f'{name_of(page)} {target}' for page, target in LINKS]
)
def test_a_link_has_a_target(page: Path, target: str) -> None:
    file, _, anchor = target.partition('#')
    path = (page.parent / file).resolve() if file else page
    assert path.exists()
    assert path.is_relative_to(ROOT)
    if anchor:
        assert anchor in anchors(path)


def test_every_page_is_linked_from_the_readme_and_the_index() -> None:
    for start in (README, ROOT / 'doc' / 'index.md'):
        linked = {
            (page.parent / target.partition('#')[0]).resolve()
            for page, target in LINKS
            if page == start
        }
        assert set(DOC) - {ROOT / 'doc' / 'index.md'} <= linked


def test_the_readme_is_short_and_begins_with_the_two_commands() -> None:
    lines = text_of(README).splitlines()
    assert len(lines) <= 190
    (_, first), *_ = FENCE.findall(text_of(README))
    assert [line.split()[0] for line in first.splitlines()] == ['./scripts/demo', './scripts/test']
    assert (
        lines.index(
            './scripts/demo    # sets everything up, then converts a synthetic harbour '
            'with the real node'
        )
        < 10
    )


FILES = [
    (page, path)
    for page in [README, ROOT / 'QUALITY_DECLARATION.md', *DOC]
    for path in re.findall(
        r'`((?:\./)?(?:config|doc|launch|scripts|test|\.ci)/[\w./-]*)`', prose(page)
    )
]


@pytest.mark.parametrize(('page', 'path'), FILES, ids=[f'{name_of(p)} {f}' for p, f in FILES])
def test_a_named_file_exists(page: Path, path: str) -> None:
    assert (ROOT / path).exists()


# Commands -------------------------------------------------------------------------------------


def commands(page: Path) -> list[list[str]]:
    """List the command lines of a page, split into words as a shell does."""
    blocks = [block for language, block in FENCE.findall(text_of(page)) if language == 'bash']
    found = []
    for block in blocks:
        waiting = ''
        for line in block.replace('\\\n', ' ').replace(' && ', '\n').splitlines():
            waiting += line + '\n'
            try:
                words = shlex.split(waiting, comments=True)
            except ValueError:
                # A quotation that goes on in the next line.
                continue
            waiting = ''
            while words and re.match('[A-Z_]+=', words[0]):
                del words[0]
            if words:
                found.append(words)
        assert not waiting, waiting
    return found


SHOWN = [(page, command) for page in PAGES for command in commands(page)]


def shown(*start: str) -> pytest.MarkDecorator:
    """Parametrize a test with all commands that begin with these words."""
    found = [(page, words) for page, words in SHOWN if words[: len(start)] == list(start)]
    assert found, start
    return pytest.mark.parametrize(
        'words',
        [words for _, words in found],
        ids=[f'{name_of(page)} {shlex.join(words)}' for page, words in found],
    )


def parsed(words: list[str]) -> argparse.Namespace | None:
    """Parse a command line of `obbhbb`; None if it cannot be parsed."""
    try:
        return PARSER.parse_args(words[1:])
    except SystemExit:
        return None


@shown('obbhbb')
def test_a_command_line_of_obbhbb_can_be_parsed(words: list[str]) -> None:
    assert parsed(words)


# Input that is generated for the examples.
MADE = {'received': make_placed_outbox, 'spool': make_spool}


def runnable() -> list[list[str]]:
    """List the examples of `doc/commands.md` whose input exists or is generated by `MADE`."""
    found = []
    for words in commands(ROOT / 'doc' / 'commands.md'):
        if words[0] != 'obbhbb' or words[1] == 'demo' or not (options := parsed(words)):
            continue
        named = (getattr(options, name, None) for name in ('source', 'labels', 'outbox', 'spool'))
        given = next(filter(None, named), [])
        inputs = given if isinstance(given, list) else [given]
        if all((ROOT / path).exists() or str(path) in MADE for path in inputs):
            found.append(words[1:])
    return found


@pytest.mark.parametrize('words', runnable(), ids=shlex.join)
def test_an_example_runs(words: list[str], tmp_path: Path, monkeypatch, capsys) -> None:
    if words[0] == 'bag':
        # No ROS distribution has it.
        pytest.importorskip('rosbags')
    for folder in ('test', 'obbhbb_ros'):
        (tmp_path / folder).symlink_to(ROOT / folder)
    for name in MADE.keys() & set(words):
        MADE[name](tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 0
    assert capsys.readouterr().out


def test_every_subcommand_but_the_demo_has_an_example_that_runs() -> None:
    assert {words[0] for words in runnable()} == set(COMMANDS) - {'demo'}


def options_of(name: str) -> set[str]:
    """List the options of a command, as its help text does at the beginning of a line."""
    parser = argparse.ArgumentParser(add_help=False)
    COMMANDS[name].add_options(parser)
    lines = re.findall(r'^  (-.*?)(?:  |$)', parser.format_help(), re.MULTILINE)
    return {option for line in lines for option in re.findall(r'(?<![\w-])--?[a-z][\w-]*', line)}


@pytest.mark.parametrize('name', COMMANDS)
def test_every_option_of_a_subcommand_is_documented_and_no_other(name: str) -> None:
    page = text_of(ROOT / 'doc' / 'commands.md')
    labels = section(page, 'Label files')
    parts = [section(page, f'`obbhbb {name}`'), labels if f'`{name}`' in labels else '']
    documented = [option for part in parts if part for option in named_in(part, '| option |')]
    names = [option.split(maxsplit=1)[0] for option in documented]
    assert sorted(names) == sorted(options_of(name))


@shown('ros2', 'run', 'obbhbb_ros')
def test_an_executable_and_its_parameters_exist(words: list[str]) -> None:
    node = words[3]
    assert node in EXECUTABLES
    for flag, value in pairwise(words):
        if flag == '-p':
            assert value.partition(':=')[0] in {spec.name for spec in NODE_TABLES[node].rows}


@shown('ros2', 'param', 'set')
def test_a_parameter_that_is_set_exists_and_accepts_the_value(words: list[str]) -> None:
    _, _, _, node, name, value = words
    (spec,) = (spec for spec in NODE_TABLES[node.lstrip('/')].rows if spec.name == name)
    assert not spec.read_only
    spec.check(type(spec.default)(value.removeprefix('.')))


@shown('ros2', 'param', 'get')
def test_a_parameter_that_is_read_exists(words: list[str]) -> None:
    _, _, _, node, name = words
    assert name in {spec.name for spec in NODE_TABLES[node.lstrip('/')].rows}


@shown('ros2', 'lifecycle', 'set')
def test_a_node_whose_state_is_set_exists(words: list[str]) -> None:
    assert words[3].lstrip('/') in EXECUTABLES


@shown('ros2', 'launch', 'obbhbb_ros')
def test_a_launch_file_and_its_arguments_exist(words: list[str]) -> None:
    known = launched(ROOT / 'launch' / words[3]).declared
    assert all(word.partition(':=')[0] in known for word in words[4:])


@pytest.mark.parametrize('file', sorted((ROOT / 'launch').glob('*.py')), ids=name_of)
def test_every_argument_of_a_launch_file_is_documented(file: Path) -> None:
    page = text_of(ROOT / 'doc' / 'deployment.md')
    named = named_in(page, f'| argument of `{file.name}` |')
    assert sorted(named) == sorted(launched(file).declared)


SCRIPTS = [
    (page, words)
    for page, words in SHOWN
    if re.match(r'\./scripts/|(\.venv/bin/)?python$', words[0])
]


@pytest.mark.parametrize('words', [words for _, words in SCRIPTS], ids=shlex.join)
def test_a_script_or_module_that_is_run_exists(words: list[str]) -> None:
    if words[0].startswith('./'):
        assert (ROOT / words[0]).is_file()
    elif words[1] == '-m':
        assert importlib.util.find_spec(words[2])
    else:
        assert (ROOT / words[1]).is_file()


# Code and parameter files ---------------------------------------------------------------------


def blocks(language: str, *left_out: str) -> pytest.MarkDecorator:
    """Parametrize a test with all code blocks of a language."""
    found = [
        (page, block)
        for page in PAGES
        if page.stem not in left_out
        for kind, block in FENCE.findall(text_of(page))
        if kind == language
    ]
    assert found, language
    return pytest.mark.parametrize(
        'block', [block for _, block in found], ids=[name_of(page) for page, _ in found]
    )


# The page of the figures needs data that the package does not have; the example for chips and the
# tour are run with the nodes, those for Arrow as programs; Ultralytics and supervision need not be
# installed.
@blocks('python', 'reproduction', 'chip_extractor', 'tour', 'python', 'arrow')
def test_an_example_in_python_runs(block: str) -> None:
    exec(block, {})


@pytest.mark.parametrize(('name', 'least'), [('python', 16), ('arrow', 4)])
def test_the_examples_of_a_page_give_what_they_show(name: str, least: int) -> None:
    if name == 'arrow':
        pytest.importorskip('pyarrow')
    page = ROOT / 'doc' / f'{name}.md'
    text = '\n'.join(block for kind, block in FENCE.findall(text_of(page)) if kind == 'pycon')
    session = doctest.DocTestParser().get_doctest(text, {}, page.name, str(page), 0)
    assert len(session.examples) >= least
    assert doctest.DocTestRunner().run(session).failed == 0


def test_corners_of_supervision_are_converted() -> None:
    supervision = pytest.importorskip('supervision')
    boxes = OrientedBoxes.from_xywhr([[50, 40, 60, 20, 0.5]])
    detections = supervision.Detections(
        xyxy=convert(boxes, method='outer'), data={'xyxyxyxy': boxes.corners}
    )
    detections.xyxy = convert(OrientedBoxes.from_corners(detections.data['xyxyxyxy']))
    np.testing.assert_allclose(detections.xyxy, convert(boxes))


@pytest.mark.parametrize('name', named_in(text_of(ROOT / 'doc' / 'python.md'), '| name |'))
def test_a_name_of_the_python_api_exists_and_is_described(name: str) -> None:
    module, _, attribute = name.rpartition('.')
    value = getattr(importlib.import_module(module), attribute)
    assert value.__doc__ or isinstance(value, Mapping)


@blocks('yaml')
def test_a_parameter_file_on_a_page_can_be_used(block: str) -> None:
    ((node, content),) = yaml.safe_load(block).items()
    if node == 'lifecycle_manager':
        return
    given = dict(flat(content['ros__parameters']))
    classes = '|'.join(given.get('class_ids', ['none']))
    specs = {
        spec.name: spec for table in NODE_TABLES.values() for spec in table.rows + table.class_rows
    }
    for name, value in given.items():
        spec = specs[re.sub(rf'^classes\.({classes})\.', 'classes.<id>.', name)]
        assert type(value) is type(spec.default)
        spec.check(value)


def flat(tree: dict[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f'{prefix}{name}.')
        else:
            yield prefix + name, value


# Nodes ----------------------------------------------------------------------------------------

MANAGED = ['obb_to_hbb', 'chip_extractor', 'downlink', 'overlay', 'ship_tracker']
SOURCES = '\n'.join(map(text_of, sorted((ROOT / 'obbhbb_ros').glob('**/*.py'))))


@pytest.mark.parametrize('node', MANAGED)
def test_the_topics_of_a_page_are_those_of_the_security_policy(node: str) -> None:
    # Another test compares the policy with the running node.
    policy = ElementTree.parse(ROOT / 'config' / 'security' / 'policy.xml')
    page = text_of(ROOT / 'doc' / f'{node}.md')
    for title, action in (('Subscribed', 'subscribe'), ('Published', 'publish')):
        (topics,) = policy.iterfind(f".//profile[@node='{node}']/topics[@{action}='ALLOW']")
        allowed = {topic.text for topic in topics} - {
            '~/transition_event',
            '/parameter_events',
            '/rosout',
        }
        named = set(named_in(page, f'## {title} topics\n'))
        assert named == allowed


def panels_of(layout: str | dict[str, Any]) -> list[str]:
    """List the panels in a tree of a Foxglove layout."""
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column')
    return panels_of(layout['first']) + panels_of(layout['second'])


def test_the_layout_for_foxglove_shows_topics_of_the_nodes() -> None:
    layout = json.loads(text_of(ROOT / 'config' / 'foxglove_layout.json'))
    panels = layout['configById']
    assert sorted(panels_of(layout['layout'])) == sorted(panels)
    shown = [panel['topicToRender'] for panel in panels.values() if 'topicToRender' in panel]
    for mode in (panel['imageMode'] for panel in panels.values() if 'imageMode' in panel):
        shown += [mode['imageTopic'], *mode.get('annotations', {})]
    policy = ElementTree.parse(ROOT / 'config' / 'security' / 'policy.xml')
    topics = {f'/{topic.text.lstrip("/")}' for topic in policy.iterfind('.//topic')}
    assert set(shown) <= topics
    assert {f'/overlay/markers/{layer}' for layer in LAYER_COLORS} <= set(shown)


def test_the_topics_of_the_player_stand_in_its_code() -> None:
    page = text_of(ROOT / 'doc' / 'play_detections.md')
    code = text_of(ROOT / 'obbhbb_ros' / 'nodes' / 'play_detections.py')
    of_labels = {each.topic for each in INPUT_TYPES.values()}
    published = set(named_in(page, '## Published topics\n'))
    assert of_labels < published
    for topic in published - of_labels:
        assert f"'{topic}'" in code


@pytest.mark.parametrize(
    ('node', 'mark', 'reasons'),
    [
        ('obb_to_hbb', 'detections', {each.name.lower() for each in Defect} - {'none'}),
        ('obb_to_hbb', 'doubts', {'beyond_turn', 'above_one', 'negative', 'infinite'}),
        ('obb_to_hbb', 'crops', {each.value for each in LeftOut}),
        ('chip_extractor', 'unpaired', {each.value for each in Unpaired}),
        ('overlay', 'frames', {each.value for each in NotDrawn}),
        ('ship_tracker', 'untracked', {'invalid', 'not_followed'}),
        ('ship_tracker', 'ids', {'repeated', 'row_numbers'}),
        (
            'chip_extractor',
            'chips',
            {each.value for each in Dropped}
            | {'image_refused', 'no_subscriber', 'failed', 'crop_plan_<reason>'},
        ),
    ],
)
def test_every_reason_in_the_diagnostics_is_explained(node, mark, reasons) -> None:
    page = text_of(ROOT / 'doc' / f'{node}.md')
    assert set(named_in(page, f'<!-- reasons: {mark} -->')) == reasons


def test_every_message_that_is_said_to_raise_the_level_is_in_the_code() -> None:
    texts = named_in(text_of(ROOT / 'doc' / 'nodes.md'), '<!-- what raises the level -->')
    assert len(texts) > 20
    assert [text for text in texts if text not in SOURCES] == []


@pytest.mark.parametrize('node', MANAGED)
def test_a_key_of_the_diagnostics_that_is_explained_exists(node: str) -> None:
    keys = [
        key
        for page in (node, 'nodes')
        for key in named_in(text_of(ROOT / 'doc' / f'{page}.md'), '<!-- keys of /diagnostics -->')
    ]
    # Each key is explained once.
    assert len(keys) == len(set(keys)) > 15
    for key in keys:
        if not PLACEHOLDER.search(key):
            # The books of a spool and of its lists get their prefix all at once.
            name = key.removesuffix('_per_second').removeprefix('spool.').removeprefix('lists.')
            assert re.search(rf"'{name}'|\b{name}=", SOURCES), key
