# SPDX-License-Identifier: Apache-2.0
"""HTML pages from the templates of this package. Needs Jinja2, the extra `plots`."""

from __future__ import annotations

from datetime import datetime
from datetime import timezone
from importlib import metadata
from typing import Any

import jinja2

from obbhbb_ros.study.progress import printable


def rendered(template: str, title: str, command: str, **values: Any) -> str:
    """
    Make a page from a template and its values: everything is escaped, nothing may be missing.

    The page tells when it was made, by which version and, unless it is empty, by which command.
    """
    templates = jinja2.Environment(
        loader=jinja2.PackageLoader('obbhbb_ros.study'),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    try:
        version = metadata.version('obbhbb_ros')
    except metadata.PackageNotFoundError:
        version = 'from a checkout'
    now = f'{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC'
    made = f'Made on {now} by obbhbb_ros {version}' + (f': {printable(command)}' if command else '')
    return templates.get_template(template).render(title=title, origin=made, **values)
