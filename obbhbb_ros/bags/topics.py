# SPDX-License-Identifier: Apache-2.0
"""The topics of a bag: which of them is converted, and how topics are added to a bag."""

from __future__ import annotations

from collections.abc import Collection
from collections.abc import Iterable
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from rosbags.interfaces import Connection
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.interfaces import Qos
from rosbags.interfaces import QosDurability
from rosbags.interfaces import QosHistory
from rosbags.interfaces import QosLiveliness
from rosbags.interfaces import QosReliability
from rosbags.interfaces import QosTime
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores
from rosbags.typesys import get_types_from_idl
from rosbags.typesys import get_types_from_msg
from rosbags.typesys import get_typestore

from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.layouts import InputType

OUTPUT_TYPE = 'vision_msgs/msg/Detection2DArray'
OUTPUT_HASH = 'RIHS01_214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968'
OUTPUTS = ('boxes', 'crop_regions')
# Topics of the nodes that hold no oriented boxes of images.
_MADE = tuple(f'/{name}' for name in (*OUTPUTS, 'crop_sources', 'chip/detections'))
_TRACKED = '/tracked_detections'
CAMERA_INFO_TYPE = 'sensor_msgs/msg/CameraInfo'
# The version of bags that Jazzy writes.
VERSION = 9
# The hash that ROS writes for an unknown type.
NO_HASH = 'RIHS00_' + 64 * '0'

_INPUT_TYPES = {f'{kind.package}/msg/{kind.name}': kind for kind in INPUT_TYPES.values()}
_FOREVER = QosTime(9223372036, 854775807)
_POLICIES = QosHistory.UNKNOWN, 0, QosReliability.RELIABLE, QosDurability.VOLATILE
# The QoS that the node offers, as rosbag2 writes it.
_QOS = Qos(*_POLICIES, _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER, False)


@dataclass(frozen=True)
class Topics:
    """
    The topics that a replay reads and writes.

    Attributes
    ----------
    detections : str
        Topic of the input.
    input_type : InputType
        Type of its messages.
    camera_info : str
        Topic that the size of the image is taken from.
    outputs : tuple of str
        Topics of the boxes and of the crop regions.
    """

    detections: str
    input_type: InputType
    camera_info: str
    outputs: tuple[str, ...]


def choose(connections: Collection[Connection], topic: str = '', camera_info: str = '') -> Topics:
    """
    Find the topic of oriented detections.

    Parameters
    ----------
    connections : collection of Connection
        The topics of the bag.
    topic : str
        The topic to convert; by default the only one that can be converted, or the one of
        `ship_tracker` instead of those beside it. Topics without messages count only if none has
        any.
    camera_info : str
        The topic of `sensor_msgs/CameraInfo`; `camera_info` beside the input by default.

    Returns
    -------
    Topics
        The topics of a node that runs in the namespace of the input.

    Raises
    ------
    ValueError
        If there is no such topic, or more than one; the message lists the candidates.
    """
    possible = {
        connection.topic: _INPUT_TYPES[connection.msgtype]
        for connection in connections
        if connection.msgtype in _INPUT_TYPES
    }
    if topic:
        topic = _absolute(topic)
        candidates = [topic] if topic in possible else []
    else:
        inputs = [name for name in possible if not name.endswith(_MADE)]
        candidates = _untracked_left_out(_empty_left_out(inputs, connections))
    if len(candidates) != 1:
        raise ValueError(_choice(connections, topic, candidates))
    detections = candidates[0]
    namespace = _namespace(detections)
    outputs = tuple(f'{namespace}/{name}' for name in OUTPUTS)
    if detections in outputs:
        raise ValueError(f'{detections} cannot be converted: the boxes would have the same name')
    _check_camera_info(connections, camera_info)
    return Topics(
        detections,
        possible[detections],
        _absolute(camera_info) if camera_info else f'{namespace}/camera_info',
        outputs,
    )


def _empty_left_out(topics: Sequence[str], connections: Iterable[Connection]) -> list[str]:
    """Leave out topics without messages; none if no topic has any, or the bag does not count."""
    filled = {connection.topic for connection in connections if connection.msgcount}
    return [topic for topic in topics if topic in filled] or list(topics)


def _untracked_left_out(topics: Sequence[str]) -> list[str]:
    """Leave out what stands beside a topic of `ship_tracker`, which has the ids of ships."""
    tracked = {_namespace(topic) for topic in topics if topic.endswith(_TRACKED)}
    return [
        topic for topic in topics if topic.endswith(_TRACKED) or _namespace(topic) not in tracked
    ]


