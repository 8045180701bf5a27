# SPDX-License-Identifier: Apache-2.0
"""Which parameter or remap gives a node its input, and what helps if messages are lost."""

from __future__ import annotations

from obbhbb_ros.wire.layouts import INPUT_TYPES
from obbhbb_ros.wire.layouts import InputType

_COMPRESSED = '/compressed'
# Bytes from which Fast DDS loses a best-effort message whole, with its default shared memory.
_LARGE = 500_000
# Topics that the nodes of this package publish, with types that they also read.
_MADE = (
    'boxes',
    'crop_regions',
    'crop_sources',
    'chip/camera_info',
    'chip/compressed',
    'chip/detections',
    'overlay/compressed',
    'tracked_detections',
)


def advice_on_type(topic: str, kind: InputType | None, read: str, carried: str) -> str:
    """
    Say how a node reads a topic that carries another type of message.

    Parameters
    ----------
    topic : str
        Full name of the topic.
    kind : InputType or None
        The type that is read, if the parameter `input_type` decides.
    read, carried : str
        Names of the message types without their packages.

    Returns
    -------
    str
        A request to the operator.
    """
    other = INPUT_TYPES.get(carried)
    if kind is not None and other is not None:
        remap = '' if other.topic == kind.topic else f' and remap {other.topic} to {topic}'
        return f'set input_type to {carried}{remap}'
    if (read, carried) == ('Image', 'CompressedImage'):
        base = topic.removesuffix(_COMPRESSED)
        return f'set image_transport to compressed, which reads {base}{_COMPRESSED}' + (
            f', and remap image to {base}' if base != topic else ''
        )
    if (read, carried) == ('CompressedImage', 'Image'):
        return 'set image_transport to raw, and remap image to this topic'
    return f'remap it to a topic that carries {read}'


def may_be_meant(topic: str, candidate: str) -> bool:
    """
    Return whether an input may be meant for a topic, which an output of our nodes is not.

    Parameters
    ----------
    topic : str
        Name of the input, before namespace and remaps.
    candidate : str
        Full name of a topic that carries its type of message.

    Examples
    --------
    >>> may_be_meant('detections', '/boxes'), may_be_meant('boxes', '/left/boxes')
    (False, True)
    """
    return not any(candidate.endswith(f'/{made}') for made in _MADE if made != topic)


def advice_on_silence(topic: str, carriers: dict[str, str]) -> str:
    """
    Say which other topics a node might read.

    Parameters
    ----------
    topic : str
        Full name of the topic on which nobody publishes.
    carriers : dict of str
        Names of other topics to the names of their message types: those of the type that is read,
        and those of images.

    Returns
    -------
    str
        Advice that begins with a semicolon; empty if there is none.
    """
    compressed = f'{topic}{_COMPRESSED}'
    if carriers.get(compressed) == 'CompressedImage':
        return f'; set image_transport to compressed to read {compressed}'
    if carriers.get(topic.removesuffix(_COMPRESSED)) == 'Image' and topic.endswith(_COMPRESSED):
        return f'; set image_transport to raw to read {topic.removesuffix(_COMPRESSED)}'
    return f'; remap it to {" or ".join(sorted(carriers)[:3])}?' if carriers else ''


def advice_on_loss(
    topic: str, depth: int, is_reliable: bool, is_overridden: bool, largest: int
) -> str:
    """
    Say what helps if the middleware loses messages.

    Parameters
    ----------
    topic : str
        Full name of the topic.
    depth : int
        Depth of the queue of the subscription.
    is_reliable, is_overridden : bool
        Whether the subscription is reliable, and whether an override decides that.
    largest : int
        Size of the largest message that has arrived, bytes; 0 for none.

    Returns
    -------
    str
        Advice that names no remedy that is in force.
    """
    override = f'qos_overrides.{topic}.subscription'
    if is_reliable:
        return (
            'they come faster than the node reads them; '
            f'{override}.depth above {depth} bridges bursts'
        )
    remedy = (
        f'remove {override}.reliability'
        if is_overridden
        else 'a publisher on it is best effort; a reliable one loses none'
    )
    # If nothing arrives on a topic, the size of its messages is not known.
    if 0 < largest < _LARGE:
        return (
            f'messages of up to {largest} bytes, pushed out by others or unread in time: {remedy}'
        )
    return (
        f'{remedy}; messages over {_LARGE / 1e6:g} MB otherwise need the DDS profile '
        f'config/fastdds_large.xml at the publisher'
    )
