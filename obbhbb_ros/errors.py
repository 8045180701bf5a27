# SPDX-License-Identifier: Apache-2.0
"""The base of all errors that this package raises on purpose."""


class ObbhbbError(Exception):
    """
    Something that a caller gave, or a file or message holds, cannot be used; the text says what.

    Every error class of the package derives from this one, and from the built-in exception that
    fits it best, so that `except ValueError` works as well.
    """
