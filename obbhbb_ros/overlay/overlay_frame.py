# SPDX-License-Identifier: Apache-2.0
"""
An image and its layers, as a picture, as markers and as annotations. No ROS in here.

    frame = OverlayFrame(image, {'boxes': boxes}, settings)
    jpeg = frame.picture().data
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obbhbb_ros.colors import DASHED_LAYERS
from obbhbb_ros.colors import LAYER_COLORS
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.overlay.annotating import Annotations
from obbhbb_ros.overlay.annotating import annotate
from obbhbb_ros.overlay.drawing import Layer
from obbhbb_ros.overlay.drawing import Picture
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.overlay.drawing import draw
from obbhbb_ros.overlay.drawing import lines
from obbhbb_ros.overlay.lettering import Labels
from obbhbb_ros.overlay.lettering import label_text
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.image import WireImage
from obbhbb_ros.wire.image_marker import line_list

_NOWHERE = np.empty((0, 4, 2))
# A thousand boxes take a sixth of a second, and nobody can tell so many apart.
_MAX_DRAWN = 2000
_NUMBERS = {layer: number for number, layer in enumerate(LAYER_COLORS)}


@dataclass(frozen=True)
class FrameSettings:
    """
    How an image and its layers are drawn.

    Attributes
    ----------
    colors : mapping of str to str
        The layers that are drawn and their colours, '#rrggbb', the first at the bottom.
    style : Style
        Style of the picture.
    input_frame : InputFrame
        Coordinates of the detections.
    """

    colors: Mapping[str, str]
    style: Style
    input_frame: InputFrame


class OverlayFrame:
    """
    An image and the layers that came with it, drawn under one snapshot of the settings.

    Parameters
    ----------
    image : WireImage
        The image.
    layers : mapping of str to Detections
        The layers that came with it, by their names in `LAYER_COLORS`.
    settings : FrameSettings
        The settings.
    """

    def __init__(
        self, image: WireImage, layers: Mapping[str, Detections], settings: FrameSettings
    ) -> None:
        self.image = image
        self._settings = settings
        self._layers = {layer: layers[layer] for layer in settings.colors if layer in layers}

    @property
    def missing(self) -> list[str]:
        """The layers that did not come."""
        return [layer for layer in self._settings.colors if layer not in self._layers]

    def frame_ids(self) -> dict[str, str]:
        """Return the frame id of each layer that came."""
        return {layer: detections.frame_id for layer, detections in self._layers.items()}

    @property
    def boxes_not_drawn(self) -> int:
        """Number of boxes that are not finite, or empty, or more than a picture shows."""
        return sum(
            int(np.isnan(corners).any(axis=(1, 2)).sum()) for corners in self._drawn.values()
        )

    def picture(self) -> Picture:
        """
        Draw the picture.

        Raises
        ------
        obbhbb_ros.overlay.drawing.OverlayError
            If the image cannot be drawn on.
        """
        layers = [self._layer(layer) for layer in self._drawn]
        return draw(self.image, layers, self._labels(), self._settings.style)

    def annotations(self) -> Annotations:
        """List lines and texts; a layer that did not come has lines without points."""
        layers = [self._layer(layer) for layer in self._settings.colors]
        size = self.image.width, self.image.height
        return annotate(size, layers, self._labels(), self._settings.style)

    def marker(self, layer: str) -> bytes:
        """Write a layer as a serialized marker; a layer that did not come has no lines."""
        image, settings = self.image, self._settings
        return line_list(
            image.stamp,
            image.frame_id,
            (layer, _NUMBERS[layer]),
            lines(self._corners.get(layer, _NOWHERE)),
            settings.colors[layer],
            settings.style.line_width_for((image.width, image.height)),
        )

    @cached_property
    def _corners(self) -> dict[str, FloatArray]:
        """Corners, (N, 4, 2), of each layer, NaN where a box cannot be drawn."""
        size, settings = (self.image.width, self.image.height), self._settings
        corners = {}
        for layer, detections in self._layers.items():
            frame = settings.input_frame if layer == 'detections' else InputFrame((0, 0))
            boxes = frame.oriented_boxes(detections.xywhr(), detections.polygons, size)
            corners[layer] = np.where(boxes.valid[:, None, None], boxes.corners, np.nan)
        return corners

    @cached_property
    def _drawn(self) -> dict[str, FloatArray]:
        """The same, of the 2000 boxes with the best scores in each layer, NaN for the others."""
        drawn = dict(self._corners)
        for layer, corners in self._corners.items():
            if len(corners) > _MAX_DRAWN:
                # NaN comes last.
                order = np.argsort(-self._layers[layer].scores(), kind='stable')
                drawn[layer] = corners.copy()
                drawn[layer][order[_MAX_DRAWN:]] = np.nan
        return drawn

    def _layer(self, layer: str) -> Layer:
        """Say how a layer is drawn."""
        return Layer(
            self._settings.colors[layer],
            self._drawn.get(layer, _NOWHERE),
            title=layer.replace('_', ' '),
            dashed=layer in DASHED_LAYERS,
        )

    def _labels(self) -> Labels | None:
        """Write class and score of the detections, else of the boxes, else of the crop regions."""
        for layer in reversed(LAYER_COLORS):
            if layer in self._layers:
                detections = self._layers[layer]
                scores = detections.scores()
                texts = list(map(label_text, detections.class_ids(), scores.tolist()))
                return Labels(self._settings.colors[layer], self._drawn[layer], texts, scores)
        return None
