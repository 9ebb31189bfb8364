"""Scanners, wall styles and readers from another package: one entry point each makes them available in every command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from scene.common.errors import InputError
from scene.common.plug_ins import load_plug_ins

pytestmark = pytest.mark.usefixtures("undrawn")

ROOT = Path(__file__).parents[1]
MODULE = """
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.formats.point_cloud import PointCloud
from scene.walls.procedural import OWN_SITES

SCANNER = Path(__file__).with_name("toy_scanner.yaml")
quarry = replace(OWN_SITES["pilkington"], width_m=6.0, height_m=4.0, albedo=0.31)


def read_toy(path):
    return PointCloud(np.loadtxt(path, delimiter=";"))
"""
SCANNER = """
name: Toy
ranging: pulse
pulse_rate_hz: {value: 100000, source: test}
range_accuracy_mm: {value: 9, kind: accuracy, source: test}
range_precision_mm: [{value: 7, at_m: 100, kind: precision, source: test}]
divergence_mrad: {value: 0.3, level: 1/e2, angle: full, source: test}
"""
ENTRIES = """[scarpsim.scanners]
toy_one = toy_package:SCANNER
[scarpsim.wall_styles]
quarry = toy_package:quarry
[scarpsim.readers]
toy = toy_package:read_toy
"""
KNOWS = """
import json
from pathlib import Path
from pipeline import configure, make_wall
from pipeline.cli.json_schema import json_schema
from pipeline.comparison.sensor_setups import sensor_setups
from pipeline.formats.points.points import read_points
from scene import InputError

config = configure(scanner="toy_one", wall={"style": "quarry"})
try:
    configure(wall={"style": "quary"})
except InputError as error:
    hint = str(error)
print(json.dumps({
    "sigma": config.tls_model().noise.range_sigma_m,
    "width": float(make_wall(style="quarry", resolution_m=0.5).bounds[1][0]),
    "points": read_points(Path("cloud.toy")).points.tolist(),
    "compared": [each.name for each in sensor_setups(["toy_one"])],
    "hint": hint,
    "schema": "quarry" in json.dumps(json_schema("simulation")),
}))
"""


@pytest.fixture
def package(tmp_path: Path) -> dict[str, str]:
    """The environment of a process in which the package is installed."""
    (tmp_path / "toy_package.py").write_text(MODULE)
    (tmp_path / "toy_scanner.yaml").write_text(SCANNER)
    (tmp_path / "cloud.toy").write_text("1;2;3\n4;5;6\n")
    info = tmp_path / "toy_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}


def test_a_package_adds_a_scanner_a_style_and_a_reader(package: dict[str, str], tmp_path: Path) -> None:
    result = subprocess.run([sys.executable, "-c", KNOWS], capture_output=True, text=True, env=package, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert found["sigma"] == pytest.approx(0.007)
    assert found["width"] == pytest.approx(6.0)
    assert found["points"] == [[1, 2, 3], [4, 5, 6]]
    assert found["compared"] == ["toy_one"]
    assert "did you mean 'quarry'" in found["hint"]
    assert found["schema"] is True


def test_a_run_takes_a_scanner_and_a_style_of_another_package(package: dict[str, str], tmp_path: Path) -> None:
    program = "import sys; from pipeline.cli.main import simulate; sys.exit(simulate(sys.argv[1:]))"
    words = ["--sensor", "tls", "--out", "run", "--set", "wall={style: quarry, resolution_m: 0.2}", "--set", "scanner=toy_one"]
    words += ["--set", "rockfall.count=1", "--set", "scanner.azimuth_step_rad=0.002", "--set", "scanner.zenith_step_rad=0.002"]
    result = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, env=package, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    config = json.loads((tmp_path / "run" / "run.json").read_text())["config"]
    assert config["wall"]["style"] == "quarry"
    assert config["scanner"]["name"] == "Toy"


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ("known = os:sep", "the name 'known' is already in use; choose another name"),
        ("other = os:nonesuch", r"does not load \(AttributeError"),
        ("other = os:sep", "an object of the type str; allowed: a number"),
    ],
)
def test_wrong_entry_points_are_said_in_one_line(
    entry: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "wrong-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: wrong\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[scarpsim.tests]\n{entry}\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(InputError, match=problem):
        load_plug_ins("scarpsim.tests", "a number", lambda value: isinstance(value, int), {"known"})
