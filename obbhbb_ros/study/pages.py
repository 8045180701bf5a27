# SPDX-License-Identifier: Apache-2.0
"""HTML pages from the templates of this package. Needs Jinja2, the extra `plots`."""

from __future__ import annotations

import jinja2


def environment() -> jinja2.Environment:
    """Return the environment of the templates: everything is escaped, nothing may be missing."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader('obbhbb_ros.study'),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
