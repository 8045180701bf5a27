# SPDX-License-Identifier: Apache-2.0
"""The size of the image of a message, and doubts about the camera that gave it."""

from __future__ import annotations

from obbhbb_ros.downlink.cameras import CameraChoice
from obbhbb_ros.pipeline.outcome import OTHER_FRAME
from obbhbb_ros.pipeline.outcome import Finding
from obbhbb_ros.pipeline.plausibility import frames_text
from obbhbb_ros.wire.camera import WireCamera


def known_image_size(
    size: tuple[int, int], camera: CameraChoice[WireCamera] | None
) -> tuple[tuple[int, int] | None, dict[str, int]]:
    """
    Return the size of the image, None if it is unknown, and count the camera that gave it.

    Parameters
    ----------
    size : tuple of int
        Width and height from the parameters, pixels; 0 where the camera decides.
    camera : CameraChoice of WireCamera, optional
        The camera of the image.
    """
    width, height = size
    used = {}
    if camera is not None and not (width and height):
        used[camera.key] = 1
        seen = camera.camera.image_size
        width, height = width or seen[0], height or seen[1]
    return ((width, height) if width and height else None), used


def no_size_complaint(consequences: list[str]) -> dict[str, str]:
    """Say what follows from an unknown size of the image."""
    return {
        'no image size': f'{", ".join(consequences)} without the size of the image: set '
        'image_width and image_height, or publish camera_info, or remap camera_info to its topic'
    }


def camera_doubt(frame_id: str, camera: CameraChoice[WireCamera] | None) -> Finding:
    """
    Count detections of another frame than the camera that gave the size, and complain by kind.

    Parameters
    ----------
    frame_id : str
        Frame of the detections.
    camera : CameraChoice of WireCamera, optional
        The camera, if it gave the size of the image.
    """
    seen = ('camera_info', camera.camera.frame_id if camera else '')
    text = frames_text(('detections', frame_id), seen)
    if not text:
        return Finding({})
    return Finding({'frame_ids_differ.camera_info': 1}, {OTHER_FRAME: text})
