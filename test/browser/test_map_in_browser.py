# SPDX-License-Identifier: Apache-2.0
"""The map of the gallery in a real browser: every ship at its place, one click from its card."""

from itertools import pairwise
from pathlib import Path

import pytest
from outboxes import make_placed_outbox

from obbhbb_ros.cli import main
from obbhbb_ros.reports.ship_geojson import ship_geojson
from obbhbb_ros.reports.ship_report import ShipReport

pytestmark = pytest.mark.once
pytest.importorskip('jinja2')


@pytest.fixture(scope='module')
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('map')
    make_placed_outbox(folder / 'box', 12)
    path = folder / 'gallery.html'
    assert main(['gallery', str(folder / 'box'), '-o', str(path)]) == 0
    return path


@pytest.mark.parametrize('width', [360, 1280])
@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_marks_and_labels_lie_in_the_map_and_stand_out(page, visit, width, scheme) -> None:
    with visit(page, width, scheme) as visited:
        chart = visited.page.locator('.chart').bounding_box()
        parts = visited.page.locator('.chart .mark, .chart span:visible').all()
        assert len(parts) > 12
        for part in parts:
            box = part.bounding_box()
            assert chart['x'] <= box['x']
            assert box['x'] + box['width'] <= chart['x'] + chart['width']
            assert chart['y'] <= box['y']
            assert box['y'] + box['height'] <= chart['y'] + chart['height']
        labels = [part.bounding_box() for part in visited.page.locator('.meridian:visible').all()]
        for left, right in pairwise(labels):
            assert left['x'] + left['width'] < right['x']
        colors = visited.page.locator('a.mark').first.evaluate(
            '(mark) => [getComputedStyle(mark).backgroundColor,'
            ' getComputedStyle(document.documentElement).backgroundColor]'
        )
        assert colors[0] != colors[1]


def test_a_label_lies_over_marks_which_take_the_clicks(page, visit) -> None:
    with visit(page, 360) as visited:
        label = visited.page.locator('.parallel').first
        covered = label.evaluate(
            """(label) => {
              const [inner, outer] = [label, label.parentElement].map(
                (element) => element.getBoundingClientRect());
              const x = inner.left + inner.width / 2, y = inner.top + inner.height / 2;
              const mark = document.querySelector('a.mark');
              mark.style.left = `${x - outer.left}px`;
              mark.style.top = `${y - outer.top}px`;
              const clicked = document.elementFromPoint(x, y) === mark;
              label.style.pointerEvents = 'auto';
              return [clicked, document.elementFromPoint(x, y) === label];
            }"""
        )
        assert covered == [True, True]


@pytest.mark.parametrize('width', [360, 1280])
def test_a_mark_leads_to_the_card_of_its_ship(page, visit, width) -> None:
    with visit(page, width) as visited:
        mark = visited.page.locator('a.mark').nth(11)
        name = mark.get_attribute('title').partition(':')[0]
        mark.click()
        card = visited.page.locator('.card:target')
        assert name in card.text_content()
        visited.page.wait_for_function(
            "() => { const box = document.querySelector('.card:target').getBoundingClientRect();"
            'return box.top >= 0 && box.top < innerHeight; }'
        )
        # Not behind the filters.
        bar = visited.page.locator('.filters').bounding_box()
        box = card.bounding_box()
        assert box['y'] >= bar['y'] + bar['height'] or bar['y'] + bar['height'] < 0


def test_marks_hide_with_their_cards(page, visit) -> None:
    with visit(page) as visited:
        marks = visited.page.locator('a.mark:visible')
        assert marks.count() == 12
        visited.page.select_option('[name=only]', label='tug')
        cards = visited.page.locator('.card:visible').count()
        assert 0 < cards < 12
        assert marks.count() == cards


def test_the_keyboard_comes_to_the_filters_before_the_marks(page, visit) -> None:
    with visit(page) as visited:
        visited.page.keyboard.press('Tab')
        assert visited.page.evaluate('document.activeElement.name') == 'order'


def test_on_paper_marks_keep_their_colour_and_cards_are_whole(page, visit) -> None:
    with visit(page) as visited:
        visited.page.emulate_media(media='print')
        assert not visited.page.locator('.filters').is_visible()
        style = '(element, name) => getComputedStyle(element)[name]'
        mark = visited.page.locator('a.mark').first
        assert mark.evaluate(style, 'printColorAdjust') == 'exact'
        card = visited.page.locator('.card').first
        assert card.evaluate(style, 'breakInside') == 'avoid'


def test_a_page_of_ship_lists_alone_speaks_of_no_cards(tmp_path, visit) -> None:
    known = {'course': 12.0, 'course_ambiguous': False, 'length_m': 30.0, 'width_m': 9.0}
    ship = ShipReport(id='a-1', latitude=36.1, longitude=180.0, **known, first=5, last=5)
    (tmp_path / 'ships_a_1.geojson.gz').write_bytes(ship_geojson([ship]))
    path = tmp_path / 'gallery.html'
    assert main(['gallery', str(tmp_path), '-o', str(path)]) == 0
    with visit(path) as visited:
        assert visited.page.locator('.mark').count() == 1
        assert visited.page.locator('.filters').count() == 0
        assert 'card, with' not in visited.page.locator('body').text_content()
        assert '180°' in visited.page.locator('.meridian').all_text_contents()
