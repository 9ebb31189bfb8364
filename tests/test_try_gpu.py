"""The script that tries a GPU: what differs between two runs is found, and a step that fails or hangs is recorded."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.formats.rasters.geotiff import write_geotiff
from scene.geometry.grid import Grid

SCRIPT = Path(__file__).parents[1] / "tools" / "try_gpu.py"
GRID = Grid(0.0, 4.0, 0.5, 20, 10)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("try_gpu", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def results(folder: Path, farther_m: float = 0.0, deeper_m: float = 0.0, lost: int = 0) -> None:
    """Write what the script compares: a scan of 200 pulses, maps of both sensors, random numbers."""
    count = 200 - lost
    points = np.column_stack([np.arange(count), np.zeros(count), np.full(count, 30.0)]).astype(float)
    extra = {"true_range_m": np.full(count, 30.0 + farther_m)}
    write_laz(folder / "tls/epoch_000/points.laz", PointCloud(points, gps_time=np.arange(count) * 1e-3, extra=extra))
    (folder / "stereo/epoch_000").mkdir(parents=True)
    for raster in ("tls/difference_001.tif", "stereo/difference_001.tif", "stereo/epoch_000/depth_left.tif"):
        write_geotiff(folder / raster, np.full((10, 20), deeper_m, dtype=np.float32), GRID)
    np.savez(folder / "random.npz", uniforms=np.arange(8.0), normals=np.arange(8.0))


@pytest.mark.parametrize(
    ("differences", "fine"),
    [({}, True), ({"farther_m": 5e-6}, True), ({"farther_m": 2e-5}, False), ({"deeper_m": 2e-5}, False), ({"lost": 1}, False)],
)
def test_differences_beyond_ten_micrometres_or_lost_pulses_are_told(
    differences: dict[str, float], fine: bool, script: ModuleType, tmp_path: Path
) -> None:
    results(tmp_path / script.PROCESSOR)
    results(tmp_path / script.CARD, **differences)
    assert script.compare(script.CARD, tmp_path)["as it should be"] is fine


def test_a_step_that_fails_or_hangs_is_recorded_and_the_next_goes_on(script: ModuleType, tmp_path: Path) -> None:
    trial = script.Trial(tmp_path, script.PROCESSOR, 60)
    trial.step("fails", [sys.executable, "-c", "print('a line'); raise SystemExit(3)"], 20)
    trial.step("hangs", [sys.executable, "-c", "import time; time.sleep(60)"], 0.5)
    trial.step("absent", ["no-such-program"], 5)
    assert trial.step("works", [sys.executable, "-c", "import os; print(os.environ['SCARPSIM_VARIANT'])"], 20) == "llvm_ad_mono\n"
    said = {name: value["said"] for name, value in json.loads((tmp_path / "gpu.json").read_text()).items()}
    assert said["fails"] == "failed, status 3"
    assert said["hangs"] == "failed: time limit"
    assert said["absent"].startswith("failed: ")
    assert said["works"] == "works"
    assert (tmp_path / "fails.log").read_text() == "a line\n"
