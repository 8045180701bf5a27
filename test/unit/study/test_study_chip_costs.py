# SPDX-License-Identifier: Apache-2.0
"""What chips cost by method, on the synthetic harbour and on images beside their labels."""

import re
import shutil
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from obbhbb_ros.cli import main
from obbhbb_ros.downlink.chips import encode
from obbhbb_ros.downlink.chips import to_8_bits
from obbhbb_ros.downlink.crops import CropSettings
from obbhbb_ros.labels import image_files
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels import write_labels
from obbhbb_ros.labels.image_files import find_images
from obbhbb_ros.labels.image_files import load_image
from obbhbb_ros.labels.image_files import opened_image
from obbhbb_ros.study.chip_costs import ENCODERS
from obbhbb_ros.study.chip_costs import RULES
from obbhbb_ros.study.chip_costs import chip_costs
from obbhbb_ros.study.chip_costs import render
from obbhbb_ros.study.harbour import harbour

SMALL = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)


def test_the_picture_is_the_same_every_time_and_as_large_as_the_labels_say() -> None:
    labels = harbour()
    picture = render(labels)
    assert picture.shape == (labels.size[1], labels.size[0], 3)
    np.testing.assert_array_equal(picture, render(labels))


def test_costs_are_those_of_the_chips_and_hulls_are_lost_only_by_tight_boxes() -> None:
    labels = harbour()
    pixels = render(labels)
    costs = chip_costs([(labels, pixels)], CropSettings())
    assert list(costs) == list(RULES)
    assert {cost.chips for cost in costs.values()} == {len(labels.class_ids)}
    outer, tight = costs['outer'], costs['superellipse']
    assert outer.hull_lost == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < tight.hull_lost < 0.02 * tight.hull
    assert tight.pixels < outer.pixels
    assert all(tight.sizes[codec] < outer.sizes[codec] for codec in ENCODERS)


def test_padding_out_to_the_whole_image_costs_the_whole_image_and_loses_nothing() -> None:
    labels = harbour()
    pixels = render(labels)[:64, :96]
    costs = chip_costs([(labels, pixels)], CropSettings(padding_px=5000.0))
    for cost in costs.values():
        assert cost.hull_lost == pytest.approx(0.0, abs=1e-6)
        assert cost.pixels == cost.chips * 64 * 96
        for codec, settings in ENCODERS.items():
            assert cost.sizes[codec] == cost.chips * len(encode(pixels, settings))


@pytest.fixture
def folder(tmp_path):
    """Labels of an image, and the image beside them."""
    labels = harbour()
    write_labels(tmp_path / 'harbour.csv', [labels])
    Image.fromarray(render(labels)).save(tmp_path / 'harbour.png')
    return tmp_path


def test_the_command_prints_a_row_a_method_and_draws(folder, tmp_path, capsys) -> None:
    assert main(['chips', str(folder), '--picture', str(tmp_path / 'out' / 'costs.png')]) == 0
    printed = capsys.readouterr().out
    assert '1 of 1 images found' in printed
    assert all(f'\n{name} ' in printed for name in RULES)
    assert (tmp_path / 'out' / 'costs.png').read_bytes().startswith(b'\x89PNG')


def test_without_images_the_command_says_so(folder, capsys) -> None:
    (folder / 'harbour.png').unlink()
    assert main(['chips', str(folder)]) == 1
    assert 'no image found' in capsys.readouterr().err


@pytest.mark.parametrize('name', ['harbour.png', 'harbour.JPG', 'ships.tif', '../images/ships.png'])
def test_an_image_is_found_by_its_name_or_by_that_of_a_table_of_its_own(tmp_path, name) -> None:
    labels = tmp_path / 'labels' / 'ships.csv'
    labels.parent.mkdir()
    write_labels(labels, [harbour()])
    path = (labels.parent / name).resolve()
    path.parent.mkdir(exist_ok=True)
    path.touch()
    assert find_images(list(read_labels(labels))) == [path]


