# SPDX-License-Identifier: Apache-2.0
"""The labels and boxes of images, label files and label formats."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Iterable
from collections.abc import Iterator
from collections.abc import Mapping
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from typing import Literal
from typing import NamedTuple
from typing import NoReturn
from typing import TypeAlias
from typing import TypeVar
from typing import get_args

import numpy as np
import numpy.typing as npt

from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import Conversion

FloatArray = npt.NDArray[np.float64]
ImageSize = tuple[int, int]

NO_REFERENCE = (float('nan'),) * 4
MIN_HULL_POINTS = 3
DIAGNOSTICS = ('length', 'width', 'theta', 't_x', 't_y', 'capped')

BowSource: TypeAlias = Literal['none', 'labels', 'first-edge']
BOW_SOURCES: tuple[BowSource, ...] = get_args(BowSource)

Value = float | bool | None
Item = TypeVar('Item')


class LabelError(ValueError):
    """
    A label file, or one record of it, that cannot be read.

    Attributes
    ----------
    path : Path
        The file or folder at fault.
    line : int or None
        Line of the record, counted from 1; None for the whole file.
    message : str
        What is wrong, without path and line.
    """

    def __init__(self, path: Path, line: int | None, message: str) -> None:
        super().__init__(path, line, message)
        self.path = path
        self.line = line
        self.message = message

    def __str__(self) -> str:
        """Return ``path:line: message``, as compilers write it."""
        place = f'{self.path}' if self.line is None else f'{self.path}:{self.line}'
        return f'{place}: {self.message}'


class FileError(LabelError):
    """A label file that cannot be used as a whole."""


OnError = Callable[[LabelError], None]


def raise_error(error: LabelError) -> NoReturn:
    """Raise the error: the default of `on_error`."""
    # Without the ValueError of the parser as its cause, which has the same message.
    raise error from None


@dataclass(frozen=True, eq=False)
class ImageLabels:
    """
    The labels of one image, in the order of the file.

    Attributes
    ----------
    image : str
        Image name without folder and suffix, or as the image column of a table has it.
    corners : FloatArray
        Corners of N oriented boxes in order around each box, shape (N, 4, 2), pixels.
    class_ids : tuple of str
        N classes.
    ids : tuple of str
        N instance ids, '' where the format has none.
    scores : FloatArray
        Shape (N,), 1.0 where the format has none.
    reference : FloatArray
        Reference axis-aligned boxes as xyxy, shape (N, 4), pixels; rows of NaN where none.
    hulls : tuple of (FloatArray or None)
        N hull polygons of shape (K, 2), pixels, or None.
    size : tuple of int or None
        Image width and height in pixels where known.
    source : Path
        The file the labels came from.
    bow : ndarray of bool or None
        Which labels say where the bow is, shape (N,): the first two corners are the bow end. None
        if none does.

    Raises
    ------
    ValueError
        If the fields do not agree on N or an array has another shape.
    """

    image: str
    corners: FloatArray
    class_ids: tuple[str, ...]
    ids: tuple[str, ...]
    scores: FloatArray
    reference: FloatArray
    hulls: tuple[FloatArray | None, ...]
    size: ImageSize | None
    source: Path
    bow: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Check that all fields have the same number of boxes."""
        count = len(self.class_ids)
        wanted = {
            'corners': (count, 4, 2),
            'scores': (count,),
            'reference': (count, 4),
            'bow': (count,),
        }
        for name, shape in wanted.items():
            values = getattr(self, name)
            got = shape if values is None else values.shape
            if got != shape:
                raise ValueError(f'{name} has shape {got}, not {shape} for {count} class_ids')
        for name, values in (('ids', self.ids), ('hulls', self.hulls)):
            if len(values) != count:
                raise ValueError(f'{name} has {len(values)} entries for {count} class_ids')

    def boxes(self, bow: BowSource = 'none') -> OrientedBoxes:
        """
        Return the oriented boxes.

        The bow is known where the labels say so (`labels`), at the first two corners of every box
        (`first-edge`), or nowhere (`none`). Where these are a long side it is not known.
        """
        if bow not in BOW_SOURCES:
            raise ValueError(f'bow must be one of {", ".join(BOW_SOURCES)}, not {bow!r}')
        if bow == 'labels' and self.bow is not None:
            return OrientedBoxes.from_corners(self.corners, bow=self.bow)
        return OrientedBoxes.from_corners(self.corners, bow=bow == 'first-edge')


class BoxRow(NamedTuple):
    """One axis-aligned box in Python numbers; a diagnostic that is not known is None."""

    xyxy: list[float]
    class_id: str
    id: str
    score: float
    diagnostics: Mapping[str, Value]


