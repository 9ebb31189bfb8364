"""Rasters: what is read back is what was written, GDAL reads it too, and damaged files are told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
import tifffile
from format_cases import GRID, a_raster

from pipeline.formats.rasters.geotiff import read_geotiff, read_tiff, write_geotiff, write_tiff
from scene.common.errors import InputError


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
    with pytest.raises(InputError, match="no place"):
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
