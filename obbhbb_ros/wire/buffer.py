# SPDX-License-Identifier: Apache-2.0
"""The bytes of a serialized message."""

from __future__ import annotations

from obbhbb_ros.errors import ObbhbbError


class WireError(ObbhbbError, ValueError):
    """The bytes are not a message of the expected type; the text says what is wrong and where."""
