# SPDX-License-Identifier: Apache-2.0
"""Parameters while the node runs: which are accepted, which are refused, and when they apply."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from collections.abc import Iterator
from collections.abc import Mapping
from itertools import pairwise
from math import inf
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from harness import SERVICES
from harness import Converter
from harness import Node
from harness import Site
from harness import parameters_of
from harness import stamp_of
from harness import values_of
from rcl_interfaces.msg import Parameter as Message
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParametersAtomically
from ships import FloatArray
from ships import axis_aligned
from ships import detection
from ships import detections
from ships import fleet
from ships import rows_of
from vision_msgs.msg import Detection2DArray

from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.limits import Choices
from obbhbb_ros.limits import Range
from obbhbb_ros.settings.all_nodes import NODE_TABLES
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.overlay import OVERLAY
from obbhbb_ros.settings.parameter_file import read_values
from obbhbb_ros.settings.parameters import MAX_CLASSES

# What it tests depends on rclpy, which is the same in all environments.
pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[2]
Values = Mapping[str, Any]

CONTRACT = {
    'autostart',
    'input_type',
    'method',
    'q',
    'f',
    's',
    'max_length',
    'max_width',
    'ground_sample_distance',
    'class_ids',
    'image_width',
    'image_height',
    'angle_unit',
    'invalid_policy',
    'crop.padding',
    'crop.padding_px',
    'crop.min_size',
    'crop.max_size',
    'crop.multiple_of',
    'crop.merge_max_size',
    'crop.max_count',
    'crop.max_pixels',
    'crop.max_images',
    'crop.compare_outer',
    'lock_parameters',
    'crop.q',
    'crop.min_score',
    'clip_boxes',
    'input_width',
    'input_height',
    'input_fit',
    'input_timeout',
    'hardware_id',
    'heading',
    'q_bow',
    'q_stern',
    'state.path',
    'watchdog_timeout',
}
OVERLAY_CONTRACT = {
    'autostart',
    'lock_parameters',
    'input_timeout',
    'hardware_id',
    'input_type',
    'angle_unit',
    'input_width',
    'input_height',
    'input_fit',
    'image_transport',
    'annotations',
    'layers',
    'labels',
    'legend',
    'scale',
    'quality',
    'line_width',
    'text_size',
    'max_wait',
    'max_age',
    'complete_only',
    'max_bytes',
    'max_images',
    'color.detections',
    'color.boxes',
    'color.crop_regions',
    'state.path',
    'watchdog_timeout',
}

SHIPS = fleet(8)
SLIM = {'method': 'superellipse', 'q': 1.0, 'f': 0.8, 's': 0.7, 'max_length': 90.0}
BROAD = {'method': 'shape_aware', 'q': 6.0, 'f': 1.5, 's': 1.2, 'max_length': 150.0}


def expected(values: Values) -> FloatArray:
    rule = HullRule(values['method'], values['q'], values['f'], values['s'])
    return axis_aligned(SHIPS, rule, Caps(values['max_length']))


# While messages flow --------------------------------------------------------------------------

PERIOD = 0.008
AFTER_EACH = 6


class Flow:
    """A stream of messages at 125 Hz, each with the parameter sets that may apply to it."""

    def __init__(self, node: Converter) -> None:
        self._node = node
        self._due = time.monotonic()
        self.allowed: dict[int, list[Values]] = {}

    def run(self, condition: Callable[[], Any], allowed: list[Values]) -> None:
        """Send messages until a condition holds."""
        while not condition():
            now = time.monotonic()
            if now >= self._due:
                self._due = max(self._due + PERIOD, now)
                self.allowed[self._node.send(detections(SHIPS))] = allowed
            self._node.peer.spin(0.001)

    def overtaken_by(self, coming: list[Values]) -> None:
        """Allow messages on their way to be converted after a request that is sent later."""
        answered = {stamp_of(answer) for answer in self._node.boxes}
        for stamp in self.allowed.keys() - answered:
            self.allowed[stamp] = self.allowed[stamp] + coming

    def count(self) -> int:
        return len(self.allowed)

    def check(self, answers: list[Detection2DArray]) -> None:
        """Compare the boxes of every answer with those under the sets that may apply to it."""
        assert len(answers) > self.count() / 2
        for answer in answers:
            candidates = [expected(values) for values in self.allowed[stamp_of(answer)]]
            rows = rows_of(answer)
            assert any(np.array_equal(rows, candidate) for candidate in candidates)


def flow_through(node: Converter, service: str, steps: list[list[Values]]) -> Flow:
    """Go through sets of parameters; each step lists the sets that may apply on the way to it."""
    flow = Flow(node)
    for on_the_way in steps:
        request = SERVICES[service].Request(parameters=parameters_of(on_the_way[-1]))
        flow.overtaken_by(on_the_way)
        future = node.call_async(service, request)
        # The answer to the request comes after the change: from then on only the new set holds.
        flow.run(future.done, on_the_way)
        enough = flow.count() + AFTER_EACH
        flow.run(lambda enough=enough: flow.count() >= enough, on_the_way[-1:])
    last = max(flow.allowed)
    node.wait(lambda: any(stamp_of(answer) == last for answer in node.boxes), 'the last answer')
    return flow


def one_by_one(before: Values, after: Values) -> list[Values]:
    """List the sets between two sets whose entries are exchanged one by one."""
    names = list(after)
    return [
        {**before, **{name: after[name] for name in names[:count]}}
        for count in range(len(names) + 1)
    ]


def test_no_message_mixes_two_sets_that_are_set_atomically(node: Converter) -> None:
    node.set(SLIM)
    flips = [SLIM, *([BROAD, SLIM] * 20)]
    steps = [[before, after] for before, after in pairwise(flips)]
    flow = flow_through(node, 'set_parameters_atomically', steps)
    flow.check(node.boxes)


def test_no_message_mixes_two_sets_that_are_set_one_by_one(node: Converter) -> None:
    node.set(SLIM)
    flips = [SLIM, *([BROAD, SLIM] * 20)]
    steps = [one_by_one(before, after) for before, after in pairwise(flips)]
    flow = flow_through(node, 'set_parameters', steps)
    flow.check(node.boxes)


def test_sets_that_are_rejected_change_no_message_that_flows(node: Converter) -> None:
    node.set(SLIM)
    bad = [{**BROAD, 's': 5.0}, {**BROAD, 'method': 'none'}, {**BROAD, 'crop.padding': -1.0}]
    flow = Flow(node)
    for values in bad * 5:
        request = SetParametersAtomically.Request(parameters=parameters_of(values))
        future = node.call_async('set_parameters_atomically', request)
        flow.run(future.done, [SLIM])
        assert not future.result().result.successful
    node.convert(detections(SHIPS))
    flow.check(node.boxes[:-1])


# Accepted and refused values -----------------------------------------------------------------

REFUSED = [
    ('q', float('nan')),
    ('q', 0.99),
    ('q', -float('inf')),
    ('f', 0.0),
    ('f', -0.5),
    ('f', 2.01),
    ('f', float('nan')),
    ('s', 0.0),
    ('s', 2.01),
    ('s', float('nan')),
    ('s', float('inf')),
    ('method', 'superelipse'),
    ('method', 'gaussian_published'),
    ('method', ''),
    ('max_length', -1.0),
    ('max_width', float('nan')),
    ('ground_sample_distance', -0.1),
    ('angle_unit', 'grad'),
    ('invalid_policy', 'ignore'),
    ('image_width', -1),
    ('image_height', 2_000_000),
    ('crop.padding', -0.1),
    ('crop.padding_px', float('inf')),
    ('crop.min_size', -1),
    ('crop.max_count', -1),
    ('crop.multiple_of', -8),
    ('crop.merge_max_size', -1),
    ('crop.max_pixels', -1),
    ('crop.max_images', -0.5),
]


@pytest.mark.parametrize(('name', 'value'), REFUSED)
def test_a_value_out_of_range_is_refused_by_name_and_number(
    node: Converter, name: str, value: Any
) -> None:
    before = node.get(name)
    for result in (node.set_atomically({name: value}), *node.set_one_by_one({name: value})):
        assert not result.successful
        assert name in result.reason
        assert str(value) in result.reason
    assert node.get(name) == before


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('q', 1.0),
        ('q', float('inf')),
        ('f', 2.0),
        ('f', 1e-9),
        ('s', 2.0),
        ('s', 1.1),
        ('max_length', 0.0),
        ('max_width', float('inf')),
        ('image_width', 100_000),
    ],
)
def test_a_value_at_the_end_of_its_range_is_accepted(
    node: Converter, name: str, value: Any
) -> None:
    node.set({name: value})
    assert node.get(name) == [value]


def test_an_infinite_q_gives_the_box_of_the_rectangle(node: Converter) -> None:
    node.set({'q': float('inf')})
    answer = rows_of(node.convert(detections(SHIPS)))
    np.testing.assert_allclose(answer, axis_aligned(SHIPS, HullRule('outer')), rtol=1e-12)


@pytest.mark.parametrize(
    ('name', 'value', 'wanted', 'got'),
    [
        ('q', 3, 'DOUBLE', 'INTEGER'),
        ('s', 'wide', 'DOUBLE', 'STRING'),
        ('crop.max_count', 2.0, 'INTEGER', 'DOUBLE'),
        ('method', 1, 'STRING', 'INTEGER'),
        ('class_ids', 'ship', 'STRING_ARRAY', 'STRING'),
    ],
)
def test_a_value_of_another_type_is_refused_with_both_types(
    node: Converter, name: str, value: Any, wanted: str, got: str
) -> None:
    result = node.set_atomically({name: value})
    assert not result.successful
    assert wanted in result.reason
    assert got in result.reason


def test_crop_sizes_that_exclude_each_other_are_refused(node: Converter) -> None:
    node.set({'crop.min_size': 64})
    result = node.set_atomically({'crop.max_size': 32})
    assert not result.successful
    assert 'crop.max_size (32)' in result.reason
    assert 'min_size (64)' in result.reason
    node.set({'crop.min_size': 16, 'crop.max_size': 32})


@pytest.mark.parametrize('bad', [{'s': 9.0}, {'method': 'none'}, {'crop.max_size': 1}, {'q': 1}])
@pytest.mark.parametrize('place', [0, 1, 2])
def test_a_rejected_set_changes_nothing(node: Converter, bad: Values, place: int) -> None:
    node.set({'crop.min_size': 2})
    good = list({'f': 0.5, 'max_length': 10.0}.items())
    values = dict([*good[:place], *bad.items(), *good[place:]])
    names = [spec.name for spec in OBB_TO_HBB.rows]
    before = node.get(*names)
    assert not node.set_atomically(values).successful
    assert node.get(*names) == before
    answer = rows_of(node.convert(detections(SHIPS)))
    np.testing.assert_array_equal(answer, axis_aligned(SHIPS))


def test_set_one_by_one_every_entry_is_judged_by_itself(node: Converter) -> None:
    results = node.set_one_by_one({'q': 5.0, 's': 9.0, 'f': 0.5})
    assert [result.successful for result in results] == [True, False, True]
    assert node.get('q', 's', 'f') == [5.0, 1.0, 0.5]
    answer = rows_of(node.convert(detections(SHIPS)))
    np.testing.assert_array_equal(answer, axis_aligned(SHIPS, HullRule(q=5.0, f=0.5)))


@pytest.mark.parametrize(
    ('name', 'value'), [('autostart', False), ('input_type', 'PolygonStamped')]
)
def test_a_read_only_parameter_stays(node: Converter, name: str, value: Any) -> None:
    before = node.get(name)
    result = node.set_atomically({name: value, 'q': 9.0})
    assert not result.successful
    assert name in result.reason
    assert node.get(name, 'q') == [*before, 3.0]


def test_an_unknown_parameter_is_refused(node: Converter) -> None:
    assert not node.set_atomically({'q': 9.0, 'fullness': 1.0}).successful
    assert node.get('q') == [3.0]


# What tools send ------------------------------------------------------------------------------


def value_of(kind: int, **content: Any) -> ParameterValue:
    return ParameterValue(type=kind, **content)


AS_TOOLS_SEND = [
    ('q', value_of(ParameterType.PARAMETER_STRING, string_value='inf'), inf),
    ('crop.min_score', value_of(ParameterType.PARAMETER_STRING, string_value='1e-05'), 1e-5),
    ('class_ids', value_of(ParameterType.PARAMETER_BOOL_ARRAY), []),
    ('autostart', value_of(ParameterType.PARAMETER_BOOL, bool_value=True), True),
]


@pytest.mark.parametrize(('name', 'value', 'taken'), AS_TOOLS_SEND)
def test_a_value_is_taken_as_param_load_sends_it(
    node: Converter, name: str, value: ParameterValue, taken: Any
) -> None:
    parameters = [Message(name=name, value=value)]
    for service in ('set_parameters', 'set_parameters_atomically'):
        assert refusals(node, service, parameters) == ['']
        assert node.get(name) == [taken]
        node.reset()


def refusals(node: Converter, service: str, parameters: list[Message]) -> list[str]:
    """Set parameters by a service; return why they are refused, empty where they are not."""
    response = node.call(service, SERVICES[service].Request(parameters=parameters))
    results = response.results if service == 'set_parameters' else [response.result]
    assert all(result.successful != bool(result.reason) for result in results)
    return [result.reason for result in results]


@pytest.mark.parametrize('kind', [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 255])
@pytest.mark.parametrize('service', ['set_parameters', 'set_parameters_atomically'])
def test_a_value_of_any_type_is_answered(node: Converter, service: str, kind: int) -> None:
    parameters = [*parameters_of({'s': 0.9}), Message(name='q', value=value_of(kind))]
    reasons = refusals(node, service, parameters)
    assert reasons[-1]
    is_known = kind <= ParameterType.PARAMETER_STRING_ARRAY
    assert node.get('q', 's') == [3.0, 0.9 if is_known and service == 'set_parameters' else 1.0]


@pytest.mark.parametrize('service', ['set_parameters', 'set_parameters_atomically'])
def test_numbers_as_classes_are_refused_with_the_remedy(node: Converter, service: str) -> None:
    (reason,) = refusals(node, service, parameters_of({'class_ids': [0, 8]}))
    assert 'class_ids' in reason
    assert 'quote them: ["0", "8"]' in reason


def test_a_class_and_its_values_can_be_set_at_once(node: Converter) -> None:
    node.set({'classes.tug.weight': 2.0, 'class_ids': ['tug'], 'classes.tug.q': 1.5})
    assert node.get('classes.tug.q', 'classes.tug.weight') == [1.5, 2.0]
    rejected = {'class_ids': ['tug', 'ferry'], 'classes.ferry.q': 0.5}
    assert 'classes.ferry.q' in node.set_atomically(rejected).reason
    assert node.get('class_ids', 'classes.tug.q') == [['tug'], 1.5]
    assert 'classes.ferry.q' in node.set_atomically({'classes.ferry.q': 1.5}).reason


@pytest.mark.parametrize(
    ('executable', 'name'),
    [('obb_to_hbb', 'class_ids'), ('overlay', 'layers'), ('downlink', 'outbox.levels')],
)
def test_an_empty_list_works_at_start_as_it_does_later(
    site: Site, tmp_path: Path, executable: str, name: str
) -> None:
    file = tmp_path / 'empty.yaml'
    file.write_text(f'/**: {{ros__parameters: {{{name}: []}}}}\n')
    arguments = ['--params-file', str(file)]
    if executable == 'downlink':
        for folder in ('spool', 'outbox'):
            arguments += ['-p', f'{folder}.path:={tmp_path / folder}']
    with Node(site, executable) as node:
        node.start(arguments)
        assert node.get(name) == [[]]
        node.set({name: node.get(name)[0]})
        assert node.state() == 'active'


# Descriptions for tools -----------------------------------------------------------------------

TYPES = {
    'bool': ParameterType.PARAMETER_BOOL,
    'int': ParameterType.PARAMETER_INTEGER,
    'double': ParameterType.PARAMETER_DOUBLE,
    'string': ParameterType.PARAMETER_STRING,
    'string[]': ParameterType.PARAMETER_STRING_ARRAY,
}


def test_the_parameters_are_those_of_the_contract() -> None:
    assert {spec.name for spec in OBB_TO_HBB.rows} == CONTRACT
    names = {spec.name for spec in OBB_TO_HBB.class_rows}
    of_class = ('method', 'q', 'f', 's', 'weight', 'crop_q', 'min_score', 'q_bow', 'q_stern')
    assert names == {f'classes.<id>.{name}' for name in of_class}


def test_the_overlay_has_every_parameter_of_its_contract_and_no_other() -> None:
    assert {spec.name for spec in OVERLAY.rows} == OVERLAY_CONTRACT


@pytest.mark.parametrize('spec', OBB_TO_HBB.rows, ids=lambda spec: spec.name)
def test_every_parameter_is_described(node: Converter, spec: Any) -> None:
    (description,) = node.describe(spec.name)
    assert description.type == TYPES[spec.type_name]
    assert spec.meaning in description.description
    if isinstance(spec.limits, Choices):
        assert all(word in description.description for word in spec.limits.words)
    assert description.read_only == spec.read_only
    ranges = [*description.floating_point_range, *description.integer_range]
    bounds = [(limits.from_value, limits.to_value) for limits in ranges]
    if isinstance(spec.limits, Range) and isfinite(spec.limits.high):
        assert bounds == [(spec.limits.low, spec.limits.high)]
    else:
        # rqt_reconfigure shows nothing from the first infinite range on.
        assert bounds == []
        assert str(spec.limits) in description.description or not isinstance(spec.limits, Range)


@pytest.mark.parametrize(
    ('file', 'executable'),
    [
        ('obb_to_hbb', 'obb_to_hbb'),
        ('paper', 'obb_to_hbb'),
        ('chip_extractor', 'chip_extractor'),
        ('downlink', 'downlink'),
    ],
)
def test_a_node_takes_the_parameter_file_that_comes_with_it(
    site: Site, tmp_path: Path, file: str, executable: str
) -> None:
    folders = {'spool.path': tmp_path / 'spool', 'outbox.path': tmp_path / 'outbox'}
    arguments = ['--params-file', str(ROOT / 'config' / f'{file}.yaml')]
    if executable == 'downlink':
        # The folders in the file are empty.
        for name, path in folders.items():
            arguments += ['-p', f'{name}:={path}']
    with Node(site, executable) as node:
        node.start(arguments)
        values = read_values(ROOT / 'config' / f'{file}.yaml', f'/{executable}')
        if executable == 'downlink':
            values |= {name: str(path) for name, path in folders.items()}
        assert [*map(plain, node.get(*values))] == list(values.values())


def plain(value: Any) -> Any:
    return list(value) if isinstance(value, array) else value


# Classes --------------------------------------------------------------------------------------

CLASSES_YAML = """
/**:
  ros__parameters:
    s: 0.9
    class_ids: [tug, ferry]
    classes:
      tug: {method: gaussian}
      ferry: {q: 1.5, f: 0.8}
      barge: {s: 0.5}
"""


@pytest.fixture(scope='module')
def fleet_node(site: Site) -> Iterator[Converter]:
    """A node with rules for classes in its parameter file."""
    file = site.folder / 'classes.yaml'
    file.write_text(CLASSES_YAML)
    with Converter(site, arguments=['--params-file', str(file)]) as node:
        node.connect()
        yield node


def convert_classes(node: Converter, class_ids: list[str | None]) -> FloatArray:
    """Convert the same ship under each class."""
    ship = fleet(1)[0]
    message = Detection2DArray(detections=[detection(ship, class_id) for class_id in class_ids])
    return rows_of(node.convert(message))


def under(*rules: HullRule) -> FloatArray:
    """Return the box of the same ship under each rule."""
    return np.vstack([axis_aligned(fleet(1), rule) for rule in rules])


def test_classes_in_a_parameter_file_have_rules_of_their_own(fleet_node: Converter) -> None:
    classes = ['ship', 'tug', 'ferry', None, 'tug', '']
    plain, tug = HullRule(s=0.9), HullRule('gaussian', s=0.9)
    ferry = HullRule(q=1.5, f=0.8, s=0.9)
    answer = convert_classes(fleet_node, classes)
    np.testing.assert_array_equal(answer, under(plain, tug, ferry, plain, tug, plain))


def test_what_a_class_leaves_open_follows_the_node(fleet_node: Converter) -> None:
    fleet_node.set({'s': 1.2, 'q': 2.0})
    answer = convert_classes(fleet_node, ['ship', 'ferry'])
    fleet_node.set({'s': 0.9, 'q': 3.0})
    expected_rules = HullRule(q=2.0, s=1.2), HullRule(q=1.5, f=0.8, s=1.2)
    np.testing.assert_array_equal(answer, under(*expected_rules))


def test_a_class_that_is_not_listed_has_no_rule_in_force(fleet_node: Converter) -> None:
    np.testing.assert_array_equal(convert_classes(fleet_node, ['barge']), under(HullRule(s=0.9)))
    fleet_node.set({'class_ids': ['tug', 'ferry', 'barge']})
    answer = convert_classes(fleet_node, ['barge'])
    fleet_node.set({'class_ids': ['tug', 'ferry']})
    np.testing.assert_array_equal(answer, under(HullRule(s=0.5)))
    np.testing.assert_array_equal(convert_classes(fleet_node, ['barge']), under(HullRule(s=0.9)))


def test_a_class_can_be_added_while_the_node_runs(node: Converter) -> None:
    node.set({'class_ids': ['pilot boat', 'hull/7', 'ünï.code']})
    node.set({'classes.pilot boat.q': 1.25, 'classes.ünï.code.method': 'midpoint'})
    assert node.get('classes.pilot boat.q', 'classes.hull/7.q') == [1.25, 0.0]
    answer = convert_classes(node, ['ship', 'pilot boat', 'hull/7', 'ünï.code'])
    rules = HullRule(), HullRule(q=1.25), HullRule(), HullRule('midpoint')
    np.testing.assert_array_equal(answer, under(*rules))


def test_the_rule_is_that_of_the_best_hypothesis(node: Converter) -> None:
    node.set({'class_ids': ['tug']})
    node.set({'classes.tug.method': 'outer'})
    message = Detection2DArray()
    for scores in ((0.9, 0.1), (0.1, 0.9), (0.5, 0.5), (float('nan'), 0.1)):
        two = [
            detection(fleet(1)[0], class_id, score).results[0]
            for class_id, score in zip(('tug', 'ship'), scores, strict=True)
        ]
        ship = detection(fleet(1)[0], class_id=None)
        ship.results = two
        message.detections.append(ship)
    answer = rows_of(node.convert(message))
    tug, ship = HullRule('outer'), HullRule()
    np.testing.assert_array_equal(answer, under(tug, ship, tug, ship))


def test_class_rules_are_described_and_checked_like_the_others(node: Converter) -> None:
    node.set({'class_ids': ['tug']})
    names = [spec.name.replace('<id>', 'tug') for spec in OBB_TO_HBB.class_rows]
    assert all(description.description for description in node.describe(*names))
    bad = {'method': 'none', 'q': 0.5, 'f': 3.0, 's': float('nan')}
    for name, value in bad.items():
        result = node.set_atomically({f'classes.tug.{name}': value})
        assert not result.successful
        assert f'classes.tug.{name}' in result.reason


@pytest.mark.parametrize('count', [200, MAX_CLASSES])
def test_many_classes_come_and_go_without_a_trace(start: Callable[..., Converter], count) -> None:
    node = start()
    node.connect()
    before = len(node.next_report().values)
    names = [f'class {i}.ü' for i in range(count)]
    spent = node.process.cpu_seconds()
    node.set({'class_ids': names})
    assert node.process.cpu_seconds() - spent < 2.0
    node.set({f'classes.{names[-1]}.method': 'midpoint'})
    np.testing.assert_array_equal(
        convert_classes(node, [names[0], names[-1]]), under(HullRule(), HullRule('midpoint'))
    )
    assert f'parameter.classes.{names[-1]}.method' in values_of(node.next_report())
    node.set({'class_ids': ['']})
    result = node.set_one_by_one({f'classes.{names[0]}.q': 2.0})[0]
    assert not result.successful
    np.testing.assert_array_equal(convert_classes(node, [names[-1]]), under(HullRule()))
    # The counters and latencies of the messages are new, the parameters are not.
    parameters = [key for key in values_of(node.next_report()) if key.startswith('parameter.')]
    assert len(parameters) == len(OBB_TO_HBB.rows)
    assert before <= len(node.next_report().values) <= before + 10


def test_too_many_classes_are_refused(node: Converter) -> None:
    result = node.set_atomically({'class_ids': [str(i) for i in range(MAX_CLASSES + 1)]})
    assert not result.successful
    assert result.reason == 'class_ids has 257 classes, the maximum is 256'


def test_a_class_of_the_parameter_file_keeps_its_values_when_it_comes_back(
    fleet_node: Converter,
) -> None:
    fleet_node.set({'class_ids': ['tug']})
    fleet_node.set({'class_ids': ['tug', 'ferry']})
    assert fleet_node.get('classes.ferry.q', 'classes.ferry.f') == [1.5, 0.8]


# Locked parameters ----------------------------------------------------------------------------


def test_locked_parameters_cannot_be_changed_by_anyone(start: Callable[..., Converter]) -> None:
    node = start(parameters={'lock_parameters': True, 'q': 2.5, 'class_ids': ['tug']})
    node.connect()
    for values in ({'q': 3.0}, {'class_ids': ['']}, {'use_sim_time': True}, {'classes.tug.q': 2.0}):
        for result in (node.set_atomically(values), *node.set_one_by_one(values)):
            assert not result.successful
            assert result.reason == (
                'parameters are locked: the node was started with lock_parameters'
            )
    assert node.get('q', 'lock_parameters') == [2.5, True]
    np.testing.assert_array_equal(
        rows_of(node.convert(detections(fleet(3)))), axis_aligned(fleet(3), HullRule(q=2.5))
    )


def test_the_lock_can_only_be_set_at_start(node: Converter) -> None:
    assert not node.set_atomically({'lock_parameters': True}).successful


@pytest.mark.parametrize('table', NODE_TABLES.values(), ids=list(NODE_TABLES))
def test_every_integer_fits_the_32_bits_of_tools_made_with_qt(table) -> None:
    limits = [
        (spec.limits.low, spec.limits.high)
        for spec in table.rows + table.class_rows
        if type(spec.default) is int
    ]
    assert all(-(2**31) <= low <= high < 2**31 for low, high in limits)
