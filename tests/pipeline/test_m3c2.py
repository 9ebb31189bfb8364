"""M3C2 against planes with known shifts and noise, its sign, and the labels that it shares with the difference map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pycocotools import mask

from pipeline.change.difference import SurfaceRaster
from pipeline.change.m3c2 import M3c2Config, core_grid, m3c2
from pipeline.config.simulation import SimulationConfig
from pipeline.formats.points.laz import read_laz
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.run.simulation import simulate
from scene.common.config import parse
from scene.common.keyed_random import KeyedRandom
from scene.geometry.grid import Grid
from scene.geometry.mesh import FloatArray, IntArray

pytestmark = pytest.mark.usefixtures("undrawn")

GRID = Grid(0.0, 4.0, 0.1, 60, 40)
SIGMA = 0.004


def cloud(slope: float, shift: float, seed: int, spacing: float = 0.02) -> FloatArray:
    """Return points of the plane z = slope x - shift sqrt(1 + slope^2), with noise across it."""
    generator = KeyedRandom(seed).generator()
    x, y = np.meshgrid(np.arange(-0.5, 6.5, spacing), np.arange(-0.5, 4.5, spacing))
    z = slope * x - (shift + generator.normal(0, SIGMA, x.shape)) * np.sqrt(1 + slope**2)
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def raster(slope: float) -> SurfaceRaster:
    x = GRID.x_min + (np.arange(GRID.width) + 0.5) * GRID.gsd
    heights = np.broadcast_to(slope * x, GRID.shape).astype(np.float32)
    return SurfaceRaster(GRID, heights, np.zeros(GRID.shape, dtype=np.int32))


def labels() -> IntArray:
    block = np.zeros(GRID.shape, dtype=np.int32)
    block[10:20, 30:40] = 7
    return block


@pytest.mark.parametrize(("slope", "direction", "factor"), [(0.0, "normal", 1.0), (0.5, "normal", 1.0), (0.5, "wall", 1.25**0.5)])
def test_a_shifted_plane(slope: float, direction: str, factor: float) -> None:
    """3 cm of missing rock across the plane are 3 cm along its normal, and 3 cm sqrt(1 + slope^2) along the wall's normal.

    A cylinder holds about pi (0.08 / 0.02)^2 = 50 points (fewer on a slope), so a distance has a standard error of SIGMA sqrt(2 /
    45) = 0.85 mm; the mean of 240 core points has 0.06 mm, and the limit is four of them.
    """
    config = M3c2Config(core_step_px=5, direction=direction)  # type: ignore[arg-type]
    found = m3c2(cloud(slope, 0.0, 1), cloud(slope, 0.03, 2), raster(slope), labels(), config)
    inner = found.distance[1:-1, 1:-1]
    assert inner.mean() == pytest.approx(0.03 * factor, abs=3e-4)
    assert found.significant[1:-1, 1:-1].all()
    assert set(np.unique(found.block)) == {0, 7}
    assert np.count_nonzero(found.block == 7) == 4


def test_the_level_of_detection_holds_on_stable_ground() -> None:
    """About 5 % of the core points exceed it where nothing moved; 960 are nearly independent, so 2.2 to 7.8 % is four sigma."""
    config = M3c2Config(core_step_px=2, direction="wall")
    found = m3c2(cloud(0.0, 0.0, 3), cloud(0.0, 0.0, 4), raster(0.0), labels(), config)
    assert 0.022 < found.significant.mean() < 0.078
    expected = 1.96 * SIGMA * np.sqrt(2 / (np.pi * (0.08 / 0.02) ** 2))
    assert np.median(found.level) == pytest.approx(expected, rel=0.08)
    wider = m3c2(
        cloud(0.0, 0.0, 3), cloud(0.0, 0.0, 4), raster(0.0), labels(), config.model_copy(update={"registration_error_m": 0.01})
    )
    assert np.median(wider.level - found.level) == pytest.approx(0.0196, abs=1e-5)


def test_core_points_are_the_middle_pixels() -> None:
    grid, every = core_grid(GRID, 5)
    assert (grid.width, grid.height, grid.gsd) == (12, 8, 0.5)
    assert np.arange(GRID.width)[every][:2].tolist() == [2, 7]
    found = m3c2(cloud(0.0, 0.0, 5), cloud(0.0, 0.0, 6), raster(0.0), labels(), M3c2Config())
    assert found.points[0, :2] == pytest.approx([0.25, 3.75])


def test_no_points_no_distance() -> None:
    reference = raster(0.0)
    reference.heights.flags.writeable = True
    heights = reference.heights.copy()
    heights[:, :30] = np.nan
    part = cloud(0.0, 0.0, 7)
    found = m3c2(part, part[part[:, 1] < 2.0], SurfaceRaster(GRID, heights, reference.block), labels(), M3c2Config())
    assert np.isnan(found.distance[:, :6]).all()
    assert np.isnan(found.distance[0]).all()
    assert np.isfinite(found.distance[-1, 7:]).all()
    assert found.summary()["significant"] == 0


def test_a_run_with_m3c2(tmp_path: Path) -> None:
    """The labels agree with those of the difference map at the same places, and so do the distances along the wall's normal.

    The raster has single pixels, M3C2 the mean over a cylinder: on stable ground their difference has about the raster's noise
    (NMAD 4 mm), so the medians agree to 0.3 mm; in niches they differ because cylinders of 16 cm reach over the rims (by 12 %
    from 10 cm of depth on, by 5 % from 15 cm).
    """
    values = {
        "seed": 3,
        "wall": {"style": "glendale", "width_m": 6.0, "height_m": 4.0, "resolution_m": 0.05, "seed": 1},
        "rockfall": {"count": 3, "size_m": {"kind": "gaussian", "mean": 0.5, "sigma": 0.05, "minimum": 0.3}},
        "station": {"distance_m": 20.0},
        "scanner": {"azimuth_step_rad": 0.0015, "zenith_step_rad": 0.0015},
        "difference": {"gsd_m": 0.03},
        "m3c2": {"direction": "wall", "core_step_px": 3},
    }
    out = tmp_path / "run"
    simulate(parse(SimulationConfig, values, "test"), "tls", out)
    change, full = read_geotiff(out / "difference_001.tif")
    distance, grid = read_geotiff(out / "m3c2_001.tif")
    level, _ = read_geotiff(out / "m3c2_lod_001.tif")
    assert (grid.gsd, grid.x_min, grid.y_max) == (pytest.approx(3 * full.gsd), full.x_min, full.y_max)
    core = change[1::3, 1::3][: grid.height, : grid.width]
    annotated = json.loads((out / "annotations_m3c2.json").read_text())
    masks = [mask.decode(item["segmentation"]).astype(bool) for item in annotated["annotations"]]
    inside = np.any(masks, axis=0)
    both = ~np.isnan(core) & ~np.isnan(distance)
    assert np.median((core - distance)[both & ~inside]) == pytest.approx(0, abs=3e-4)
    assert np.median((distance / core)[both & inside & (core > 0.15)]) == pytest.approx(1, abs=0.1)
    assert np.mean(distance[both & inside] > level[both & inside]) > 0.8
    points = read_laz(out / "m3c2_001.laz")
    assert {"distance_m", "lod_m", "significant", "block"} <= set(points.extra)
    run = json.loads((out / "run.json").read_text())
    assert run["epochs"][1]["m3c2"]["core_points"] == np.isfinite(distance).sum()
