# SPDX-License-Identifier: Apache-2.0
"""What the player plays: labels, image files, and the windows of a pass over them."""

from __future__ import annotations

from collections.abc import Iterator
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import as_file
from importlib.resources import files
from pathlib import Path
from typing import Any
from typing import NamedTuple

from numpy.typing import NDArray

from obbhbb_ros.data import HARBOUR
from obbhbb_ros.data import HARBOUR_SIZE
from obbhbb_ros.earth.straight_pass import StraightPass
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.image_files import find_images
from obbhbb_ros.labels.image_files import load_image
from obbhbb_ros.labels.image_files import size_of_file
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.passes import inside_image
from obbhbb_ros.labels.passes import pass_over
from obbhbb_ros.settings.play_detections import PlayerSettings


class PlayedFrame(NamedTuple):
    """
    Labels to play, and the file of their image.

    Of a pass also the row at which the window begins, and the way of the camera if it has a pose.
    """

    labels: ImageLabels
    file: Path | None
    top: int | None = None
    flight: StraightPass | None = None


class PlayedFrames:
    """
    The frames of a label file, in order.

    Parameters
    ----------
    settings : PlayerSettings
        What to play.
    log : object
        The logger of the node.

    Attributes
    ----------
    skipped, outside : int
        Malformed records, and labels outside their image: they are reported and not played.

    Raises
    ------
    ValueError, OSError
        If the labels cannot be read, or there are none.
    """

    def __init__(self, settings: PlayerSettings, log: Any) -> None:
        self._log = log
        self.skipped = self.outside = 0
        self._picture: tuple[Path, str, NDArray[Any]] | None = None
        images = list(self._read(settings))
        if not images:
            raise ValueError(f'no image to play in {settings.path}')
        self._frames = list(self._framed(images, settings))

    def __len__(self) -> int:
        """Count the frames."""
        return len(self._frames)

    def __getitem__(self, index: int) -> PlayedFrame:
        """Return a frame."""
        return self._frames[index]

    @property
    def without_file(self) -> int:
        """How many frames have no image file."""
        return sum(frame.file is None for frame in self._frames)

    def _read(self, settings: PlayerSettings) -> Iterator[ImageLabels]:
        """Read the labels; malformed records are reported, counted and left out."""
        size = (settings.image_width, settings.image_height)
        if settings.path:
            yield from read_labels(
                Path(settings.path).expanduser(),
                settings.format or None,
                image_size=size if all(size) else None,
                on_error=self._skip,
            )
        else:
            with as_file(files('obbhbb_ros') / 'data' / HARBOUR) as path:
                yield from read_labels(path, image_size=HARBOUR_SIZE)

    def _framed(
        self, images: Sequence[ImageLabels], settings: PlayerSettings
    ) -> Iterator[PlayedFrame]:
        """List what is played: whole images, or the windows of a pass over each."""
        for labels, file in zip(images, find_images(images), strict=True):
            if not settings.pass_height:
                yield PlayedFrame(labels, file)
                continue
            sighted = self._in_sight(labels, file)
            flight = _flight(settings, sighted.size)
            for top, seen in pass_over(sighted, settings.pass_height, settings.pass_step):
                yield PlayedFrame(seen, file, top, flight)

    def _in_sight(self, labels: ImageLabels, file: Path | None) -> ImageLabels:
        """Give labels the size of their image file; leave out, and report, those outside it."""
        size = labels.size
        if file is not None:
            try:
                size = size_of_file(file)
            except ValueError as error:
                self._log.error(f'no image: {error}')
        if labels.size and labels.size != size:
            self._log.warning(
                f'{file} has {_pixels(size)}, its labels say {_pixels(labels.size)}: the pass is '
                'over the file'
            )
        sized = replace(labels, size=size)
        seen = inside_image(sized)
        if left := len(labels.class_ids) - len(seen.class_ids):
            self.outside += left
            self._log.warning(
                f'{labels.source}: image {labels.image!r}: {left} labels are outside it and are '
                'not played'
            )
        return seen

    def _skip(self, error: LabelError) -> None:
        """Log and count a malformed record."""
        self.skipped += 1
        self._log.error(f'skipped: {error}')

    def picture(self, frame: PlayedFrame) -> tuple[str, NDArray[Any]] | None:
        """Read encoding and pixels, (H, W) or (H, W, C), of a frame; None if that fails."""
        file = frame.file
        if file is None:
            return None
        try:
            if self._picture is None or self._picture[0] != file:
                self._picture = (file, *load_image(file))
        except (ImportError, OSError, ValueError) as error:
            self._log.error(f'no image: {file}: {error}', throttle_duration_sec=5.0)
            return None
        _, encoding, pixels = self._picture
        if frame.top is not None and frame.labels.size is not None:
            width, height = frame.labels.size
            pixels = pixels[frame.top : frame.top + height]
            # The file may have changed, or its size may be written in another way than it is shown.
            if pixels.shape[:2] != (height, width):
                self._log.error(
                    f'no image: {file}: its size is not the one it had at the start',
                    throttle_duration_sec=5.0,
                )
                return None
        return encoding, pixels


def _pixels(size: ImageSize | None) -> str:
    """Write a size."""
    return '{} x {} pixels'.format(*size) if size else 'an unknown size'


def _flight(settings: PlayerSettings, size: ImageSize | None) -> StraightPass | None:
    """Return how the camera flies over an image, if it has a pose."""
    if not settings.pass_altitude or size is None:
        return None
    return StraightPass(
        settings.pass_latitude,
        settings.pass_longitude,
        settings.pass_altitude,
        settings.pass_ground_sample_distance,
        size,
    )
