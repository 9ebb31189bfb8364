"""Rasters: what is read back is what was written, GDAL reads it too, and damaged files are reported."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from format_cases import GRID, a_raster

from pipeline.formats.rasters.geotiff import read_geotiff, read_raster, read_tiff, write_geotiff, write_tiff
from pipeline.measurement.reference import reference_from_dem
from scene.common.errors import InputError
from scene.geometry.grid import Grid


@pytest.fixture
def raster() -> np.ndarray:
    return a_raster()


def test_geotiff_as_gdal_reads_it(tmp_path: Path, raster: np.ndarray) -> None:
    path = tmp_path / "difference_001.tif"
    write_geotiff(path, raster, GRID, description="reference minus epoch, m")
    with rasterio.open(path) as data:
        assert data.transform.almost_equals(rasterio.Affine(0.02, 0, 1.25, 0, -0.02, 9.5), precision=1e-12)
        assert data.res == (0.02, 0.02)
        assert np.isnan(data.nodata)
        assert data.dtypes == ("float32",)
        assert data.tags()["AREA_OR_POINT"] == "Area"
        assert data.tags()["TIFFTAG_IMAGEDESCRIPTION"] == "reference minus epoch, m"
        assert not data.crs.is_geographic
        assert not data.crs.is_projected
        assert "wall frame" in data.crs.to_wkt()
        assert 'UNIT["metre",1' in data.crs.to_wkt()
        np.testing.assert_array_equal(data.read(1), raster)
        assert data.read(1, masked=True).mask.sum() == np.isnan(raster).sum()
        assert data.index(1.25 + 10.5 * 0.02, 9.5 - 3.5 * 0.02) == (3, 10)


def test_tiff_round_trips(tmp_path: Path, raster: np.ndarray) -> None:
    for description in ("", "a difference"):
        write_geotiff(tmp_path / "a.tif", raster, GRID, description=description)
        read, grid = read_geotiff(tmp_path / "a.tif")
        np.testing.assert_array_equal(read, raster)
        assert grid == GRID
    write_tiff(tmp_path / "b.tif", raster.astype(np.float64), description="depth, m")
    np.testing.assert_array_equal(read_tiff(tmp_path / "b.tif"), raster)
    np.testing.assert_array_equal(tifffile.imread(tmp_path / "b.tif"), raster)
    with pytest.raises(InputError, match="no pixel scale and tie point"):
        read_geotiff(tmp_path / "b.tif")
    with pytest.raises(ValueError, match=r"\(40, 70\)"):
        write_geotiff(tmp_path / "c.tif", raster.T, GRID)


def test_geotiff_of_gdal(tmp_path: Path, raster: np.ndarray) -> None:
    """Deflated, with another number for no data, without coordinate system."""
    path, marked = tmp_path / "a.tif", np.nan_to_num(raster, nan=-9999)
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "width": 70,
        "height": 40,
        "count": 1,
        "nodata": -9999,
        "compress": "deflate",
    }
    with rasterio.open(path, "w", transform=rasterio.Affine(0.02, 0, 1.25, 0, -0.02, 9.5), **profile) as data:
        data.write(marked, 1)
    read, grid = read_geotiff(path)
    np.testing.assert_array_equal(read, raster)
    assert (grid.x_min, grid.y_max, grid.shape) == (GRID.x_min, GRID.y_max, GRID.shape)
    assert grid.gsd == pytest.approx(GRID.gsd, rel=1e-12)


def test_tiff_damaged_files_are_input_errors(tmp_path: Path, raster: np.ndarray) -> None:
    path = tmp_path / "a.tif"
    write_geotiff(path, raster, GRID)
    data = path.read_bytes()
    for cut in (b"", b"II", b"garbage" * 100, data[:50], data[: len(data) // 2], data[:-1]):
        path.write_bytes(cut)
        with pytest.raises(InputError):
            read_geotiff(path)
    with pytest.raises(InputError, match="No such file"):
        read_tiff(tmp_path / "none.tif")
    tifffile.imwrite(path, np.zeros((8, 8, 3), dtype=np.uint8))
    with pytest.raises(InputError, match="one band"):
        read_tiff(path)


HEIGHTS = (100.0 + 3.0 * np.sin(np.arange(60)[:, None] / 5.0) + np.arange(80)[None] / 8.0).astype(np.float32)
CORNER, SIDE = (500_000.0, 5_400_030.0), 0.5


def _gdal(
    path: Path,
    values: np.ndarray = HEIGHTS,
    *,
    tags: dict[str, str] | None = None,
    mask: np.ndarray | None = None,
    **more: object,
) -> Path:
    """Write a raster with GDAL, which many other programs use."""
    north_up = rasterio.transform.from_origin(*CORNER, SIDE, SIDE)
    profile = {"driver": "GTiff", "height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": values.dtype.name}
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", **{"crs": "EPSG:32632", "transform": north_up, **profile, **more}) as data,
    ):
        data.update_tags(**(tags or {}))
        data.write(values, 1)
        if mask is not None:
            data.write_mask(mask)
    return path


@pytest.mark.parametrize("kind", ["Area", "Point"])
def test_pixels_lie_where_gdal_puts_them_whether_they_are_areas_or_points(tmp_path: Path, kind: str) -> None:
    values, grid = read_geotiff(_gdal(tmp_path / "a.tif", tags={"AREA_OR_POINT": kind}))
    np.testing.assert_array_equal(values, HEIGHTS)
    assert grid == Grid(*CORNER, SIDE, 80, 60)


@pytest.mark.parametrize(
    "storage",
    [
        {"compress": "lzw"},
        {"compress": "lzw", "predictor": 3},
        {"compress": "deflate", "predictor": 2},
        {"compress": "deflate", "predictor": 3},
        {"compress": "packbits"},
        {"compress": "zstd"},
        {"compress": "lerc"},
        {"compress": "lzma"},
        {"tiled": True, "blockxsize": 32, "blockysize": 32, "compress": "lzw"},
        {"BIGTIFF": "YES"},
        {"ENDIANNESS": "BIG"},
    ],
    ids=str,
)
def test_every_way_in_which_gdal_stores_floats_is_read(tmp_path: Path, storage: dict[str, object]) -> None:
    np.testing.assert_array_equal(read_geotiff(_gdal(tmp_path / "a.tif", **storage))[0], HEIGHTS)


def test_a_raster_from_south_to_north_is_turned(tmp_path: Path) -> None:
    south_up = rasterio.Affine(SIDE, 0, CORNER[0], 0, SIDE, CORNER[1] - 60 * SIDE)
    values, grid = read_geotiff(_gdal(tmp_path / "a.tif", HEIGHTS[::-1], transform=south_up))
    np.testing.assert_array_equal(values, HEIGHTS)
    assert grid == Grid(*CORNER, SIDE, 80, 60)


@pytest.mark.parametrize(
    ("transform", "problem"),
    [
        (rasterio.Affine(0.5, 0.1, 0.0, 0.1, -0.5, 0.0), "rotated relative to the axes"),
        (rasterio.Affine(0.5, 0.0, 0.0, 0.0, -0.25, 0.0), r"the pixels are 0\.5 x 0\.25 units"),
    ],
)
def test_pixels_that_are_turned_or_not_square_are_refused(tmp_path: Path, transform: rasterio.Affine, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        read_geotiff(_gdal(tmp_path / "a.tif", transform=transform))


@pytest.mark.parametrize("value", [-9999.0, -32768.0, -3.4028234663852886e38])
def test_what_programs_write_for_no_data_is_no_height(tmp_path: Path, value: float) -> None:
    holed = HEIGHTS.copy()
    holed[5:20, 5:20] = value
    raster = read_raster(_gdal(tmp_path / "a.tif", holed))
    assert np.isnan(raster.values[5:20, 5:20]).all()
    assert np.isnan(raster.values).sum() == 225
    assert raster.notes == (f"225 pixels of {value:g} are read as missing data, although the file does not say so",)
    reference = reference_from_dem(tmp_path / "a.tif")
    assert reference.mesh.bounds[0, 2] == HEIGHTS.min()
    assert raster.notes[0] in reference.words


def test_minus_9999_among_heights_as_low_stays_a_height(tmp_path: Path) -> None:
    """On an ocean floor other values come within half the distance from zero, so -9999 is a height."""
    deep = HEIGHTS - 6000
    deep[3, 3] = -9999
    raster = read_raster(_gdal(tmp_path / "a.tif", deep))
    assert raster.values[3, 3] == -9999
    assert raster.notes == ()


def test_a_mask_scale_and_offset_of_gdal_are_applied(tmp_path: Path) -> None:
    stored, mask = np.round((HEIGHTS - 50) / 0.01).astype(np.int16), np.full(HEIGHTS.shape, 255, np.uint8)
    mask[:4] = 0
    path = _gdal(tmp_path / "a.tif", stored, mask=mask)
    with rasterio.open(path, "r+") as data:
        data.scales, data.offsets = (0.01,), (50.0,)
    values, _ = read_geotiff(path)
    assert np.isnan(values[:4]).all()
    np.testing.assert_allclose(values[4:], HEIGHTS[4:], atol=0.0051)


@pytest.mark.parametrize(("crs", "metres"), [("EPSG:2225", 1200 / 3937), ("EPSG:2222", 0.3048)])
def test_a_model_in_feet_becomes_metres(tmp_path: Path, crs: str, metres: float) -> None:
    """State planes in US survey feet and in international feet: at 5,400,030 ft they differ by 3.3 m."""
    reference = reference_from_dem(_gdal(tmp_path / "a.tif", crs=crs))
    centre = (CORNER[0] + SIDE / 2) * metres, (CORNER[1] - SIDE / 2) * metres, float(HEIGHTS[0, 0]) * metres
    np.testing.assert_allclose(reference.mesh.vertices[0], centre, rtol=1e-9)
    assert any("which were converted to metres" in words for words in reference.words)
    with pytest.raises(InputError, match=r"states its unit, .*ft.*, but --unit says mm"):
        reference_from_dem(tmp_path / "a.tif", "mm")


def test_a_unit_that_only_the_code_of_the_coordinate_system_has_is_read(tmp_path: Path) -> None:
    path = _gdal(tmp_path / "a.tif", crs="EPSG:2225")
    content = path.read_bytes()
    row = struct.pack("<4H", 3076, 0, 1, 9003)
    assert row in content
    path.write_bytes(content.replace(row, struct.pack("<4H", 3077, 0, 1, 9003)))  # a key that nobody reads
    assert read_raster(path).place.linear_m == pytest.approx(1200 / 3937, rel=1e-12)


def test_degrees_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"geographic coordinates"):
        read_geotiff(_gdal(tmp_path / "a.tif", crs="EPSG:4326", transform=rasterio.transform.from_origin(8.0, 50.0, 1e-5, 1e-5)))


def test_a_compression_that_cannot_be_read_is_no_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _gdal(tmp_path / "a.tif", compress="lzw")
    content = path.read_bytes()
    tag = (259).to_bytes(2, "little") + (3).to_bytes(2, "little") + (1).to_bytes(4, "little")
    path.write_bytes(content.replace(tag + (5).to_bytes(2, "little"), tag + (34925 + 77).to_bytes(2, "little")))
    with pytest.raises(InputError, match=r"uses a compression that cannot be read.*save the raster with deflate"):
        read_tiff(path)
