# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, and pages in it that note what they should not do."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
# Elements that end beyond the right edge, and those that cut off their content; not what lies in
# an element that scrolls.
CUT = """() => [...document.querySelectorAll('body *')].filter((element) => {
  if (!element.checkVisibility() || element.closest('.wide, .switch, svg, option')) return false;
  const box = element.getBoundingClientRect(), style = getComputedStyle(element);
  return box.right > innerWidth + 1 || box.left < -1
    || (style.overflowX === 'hidden' && element.scrollWidth > element.clientWidth + 1);
}).map((element) => `${element.tagName} ${element.className}: ${element.textContent.trim()}`)"""


class Visit:
    """A page in the browser, and what has gone wrong on it."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on('console', self._on_console)
        page.on('pageerror', lambda error: self.errors.append(str(error)))
        page.on('requestfailed', lambda request: self.errors.append(f'failed: {request.url[:99]}'))
        page.on('request', lambda request: self.requests.append(request.url))

    def cut(self) -> list[str]:
        """Name the elements that are cut off or reach beyond the window."""
        return self.page.evaluate(CUT)

    def foreign_requests(self) -> list[str]:
        """List the addresses of requests that are neither files nor embedded."""
        return [url for url in self.requests if not url.startswith(('file:', 'data:'))]

    def _on_console(self, message: Any) -> None:
        if message.type in ('error', 'warning'):
            self.errors.append(message.text)


@pytest.fixture(scope='session')
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip(
        'playwright.sync_api', reason='Playwright is not installed, the extra browser'
    )
    with sync_api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        program = next(filter(None, map(shutil.which, (own, *NAMES))), None)
        if program is None:
            pytest.skip('there is no Chromium: install the package chromium')
        chromium = playwright.chromium.launch(executable_path=program)
        yield chromium
        chromium.close()


@pytest.fixture
def visit(browser):
    """Give a context manager that opens a file in a window of some width and colour scheme."""

    @contextmanager
    def opened(path: Path, width: int = 1280, scheme: str = 'light') -> Iterator[Visit]:
        size = {'width': width, 'height': 900}
        context = browser.new_context(viewport=size, color_scheme=scheme)
        try:
            visited = Visit(context.new_page())
            visited.page.goto(path.as_uri())
            yield visited
            assert visited.errors == []
            assert visited.foreign_requests() == []
        finally:
            context.close()

    return opened
