# SPDX-License-Identifier: Apache-2.0
"""Which ship a chip shows: ids of detections, made different from those of any other run."""

from __future__ import annotations

from collections.abc import Sequence

from obbhbb_ros.tracking.track_ids import is_tracker_id
from obbhbb_ros.tracking.track_ids import new_session
from obbhbb_ros.tracking.track_ids import repeated_ids

# No tracker keeps a number longer than this without detections, seconds.
_PAUSE = 60.0


class ObjectIds:
    """
    Names the objects of frames by the ids of their detections.

    The ids of `ship_tracker` are used as they are. Those of other trackers are numbers that begin
    again with each of their runs; they are put behind a session, which changes with each of ours,
    and after a minute without ids.

    Examples
    --------
    >>> objects = ObjectIds()
    >>> objects.name(['09af31bc-7', 'ship', 'ship', ''], now=0.0)
    ['09af31bc-7', '', '', '']
    >>> (first,), (again,), (later,) = (objects.name(['4'], now) for now in (1.0, 61.0, 122.0))
    >>> first == again, first == later, first.endswith('-4')
    (True, False, True)
    """

    def __init__(self) -> None:
        self._session, self._heard = new_session(), -_PAUSE

    def name(self, ids: Sequence[str], now: float) -> list[str]:
        """
        Return the objects of a frame.

        Parameters
        ----------
        ids : sequence of str
            The ids of its detections; empty where one has none.
        now : float
            Monotonic time, seconds.

        Returns
        -------
        list of str
            The ids of their objects; empty for a detection without id, and for those that share
            theirs: it is a class name, for example, and names no ship.
        """
        if any(ids):
            if now - self._heard > _PAUSE:
                self._session = new_session()
            self._heard = now
        repeated = repeated_ids(ids)
        return ['' if text in repeated else self._object(text) if text else '' for text in ids]

    def _object(self, text: str) -> str:
        """Return the object of an id."""
        return text if is_tracker_id(text) else f'{self._session}-{text}'