@dataclass(frozen=True, eq=False)
class ImageBoxes:
    """
    The axis-aligned boxes of one image, to be written.

    Attributes
    ----------
    xyxy : FloatArray
        x_min, y_min, x_max, y_max of N boxes, shape (N, 4), pixels.
    diagnostics : Conversion or None
        How the N boxes were computed; its `xyxy` and `valid` are not used.
    image, class_ids, ids, scores, size, source
        As in `ImageLabels`.

    Raises
    ------
    ValueError
        If the fields do not agree on N, or a box is not finite.
    """

    image: str
    xyxy: FloatArray
    class_ids: tuple[str, ...]
    ids: tuple[str, ...]
    scores: FloatArray
    size: ImageSize | None
    source: Path
    diagnostics: Conversion | None = None

    def __post_init__(self) -> None:
        """Check that all fields have the same number of boxes, and that these are finite."""
        count = len(self.class_ids)
        given = [len(self.ids), len(self.scores), len(self.xyxy)]
        if self.diagnostics is not None:
            given.append(len(self.diagnostics.length))
        if given != [count] * len(given) or self.xyxy.shape != (count, 4):
            raise ValueError(f'image {self.image!r}: fields do not agree on the number of boxes')
        if not (np.isfinite(self.xyxy).all() and np.isfinite(self.scores).all()):
            raise ValueError(f'image {self.image!r}: a box has a value that is not finite')

    def rows(self) -> Iterator[BoxRow]:
        """Go through the boxes, with the six diagnostics or with none."""
        names = () if self.diagnostics is None else DIAGNOSTICS
        columns = {name: getattr(self.diagnostics, name).tolist() for name in names}
        rows = zip(self.xyxy.tolist(), self.class_ids, self.ids, self.scores.tolist(), strict=True)
        for index, row in enumerate(rows):
            yield BoxRow(*row, {name: _known(values[index]) for name, values in columns.items()})


def _known(value: Value) -> Value:
    # Methods that touch no curve have no t_x: NaN, which JSON cannot hold.
    return None if value != value else value  # noqa: PLR0124


AnyImage = TypeVar('AnyImage', ImageLabels, ImageBoxes)


class Box(NamedTuple):
    """
    One record of a label file, as a format's parser returns it.

    `corners` holds x1 y1 … x4 y4, `reference` x1 y1 x2 y2, all in pixels. With `bow`, the first
    two corners are the bow end.
    """

    corners: Sequence[float]
    class_id: str
    id: str = ''
    score: float = 1.0
    reference: Sequence[float] = NO_REFERENCE
    hull: FloatArray | None = None
    bow: bool = False


@dataclass(frozen=True)
class LabelFile:
    """
    A label file that is being read.

    `image_size` is width and height of every image in pixels, as the caller gave it; `on_error`
    gets a LabelError for each malformed record, which is left out.
    """

    path: Path
    image_size: ImageSize | None
    on_error: OnError

    def error(self, message: str, line: int | None = None) -> FileError:
        """Make the error to raise if the file as a whole cannot be used."""
        return FileError(self.path, line, message)

    def parse_each(
        self, records: Iterable[tuple[int | None, str, Any]], parse: Callable[[Any], Item]
    ) -> Iterator[tuple[int | None, str, Item]]:
        """
        Parse records one by one, and report and skip those for which `parse` raises ValueError.

        Records come and go with their line, where known, and the start of an error message.
        """
        for line, place, record in records:
            try:
                item = parse(record)
            except ValueError as error:
                self.on_error(LabelError(self.path, line, f'{place}{error}'))
            else:
                yield line, place, item

    def image(self, name: str, boxes: Sequence[Box], size: ImageSize | None = None) -> ImageLabels:
        """Gather the boxes of an image; `size` is used if the caller gave no `image_size`."""
        return assemble(name, boxes, self.image_size or size, self.path)

    def images(self, boxes: Mapping[str, Sequence[Box]]) -> Iterator[ImageLabels]:
        """Gather the boxes of images by name."""
        return (self.image(name, each) for name, each in boxes.items())


def assemble(image: str, boxes: Sequence[Box], size: ImageSize | None, source: Path) -> ImageLabels:
    """Gather the N boxes of an image into arrays of N rows, 0 included."""
    return ImageLabels(
        image=image,
        corners=np.array([box.corners for box in boxes], np.float64).reshape(-1, 4, 2),
        class_ids=tuple(box.class_id for box in boxes),
        ids=tuple(box.id for box in boxes),
        scores=np.array([box.score for box in boxes], np.float64),
        reference=np.array([box.reference for box in boxes], np.float64).reshape(-1, 4),
        hulls=tuple(box.hull for box in boxes),
        size=size,
        source=source,
        bow=np.array([box.bow for box in boxes]) if any(box.bow for box in boxes) else None,
    )


@dataclass(frozen=True)
class Format:
    """
    A label format.

    Attributes
    ----------
    name : str
        Name on the command line.
    suffixes : tuple of str
        File suffixes, lower case with the dot.
    summary : str
        One line for help texts.
    sniff : callable
        ``sniff(head)`` returns whether the beginning of a file fits this format, and no other with
        the same suffix.
    read : callable
        ``read(file)`` returns the images of a `LabelFile`. It passes malformed records to its
        `on_error`, and raises its `error` if the file as a whole cannot be used.
    write : callable or None
        ``write(path, images)`` writes a list of checked `ImageLabels`: to a file or, in formats
        with one file per image, to a folder. It raises ValueError, before it writes anything,
        for names and values that the format cannot hold. None if the format is only read.
    write_boxes : callable or None
        The same for a list of `ImageBoxes`. None if the format is not written with these.
    holds_diagnostics : bool
        Whether `write_boxes` writes the diagnostics of a conversion.
    """

    name: str
    suffixes: tuple[str, ...]
    summary: str
    sniff: Callable[[str], bool]
    read: Callable[[LabelFile], Iterable[ImageLabels]]
    write: Callable[[Path, list[ImageLabels]], None] | None = None
    write_boxes: Callable[[Path, list[ImageBoxes]], None] | None = None
    holds_diagnostics: bool = False


def names(formats: Iterable[Format]) -> str:
    """List formats for a message: ``csv (.csv), dota (.txt)``."""
    return ', '.join(f'{each.name} ({", ".join(each.suffixes)})' for each in formats)