def _namespace(topic: str) -> str:
    """Return the namespace of a topic."""
    return topic.rpartition('/')[0]


def _absolute(topic: str) -> str:
    """Write the name of a topic in full."""
    return '/' + topic.lstrip('/')


def _choice(connections: Collection[Connection], topic: str, candidates: Sequence[str]) -> str:
    """Explain why no topic could be chosen."""
    if candidates:
        return f'more than one topic can be converted, choose one by --topic: {_listed(candidates)}'
    topics = [f'{connection.topic} ({connection.msgtype})' for connection in connections]
    subject = f'{topic} is no topic' if topic else 'no topic'
    return f'{subject} that can be converted; the bag has {_listed(topics) or "no topics"}'


def _listed(names: Collection[str]) -> str:
    """List names in order."""
    return ', '.join(sorted(names))


def _check_camera_info(connections: Collection[Connection], topic: str) -> None:
    """Raise ValueError if the bag lacks the topic that the caller named."""
    infos = [
        connection.topic for connection in connections if connection.msgtype == CAMERA_INFO_TYPE
    ]
    if topic and _absolute(topic) not in infos:
        raise ValueError(
            f'{_absolute(topic)} is no topic of {CAMERA_INFO_TYPE}; the bag has '
            f'{_listed(infos) or "none"}'
        )


def add_topic(writer: Writer, connection: Connection) -> Connection:
    """Add a topic as it was in another bag."""
    definition, digest = _definition(connection)
    format_and_qos = connection.ext._asdict()
    return writer.add_connection(
        connection.topic, connection.msgtype, msgdef=definition, rihs01=digest, **format_and_qos
    )


def add_topics(writer: Writer, connections: Iterable[Connection]) -> dict[int, Connection]:
    """Add topics as they were in another bag, by their id there; equal ones are merged."""
    added: dict[int, Connection] = {}
    for source in connections:
        key = source.topic, source.msgtype, source.ext
        equal = (done for done in writer.connections if (done.topic, done.msgtype, done.ext) == key)
        added[source.id] = next(equal, None) or add_topic(writer, source)
    return added


def add_output(writer: Writer, topic: str, connections: Collection[Connection]) -> Connection:
    """Add a topic of boxes, with the definition of their type that the bag has, if any."""
    of_boxes = (connection for connection in connections if connection.msgtype == OUTPUT_TYPE)
    first = next((connection for connection in of_boxes if connection.msgdef.data), None)
    if first is None:
        return add_live_topic(writer, topic, OUTPUT_TYPE)
    return add_topic(writer, first._replace(topic=topic, ext=ConnectionExtRosbag2('cdr', [_QOS])))


def add_live_topic(writer: Writer, topic: str, msgtype: str) -> Connection:
    """Add a topic as if recorded from a node; its type is one of Jazzy or that of the boxes."""
    definition, digest = None, None
    if msgtype == OUTPUT_TYPE:
        folder = resources.files('obbhbb_ros.data')
        definition = (folder / 'Detection2DArray.msg').read_text(encoding='utf-8')
        digest = OUTPUT_HASH
    return writer.add_connection(
        topic,
        msgtype,
        typestore=get_typestore(Stores.ROS2_JAZZY),
        msgdef=definition,
        rihs01=digest,
        offered_qos_profiles=[_QOS],
    )


def _definition(connection: Connection) -> tuple[str, str]:
    """Return text and hash of a message type, as far as they can be found."""
    text: str = connection.msgdef.data
    if text and connection.digest:
        return text, connection.digest
    msgtype = connection.msgtype
    try:
        store = get_typestore(Stores.EMPTY if text else Stores.ROS2_JAZZY)
        if text:
            store.register(_parsed(connection))
        else:
            # Bags of Humble and older have no definitions.
            text, _ = store.generate_msgdef(msgtype, ros_version=2)
        return text, connection.digest or store.hash_rihs01(msgtype)
    # Any exception: the definition may be anything, and the messages are copied regardless.
    except Exception:
        return text, connection.digest or NO_HASH


def _parsed(connection: Connection) -> Any:
    """Parse the definition of a message type."""
    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.IDL:
        return get_types_from_idl(text)
    return get_types_from_msg(text, connection.msgtype)
