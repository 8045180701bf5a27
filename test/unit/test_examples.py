# SPDX-License-Identifier: Apache-2.0
"""The examples in docstrings run, and the main public names have some."""

import doctest
import pkgutil
from importlib import import_module
from pathlib import Path

import pytest

import obbhbb_ros
from obbhbb_ros import files
from obbhbb_ros.downlink import budget
from obbhbb_ros.downlink import chips
from obbhbb_ros.downlink import crops
from obbhbb_ros.downlink import joiner
from obbhbb_ros.downlink import merging
from obbhbb_ros.earth import ellipsoid
from obbhbb_ros.earth import pinhole
from obbhbb_ros.earth import placement
from obbhbb_ros.earth import pose
from obbhbb_ros.earth import pose_track
from obbhbb_ros.geometry import boxes
from obbhbb_ros.geometry import converter
from obbhbb_ros.geometry import methods

# By their text, as some modules need what is not installed everywhere.
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(obbhbb_ros.__path__, 'obbhbb_ros.')
    if not module.name.endswith('.__main__')
    and '>>> ' in Path(module.module_finder.find_spec(module.name).origin).read_text('utf-8')
)
WITH_EXAMPLES = (
    boxes.OrientedBoxes.from_corners,
    boxes.OrientedBoxes.from_polygons,
    boxes.OrientedBoxes.from_xywhr,
    ellipsoid.east_north_up,
    ellipsoid.first_hits,
    ellipsoid.to_ecef,
    ellipsoid.to_geodetic,
    pinhole.Pinhole,
    placement.place,
    pose.CameraPose,
    pose.Fix.from_message,
    pose_track.SampleTrack,
    converter.HullRule,
    converter.centers_and_extents,
    converter.convert,
    converter.convert_by_rule,
    converter.convert_with_diagnostics,
    converter.half_extents,
    converter.to_xyxy,
    files.replacing,
    methods.get_method,
    methods.shape_aware,
    methods.superellipse,
    budget.TokenBucket,
    chips.CodecSettings,
    chips.cut,
    chips.format_text,
    chips.pixel_format,
    chips.placed,
    crops.CropSettings,
    crops.plan_crops,
    merging.merge_regions,
    joiner.JoinerSide,
    joiner.StampCache,
)


@pytest.mark.parametrize('name', MODULES)
def test_the_examples_of_a_module_give_what_they_show(name) -> None:
    try:
        module = import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or '').startswith('obbhbb_ros'):
            raise
        pytest.skip(f'{error.name} is not installed')
    assert doctest.testmod(module).failed == 0


@pytest.mark.parametrize('public', WITH_EXAMPLES, ids=lambda public: public.__qualname__)
def test_the_main_names_have_examples(public) -> None:
    assert doctest.DocTestParser().get_examples(public.__doc__)
