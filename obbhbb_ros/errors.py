# SPDX-License-Identifier: Apache-2.0
"""The base of the error classes of this package."""


class ObbhbbError(Exception):
    """
    An input, a file or a message that cannot be used; the text says why.

    Every error class of the package derives from this one, and from the built-in exception that
    fits it best, so that `except ValueError` works as well. An argument that is out of range or of
    the wrong type raises a plain ValueError or TypeError.
    """


class StartError(ObbhbbError, RuntimeError):
    """A node cannot start; the text says why."""
