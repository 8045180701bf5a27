# SPDX-License-Identifier: Apache-2.0
"""Contact with the ground: what was said last, unless that is too long ago."""

from __future__ import annotations


class ContactWatch:
    """
    Knows whether there is contact; contact that is not renewed in time counts as lost.

    Attributes
    ----------
    is_contact : bool
        Whether there is contact; at first there is none.
    is_lost : bool
        Whether contact was not renewed in time, and nothing was heard since.

    Examples
    --------
    >>> watch = ContactWatch()
    >>> watch.hear(True, now=10.0)
    >>> watch.expire(now=12.0, timeout=5.0), watch.expire(now=16.0, timeout=5.0)
    (False, True)
    >>> watch.is_contact, watch.is_lost, watch.silence(now=17.0)
    (False, True, 7.0)
    """

    def __init__(self) -> None:
        self.is_contact = self.is_lost = False
        self._heard_at = 0.0

    def hear(self, is_contact: bool, now: float) -> None:
        """Take over what is said at a time, seconds."""
        self.is_contact, self.is_lost, self._heard_at = is_contact, False, now

    def expire(self, now: float, timeout: float) -> bool:
        """End contact that was not renewed within a timeout (0: none); return whether it ends."""
        is_over = self.is_contact and 0.0 < timeout < self.silence(now)
        if is_over:
            self.is_contact, self.is_lost = False, True
        return is_over

    def silence(self, now: float) -> float:
        """Return the time since something was heard, seconds."""
        return now - self._heard_at
