# SPDX-License-Identifier: Apache-2.0
"""What is written twice says the same: manifest, configuration files, tables of the pages."""

from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import pytest
from documentation import PAPER
from documentation import documents

import obbhbb_ros
from obbhbb_ros.labels import read_labels
from obbhbb_ros.settings.all_nodes import NODE_TABLES
from obbhbb_ros.settings.chip_extractor import CHIP_EXTRACTOR
from obbhbb_ros.settings.downlink import DOWNLINK
from obbhbb_ros.settings.obb_to_hbb import OBB_TO_HBB
from obbhbb_ros.settings.overlay import OVERLAY
from obbhbb_ros.settings.parameter_file import read_values
from obbhbb_ros.settings.ship_tracker import SHIP_TRACKER
from obbhbb_ros.study.harbour import harbour

pytestmark = pytest.mark.once

ROOT = Path(__file__).parents[2]


DOCUMENTS = documents(ROOT)


@pytest.mark.parametrize('path', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_document_that_follows_from_the_tables_is_up_to_date(path) -> None:
    assert path.read_text(encoding='utf-8') == DOCUMENTS[path]


def test_every_parameter_file_and_every_marked_table_follows_from_the_tables() -> None:
    marked = [path for path in ROOT.glob('doc/*.md') if ': begin -->' in path.read_text()]
    assert {*ROOT.glob('config/*.yaml'), *marked} == set(DOCUMENTS)


@pytest.mark.parametrize(
    ('name', 'table', 'differences'),
    [
        ('obb_to_hbb', OBB_TO_HBB, {}),
        ('paper', OBB_TO_HBB, PAPER),
        ('chip_extractor', CHIP_EXTRACTOR, {}),
        ('downlink', DOWNLINK, {}),
        ('overlay', OVERLAY, {}),
        ('ship_tracker', SHIP_TRACKER, {}),
    ],
)
def test_a_shipped_yaml_states_every_parameter_and_can_be_used(name, table, differences) -> None:
    values = read_values(ROOT / 'config' / f'{name}.yaml', '/any/name')
    assert values == {spec.name: spec.default for spec in table.rows} | differences
    # The node that releases has nothing to do without folders, so their defaults are refused.
    folders = {'spool.path': '/spool', 'outbox.path': '/outbox'} if name == 'downlink' else {}
    table.settings(values | folders)


@pytest.mark.parametrize(
    'spec',
    [row for table in NODE_TABLES.values() for row in table.rows + table.class_rows],
    ids=lambda spec: spec.name,
)
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
    assert (carried.scores == drawn.scores).all()
    assert all((a == b).all() for a, b in zip(carried.hulls, drawn.hulls, strict=True))


def test_every_source_names_its_license() -> None:
    files = [*ROOT.glob('*.py'), *ROOT.glob('*/**/*.py'), *(ROOT / 'scripts').iterdir()]
    hidden = [path for path in files if '/.' in f'/{path.relative_to(ROOT)}']
    sources = [path for path in files if path not in hidden]
    assert len(sources) > 100
    for source in sources:
        head = source.read_text(encoding='utf-8').splitlines()[:2]
        assert '# SPDX-License-Identifier: Apache-2.0' in head, source


def test_a_flight_machine_installs_what_the_nodes_need_and_no_more() -> None:
    manifest = ElementTree.parse(ROOT / 'package.xml')
    python = {item.text for item in manifest.findall('exec_depend') if item.text[:6] == 'python'}
    assert python == {'python3-numpy', 'python3-pil', 'python3-shapely', 'python3-yaml'}
    assert manifest.findtext('url').startswith('https://')
