# SPDX-License-Identifier: Apache-2.0
"""HTML pages from the templates of a room, all of one style. Needs Jinja2, the extra `plots`."""

from __future__ import annotations

from datetime import datetime
from datetime import timezone
from importlib import metadata
from typing import Any

import jinja2

from obbhbb_ros.progress import printable


def rendered(room: str, template: str, title: str, command: str, **values: Any) -> str:
    """
    Make a page from a template of a room and its values: all is escaped, nothing may be missing.

    The page tells when it was made, by which version and, unless it is empty, by which command.
    """
    loaders = [jinja2.PackageLoader(package) for package in (f'obbhbb_ros.{room}', 'obbhbb_ros')]
    templates = jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders),
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
