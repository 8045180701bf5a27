# SPDX-License-Identifier: Apache-2.0
"""The gallery in a real browser: one card per ship, sorted and filtered, by keyboard as well."""

from pathlib import Path

import pytest
from outboxes import FIRST_STAMP
from outboxes import a_chip
from outboxes import put

from obbhbb_ros.cli import main

pytestmark = pytest.mark.once
pytest.importorskip('jinja2')

# Name, ship, value, class and seconds after the first stamp.
CHIPS = (
    ('a', 'x-1', 0.2, 'tug', 50),
    ('b', 'x-1', 0.9, 'cargo', 10),
    ('c', None, 0.8, 'tug', 20),
    ('d', 'x-1', 0.5, 'tug', 0),
    ('e', 'x-2', 0.6, 'tug', 40),
)


@pytest.fixture(scope='module')
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('gallery')
    for name, ship, value, class_id, seconds in CHIPS:
        stamp = {'sec': FIRST_STAMP + seconds, 'nanosec': 0}
        facts = {'id': name, 'value': value, 'score': value, 'class_id': class_id, 'stamp': stamp}
        of_ship = {'object': ship, 'view': 1, 'rank': value} if ship else {}
        put(folder / 'box', *a_chip(**facts, **of_ship))
    path = folder / 'gallery.html'
    assert main(['gallery', str(folder / 'box'), '-o', str(path)]) == 0
    return path


def shown(visited) -> list[str]:
    """Name the best views of the cards that are shown, in their order."""
    links = visited.page.locator('.card:visible .pictures a')
    return [Path(link.get_attribute('href')).stem for link in links.all()]


@pytest.mark.parametrize(
    ('order', 'names'),
    [('rank', 'bce'), ('newest', 'bec'), ('oldest', 'bce'), ('class', 'ceb'), ('views', 'bce')],
)
def test_cards_are_sorted(page, visit, order, names) -> None:
    with visit(page) as visited:
        assert shown(visited) == ['b', 'c', 'e']
        visited.page.select_option('[name=order]', order)
        assert shown(visited) == list(names)


@pytest.mark.parametrize(
    ('name', 'value', 'names'),
    [
        ('score', '0.7', 'bc'),
        ('value', '0.85', 'b'),
        # The ship of b was seen last by a.
        ('since', '2025-11-27T23:17:15', 'be'),
        ('until', '2025-11-27T23:16:45', 'b'),
    ],
)
def test_cards_are_filtered_and_all_are_shown_again(page, visit, name, value, names) -> None:
    with visit(page) as visited:
        visited.page.fill(f'[name={name}]', value)
        assert shown(visited) == list(names)
        assert visited.page.locator('output').text_content() == f'{len(names)} shown'
        visited.page.click('button')
        visited.page.wait_for_function("document.querySelector('output').value === '3 shown'")
        assert shown(visited) == ['b', 'c', 'e']


def test_cards_are_filtered_by_class(page, visit) -> None:
    with visit(page) as visited:
        visited.page.select_option('[name=only]', label='cargo')
        assert shown(visited) == ['b']


def test_the_keyboard_is_enough(page, visit) -> None:
    with visit(page) as visited:
        press = visited.page.keyboard.press
        press('Tab')
        assert visited.page.evaluate('document.activeElement.name') == 'order'
        # The second order.
        press('ArrowDown')
        assert shown(visited) == ['b', 'e', 'c']
        visited.page.locator('summary').focus()
        other_views = visited.page.locator('.views a')
        assert not other_views.first.is_visible()
        press('Enter')
        assert other_views.count() == 2
        other_views.first.wait_for(state='visible')
        press('Tab')
        focused = visited.page.evaluate('document.activeElement.href')
        assert Path(focused).stem == 'd'


def test_all_pictures_are_loaded_when_they_are_seen(page, visit) -> None:
    with visit(page) as visited:
        visited.page.click('summary')
        visited.page.wait_for_function(
            '[...document.images].every((each) => each.complete && each.naturalWidth > 0)'
        )


@pytest.mark.parametrize('width', [360, 1280])
def test_nothing_is_cut_off_when_the_other_views_are_open(page, visit, width) -> None:
    with visit(page, width) as visited:
        visited.page.click('summary')
        assert visited.cut() == []
