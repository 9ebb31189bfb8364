"""Labels: the outlines of carved niches where the map shows them, for every way of making a surface, with and without noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pipeline.config.simulation import SimulationConfig
from pipeline.report.progress import Progress
from pipeline.run.epoch import LaterEpoch, ReferenceEpoch, observe_epoch, observe_reference
from pipeline.run.site import prepare_site
from scene.common.config import parse
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import WALL, IntArray, TriangleMesh
from scene.ray_casting.raycast import RayCaster, heights

QUIET = {"sensor": "stereo", "noise": {"parallax_sigma_px": 0, "regularization_sigma_px": 0}}
NOISY = {"sensor": "stereo", "noise": {"parallax_sigma_px": 0.6, "regularization_sigma_px": 0.25}}
BARS = {"small": (0.8, 0.11), "medium": (0.95, 0.3), "large": (0.95, 0.8)}
"""Share of blocks whose label overlaps the true outline by 0.75 or more, and their size, m (issue 22)."""


def epoch(sensor: str, model: Any, size: float, **changes: Any) -> tuple[ReferenceEpoch, LaterEpoch]:
    values = {
        "wall": {"style": "glendale", "width_m": 9.0, "height_m": 6.0, "resolution_m": 0.05, "seed": 2},
        "cameras": {"distance_m": 105.0, "base_m": 28.0},
        "station": {"distance_m": 105.0},
        "scanner": {"azimuth_step_rad": 0.0004, "zenith_step_rad": 0.0004},
        "rockfall": {"count": max(6, round(2.4 / size)), "size_m": size, "safe_zone_offset_m": 0.3},
        "sensor": [model],
        **changes,
    }
    config = parse(SimulationConfig, values, "test")
    site = prepare_site(config, sensor, KeyedRandom(1))  # type: ignore[arg-type]
    reference = observe_reference(config, site, KeyedRandom(1), Progress())
    return reference, observe_epoch(config, site, reference, 1, KeyedRandom(1), Progress())


def true_outlines(reference: ReferenceEpoch, seen: LaterEpoch) -> IntArray:
    """Return per pixel (h, w) the block in whose solid the wall's surface lies, from the blocks' meshes, without carving."""
    grid = reference.raster.grid
    surface = heights(reference.caster, grid)
    result = np.full(grid.shape, WALL, dtype=np.int32)
    for index in range(len(seen.solids)):
        block = seen.solids.mesh(index)
        top = heights(RayCaster(block), grid)
        bottom = -heights(RayCaster(TriangleMesh(block.vertices * [1, 1, -1], block.faces[:, ::-1].copy())), grid)
        result[(bottom < surface) & (surface <= top)] = index + 1
    return result


def overlaps(label: IntArray, truth: IntArray, count: int) -> np.ndarray:
    common = np.bincount(truth[label == truth], minlength=count + 1)
    union = np.bincount(label.ravel(), minlength=count + 1) + np.bincount(truth.ravel(), minlength=count + 1) - common
    return (common / np.maximum(union, 1))[1:]


@pytest.mark.parametrize("noise", [QUIET, NOISY], ids=["quiet", "noisy"])
@pytest.mark.parametrize("reconstruction", ["direct", "vertices"])
@pytest.mark.parametrize("size", BARS)
def test_labels_are_the_true_outlines(size: str, reconstruction: str, noise: dict[str, Any]) -> None:
    share, side = BARS[size]
    reference, seen = epoch("stereo", noise, side, reconstruction=reconstruction, noisy_reference=False)
    found = overlaps(seen.raster.block, true_outlines(reference, seen), len(seen.solids))
    assert np.mean(found >= 0.75) >= share


def test_the_scanners_labels_are_the_true_outlines() -> None:
    reference, seen = epoch("tls", {"sensor": "tls", "noise": {"range_sigma_m": 0.01}}, 0.3)
    found = overlaps(seen.raster.block, true_outlines(reference, seen), len(seen.solids))
    assert np.mean(found >= 0.75) >= 0.95


@pytest.mark.parametrize("reconstruction", ["direct", "vertices"])
def test_labels_go_where_the_sensors_errors_put_the_niches(reconstruction: str) -> None:
    """Both principal points are wrong by 12 px, which shifts the map by about 14 cm (105 m / 10,250 px each); no ICP corrects it
    here.
    """
    model = {**QUIET, "effects": [{"name": "principal_point_x", "camera": "both", "delta_px": 12.0}]}
    _, seen = epoch("stereo", model, 0.8, reconstruction=reconstruction, icp=None, depth_map="high", noisy_reference=True)
    _, still = epoch("stereo", QUIET, 0.8, reconstruction=reconstruction, icp=None, depth_map="high")
    shift = np.subtract(*([x_of(each, label) for label in range(1, len(each.solids) + 1)] for each in (seen, still)))
    assert np.abs(shift).mean() == pytest.approx(12.0 * 105.0 / 10_250, rel=0.15)
    niche, outside = (np.nanmedian(np.abs(seen.difference[chosen])) for chosen in (seen.raster.block > 0, seen.raster.block == 0))
    assert niche > 0.05 > 0.002 > outside


def x_of(seen: LaterEpoch, label: int) -> float:
    """Return the x of a label's middle in the wall frame, m."""
    grid = seen.raster.grid
    return grid.x_min + grid.gsd * (float(np.nonzero(seen.raster.block == label)[1].mean()) + 0.5)
