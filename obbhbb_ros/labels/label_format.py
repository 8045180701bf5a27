# SPDX-License-Identifier: Apache-2.0
"""What a label format is: how to recognise, read and write its files."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field
from pathlib import Path

from obbhbb_ros.labels.image_labels import ImageBoxes
from obbhbb_ros.labels.image_labels import ImageLabels
from obbhbb_ros.labels.label_file import LabelFile
from obbhbb_ros.labels.losses import Part

BoxWriter = Callable[[Path, list[ImageBoxes]], None]


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
        ``sniff(head)`` returns whether the beginning of a file fits this format and no other one
        with the same suffix.
    read : callable
        ``read(file)`` returns the images of a `LabelFile`. It passes malformed records to its
        `on_error`, and raises its `error` if the file as a whole cannot be used.
    write : callable or None
        ``write(path, images)`` writes a list of checked `ImageLabels`: to a file or, in formats
        with one file per image, to a folder. It raises ValueError, before it writes anything,
        for names and values that the format cannot hold. None if the format is only read.
    write_boxes : callable or None
        The same for a list of `ImageBoxes`. None if the format is not written with these.
    variants : mapping of str to callable
        Other ways to write boxes, for tools that need them.
    holds : collection of Part
        What `write_boxes` writes besides boxes and classes.
    reserved : collection of str
        Names, in lower case, that a property cannot have, since the format has them itself.
    longest_name : int or None
        How many bytes of the name of a property it holds; None for all.
    problem : callable
        ``problem(head)`` says why the beginning of a file, though it may fit, means something else;
        '' if it does not. It then holds for all files of a folder.
    needs_sizes : bool
        Whether images with boxes cannot be written without their size, at which boxes are cut.
    in_pixels : bool
        Whether what is written is in the pixels of an image, and nowhere else.
    spread : bool
        Whether the boxes of an image may be in several files.
    """

    name: str
    suffixes: tuple[str, ...]
    summary: str
    sniff: Callable[[str], bool]
    read: Callable[[LabelFile], Iterable[ImageLabels]]
    write: Callable[[Path, list[ImageLabels]], None] | None = None
    write_boxes: BoxWriter | None = None
    variants: Mapping[str, BoxWriter] = field(default_factory=dict)
    holds: Collection[Part] = ()
    reserved: Collection[str] = ()
    longest_name: int | None = None
    problem: Callable[[str], str] = lambda _: ''
    needs_sizes: bool = False
    in_pixels: bool = False
    spread: bool = False

    def box_writer(self, variant: str | None) -> BoxWriter:
        """Return `write_boxes` or the variant of that name; ValueError if there is none."""
        writer = self.write_boxes if variant is None else self.variants.get(variant)
        if writer is None:
            known = ', '.join(self.variants) or 'none'
            raise ValueError(
                f'label format {self.name!r} has no variant {variant!r}: it has {known}'
            )
        return writer


def names(formats: Iterable[Format]) -> str:
    """List formats for a message: ``csv (.csv), dota (.txt)``."""
    return ', '.join(f'{entry.name} ({", ".join(entry.suffixes)})' for entry in formats)
