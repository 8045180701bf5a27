# SPDX-License-Identifier: Apache-2.0
"""Conversion of label files of oriented boxes to label files of axis-aligned boxes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from obbhbb_ros.geometry.boxes import BLOCK
from obbhbb_ros.geometry.boxes import Defect
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.boxes import crossed
from obbhbb_ros.geometry.converter import NO_CAPS
from obbhbb_ros.geometry.converter import Caps
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.geometry.converter import convert_by_rule
from obbhbb_ros.geometry.converter import convert_with_diagnostics
from obbhbb_ros.labels import map_images
from obbhbb_ros.labels import maps
from obbhbb_ros.labels import parquet
from obbhbb_ros.labels.formats import box_format
from obbhbb_ros.labels.formats import find_labels
from obbhbb_ros.labels.image_border import clip_to_image
from obbhbb_ros.labels.image_completion import completed
from obbhbb_ros.labels.image_labels import BowSource
from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.image_labels import ImageSize
from obbhbb_ros.labels.label_file import LabelError
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.label_format import Format
from obbhbb_ros.labels.losses import LossCount

OUTSIDE = 'outside the image'

Progress = Callable[[Iterable[ImageLabels], 'int | None'], Iterable[ImageLabels]]


@dataclass(frozen=True)
class LabelTally:
    """
    What became of the records of label files.

    Attributes
    ----------
    images : int
        Images read.
    boxes : int
        Boxes converted.
    left_out : mapping of str to int
        Boxes that cannot be converted, by reason.
    malformed : int
        Records that could not be read.
    bows : int or None
        Boxes whose bow is known; None if no bow was asked for.
    reordered : int
        Boxes whose corners were not in order around them.
    cut : int
        Boxes that end at the border of their image, as they do not in the labels.
    in_degrees : int
        Boxes in degrees, which were computed in metres on the ground.
    placed : int
        Boxes in a map, which were placed in the pixels of their image.
    losses : str
        What the labels say and the format that is written cannot hold; '' for nothing.
    """

    images: int
    boxes: int
    left_out: Mapping[str, int]
    malformed: int
    bows: int | None = None
    reordered: int = 0
    cut: int = 0
    in_degrees: int = 0
    placed: int = 0
    losses: str = ''

    @property
    def complete(self) -> bool:
        """Whether every record became a box."""
        return not self.left_out and not self.malformed

    @property
    def readable(self) -> bool:
        """Whether anything was read; images without boxes and without errors are valid."""
        return self.boxes > 0 or (self.images > 0 and self.complete)

    def __str__(self) -> str:
        """Return the counts in one line, and the losses in another."""
        reasons = ', '.join(f'{count} {reason}' for reason, count in self.left_out.items())
        bows = '' if self.bows is None else f' ({self.bows} with a known bow)'
        return (
            f'{self.images} images, {self.boxes} boxes converted{bows}, '
            f'{sum(self.left_out.values())} left out{f" ({reasons})" if reasons else ""}, '
            f'{self.malformed} malformed records skipped'
            f'{f", {self.reordered} with crossed corners put in order" if self.reordered else ""}'
            f'{f", {self.cut} cut at the border of the image" if self.cut else ""}'
            f'{f", {self.in_degrees} in degrees computed in metres" if self.in_degrees else ""}'
            f'{f", {self.placed} placed in the pixels of their image" if self.placed else ""}'
            f'{f"{chr(10)}not held by {self.losses}" if self.losses else ""}'
        )


class ConvertedImage(NamedTuple):
    """
    What became of the boxes of an image.

    Attributes
    ----------
    boxes : ImageBoxes
        The boxes that could be converted.
    left_out : mapping of int to str
        The reason for each row that could not.
    bows : int
        Boxes whose bow is known.
    """

    boxes: ImageBoxes
    left_out: Mapping[int, str]
    bows: int


def convert_image(
    labels: ImageLabels,
    rule: HullRule,
    caps: Caps = NO_CAPS,
    diagnostics: bool = False,
    bow: BowSource = 'none',
    *,
    metres: bool = False,
) -> ConvertedImage:
    """
    Convert the boxes of an image, and say how they were computed if `diagnostics`.

    `bow` says how the bow is known, as in `ImageLabels.boxes`. With `metres`, and where the labels
    are in degrees, caps and lengths are in metres on the ground. Raises ValueError if the caps
    cannot be applied.
    """
    in_degrees = labels.extras.label_set.in_degrees
    if in_degrees and caps != NO_CAPS and not metres:
        raise ValueError(f'{labels.source}: in degrees: give the caps in metres, for example 400m')
    scale = maps.metres_per_unit(labels)[:, None] if metres or in_degrees else None
    if scale is not None:
        # A box that is scaled with all its coordinates has a result that is scaled likewise.
        labels = replace(labels, corners=labels.corners * scale[:, :, None])
    boxes = labels.boxes(bow)
    xyxy = convert_by_rule(boxes, rule, caps)
    if scale is not None:
        xyxy /= scale
    # The area must be finite too, since COCO files contain it.
    with np.errstate(over='ignore', invalid='ignore'):
        finite = np.isfinite((xyxy[:, 2:] - xyxy[:, :2]).prod(axis=1))
    if in_degrees:
        xyxy = maps.boxes_in_degrees(xyxy)
    class_ids, ids, scores, extras = labels.class_ids, labels.ids, labels.scores, labels.extras
    convertible = boxes
    # Most often all can be converted, and selecting them takes as long as converting them.
    if not finite.all():
        rows = np.flatnonzero(finite)
        class_ids = tuple(class_ids[row] for row in rows)
        ids = tuple(ids[row] for row in rows)
        xyxy, scores, extras, convertible = xyxy[rows], scores[rows], extras.take(rows), boxes[rows]
    converted = ImageBoxes(
        image=labels.image,
        xyxy=xyxy,
        class_ids=class_ids,
        ids=ids,
        scores=scores,
        size=labels.size,
        source=labels.source,
        diagnostics=convert_with_diagnostics(convertible, rule, caps) if diagnostics else None,
        extras=extras,
    )
    left_out = {row: _reason(boxes, row) for row in np.flatnonzero(~finite).tolist()}
    bows = int(np.count_nonzero(boxes.bow))
    return ConvertedImage(converted, left_out, bows)


def _reason(boxes: OrientedBoxes, row: int) -> str:
    """Say why a box is left out: for its defect or, without one, because its result is too big."""
    defect = Defect(boxes.defects[row])
    return 'overflow' if defect == Defect.NONE else defect.name.lower().replace('_', ' ')


def convert_labels(
    images: Iterable[ImageLabels],
    convert: Callable[[ImageLabels], ConvertedImage],
    report: Callable[[str], None],
) -> tuple[list[ImageBoxes], LabelTally]:
    """
    Convert images with `convert_image`, and count the boxes that cannot be converted.

    `report` gets a line for each of these. The counts do not include malformed records.
    """
    done: list[ImageBoxes] = []
    reasons: Counter[str] = Counter()
    bows = in_degrees = placed = 0
    reordered = _CrossedCount()
    for labels in images:
        converted = convert(labels)
        in_degrees += labels.extras.label_set.in_degrees * len(converted.boxes.class_ids)
        placed += labels.extras.label_set.placed * len(converted.boxes.class_ids)
        done.append(converted.boxes)
        bows += converted.bows
        reordered.add(labels.corners)
        reasons.update(converted.left_out.values())
        for row, reason in converted.left_out.items():
            report(f'{labels.source}: image {labels.image!r}: box {row + 1} left out: {reason}')
    boxes = sum(len(image.class_ids) for image in done)
    left_out = dict(reasons)
    return done, LabelTally(
        len(done), boxes, left_out, 0, bows, reordered.total(), in_degrees=in_degrees, placed=placed
    )


class _CrossedCount:
    """Counts corners that are not in order, many at a time: images hold few boxes."""

    def __init__(self) -> None:
        self._waiting: list[FloatArray] = []
        self._rows = self._count = 0

    def add(self, corners: FloatArray) -> None:
        """Take the corners of an image, (N, 4, 2)."""
        self._waiting.append(corners)
        self._rows += len(corners)
        if self._rows >= BLOCK:
            self.total()

    def total(self) -> int:
        """Count those that wait, and return how many there are of all."""
        if self._waiting:
            self._count += np.count_nonzero(crossed(np.concatenate(self._waiting)))
            self._waiting, self._rows = [], 0
        return int(self._count)


def convert_file(
    source: Path,
    target: Path,
    rule: HullRule,
    caps: Caps = NO_CAPS,
    *,
    source_format: str | None = None,
    target_format: str | None = None,
    variant: str | None = None,
    image_size: tuple[int, int] | None = None,
    diagnostics: bool = False,
    bow: BowSource = 'none',
    report: Callable[[str], None],
    progress: Progress = lambda images, _: images,
    metres: bool = False,
) -> LabelTally:
    """
    Read a file or folder of oriented boxes and write one of axis-aligned boxes.

    If nothing can be read, nothing is written.

    Parameters
    ----------
    source, target : Path
        Label file or folder to read, and to write.
    rule, caps, diagnostics, bow
        How to convert, whether to write how each box was computed, and how the bow is known, as in
        `ImageLabels.boxes`.
    source_format, target_format : str, optional
        Names of `obbhbb_ros.labels.FORMATS`; by default the first is detected and the second
        follows from the suffix of `target`.
    variant : str, optional
        One of the other ways in which the target format is written.
    image_size : tuple of int, optional
        Width and height of every image, pixels; by default from labels or images.
    report : callable
        Gets a line for each malformed record, for each box that is left out, and for what other
        tools will miss.
    progress : callable, optional
        Gets the images as they are read and the number of files if `source` is a folder; passes
        the images on and shows the progress.
    metres : bool
        Whether the caps are metres on the ground instead of units of the coordinates.

    Raises
    ------
    ValueError
        If a format is unknown or cannot be detected, the target format cannot hold the boxes, or
        an image size that it needs is not known; if it is in pixels, the labels in a map, and no
        image lies there, or the caps are in metres.
    OSError
        If a file cannot be read or written.
    """
    target_labels = box_format(target, target_format, diagnostics)
    write = target_labels.box_writer(variant)
    if metres and target_labels.in_pixels:
        raise ValueError(f'{target_labels.name} is in pixels: give the caps in pixels, not metres')
    source_labels = find_labels(source, source_format)
    malformed: list[LabelError] = []

    def skip(error: LabelError) -> None:
        malformed.append(error)
        report(str(error))

    if source_labels.format is target_labels is parquet.FORMAT and source.is_file():
        file = LabelFile(source, on_error=skip)
        plain = bow == 'none' and not diagnostics and not metres
        tally = _rewritten(file, target, rule, caps, report) if plain else None
        if tally is not None:
            return replace(tally, malformed=len(malformed))
    labels = source_labels.read(image_size, skip)
    if target_labels.in_pixels:
        labels = map_images.on_images(labels)
    total = len(source_labels.files) if source.is_dir() else None
    convert = partial(
        convert_image, rule=rule, caps=caps, diagnostics=diagnostics, bow=bow, metres=metres
    )
    images, tally = convert_labels(progress(labels, total), convert, report)
    bows = None if bow == 'none' else tally.bows
    losses = _losses(target_labels, images, image_size)
    tally = replace(tally, malformed=len(malformed), bows=bows, losses=losses)
    if tally.readable:
        images = completed(images, target_labels, report)
        if target_labels.needs_sizes:
            images, tally = _clipped(images, tally, report)
    if tally.readable:
        write(target, images)
    return tally


def _rewritten(
    file: LabelFile, target: Path, rule: HullRule, caps: Caps, report: Callable[[str], None]
) -> LabelTally | None:
    """Convert from Parquet to Parquet as `parquet.rewrite` does."""
    reasons: Counter[str] = Counter()

    def refuse(labels: ImageLabels) -> None:
        left_out = convert_image(labels, rule, caps).left_out
        for row in range(len(labels.class_ids)):
            reason = left_out.get(row, 'overflow')
            reasons[reason] += 1
            report(f'{labels.source}: image {labels.image!r}: a box left out: {reason}')

    counts = parquet.rewrite(file, target, rule, caps, refuse)
    return None if counts is None else LabelTally(*counts, dict(reasons), malformed=0)


def _clipped(
    images: Iterable[ImageBoxes], tally: LabelTally, report: Callable[[str], None]
) -> tuple[list[ImageBoxes], LabelTally]:
    """Cut the boxes at the border of their image, and count."""
    done: list[ImageBoxes] = []
    outside = cut = 0
    for image in images:
        clipped = clip_to_image(image)
        done.append(clipped.boxes)
        outside += len(clipped.outside)
        cut += clipped.cut
        for row in clipped.outside:
            place = f'{image.source}: image {image.image!r}'
            report(f'{place}: box {row + 1} of {len(image.class_ids)} left out: {OUTSIDE}')
    left_out = {**tally.left_out, **({OUTSIDE: outside} if outside else {})}
    return done, replace(tally, boxes=tally.boxes - outside, left_out=left_out, cut=cut)


def _losses(target: Format, images: Iterable[ImageBoxes], image_size: ImageSize | None) -> str:
    # A size that the caller passes is not one of the labels.
    holds = {*target.holds, *(('image sizes',) if image_size else ())}
    count = LossCount(holds, target.reserved, target.longest_name)
    for image in images:
        count.add(image)
    return f'{target.name}: {count}' if str(count) else ''