def test_the_file_of_a_table_names_no_image_if_it_has_several(tmp_path) -> None:
    table = tmp_path / 'ships.csv'
    write_labels(table, [harbour()])
    lines = table.read_text().splitlines(keepends=True)
    table.write_text(''.join([*lines, lines[-1].replace('harbour', 'other', 1)]))
    Image.fromarray(SMALL).save(tmp_path / 'ships.png')
    shutil.copy(tmp_path / 'ships.png', tmp_path / 'other.png')
    found = dict(zip(('harbour', 'other'), find_images(list(read_labels(table))), strict=True))
    assert found == {'harbour': None, 'other': tmp_path / 'other.png'}


@pytest.mark.parametrize(
    ('mode', 'encoding'),
    [('L', 'mono8'), ('RGB', 'rgb8'), ('RGBA', 'rgba8'), ('I;16', 'mono16'), ('P', 'rgb8')],
)
def test_an_image_is_read_with_its_own_encoding(tmp_path, mode, encoding) -> None:
    Image.new(mode, (3, 2), 7 if mode in {'L', 'P', 'I;16'} else None).save(tmp_path / 'a.png')
    found, pixels = load_image(tmp_path / 'a.png')
    assert found == encoding
    assert pixels.shape[:2] == (2, 3)


def test_a_photograph_is_read_as_it_is_shown(tmp_path) -> None:
    turned = Image.Exif()
    turned[0x0112] = 6
    Image.fromarray(np.zeros((20, 40, 3), np.uint8)).save(tmp_path / 'a.jpg', exif=turned)
    assert load_image(tmp_path / 'a.jpg')[1].shape == (40, 20, 3)


def test_a_scene_that_pillow_would_refuse_is_opened(tmp_path) -> None:
    size = (20_000, 10_000)
    Image.new('1', size).save(tmp_path / 'scene.png')
    with opened_image(tmp_path / 'scene.png') as stored:
        assert stored.size == size
    assert Image.MAX_IMAGE_PIXELS < 10**9


