# SPDX-License-Identifier: Apache-2.0
"""Digests by which damage to a text is noticed, and JSON that ends with its own digest."""

from __future__ import annotations

import hashlib

_DIGITS = 16


def digest_of(content: bytes) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of some bytes."""
    return hashlib.sha256(content).hexdigest()[:_DIGITS]


def sealed(content: bytes) -> bytes:
    """
    Add the key `digest` to the end of a JSON object, over all bytes before it.

    Examples
    --------
    >>> sealed(b'{"id": "a"}')
    b'{"id": "a", "digest": "500b8e8db9cb88b4"}'
    """
    body = content.removesuffix(b'}')
    return body + f', "digest": "{digest_of(body)}"}}'.encode('ascii')


SEAL_LENGTH = len(sealed(b'}')) - 1
"""Bytes that `sealed` adds."""


def is_sealed(content: bytes) -> bool:
    """
    Return whether JSON ends with the digest of what is before it.

    Examples
    --------
    >>> content = sealed(b'{"id": "a"}')
    >>> is_sealed(content), is_sealed(content.replace(b'a', b'b')), is_sealed(b'{"id": "a"}')
    (True, False, False)
    """
    body = content[: -SEAL_LENGTH - 1]
    return content == sealed(body + b'}')
