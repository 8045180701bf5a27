# SPDX-License-Identifier: Apache-2.0
"""Label files of oriented boxes to label files of axis-aligned ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import fields
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from obbhbb_ros.boxes import Defect
from obbhbb_ros.boxes import OrientedBoxes
from obbhbb_ros.converter import NO_CAPS
from obbhbb_ros.converter import Caps
from obbhbb_ros.converter import Conversion
from obbhbb_ros.converter import HullRule
from obbhbb_ros.converter import convert_by_rule
from obbhbb_ros.converter import convert_with_diagnostics
from obbhbb_ros.labels import ConvertedImage
from obbhbb_ros.labels import ImageLabels
from obbhbb_ros.labels import LabelError
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_boxes
from obbhbb_ros.labels.files import bare_name
from obbhbb_ros.labels.files import label_files
from obbhbb_ros.labels.image_size import stored_size
from obbhbb_ros.labels.registry import FORMATS
from obbhbb_ros.labels.registry import detect_format
from obbhbb_ros.labels.registry import format_named
from obbhbb_ros.labels.writer import box_format
from obbhbb_ros.labels.writer import no_diagnostics
from obbhbb_ros.study.progress import track

REASONS = {
    Defect.NOT_FINITE: 'not finite',
    Defect.NEGATIVE_SIZE: 'negative size',
    Defect.EMPTY: 'empty',
    Defect.TOO_FEW_POINTS: 'too few points',
    Defect.NO_RECTANGLE: 'no rectangle',
}
OVERFLOW = 'overflow'


@dataclass(frozen=True)
class Tally:
    """
    What became of the records of a conversion.

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
    """

    images: int
    boxes: int
    left_out: Mapping[str, int]
    malformed: int

    @property
    def complete(self) -> bool:
        """Whether every record became a box."""
        return not self.left_out and not self.malformed

    @property
    def readable(self) -> bool:
        """Whether there was anything to read; no box and no error is an empty data set."""
        return self.boxes > 0 or (self.images > 0 and self.complete)

    def __str__(self) -> str:
        """Sum up in one line."""
        reasons = ', '.join(f'{count} {reason}' for reason, count in self.left_out.items())
        return (
            f'{self.images} images, {self.boxes} boxes converted, '
            f'{sum(self.left_out.values())} left out{f" ({reasons})" if reasons else ""}, '
            f'{self.malformed} malformed records skipped'
        )


def convert_image(
    labels: ImageLabels, rule: HullRule, caps: Caps = NO_CAPS, diagnostics: bool = False
) -> tuple[ConvertedImage, dict[int, str]]:
    """
    Convert the boxes of an image.

    Parameters
    ----------
    labels : ImageLabels
        N oriented boxes.
    rule : HullRule
        The rule.
    caps : Caps
        Bounds of the result.
    diagnostics : bool
        Whether to tell how each box came about.

    Returns
    -------
    ConvertedImage, dict of int to str
        The boxes that could be converted, and the reason for each row that could not.
    """
    boxes = OrientedBoxes.from_corners(labels.corners)
    conversion = convert_with_diagnostics(boxes, rule, caps) if diagnostics else None
    xyxy = convert_by_rule(boxes, rule, caps) if conversion is None else conversion.xyxy
    # Formats that give an area have to be able to.
    with np.errstate(over='ignore', invalid='ignore'):
        finite = np.isfinite((xyxy[:, 2:] - xyxy[:, :2]).prod(axis=1))
    rows = np.flatnonzero(finite)
    bad = np.flatnonzero(~finite).tolist()
    converted = ConvertedImage(
        image=labels.image,
        xyxy=xyxy[rows],
        class_ids=tuple(labels.class_ids[row] for row in rows),
        ids=tuple(labels.ids[row] for row in rows),
        scores=labels.scores[rows],
        size=labels.size,
        source=labels.source,
        diagnostics=None if conversion is None else _select(conversion, rows),
    )
    return converted, {row: REASONS.get(Defect(boxes.defects[row]), OVERFLOW) for row in bad}


def _select(conversion: Conversion, rows: NDArray[np.intp]) -> Conversion:
    names = [field.name for field in fields(Conversion)]
    return Conversion(**{name: getattr(conversion, name)[rows] for name in names})


def convert_labels(
    images: Iterable[ImageLabels],
    rule: HullRule,
    caps: Caps = NO_CAPS,
    *,
    diagnostics: bool = False,
    report: Callable[[str], None],
) -> tuple[list[ConvertedImage], Tally]:
    """
    Convert images, and count what could not be.

    Parameters
    ----------
    images : iterable of ImageLabels
        The images.
    rule, caps, diagnostics
        As for `convert_image`.
    report : callable
        Gets a line for each box that is left out.

    Returns
    -------
    list of ConvertedImage, Tally
        Every image, and the counts; of malformed records it knows none.
    """
    converted = []
    reasons: Counter[str] = Counter()
    for labels in images:
        image, bad = convert_image(labels, rule, caps, diagnostics)
        converted.append(image)
        reasons.update(bad.values())
        for row, reason in bad.items():
            report(f'{labels.source}: image {labels.image!r}: box {row + 1} left out: {reason}')
    boxes = sum(len(image.class_ids) for image in converted)
    return converted, Tally(len(converted), boxes, dict(reasons), 0)


def convert_file(
    source: Path,
    target: Path,
    rule: HullRule,
    caps: Caps = NO_CAPS,
    *,
    source_format: str | None = None,
    target_format: str | None = None,
    image_size: tuple[int, int] | None = None,
    diagnostics: bool = False,
    report: Callable[[str], None],
) -> Tally:
    """
    Read a file or folder of oriented boxes and write one of axis-aligned boxes.

    Nothing is written where nothing could be read.

    Parameters
    ----------
    source, target : Path
        Label file or folder to read, and to write.
    rule, caps, diagnostics
        As for `convert_image`.
    source_format, target_format : str, optional
        Names of `obbhbb_ros.labels.FORMATS`; by default the first is detected and the second told
        from the suffix of `target`.
    image_size : tuple of int, optional
        Width and height of every image, pixels; by default from labels or images.
    report : callable
        Gets a line for each record that is malformed and each box that is left out.

    Returns
    -------
    Tally
        The counts.

    Raises
    ------
    ValueError
        If a format is unknown or not to be told, the target format cannot hold what there is, or
        a size that it needs is not known.
    OSError
        If a file cannot be read or written.
    """
    writes = box_format(target, target_format)
    if diagnostics and not writes.holds_diagnostics:
        raise ValueError(no_diagnostics(writes))
    reads = format_named(source_format or detect_format(source))
    malformed: list[LabelError] = []

    def skip(error: LabelError) -> None:
        malformed.append(error)
        report(str(error))

    images = read_labels(source, reads.name, image_size=image_size, on_error=skip)
    total = len(label_files(source, reads.suffixes)) if source.is_dir() else None
    converted, tally = convert_labels(
        track(images, 'converting', total), rule, caps, diagnostics=diagnostics, report=report
    )
    tally = replace(tally, malformed=len(malformed))
    if tally.readable:
        if writes is FORMATS['yolo']:
            converted = [_sized(image) for image in converted]
        write_boxes(target, converted, writes.name)
    return tally


def _sized(converted: ConvertedImage) -> ConvertedImage:
    """Look for the image file where the labels do not tell the size."""
    if converted.size is not None or not converted.class_ids:
        return converted
    # Where the label file of that image would be.
    place = converted.source.parent / f'{bare_name(converted.image)}.txt'
    try:
        return replace(converted, size=stored_size(place))
    except LabelError as error:
        advice = error.message.replace('pass image_size=(width, height)', 'give the image size')
        raise ValueError(f'image {converted.image!r}: YOLO needs its size: {advice}') from None
