# SPDX-License-Identifier: Apache-2.0
"""Parameters and parameter files, checked and used without ROS as the nodes do it."""

import math
import pydoc
import subprocess
import sys
from pathlib import Path

import pytest

from obbhbb_ros.downlink.budget import BudgetSettings
from obbhbb_ros.downlink.budget import LinkSettings
from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.joiner import PairLimits
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.limits import Range
from obbhbb_ros.overlay.collector import CollectorLimits
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.settings.chip_extractor import CHIP_EXTRACTOR
from obbhbb_ros.settings.downlink import DOWNLINK
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.overlay import OVERLAY
from obbhbb_ros.settings.parameter_file import read_values
from obbhbb_ros.settings.parameters import rows_of
from obbhbb_ros.settings.play_detections import PlayerSettings

CONFIG = Path(__file__).parents[2] / 'config'
NESTED = """
/**:
  ros__parameters:
    q: 2.5
    crop:
      padding: 0.25
payload/obb_to_hbb:
  ros__parameters:
    class_ids: [ship, tug]
    classes.tug.method: outer
/payload/obb_to_hbb:
  ros__parameters:
    q: 4.0
other:
  ros__parameters:
    q: 9.0
"""


@pytest.fixture
def written(tmp_path):
    """Write a parameter file."""

    def write(text):
        path = tmp_path / 'params.yaml'
        path.write_text(text, encoding='utf-8')
        return path

    return write


def test_a_file_gives_the_settings_of_the_node(written) -> None:
    values = read_values(written(NESTED), '/payload/obb_to_hbb')
    settings = OBB_TO_HBB.settings(values)
    assert settings.rules[0] == HullRule(q=4.0)
    assert settings.crop.padding == 0.25
    assert settings.rules[settings.rule_of_class['tug']] == HullRule('outer', q=4.0)


def test_sections_of_other_nodes_are_ignored(written) -> None:
    assert read_values(written(NESTED), '/elsewhere/obb_to_hbb')['q'] == 2.5
    assert read_values(written(NESTED), '/other')['q'] == 9.0


@pytest.mark.parametrize(
    ('section', 'applies'),
    [
        ('/a/b/obb_to_hbb', True),
        ('a/b/obb_to_hbb', True),
        ('/a/*/obb_to_hbb', True),
        ('/**/obb_to_hbb', True),
        ('/a/**', True),
        ('/*/obb_to_hbb', False),
        ('obb_to_hbb', False),
        ('/a/b', False),
    ],
)
def test_a_section_applies_to_the_nodes_that_its_name_matches(written, section, applies) -> None:
    others = '/**: {ros__parameters: {s: 1.5}}'
    path = written(f'{others}\n{section}: {{ros__parameters: {{q: 5.0}}}}')
    assert ('q' in read_values(path, '/a/b/obb_to_hbb')) == applies


@pytest.mark.parametrize(
    ('text', 'applies'),
    [
        ('a: {b: {obb_to_hbb: {ros__parameters: {q: 5.0}}}}', True),
        ('/a/: {b/obb_to_hbb: {ros__parameters: {q: 5.0}}}', True),
        ('/: {a: {/b/obb_to_hbb: {ros__parameters: {q: 5.0}}}}', True),
        ('a: {"*": {obb_to_hbb: {ros__parameters: {q: 5.0}}}}', True),
        ('a: {"**": {ros__parameters: {q: 5.0}}}', True),
        ('/**: {obb_to_hbb: {ros__parameters: {q: 5.0}}}', True),
        ('a: {ros__parameters: {q: 9.0}, b: {obb_to_hbb: {ros__parameters: {q: 5.0}}}}', True),
        ('a: {obb_to_hbb: {ros__parameters: {q: 5.0}}}', False),
        ('a: {b: {ros__parameters: {obb_to_hbb: {ros__parameters: {q: 5.0}}}}}', False),
    ],
)
def test_sections_may_be_nested_by_namespace(written, text, applies) -> None:
    path = written(f'/*/b/*: {{ros__parameters: {{s: 1.5}}}}\n{text}')
    expected = {'s': 1.5, 'q': 5.0} if applies else {'s': 1.5}
    assert read_values(path, '/a/b/obb_to_hbb') == expected


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('/**: &all {ros__parameters: {q: 5.0}, again: *all}', 'ROS does not support aliases'),
        ('/**: {ros__parameters: ' + '{a: ' * 2000 + '}' * 2001, 'recursion'),
    ],
    ids=['alias', 'deep'],
)
def test_what_ros_refuses_is_refused(written, text, reason) -> None:
    with pytest.raises(ValueError, match=f'params.*{reason}'):
        read_values(written(text), '/obb_to_hbb')