def test_an_image_beyond_the_limit_is_an_error_that_names_it(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(image_files, 'MAX_PIXELS', 100)
    Image.new('L', (20, 20)).save(tmp_path / 'scene.png')
    with pytest.raises(ValueError, match=r'scene\.png: Image size \(400 pixels\) exceeds limit'):
        load_image(tmp_path / 'scene.png')


@pytest.mark.parametrize('mode', ['I', 'I;16'])
def test_grey_images_of_16_bits_keep_their_depth(tmp_path, mode) -> None:
    seen = np.arange(0, 65536, 64, dtype=np.uint16).reshape(32, 32)
    Image.fromarray(seen.astype(np.int32 if mode == 'I' else np.uint16)).save(tmp_path / 'a.tiff')
    with Image.open(tmp_path / 'a.tiff') as stored:
        assert stored.mode == mode
    encoding, pixels = load_image(tmp_path / 'a.tiff')
    assert (encoding, pixels.dtype) == ('mono16', np.uint16)
    np.testing.assert_array_equal(pixels, seen)


def tiff_of_16_bits(values):
    """Write the TIFF file of colours of 16 bits, (H, W, 3), uncompressed."""
    height, width, _ = values.shape
    data = values.astype('<u2').tobytes()
    tags = [
        (256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, 8 + len(data)), (259, 3, 1, 1),
        (262, 3, 1, 2), (273, 4, 1, 8), (277, 3, 1, 3), (278, 3, 1, height), (279, 4, 1, len(data)),
    ]  # fmt: skip
    entries = b''.join(struct.pack('<HHII', *tag) for tag in tags)
    bits = struct.pack('<3H', 16, 16, 16)
    start = struct.pack('<2sHI', b'II', 42, 8 + len(data) + len(bits))
    return start + data + bits + struct.pack('<H', len(tags)) + entries + bytes(4)


def png_of_16_bits(values):
    """Write the PNG file of colours of 16 bits, (H, W, 3)."""
    height, width, _ = values.shape

    def chunk(name, data):
        return (
            struct.pack('>I', len(data)) + name + data + struct.pack('>I', zlib.crc32(name + data))
        )

    rows = b''.join(bytes(1) + row.astype('>u2').tobytes() for row in values)
    head = struct.pack('>IIBBBBB', width, height, 16, 2, 0, 0, 0)
    chunks = chunk(b'IHDR', head) + chunk(b'IDAT', zlib.compress(rows)) + chunk(b'IEND', b'')
    return b'\x89PNG\r\n\x1a\n' + chunks


@pytest.mark.parametrize(('name', 'write'), [('a.tif', tiff_of_16_bits), ('a.png', png_of_16_bits)])
def test_colours_of_16_bits_are_refused_with_the_reason(tmp_path, name, write) -> None:
    # 11 bits, as satellites have them: the upper 8 are almost black.
    values = np.random.default_rng(1).integers(0, 2048, (6, 5, 3))
    (tmp_path / name).write_bytes(write(values))
    with opened_image(tmp_path / name) as stored:
        assert np.asarray(stored).max() < 8
    with pytest.raises(ValueError, match=rf'{name}: colours of 16 bits cannot be read'):
        load_image(tmp_path / name)


@pytest.mark.parametrize(
    ('low', 'high', 'dtype'),
    [(0.0, 1.0, np.float32), (-30.0, 5.0, np.float32), (0, 10**6, np.int32), (-500, 900, np.int32)],
)
def test_values_that_16_bits_do_not_hold_are_stretched(tmp_path, low, high, dtype) -> None:
    values = np.linspace(low, high, 64 * 64).reshape(64, 64).astype(dtype)
    Image.fromarray(values).save(tmp_path / 'a.tif')
    encoding, pixels = load_image(tmp_path / 'a.tif')
    assert encoding == 'mono16'
    assert (np.diff(pixels.ravel().astype(int)) >= 0).all()
    assert (pixels == 0).mean() == pytest.approx(0.005, abs=0.001)
    assert (pixels == 65535).mean() == pytest.approx(0.005, abs=0.001)


def test_pixels_that_are_no_numbers_are_black_and_do_not_darken_the_others(tmp_path) -> None:
    values = np.linspace(0.0, 1.0, 64 * 64, dtype=np.float32).reshape(64, 64)
    values[0, :3] = np.nan, -np.inf, np.inf
    Image.fromarray(values).save(tmp_path / 'a.tif')
    _, pixels = load_image(tmp_path / 'a.tif')
    assert pixels[0, :3].tolist() == [0, 0, 65535]
    assert 30_000 < pixels.mean() < 36_000


def test_an_image_without_a_number_is_an_error_that_names_it(tmp_path) -> None:
    Image.fromarray(np.full((4, 4), np.nan, np.float32)).save(tmp_path / 'a.tif')
    with pytest.raises(ValueError, match=r'a\.tif: the image has no finite pixel'):
        load_image(tmp_path / 'a.tif')


@pytest.mark.parametrize('dtype', [np.uint16, np.float32])
def test_chips_of_deep_images_are_as_bright_as_those_of_8_bits(
    folder, tmp_path, capsys, dtype
) -> None:
    grey = np.asarray(Image.open(folder / 'harbour.png').convert('L'))
    (folder / 'harbour.png').unlink()
    deep = (grey * (8.0 if dtype == np.uint16 else 1 / 255)).astype(dtype)
    Image.fromarray(deep).save(folder / 'harbour.tif')
    assert main(['chips', str(folder), '--picture', str(tmp_path / 'costs.png')]) == 0
    of_deep = capsys.readouterr().out
    (folder / 'harbour.tif').unlink()
    Image.fromarray(to_8_bits(grey)).save(folder / 'harbour.png')
    assert main(['chips', str(folder)]) == 0
    of_8_bits = capsys.readouterr().out
    # Pixels, and bytes by codec.
    costs = [list(map(int, re.findall(r'(\d+) \(', text))) for text in (of_deep, of_8_bits)]
    assert costs[0]
    np.testing.assert_allclose(*costs, rtol=0.01)


def test_an_image_smaller_than_its_labels_is_said(folder, capsys) -> None:
    with Image.open(folder / 'harbour.png') as whole:
        whole.crop((0, 0, 40, 30)).save(folder / 'harbour.png')
    main(['chips', str(folder)])
    said = capsys.readouterr().err
    assert 'labels lie outside its 40 x 30 px' in said
    assert 'harbour.png' in said
