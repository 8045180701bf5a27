# SPDX-License-Identifier: Apache-2.0
"""An image and its layers: which boxes are drawn."""

import io

import numpy as np
from cdr import Detection
from cdr import Hypothesis
from cdr import Message
from cdr import encode
from PIL import Image

from obbhbb_ros.geometry.input_frame import InputFrame
from obbhbb_ros.overlay.drawing import Style
from obbhbb_ros.overlay.overlay_frame import FrameSettings
from obbhbb_ros.overlay.overlay_frame import OverlayFrame
from obbhbb_ros.wire.detections import Detections
from obbhbb_ros.wire.image import WireImage

STYLE = Style(labels=False, legend=False, quality=100, line_width=1)
SETTINGS = FrameSettings({'boxes': '#ff0000'}, STYLE, InputFrame((0, 0)))


def detection(score, x):
    return Detection(results=(Hypothesis('ship', score),), bbox=(x, 20.0, 0.0, 10.0, 10.0))


def test_of_too_many_boxes_the_best_are_drawn_and_the_others_counted() -> None:
    image = WireImage((5, 0), 'camera', 'mono8', 60, 40, 60, False, memoryview(bytes(2400)))
    rows = [detection(0.2, 45.0), detection(float('nan'), 45.0)]
    rows += [detection(0.5, 15.0)] * 2000
    frame = OverlayFrame(
        image, {'boxes': Detections(encode(Message(detections=tuple(rows))))}, SETTINGS
    )
    assert frame.boxes_not_drawn == 2
    with Image.open(io.BytesIO(frame.picture().data)) as file:
        red = np.asarray(file)[..., 0] > 100
    assert red[:, :30].any()
    assert not red[:, 30:].any()
    assert len(frame.marker('boxes')) > len(encode(Message())) + 2002 * 8 * 24
