# SPDX-License-Identifier: Apache-2.0
"""obbhbb report: what the page says first, what it holds, and that nothing in it is cut off."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from fleets import REAL
from fleets import labels

from obbhbb_ros import convert
from obbhbb_ros.cli import main
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.study.harbour import harbour
from obbhbb_ros.study.metrics import iou
from obbhbb_ros.study.ships import Ships
from obbhbb_ros.study.ships import read_ships

report = pytest.importorskip('obbhbb_ros.study.report')


@pytest.fixture(scope='module')
def real_page():
    return report.report_page(read_ships([REAL]), 'real', gallery=3, command='obbhbb report real')


class Page(HTMLParser):
    """What a browser would fetch, and how many of each element there are."""

    def __init__(self, text):
        super().__init__()
        self.fetched, self.counts, self.open = [], {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        values = dict(attrs)
        for name in ('src', 'href', 'xlink:href'):
            if values.get(name) and not values[name].startswith(('#', 'data:')):
                self.fetched.append(values[name])


def test_report_writes_one_page_that_fetches_nothing(tmp_path, capsys) -> None:
    path = tmp_path / 'new' / 'report.html'
    assert main(['report', str(REAL), '-o', str(path), '--gallery', '7']) == 0
    text = path.read_text(encoding='utf-8')
    page = Page(text)
    assert page.fetched == []
    assert 'url(http' not in text
    assert 'script' not in page.counts
    assert text.count('class="card"') == 7
    assert page.counts['table'] == 5
    for heading in ('side by side', 'By angle', 'Calibration', 'Sensitivity', 'Synthetic'):
        assert heading in text


def test_the_gallery_begins_with_the_worst_ship() -> None:
    ships = read_ships([REAL])
    overlap = iou(convert(ships.boxes), ships.reference)
    cards = re.findall(r'<p><b>([^<]+)</b>', report.report_page(ships, 'real', gallery=5))
    assert cards == [ships.names[row] for row in np.argsort(overlap)[:5]]


def test_a_report_of_ships_without_reference_has_no_calibration_on_them() -> None:
    text = report.report_page(Ships.from_labels([labels('a', [[0, 0, 20, 10]])]), '<b>', gallery=3)
    assert 'Calibration on these ships' not in text
    assert 'protocol hbb:' not in text
    assert '&lt;b&gt;' in text
    assert '<b></h1>' not in text


def test_a_report_draws_hulls_where_the_labels_have_them() -> None:
    text = report.report_page(Ships.from_labels([harbour()]), 'harbour', gallery=4)
    assert text.count('class="hull"') == 4
    assert 'class tug' in text


def sentence(page):
    """The conclusion of a page."""
    return re.search('<p class="conclusion">(.*?)</p>', page)[1]


def referenced_by(rule):
    """The real ships, with the boxes that a rule makes of them as references."""
    ships = read_ships([REAL])
    return replace(ships, reference=convert_by_rule(ships.boxes, rule))


def test_a_report_opens_with_its_conclusion_then_come_the_ships_then_the_synthetic_hulls(
    real_page,
) -> None:
    parts = ['class="conclusion"', '<h2>Calibration', '<h2>Gallery', '<h2>Synthetic hulls']
    places = [real_page.index(part) for part in parts]
    assert places == sorted(places)
    assert real_page.index('<p class="conclusion">') < real_page.index('<h2>')


def test_where_calibration_gains_nothing_the_default_is_recommended(real_page) -> None:
    assert re.match(
        r'For these ships use the default, q 3: it has a mean IoU of 0\.9200 on held-out images, '
        r'\+0\.1100 against the outer box \(\+0\.\d{4} to \+0\.\d{4}\); a rule calibrated on them, '
        r'q 3\.\d+, f 1, s 1, makes a difference of [+-]0\.000\d \(',
        sentence(real_page),
    )


def test_where_calibration_gains_its_rule_is_recommended() -> None:
    page = report.report_page(referenced_by(HullRule(q=1.5)), 'slim', gallery=0)
    assert re.match(
        r'For these ships use q 1\.5, f 1, s 1: it has a mean IoU of (1\.0000|0\.9999) on '
        r'held-out images, \+0\.\d{4} against the outer box .* and \+0\.\d{4} .* against the '
        r'default, q 3\.$',
        sentence(page),
    )


def test_ships_of_one_image_are_not_calibrated() -> None:
    ships = referenced_by(HullRule())
    one = replace(ships, image_of=np.zeros(len(ships), int))
    text = sentence(report.report_page(one, 'one image', gallery=0))
    outer = iou(convert(one.boxes, method='outer'), one.reference).mean()
    assert text.startswith('Too few images')
    assert f'whose mean IoU is 1.0000, where the outer box has {outer:.4f}.' in text


def test_a_report_names_its_date_version_and_command(real_page, capsys, tmp_path) -> None:
    made = r'Made on \d{4}-\d\d-\d\d \d\d:\d\d UTC by obbhbb_ros [^:]+: '
    assert re.search(made + 'obbhbb report real', real_page)
    path = tmp_path / 'r.html'
    assert main(['report', str(REAL), '--gallery', '0', '-o', str(path)]) == 0
    assert re.search(made + f'obbhbb report {REAL} --gallery 0 -o', path.read_text('utf-8'))


def test_every_picture_of_a_report_has_a_text(real_page) -> None:
    texts = re.findall(r'role="img" aria-label="([^"]+)"', real_page)
    assert len(texts) == real_page.count('<svg')
    assert all(len(text) > 20 for text in texts)


def test_what_is_wide_scrolls_and_can_be_reached_with_the_keyboard(real_page) -> None:
    wide = real_page.count('<div class="wide" tabindex="0">')
    inner = real_page.count('<table>') + real_page.count('<pre>')
    assert wide == inner + real_page.count('class="figure"')