def test_the_node_may_be_named_without_the_first_slash(written) -> None:
    assert read_values(written(NESTED), 'payload/obb_to_hbb')['q'] == 4.0


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1e1', 10.0),
        ('1e-1', 0.1),
        ('-1E+2', -100.0),
        ('1.5e3', 1500.0),
        ('.5e1', 5.0),
        ('[1e1, 2.0]', [10.0, 2.0]),
        ('"1e1"', '1e1'),
        ('1e', '1e'),
        ('e1', 'e1'),
        ('1e1s', '1e1s'),
        ('2.5', 2.5),
        ('10', 10),
    ],
)
def test_numbers_are_read_as_ros_reads_them(written, text, value) -> None:
    q = read_values(written(f'/**: {{ros__parameters: {{q: {text}}}}}'), '/any')['q']
    assert (q, type(q)) == (value, type(value))


@pytest.mark.parametrize(
    ('text', 'reason'),
    [
        ('q: 2.0', 'no parameters for /obb_to_hbb'),
        ('', 'no parameters for /obb_to_hbb'),
        ('[1, 2', 'params.yaml'),
        ('/**:\n  q: 2.0', r'no ros__parameters in /\*\*'),
        ('/**: 5', r'no ros__parameters in /\*\*'),
        ('/**:\n  ros__parameters:', 'no parameters for /obb_to_hbb'),
        ('/**:\n  ros__parameters: 5', r'ros__parameters in /\*\* must be names and values, not 5'),
        ('/**:\n  ros__parameters: [q]', 'must be names and values'),
    ],
)
def test_a_file_without_parameters_is_an_error_that_names_the_file(written, text, reason) -> None:
    path = written(text)
    with pytest.raises(ValueError, match=reason) as error:
        read_values(path, '/obb_to_hbb')
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ('values', 'reason'),
    [
        ({'q': 0.5}, '^q must be 1 to inf, not 0.5'),
        ({'q': math.nan}, '^q must be'),
        ({'q': 3}, '^q must be a double, not 3: write 2.0 instead of 2'),
        ({'image_width': True}, '^image_width must be an int'),
        ({'method': 'magic'}, '^method must be one of'),
        ({'f': 0.0}, '^f must be above 0 and at most 2, not 0.0'),
        ({'crop.max_size': 8, 'crop.min_size': 9}, '^crop.max_size'),
        ({'class_ids': ['a'], 'classes.a.q': 0.5}, '^classes.a.q must be 1 to inf'),
        ({'crop.q': 0.5}, '^crop.q must be 0, or 1 to inf, not 0.5'),
        ({'class_ids': ['a'], 'classes.a.crop_q': 0.5}, '^classes.a.crop_q must be 0, or 1 to inf'),
        ({'class_ids': ['a'], 'classes.a.crop_q': -0.5}, '^classes.a.crop_q must be -1, or'),
        ({'class_ids': ['a'], 'classes.a.min_score': -0.5}, '^classes.a.min_score must be -1, or'),
        ({'class_ids': ['a', 5]}, r"^class_ids must be a string\[\], not \['a', 5\]"),
        ({'class_ids': [str(i) for i in range(257)]}, 'the maximum is 256'),
    ],
)
def test_unusable_values_are_refused_by_name(values, reason) -> None:
    with pytest.raises(ValueError, match=reason):
        OBB_TO_HBB.settings(values)


