# SPDX-License-Identifier: Apache-2.0
"""The HTML pages in a real browser: narrow and wide, light and dark, without a network."""

from itertools import product
from pathlib import Path

import pytest
from outboxes import make_placed_outbox

from obbhbb_ros.cli import main

pytestmark = pytest.mark.once
pytest.importorskip('jinja2')
pytest.importorskip('matplotlib')

REAL = Path(__file__).parents[1] / 'data' / 'real_ships.csv'
WINDOWS = list(product((360, 1280), ('light', 'dark')))


@pytest.fixture(scope='module')
def pages(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp('pages')
    make_placed_outbox(folder / 'box', 12)
    made = {name: folder / f'{name}.html' for name in ('gallery', 'report')}
    assert main(['gallery', str(folder / 'box'), '-o', str(made['gallery'])]) == 0
    assert main(['report', str(REAL), '-o', str(made['report']), '--gallery', '3']) == 0
    return made


@pytest.mark.parametrize(('width', 'scheme'), WINDOWS)
@pytest.mark.parametrize('name', ['gallery', 'report'])
def test_nothing_is_cut_off_and_nothing_is_fetched(pages, visit, name, width, scheme) -> None:
    with visit(pages[name], width, scheme) as visited:
        assert visited.page.locator('.card').count() > 0
        assert visited.cut() == []
        scrolled = visited.page.evaluate('document.documentElement.scrollWidth')
        assert scrolled <= width


@pytest.mark.parametrize('name', ['gallery', 'report'])
def test_text_stands_out_from_its_paper_in_light_and_dark(pages, visit, name) -> None:
    papers = set()
    for scheme in ('light', 'dark'):
        with visit(pages[name], scheme=scheme) as visited:
            ink, paper = visited.page.evaluate(
                "() => ['color', 'backgroundColor'].map("
                '(name) => getComputedStyle(document.documentElement)[name])'
            )
            assert contrast(ink, paper) > 7.0
            papers.add(paper)
    assert len(papers) == 2


def contrast(*colors: str) -> float:
    """Compute the contrast of two colours, `rgb(r, g, b)`, by WCAG 2.1."""
    lights = []
    for color in colors:
        parts = [int(part) / 255 for part in color[4:-1].split(',')]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        lights.append(0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05)
    return max(lights) / min(lights)


def test_the_boxes_of_a_method_hide_with_the_keyboard(pages, visit) -> None:
    with visit(pages['report']) as visited:
        boxes = visited.page.locator('.gallery .m-outer')
        assert boxes.first.is_visible()
        visited.page.locator('#show-outer').focus()
        visited.page.keyboard.press('Space')
        assert not boxes.first.is_visible()
