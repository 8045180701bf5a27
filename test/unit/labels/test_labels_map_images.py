# SPDX-License-Identifier: Apache-2.0
"""Labels in map coordinates on the pixels of GeoTIFFs."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from obbhbb_ros.cli import main
from obbhbb_ros.geometry.boxes import FloatArray
from obbhbb_ros.geometry.boxes import OrientedBoxes
from obbhbb_ros.geometry.converter import HullRule
from obbhbb_ros.labels import read_labels
from obbhbb_ros.labels.axis_aligned import convert_file
from obbhbb_ros.labels.map_images import in_pixels
from obbhbb_ros.labels.map_images import load_map_image
from obbhbb_ros.study.ships import read_ships

rasterio = pytest.importorskip('rasterio', reason='GeoTIFF needs the extra `geo`')
pyproj = pytest.importorskip('pyproj', reason='GeoTIFF needs the extra `geo`')

UTM = 'EPSG:32633'
WIDTH, HEIGHT = 120, 80
SHIPS = OrientedBoxes.from_xywhr([[40, 30, 40, 8, 0.5], [85, 50, 30, 6, 1.4]]).corners
# a b c, d e f of x = a column + b row + c: north up, turned by 30 degrees.
NORTH_UP = (0.5, 0.0, 500300.0, 0.0, -0.5, 6649600.0)
TURNED = (0.433, -0.25, 500300.0, -0.25, -0.433, 6649600.0)
PLACES = {'north up': NORTH_UP, 'turned': TURNED}


def put_image(
    path: Path,
    transform: tuple[float, ...] | None = NORTH_UP,
    crs: str | None = UTM,
    bands: Any = None,
    **options: Any,
) -> Path:
    """Write a GeoTIFF, by default one without colours."""
    bands = np.zeros((1, HEIGHT, WIDTH), np.uint8) if bands is None else np.asarray(bands)
    place = {'crs': crs, 'transform': transform and rasterio.Affine(*transform)}
    count, height, width = bands.shape
    profile = {'count': count, 'height': height, 'width': width, 'dtype': bands.dtype}
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path, 'w', driver='GTiff', **profile, **place, **options) as image:
            image.write(bands)
    return path


def placed(points: FloatArray, transform: tuple[float, ...] = NORTH_UP) -> FloatArray:
    """Return the place of pixels in the map."""
    matrix = np.array(transform).reshape(2, 3)
    return points @ matrix[:, :2].T + matrix[:, 2]


def put_labels(path: Path, rings: Any, crs: str | None = UTM, **properties: Any) -> Path:
    """Write polygons as GeoJSON."""
    features = [
        {
            'type': 'Feature',
            'properties': {'class': 'ship', **properties},
            'geometry': {'type': 'Polygon', 'coordinates': [[*ring.tolist(), ring[0].tolist()]]},
        }
        for ring in rings
    ]
    named = None if crs is None else {'type': 'name', 'properties': {'name': crs}}
    document = {'type': 'FeatureCollection', 'crs': named, 'features': features}
    path.write_text(json.dumps(document))
    return path


def moved(rings: FloatArray, crs: str) -> FloatArray:
    """Return rings of the map in another reference system."""
    there = pyproj.Transformer.from_crs(UTM, crs, always_xy=True)
    return np.column_stack(there.transform(*rings.reshape(-1, 2).T)).reshape(rings.shape)


@pytest.mark.parametrize('place', PLACES)
@pytest.mark.parametrize('crs', [UTM, 'EPSG:4326', 'OGC:CRS84', 'EPSG:32634', 'EPSG:3857'])
def test_labels_in_a_map_meet_the_pixels_of_the_image(tmp_path: Path, place: str, crs: str) -> None:
    image = put_image(tmp_path / 'a.tif', PLACES[place])
    rings = moved(placed(SHIPS, PLACES[place]), crs)
    (labels,) = read_labels(put_labels(tmp_path / 'a.geojson', rings, crs))
    pixels = in_pixels(labels, image)
    np.testing.assert_allclose(pixels.corners, SHIPS, atol=1e-3)
    assert pixels.size == (WIDTH, HEIGHT)
    assert pixels.extras.label_set.crs == ''
    assert not pixels.extras.label_set.in_degrees


def test_hulls_and_ids_stay_those_of_the_ship(tmp_path: Path) -> None:
    image = put_image(tmp_path / 'a.tif', TURNED)
    hull = np.array([[20.0, 20.0], [60.0, 22.0], [66.0, 26.0], [60.0, 30.0], [20.0, 31.0]])
    path = put_labels(tmp_path / 'a.geojson', [placed(hull, TURNED)], id='7')
    (labels,) = read_labels(path)
    pixels = in_pixels(labels, image)
    assert pixels.hulls[0] is not None
    np.testing.assert_allclose(pixels.hulls[0], hull, atol=1e-6)
    assert pixels.ids == ('7',)


def test_reference_boxes_stay_where_they_are_upright_in_the_image(tmp_path: Path) -> None:
    upright = np.array([[20.0, 20.0], [60.0, 20.0], [60.0, 30.0], [20.0, 30.0]])
    (labels,) = read_labels(put_labels(tmp_path / 'a.geojson', [placed(upright)]))
    same = in_pixels(labels, put_image(tmp_path / 'a.tif'))
    np.testing.assert_allclose(same.reference, [[20.0, 20.0, 60.0, 30.0]], atol=1e-6)
    turned = in_pixels(labels, put_image(tmp_path / 'b.tif', TURNED))
    assert np.isnan(turned.reference).all()


def test_labels_in_pixels_stay_as_they_are(tmp_path: Path) -> None:
    (labels,) = read_labels(put_labels(tmp_path / 'a.geojson', SHIPS, None))
    assert in_pixels(labels, tmp_path / 'missing.tif') is labels


@pytest.mark.parametrize(
    ('transform', 'crs', 'message'),
    [
        (None, None, 'lies in no map, .* gdalwarp'),
        (NORTH_UP, None, 'names no reference system, .* gdal_edit.py -a_srs'),
    ],
)
def test_an_image_without_a_place_is_refused_with_the_remedy(
    tmp_path: Path, transform: tuple[float, ...] | None, crs: str | None, message: str
) -> None:
    image = put_image(tmp_path / 'a.tif', transform, crs)
    (labels,) = read_labels(put_labels(tmp_path / 'a.geojson', placed(SHIPS)))
    with pytest.raises(ValueError, match=message):
        in_pixels(labels, image)


@pytest.mark.parametrize('keep', [0, 3, 100, 500])
def test_an_image_that_is_cut_off_is_refused_by_its_name(tmp_path: Path, keep: int) -> None:
    image = put_image(tmp_path / 'a.tif', bands=np.ones((3, HEIGHT, WIDTH), np.uint8))
    image.write_bytes(image.read_bytes()[:keep])
    with pytest.raises(ValueError, match=r'a\.tif: cannot be read'):
        load_map_image(image)


def test_an_image_that_claims_too_many_pixels_is_refused(tmp_path: Path) -> None:
    path = tmp_path / 'a.tif'
    profile = {'count': 1, 'height': 2**17, 'width': 2**17, 'dtype': 'uint8', 'tiled': True}
    place = {'crs': UTM, 'transform': rasterio.Affine(*NORTH_UP)}
    with rasterio.open(path, 'w', driver='GTiff', SPARSE_OK=True, **profile, **place):
        pass
    with pytest.raises(ValueError, match='131072 x 131072 pixels are too many'):
        load_map_image(path)


def test_points_that_the_system_of_the_image_does_not_reach_are_not_finite(tmp_path: Path) -> None:
    far = moved(placed(SHIPS), 'OGC:CRS84') * [1.0, -1.0]
    (labels,) = read_labels(put_labels(tmp_path / 'a.geojson', far, 'OGC:CRS84'))
    globe = put_image(tmp_path / 'a.tif', crs='+proj=ortho +lat_0=60 +lon_0=15')
    assert not np.isfinite(in_pixels(labels, globe).corners).any()


@pytest.mark.parametrize('count', [1, 2, 3, 4])
def test_the_first_three_bands_are_the_colours(tmp_path: Path, count: int) -> None:
    bands = np.arange(count * HEIGHT * WIDTH).reshape(count, HEIGHT, WIDTH).astype(np.uint16)
    pixels = load_map_image(put_image(tmp_path / 'a.tif', bands=bands))
    shown = bands[:3] if count >= 3 else bands[:1]
    np.testing.assert_array_equal(pixels, shown.transpose(1, 2, 0))


def test_pixels_without_a_value_do_not_darken_the_others(tmp_path: Path) -> None:
    band = np.full((1, HEIGHT, WIDTH), -9999.0, np.float32)
    band[0, :, : WIDTH // 2] = np.linspace(0.1, 0.2, HEIGHT)[:, None]
    pixels = load_map_image(put_image(tmp_path / 'a.tif', bands=band, nodata=-9999.0))
    assert not pixels[:, WIDTH // 2 :].any()
    assert 20000 < np.median(pixels[:, : WIDTH // 2]) < 45000


def test_complex_pixels_are_refused(tmp_path: Path) -> None:
    image = put_image(tmp_path / 'a.tif', bands=np.zeros((1, HEIGHT, WIDTH), np.complex64))
    with pytest.raises(ValueError, match='complex numbers'):
        load_map_image(image)


@pytest.mark.parametrize('crs', [UTM, 'EPSG:4326'])
def test_chips_of_a_map_are_those_of_the_pixels(
    tmp_path: Path, crs: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('PIL')
    bands = np.random.default_rng(1).integers(0, 255, (3, HEIGHT, WIDTH)).astype(np.uint8)
    put_image(tmp_path / 'a.tif', bands=bands)
    put_labels(tmp_path / 'a.geojson', moved(placed(SHIPS), crs), crs)
    put_image(tmp_path / 'b.tif', bands=bands)
    put_labels(tmp_path / 'b.geojson', SHIPS, None)
    tables = []
    for name in 'ab':
        assert main(['chips', str(tmp_path / f'{name}.geojson')]) == 0
        tables.append(capsys.readouterr().out.split('\n', 1)[1])
    assert tables[0] == tables[1]


def test_chips_draw_each_ship_with_all_boxes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip('PIL')
    pytest.importorskip('matplotlib')
    put_image(tmp_path / 'a.tif', TURNED)
    path = put_labels(tmp_path / 'a.geojson', [*placed(SHIPS, TURNED), placed(SHIPS[0] + 500)])
    assert main(['chips', str(path), '--ships', str(tmp_path / 'ships')]) == 0
    assert '2 pictures' in capsys.readouterr().out
    pictures = sorted((tmp_path / 'ships').iterdir())
    assert [picture.name for picture in pictures] == ['a_1.png', 'a_2.png']
    assert all(picture.read_bytes().startswith(b'\x89PNG') for picture in pictures)


def test_labels_of_a_map_without_its_name_are_refused_with_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put_image(tmp_path / 'a.tif')
    path = put_labels(tmp_path / 'a.geojson', placed(SHIPS), None)
    assert main(['chips', str(path)]) == 1
    assert 'name no reference system: give them one' in capsys.readouterr().err


@pytest.mark.parametrize('target', ['coco', 'voc', 'yolo'])
@pytest.mark.parametrize('crs', [UTM, 'EPSG:4326'])
def test_formats_in_pixels_get_the_boxes_of_the_image(
    tmp_path: Path, target: str, crs: str
) -> None:
    place = tmp_path / 'in'
    place.mkdir()
    put_image(place / 'a.tif', TURNED)
    path = put_labels(place / 'a.geojson', moved(placed(SHIPS, TURNED), crs), crs)
    out = tmp_path / ('out.json' if target == 'coco' else 'out')
    tally = convert_file(
        path, out, HullRule('outer'), target_format=target, source_format='geojson', report=print
    )
    assert 'reference system' not in tally.losses
    # The size is that of the image.
    assert 'image size' not in tally.losses
    assert f'{len(SHIPS)} placed in the pixels of their image' in str(tally)
    (written,) = read_labels(out, target, image_size=(WIDTH, HEIGHT))
    expected = np.hstack((SHIPS.min(axis=1), SHIPS.max(axis=1)))
    np.testing.assert_allclose(written.reference, expected, atol=0.01)


@pytest.mark.parametrize('target', ['coco', 'voc', 'yolo'])
def test_formats_in_pixels_refuse_a_map_without_an_image(tmp_path: Path, target: str) -> None:
    path = put_labels(tmp_path / 'a.geojson', placed(SHIPS))
    out = tmp_path / 'out'
    with pytest.raises(ValueError, match=r'EPSG:32633.*pixels are needed: no GeoTIFF'):
        convert_file(path, out, HullRule(), target_format=target, report=print)
    with pytest.raises(ValueError, match='give the caps in pixels'):
        convert_file(path, out, HullRule(), target_format=target, report=print, metres=True)
    assert not out.exists()


def put_pair(folder: Path, crs: str | None) -> tuple[Path, Path]:
    """Write labels, and reference boxes in pixels, for one image."""
    put_image(folder / 'a.tif', TURNED)
    rings = SHIPS if crs is None else moved(placed(SHIPS, TURNED), crs)
    path = put_labels(folder / 'a.geojson', rings, crs)
    lines = [
        f'a,ship,{",".join(map(str, box))}'
        for box in np.hstack((SHIPS.min(axis=1) + 1.0, SHIPS.max(axis=1) - 1.0)).tolist()
    ]
    reference = folder / 'boxes.csv'
    reference.write_text('\n'.join(['image,class,x_min,y_min,x_max,y_max', *lines]))
    return path, reference


@pytest.mark.parametrize('crs', [UTM, 'EPSG:4326'])
def test_labels_in_a_map_and_references_in_pixels_meet_on_the_image(
    tmp_path: Path, crs: str
) -> None:
    folders = tmp_path / 'map', tmp_path / 'pixels'
    for folder, system in zip(folders, (crs, None), strict=True):
        folder.mkdir()
        put_pair(folder, system)
    ships, same = (
        read_ships([folder / 'a.geojson'], reference=folder / 'boxes.csv') for folder in folders
    )
    np.testing.assert_allclose(ships.boxes.corners, same.boxes.corners, atol=1e-3)
    np.testing.assert_allclose(ships.reference, same.reference)
    assert ships.with_reference.all()


def test_labels_in_two_systems_without_an_image_are_refused(tmp_path: Path) -> None:
    path = put_labels(tmp_path / 'a.geojson', placed(SHIPS))
    reference = put_labels(tmp_path / 'b.geojson', moved(placed(SHIPS), 'EPSG:32634'), 'EPSG:32634')
    with pytest.raises(ValueError, match='no GeoTIFF of that name'):
        read_ships([path], reference=reference)


def test_references_of_no_named_system_are_in_that_of_the_labels(tmp_path: Path) -> None:
    path = put_labels(tmp_path / 'a.geojson', placed(SHIPS))
    reference = tmp_path / 'boxes.csv'
    convert_file(path, reference, HullRule(), report=print)
    assert read_ships([path], reference=reference).with_reference.all()