FIELDS = [
    (table, settings, prefix, row.name.removeprefix(prefix), row.limits)
    for table, settings, prefix in (
        (OBB_TO_HBB, CropSettings, 'crop.'),
        (CHIP_EXTRACTOR, CodecSettings, ''),
        (CHIP_EXTRACTOR, BudgetSettings, 'budget.'),
        (CHIP_EXTRACTOR, PairLimits, 'cache.'),
        (DOWNLINK, LinkSettings, 'budget.'),
        (OVERLAY, Style, ''),
        (OVERLAY, CollectorLimits, ''),
    )
    for row in rows_of(settings, prefix)
    if isinstance(row.limits, Range)
]


@pytest.mark.parametrize(
    ('table', 'settings', 'prefix', 'name', 'limits'),
    FIELDS,
    ids=[f'{settings.__name__}.{name}' for _, settings, _, name, _ in FIELDS],
)
def test_a_node_and_its_library_refuse_the_same_values(
    table, settings, prefix, name, limits
) -> None:
    kind = type(getattr(settings(), name))
    for value in map(kind, (limits.low - 1, limits.high + 1)):
        with pytest.raises(ValueError, match='must be') as of_library:
            settings(**{name: value})
        with pytest.raises(ValueError, match='must be') as of_node:
            table.settings({prefix + name: value})
        assert str(of_node.value) == f'{prefix}{of_library.value}'
    assert getattr(settings(**{name: limits.high}), name) == limits.high


@pytest.mark.parametrize('settings', [HullRule, LinkSettings, BudgetSettings, PlayerSettings])
def test_help_says_what_every_field_of_settings_means(settings) -> None:
    text = pydoc.plain(pydoc.render_doc(settings))
    for row in rows_of(settings):
        assert f' |  {row.name}\n |      {row.meaning}\n' in text
    assert text.count('Attributes\n') == 1


def test_a_lower_end_can_be_excluded() -> None:
    limits = Range(0.0, 2.0, above=True)
    limits.check('f', 1e-9)
    for value in (0.0, -1.0, 2.1, math.nan):
        with pytest.raises(ValueError, match=r'^f must be above 0 and at most 2, not'):
            limits.check('f', value)


def settings_of_class(**values):
    return OBB_TO_HBB.settings(
        {'crop.q': 4.0, 'crop.min_score': 0.5, 'class_ids': ['tug']}
        | {f'classes.tug.{name}': value for name, value in values.items()}
    )


def test_a_class_without_values_for_its_crop_regions_has_those_of_the_node() -> None:
    for settings in (settings_of_class(), settings_of_class(min_score=-1.0, crop_q=-1.0)):
        assert settings.min_scores.tolist() == [0.5, 0.5]
        assert settings.crop_rules == (HullRule(q=4.0), HullRule(q=4.0))


def test_a_class_can_have_crop_regions_for_any_score_around_the_box_alone() -> None:
    settings = settings_of_class(min_score=0.0, crop_q=0.0)
    assert settings.min_scores.tolist() == [0.5, 0.0]
    assert settings.crop_rules == (HullRule(q=4.0), None)


def test_a_misspelt_class_parameter_makes_no_class() -> None:
    names = ['classes.q', 'classes.tug.q', 'classes.a.b.f']
    assert OBB_TO_HBB.mentioned_classes(names) == ['tug', 'a.b']


def test_settings_of_the_chip_node_are_checked_together() -> None:
    with pytest.raises(ValueError, match='lossless'):
        CHIP_EXTRACTOR.settings({'codec': 'jpeg', 'lossless': True})


def test_the_settings_of_the_downlink_need_no_shapely() -> None:
    code = 'import sys, obbhbb_ros.settings.downlink; print("shapely" in sys.modules)'
    printed = subprocess.run([sys.executable, '-c', code], check=True, capture_output=True)
    assert printed.stdout.strip() == b'False'


def test_no_ros_is_imported() -> None:
    code = (
        'import sys, obbhbb_ros.identification, obbhbb_ros.wire.image\n'
        'from obbhbb_ros.settings import chip_extractor, downlink, obb_to_hbb, overlay\n'
        'print([name for name in sys.modules if name.startswith(("rclpy", "rcl_", "rosidl"))])'
    )
    printed = subprocess.run([sys.executable, '-c', code], check=True, capture_output=True)
    assert printed.stdout.strip() == b'[]'
