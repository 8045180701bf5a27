# SPDX-License-Identifier: Apache-2.0
"""Joins images with their layers by exact stamp, in bounded memory and in any order of arrival."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Set
from dataclasses import dataclass
from dataclasses import field
from enum import Enum
from typing import Generic
from typing import TypeVar

from obbhbb_ros.downlink.joiner import DropMemory
from obbhbb_ros.downlink.joiner import Lateness
from obbhbb_ros.downlink.joiner import Mark
from obbhbb_ros.downlink.joiner import StampCache
from obbhbb_ros.downlink.joiner import shortage
from obbhbb_ros.limits import MAX_BYTES
from obbhbb_ros.limits import CheckedSettings
from obbhbb_ros.limits import Range
from obbhbb_ros.limits import setting
from obbhbb_ros.wire.stamp import Stamp

ImageT = TypeVar('ImageT')
LayerT = TypeVar('LayerT')

_MAX_STAMPS = 1000


class NotDrawn(str, Enum):
    """Why an image or its layers were dropped."""

    NO_IMAGE = 'no_image'
    INCOMPLETE = 'incomplete'
    OVERTAKEN = 'overtaken'
    CROWDED_OUT = 'crowded_out'
    CLEARED = 'deactivated'


@dataclass(frozen=True)
class CollectorLimits(CheckedSettings):
    """How images and their layers wait for each other; ValueError if a value is out of range."""

    max_wait: float = setting(
        0.5,
        'How long an image waits for its layers, seconds. Then it is drawn with those that have '
        'arrived.',
        Range(0.0, 60.0),
    )
    max_age: float = setting(
        5.0,
        'How long layers wait for their image, seconds, and with complete_only images for their '
        'layers. A large image takes a while to arrive.',
        Range(0.0, 3600.0),
    )
    complete_only: bool = setting(
        False,
        'Draw only images with all their layers. They wait up to max_age, and max_wait has no '
        'effect.',
    )
    max_bytes: float = setting(
        128.0 * 2**20,
        'Maximum bytes of the images that wait for their layers; the oldest is dropped first.',
        Range(1.0, MAX_BYTES),
    )
    max_images: int = setting(
        0, 'Maximum number of these images. 0: no limit but max_bytes.', Range(0, 1000)
    )

    @property
    def patience(self) -> tuple[str, float]:
        """Name and value of the parameter that says how long an image waits."""
        return ('max_age', self.max_age) if self.complete_only else ('max_wait', self.max_wait)

    def shortage(self, lateness: Lateness) -> str:
        """Say which limits were too small to keep an image until its layer came."""
        return shortage(
            lateness,
            ('max_bytes', self.max_bytes),
            ('max_images', self.max_images),
            self.patience,
        )


@dataclass
class ImageParts(Generic[ImageT, LayerT]):
    """
    An image and its layers by name, as far as they have arrived.

    Attributes
    ----------
    since : float
        When the image arrived, or the first layer while there is no image.
    mark : Mark, optional
        What had come before the image.
    """

    since: float
    image: ImageT | None = None
    mark: Mark | None = None
    layers: dict[str, LayerT] = field(default_factory=dict)


class LayerCollector(Generic[ImageT, LayerT]):
    """
    Images and layers that wait for each other.

    An image is ready once all awaited layers are there, or `max_wait` after its arrival unless
    only complete ones are wanted. An
    incomplete image is dropped if one that arrived later was ready before it: pictures do not go
    back in time. Layers may wait longer than images, because a large image takes a while to
    arrive.

    `obbhbb_ros.downlink.joiner.JoinerSide` pairs, expires and drops every message for itself; here
    an image and its layers are complete, expire and are dropped as one. Both hold what waits in a
    `StampCache`.

    Parameters
    ----------
    on_dropped : callable
        Called with the reason for each image or set of layers that is dropped.
    size_of : callable, optional
        Returns the bytes of an image.

    Examples
    --------
    >>> collector = LayerCollector(on_dropped=print)
    >>> limits = CollectorLimits(max_wait=0.5, max_age=5.0, max_images=10)
    >>> collector.add_layer('boxes', (5, 0), 'some boxes', now=0.0)
    True
    >>> collector.add_image((5, 0), 'pixels', now=0.1)
    True
    >>> collector.ready({'boxes'}, now=0.1, limits=limits)
    [('pixels', {'boxes': 'some boxes'})]
    """

    def __init__(
        self,
        on_dropped: Callable[[NotDrawn], None],
        size_of: Callable[[ImageT], int] = lambda _: 0,
    ) -> None:
        self._on_dropped, self._size_of = on_dropped, size_of
        # Images that were dropped, or drawn incomplete.
        self._memory = DropMemory()
        self._waiting = StampCache[ImageParts[ImageT, LayerT]](
            lambda reason, _: on_dropped(NotDrawn(reason.value))
        )
        # Arrival of the latest image that was ready.
        self._last_ready = 0.0

    def __len__(self) -> int:
        """Count the stamps that wait."""
        return len(self._waiting)

    def add_image(self, stamp: Stamp, image: ImageT, now: float) -> bool:
        """
        Add an image at `now`, seconds of a monotonic clock.

        Returns false if it replaces another one of the same stamp.
        """
        parts = self._parts(stamp, now)
        is_new = parts.image is None
        if is_new:
            parts.since = now
        parts.image = image
        parts.mark = self._memory.arrived(stamp, self._size_of(image), now)
        return is_new

    def add_layer(self, name: str, stamp: Stamp, layer: LayerT, now: float) -> bool:
        """Add a layer, as `add_image` adds an image."""
        parts = self._parts(stamp, now)
        is_new = name not in parts.layers
        parts.layers[name] = layer
        return is_new

    def lateness(self, stamp: Stamp, now: float) -> Lateness | None:
        """Tell what would have kept an image that was dropped, or drawn incomplete."""
        return self._memory.lateness(stamp, now)

    def ready(
        self, awaited: Set[str], now: float, limits: CollectorLimits
    ) -> list[tuple[ImageT, dict[str, LayerT]]]:
        """
        Remove and return the images that are ready, each with the layers that are there.

        Parameters
        ----------
        awaited : set of str
            Names of the layers without which an image is incomplete.
        now : float
            Seconds of a monotonic clock.
        limits : CollectorLimits
            How long to wait.
        """
        ready = []
        for stamp, parts in self._waiting.items():
            is_complete = parts.image is not None and awaited <= parts.layers.keys()
            patience = limits.max_age if parts.image is None else limits.patience[1]
            if not is_complete and now - parts.since < patience:
                continue
            self._waiting.pop(stamp)
            if parts.mark is not None and not is_complete:
                self._memory.dropped(stamp, parts.mark)
            if parts.image is None:
                self._on_dropped(NotDrawn.NO_IMAGE)
            elif not is_complete and limits.complete_only:
                self._on_dropped(NotDrawn.INCOMPLETE)
            elif not is_complete and parts.since < self._last_ready:
                self._on_dropped(NotDrawn.OVERTAKEN)
            else:
                self._last_ready = max(self._last_ready, parts.since)
                ready.append((parts.image, parts.layers))
        self._make_room(limits)
        return ready

    def clear(self) -> None:
        """Drop everything."""
        self._waiting.clear()

    def _parts(self, stamp: Stamp, now: float) -> ImageParts[ImageT, LayerT]:
        """Return the parts of a stamp."""
        if stamp not in self._waiting:
            self._waiting.put(stamp, ImageParts(now), now, _MAX_STAMPS)
        return self._waiting[stamp]

    def _make_room(self, limits: CollectorLimits) -> None:
        """Drop the oldest images where there are too many; the latest stays."""
        waiting = [
            (stamp, parts.mark, self._size_of(parts.image))
            for stamp, parts in self._waiting.items()
            if parts.image is not None and parts.mark is not None
        ]
        total = sum(size for _, _, size in waiting)
        for i, (stamp, mark, size) in enumerate(waiting[:-1]):
            is_crowd = 0 < limits.max_images < len(waiting) - i
            if total <= limits.max_bytes and not is_crowd:
                return
            total -= size
            self._waiting.pop(stamp)
            self._memory.dropped(stamp, mark)
            self._on_dropped(NotDrawn.CROWDED_OUT)
