# SPDX-License-Identifier: Apache-2.0
"""
What planning and cutting cost, without ROS.

`python test/benchmarks/crops.py` prints medians.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from obbhbb_ros.downlink.chips import CodecSettings
from obbhbb_ros.downlink.chips import cut
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.downlink.chips import pixel_format
from obbhbb_ros.downlink.chips import placed
from obbhbb_ros.downlink.chips import view_of
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.downlink.crops import plan_crops
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.text_tables import text_table
from obbhbb_ros.wire.image import read_image

SIDE = 4096
MERGE = CropSettings(merge_max_size=256)
PLANS = (
    ('100 boxes', 100, SIDE, CropSettings()),
    ('1000 boxes', 1000, SIDE, CropSettings()),
    ('100, merged', 100, SIDE, MERGE),
    ('1000, merged', 1000, SIDE, MERGE),
    (
        '1000, merged, multiples of 16, max_pixels',
        1000,
        SIDE,
        CropSettings(merge_max_size=256, multiple_of=16, max_pixels=10**6),
    ),
    ('1000 in 1500 x 1500, merged', 1000, 1500, MERGE),
    ('1000 in 640 x 640, merged', 1000, 640, MERGE),
)


def milliseconds(work: Callable[[], Any], rounds: int) -> tuple[float, float]:
    """Return the median and the minimum of how long something takes."""
    times = []
    for _ in range(rounds):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times)), 1e3 * min(times)


def boxes(count: int, side: int) -> tuple[FloatArray, FloatArray]:
    """Scatter boxes of 20 to 200 pixels a side over an image."""
    random = np.random.default_rng(count)
    center = random.uniform(0, side, (count, 2))
    reach = random.uniform(10, 100, (count, 2))
    return np.hstack((center - reach, center + reach)), random.uniform(size=count)


def planning() -> str:
    """Measure plans."""
    rows = []
    for name, count, side, settings in PLANS:
        xyxy, scores = boxes(count, side)
        plan = partial(plan_crops, xyxy, scores, (side, side), settings)
        median, minimum = milliseconds(plan, 200)
        rows.append((name, f'{median:.2f}', f'{minimum:.2f}', str(len(plan().regions))))
    return text_table(('plan', 'median [ms]', 'minimum [ms]', 'regions'), rows)


def cutting() -> str:
    """Measure extraction from a frame as it comes from the middleware."""
    pixels = np.random.default_rng(0).integers(0, 2**16, (SIDE, SIDE)).astype('<u2')
    message = Image(
        height=SIDE,
        width=SIDE,
        encoding='mono16',
        step=2 * SIDE,
        data=array('B', pixels.tobytes()),
    )
    data = serialize_message(message)
    regions = plan_crops(*boxes(100, SIDE), (SIDE, SIDE), CropSettings()).regions.tolist()
    layout = pixel_format('mono16', 'png')

    def extract() -> list[Any]:
        view = view_of(read_image(data))
        places = (placed(tuple(region), (SIDE, SIDE), layout) for region in regions)
        return [cut(view, place, layout) for place in places if place]

    assert np.shares_memory(view_of(read_image(data)), np.frombuffer(data, np.uint8))
    chips = extract()
    rows = [('extract', *map('{:.2f}'.format, milliseconds(extract, 50)))]
    for codec in (CodecSettings('png'), CodecSettings('jpeg2000', lossless=True)):
        times = milliseconds(lambda: [encode(chip, codec) for chip in chips], 3)  # noqa: B023
        rows.append((f'encode, {codec.codec}', *map('{:.0f}'.format, times)))
    megapixels = sum(chip.size for chip in chips) / 1e6
    head = f'100 chips, {megapixels:.2f} Mpx of {SIDE} x {SIDE} mono16'
    return text_table((head, 'median [ms]', 'minimum [ms]'), rows)


def main() -> None:
    """Measure and print."""
    print(planning(), cutting(), sep='\n\n')


if __name__ == '__main__':
    main()
