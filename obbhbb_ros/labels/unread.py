# SPDX-License-Identifier: Apache-2.0
"""What a file is that no format reads: the error says it, by the name of its tool if known."""

from __future__ import annotations

import re
from collections.abc import Callable
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

from obbhbb_ros.labels.documents import json_paths
from obbhbb_ros.labels.text import SHOWN
from obbhbb_ros.labels.text import describe_text
from obbhbb_ros.labels.text import is_index
from obbhbb_ros.labels.text import is_normalised
from obbhbb_ros.labels.text import is_number
from obbhbb_ros.labels.yolo_lines import SKEW
from obbhbb_ros.labels.yolo_lines import skew

MOT_FIELDS = (9, 10)
# Frame, track, class, height and width of the image; then a mask.
MOTS_NUMBERS = 5
KITTI_FIELDS = (15, 16)
UCAS_AOD_FIELDS = 13
YOLO_FIELDS = (9, 10, 11)
THREE_POINT_FIELDS = (7, 8)
# The first element, behind declaration and comments.
ROOT = re.compile(r'<([^\s!?/>]+)')
PADDLE_OCR = re.compile(r'[^\t\n]+\t\[\{"transcription"')
# The last lines of the head may be cut off.
LINES = 5


@dataclass(frozen=True)
class UnreadFormat:
    """
    A format that is not read.

    Attributes
    ----------
    name : str
        What the file is, for a message.
    suffixes : tuple of str
        File suffixes, lower case with the dot.
    sniff : callable
        ``sniff(head)`` returns whether the beginning of a file is in this format.
    advice : str
        What to do instead.
    """

    name: str
    suffixes: tuple[str, ...]
    sniff: Callable[[str], bool]
    advice: str

    @property
    def message(self) -> str:
        """What the file is, that it is not read, and what to do."""
        return f'{self.name}, which is not read: {self.advice}'


def unread_format(suffix: str, head: str) -> UnreadFormat | None:
    """Return the unread format that the beginning of a file has, if any."""
    fitting = (entry for entry in UNREAD if suffix in entry.suffixes and entry.sniff(head))
    return next(fitting, None)


def describe(head: str) -> str:
    """Say what the beginning of a file that no format fits looks like."""
    begin = head.lstrip()
    if begin.startswith(('{', '[')):
        return _describe_json(head)
    if (root := ROOT.search(begin)) is not None and begin.startswith('<'):
        return f'XML with the root <{root[1][:SHOWN]}>'
    return describe_text(head)


def _describe_json(head: str) -> str:
    paths = json_paths(head)
    for start, what in (('{', 'a JSON object'), ('[{', 'a JSON array of objects')):
        if start in paths:
            inner = (path.removeprefix(start) for path in paths if path.startswith(start))
            members = sorted(name for name in inner if name and not set(name) & set('{['))
            return f'{what} with {", ".join(members)[:SHOWN] or "no members"}'
    return 'a JSON array'


def _json(name: str, *paths: str, advice: str = 'export as COCO') -> UnreadFormat:
    """Recognise JSON that has all `paths`, see `json_paths`."""
    return UnreadFormat(name, ('.json',), lambda head: json_paths(head).issuperset(paths), advice)


def _xml(name: str, pattern: str, advice: str = 'export as CVAT XML or COCO') -> UnreadFormat:
    return UnreadFormat(name, ('.xml',), partial(_matches, re.compile(pattern)), advice)


def _matches(pattern: re.Pattern[str], head: str) -> bool:
    return pattern.search(head) is not None


def _text(name: str, is_line: Callable[[str], bool], advice: str) -> UnreadFormat:
    return UnreadFormat(name, ('.txt',), partial(_all_lines, is_line), advice)


def _all_lines(is_line: Callable[[str], bool], head: str) -> bool:
    lines = [line for line in head.splitlines() if line.strip()][:LINES]
    return bool(lines) and all(map(is_line, lines))


def _is_mot(line: str) -> bool:
    fields = line.split(',')
    if len(fields) not in MOT_FIELDS or not _are_numbers(fields):
        return False
    frame, track, _, _, _, _, considered, class_id = map(float, fields[:8])
    whole = all(value.is_integer() for value in (frame, track, considered, class_id))
    return whole and frame >= 1 and considered in {-1.0, 0.0, 1.0} and float(fields[8]) <= 1.0


def _is_mots(line: str) -> bool:
    fields = line.split(maxsplit=MOTS_NUMBERS)
    return (
        len(fields) > MOTS_NUMBERS
        and all(is_index(field.removeprefix('-')) for field in fields[:MOTS_NUMBERS])
        and not is_number(fields[-1].split()[0])
    )


def _is_semantic(head: str) -> bool:
    paths = json_paths(head)
    masks = {'[{file_name', '[{category_id', '[{segmentation'}
    return masks <= paths and paths.isdisjoint({'[{score', '[{image_id', '[{bbox'})


def _is_kitti(line: str) -> bool:
    fields = line.split()
    return len(fields) in KITTI_FIELDS and not is_number(fields[0]) and _are_numbers(fields[1:])


def _is_ucas_aod(line: str) -> bool:
    fields = line.split()
    return (
        len(fields) == UCAS_AOD_FIELDS
        and _are_numbers(fields)
        and not is_normalised(map(float, fields[1:]))
    )


