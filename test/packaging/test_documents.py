# SPDX-License-Identifier: Apache-2.0
"""What is written twice says the same: manifest, configuration files, tables of the pages."""

from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

import obbhbb_ros
from obbhbb_ros.labels import read_labels
from obbhbb_ros.nodes.chip_settings import CHIP_TABLE
from obbhbb_ros.nodes.chip_settings import build_chip_settings
from obbhbb_ros.nodes.documentation import PAPER
from obbhbb_ros.nodes.documentation import documents
from obbhbb_ros.nodes.settings import CLASS_TABLE
from obbhbb_ros.nodes.settings import TABLE
from obbhbb_ros.nodes.settings import build_settings
from obbhbb_ros.study.harbour import harbour

ROOT = Path(__file__).parents[2]


DOCUMENTS = documents(ROOT)


@pytest.mark.parametrize('path', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_document_that_follows_from_the_tables_is_up_to_date(path) -> None:
    assert path.read_text(encoding='utf-8') == DOCUMENTS[path]


def test_every_parameter_file_and_every_marked_table_follows_from_the_tables() -> None:
    marked = [path for path in ROOT.glob('doc/*.md') if ': begin -->' in path.read_text()]
    assert {*ROOT.glob('config/*.yaml'), *marked} == set(DOCUMENTS)


@pytest.mark.parametrize(('name', 'differences'), [('obb_to_hbb', {}), ('paper', PAPER)])
def test_a_shipped_yaml_states_every_parameter_and_can_be_used(name, differences) -> None:
    text = (ROOT / 'config' / f'{name}.yaml').read_text(encoding='utf-8')
    values = flat(yaml.safe_load(text)['/**']['ros__parameters'])
    assert values == {spec.name: spec.default for spec in TABLE} | differences
    build_settings(values)


def flat(tree, prefix=''):
    """Join nested keys with dots, as ROS does."""
    values = {}
    for key, value in tree.items():
        inner = isinstance(value, dict)
        values.update(flat(value, f'{prefix}{key}.') if inner else {prefix + key: value})
    return values


def test_the_shipped_yaml_of_the_chip_node_states_every_parameter_and_can_be_used() -> None:
    text = (ROOT / 'config' / 'chip_extractor.yaml').read_text(encoding='utf-8')
    values = flat(yaml.safe_load(text)['/**']['ros__parameters'])
    assert values == {spec.name: spec.default for spec in CHIP_TABLE}
    assert build_chip_settings(values) == build_chip_settings(
        {spec.name: spec.default for spec in CHIP_TABLE}
    )


@pytest.mark.parametrize('spec', TABLE + CLASS_TABLE + CHIP_TABLE, ids=lambda spec: spec.name)
def test_every_parameter_is_described_and_its_default_accepted(spec) -> None:
    assert spec.meaning.endswith('.')
    spec.check(spec.default)


def test_the_version_is_that_of_the_manifest() -> None:
    stated = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert obbhbb_ros.__version__ == version('obbhbb_ros') == stated
    assert f'\n{stated} (' in (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8')


def test_the_carried_harbour_is_the_one_that_is_drawn() -> None:
    drawn = harbour()
    (carried,) = read_labels(Path(obbhbb_ros.__file__).parent / 'data' / 'harbour.csv')
    assert (carried.corners == drawn.corners).all()
    assert (carried.reference == drawn.reference).all()
    assert carried.class_ids == drawn.class_ids
    assert all((a == b).all() for a, b in zip(carried.hulls, drawn.hulls, strict=True))


def test_every_source_names_its_license() -> None:
    files = [*ROOT.glob('*.py'), *ROOT.glob('*/**/*.py'), *(ROOT / 'scripts').iterdir()]
    hidden = [each for each in files if '/.' in f'/{each.relative_to(ROOT)}']
    sources = [each for each in files if each not in hidden]
    assert len(sources) > 100
    for source in sources:
        head = source.read_text(encoding='utf-8').splitlines()[:2]
        assert '# SPDX-License-Identifier: Apache-2.0' in head, source


def test_a_flight_machine_installs_what_the_nodes_need_and_no_more() -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml')
    python = {each.text for each in manifest.findall('exec_depend') if each.text[:6] == 'python'}
    assert python == {'python3-numpy', 'python3-pil', 'python3-shapely'}
    assert manifest.findtext('url').startswith('https://')