def _is_yolo_in_pixels(line: str) -> bool:
    fields = line.replace(',', ' ').split()
    if len(fields) not in YOLO_FIELDS or not _are_numbers(fields) or not is_index(fields[0]):
        return False
    numbers = list(map(float, fields[:9]))
    return not is_normalised(numbers[1:]) and skew(numbers[1:]) <= SKEW < skew(numbers[:8])


def _is_three_points(line: str) -> bool:
    fields = line.split()
    if len(fields) not in THREE_POINT_FIELDS or not _are_numbers(fields):
        return False
    tracked = len(fields) == THREE_POINT_FIELDS[0] and is_index(fields[-1])
    return is_index(fields[0]) and is_normalised(map(float, fields[1:7])) and not tracked


def _are_numbers(fields: Iterable[str]) -> bool:
    return all(map(is_number, fields))


def _any(head: str) -> bool:
    return True


def _header(name: str, *columns: str, advice: str = 'export as COCO') -> UnreadFormat:
    """Recognise a CSV table by columns that its first line has."""
    return UnreadFormat(name, ('.csv',), partial(_has_columns, set(columns)), advice)


def _has_columns(columns: set[str], head: str) -> bool:
    return columns.issubset(head.partition('\n')[0].strip().lstrip('#').split(','))


LINES_ADVICE = 'write one JSON document, as COCO or GeoJSON has it'
SAVE_TXT = 'it does not name the image: write it with save_txt'
INSTANCES = 'it does not tell ships apart: use the instances, as coco_instances_results.json'
PICKLE_ADVICE = 'it can run any code: write JSON, as coco_instances_results.json of Detectron2'
OWN_CODE = 'write its corners as DOTA or CSV'
UNREAD = (
    _json('Segment Anything (SA-1B) JSON', '{image{', '{annotations['),
    _json('SODA-A JSON', '{images{', '{annotations[', advice='write its poly as segmentation'),
    _json('JSON of Ultralytics results', '[{box{', '[{confidence', advice=SAVE_TXT),
    _json('CreateML JSON', '[{annotations[{coordinates'),
    _json('VGG Image Annotator JSON', '{_via_img_metadata{'),
    UnreadFormat(
        'VGG Image Annotator JSON',
        ('.json',),
        lambda head: '"shape_attributes"' in head,
        'export as COCO',
    ),
    _json('Supervisely JSON', '{objects[', '{size{'),
    _json('Dataloop JSON', '{annotations[', '{filename'),
    _json('Lightly JSON', '{predictions[', '{file_name'),
    _json('FiftyOne JSON', '{samples['),
    _json('V7 Darwin JSON', '{item{', '{annotations['),
    _json('SuperAnnotate JSON', '{instances[', '{metadata{'),
    _json('Grounding DINO (ODVG) JSON', '{detection{instances['),
    _json('COCO panoptic JSON', '{annotations[{segments_info[', advice='export its instances'),
    UnreadFormat('JSON of semantic segmentation', ('.json',), _is_semantic, INSTANCES),
    UnreadFormat('a pickle of Python', ('.pkl', '.pickle', '.pth', '.pt'), _any, PICKLE_ADVICE),
    _json('VoTT JSON', '{asset{', '{regions['),
    _xml('LabelMe XML', r'<(imagesize|sourceAnnotation|pt)>'),
    _xml('KML', r'<kml[ >]', 'convert to GeoJSON'),
    _xml('GML', r'<\w+:FeatureCollection[ >]', 'convert to GeoJSON'),
    UnreadFormat('KML', ('.kml', '.kmz'), _any, 'convert to GeoJSON'),
    UnreadFormat('GML', ('.gml',), _any, 'convert to GeoJSON'),
    UnreadFormat('MapInfo', ('.tab', '.mif'), _any, 'convert to GeoJSON or GeoPackage'),
    UnreadFormat('Feather', ('.feather',), _any, 'write it as CSV'),
    UnreadFormat('JSON lines', ('.jsonl', '.ndjson', '.geojsonl', '.geojsons'), _any, LINES_ADVICE),
    _header('Open Images CSV', 'ImageID', 'LabelName', 'XMin'),
    _header('VGG Image Annotator CSV', 'region_shape_attributes'),
    _header('CSV of Ultralytics results', 'class', 'confidence', 'box', advice=SAVE_TXT),
    UnreadFormat(
        'labelImg_OBB text', ('.txt',), lambda head: head.lstrip().startswith('YOLO_OBB'), OWN_CODE
    ),
    UnreadFormat(
        'PaddleOCR text', ('.txt',), partial(_matches, PADDLE_OCR), 'export as DOTA or COCO'
    ),
    _text('MOTS text', _is_mots, 'export its masks as COCO'),
    _text('MOT ground truth', _is_mot, 'it has upright boxes and tracks: write them as CSV'),
    _text('KITTI text', _is_kitti, 'it has upright boxes: write them as YOLO'),
    _text('YOLO-OBB in pixels', _is_yolo_in_pixels, 'divide the corners by the size of the image'),
    _text('YOLO of three points, or of a box and a key point', _is_three_points, OWN_CODE),
    _text('UCAS-AOD text', _is_ucas_aod, OWN_CODE),
)
