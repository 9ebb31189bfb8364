"""An effect from another package: one class and one entry point make it available in every command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("undrawn")

EFFECT = '''
"""Range error of a scanner that warms up."""

from typing import Any, Literal

from sensors.effects.base import parameter
from sensors.effects.laser import RangeEffect, RangeSpread


class RangeWarmUp(RangeEffect):
    """dR = a s (1 - s): s the share of the scan's duration that has passed."""

    name: Literal["range_warm_up"] = "range_warm_up"
    needs = ("share",)
    amplitude_m: float = parameter("four times the largest error", unit="m", source="empirical", typical=0.005, ge=-1, le=1)

    def error(self, at: Any, m: Any, p: Any) -> Any:
        return p.amplitude_m * at.share * (1 - at.share)


class RangeShimmer(RangeSpread):
    """dR ~ N(0, s R^2)."""

    name: Literal["range_shimmer"] = "range_shimmer"
    sigma_per_m: float = parameter("standard deviation over R^2", unit="1/m", source="test", typical=1e-6, ge=0, le=1)

    def sigma(self, at: Any, m: Any, p: Any) -> Any:
        return p.sigma_per_m * at.range_m**2
'''
ENTRIES = "[scarpsim.effects]\nwarm = toy_effects:RangeWarmUp\nshimmer = toy_effects:RangeShimmer\n"
KNOWS = """
import json
from types import SimpleNamespace
import numpy as np
from pipeline.gap.mean.signatures import systematic_families
from pipeline.gap.noise_and_edges.variance_model import variance_candidates
from pipeline.cli.json_schema import json_schema
from scene.common.keyed_random import KeyedRandom
from sensors.effects import TLS_EFFECTS, catalogue
from sensors.models.sensor_model import TlsModel
from sensors.signal_chain.pulses import PulseGeometry

at = PulseGeometry(*np.random.default_rng(1).uniform(0.4, 0.9, (9, 50)))
residuals = SimpleNamespace(sensor="tls", geometry=at, candidates=catalogue("tls"))
toy = next(each for each in systematic_families(residuals, None) if each.name == "range_warm_up")
shimmer = next(each for each in variance_candidates(residuals) if each.name == "range_shimmer")
model = TlsModel(noise={"range_sigma_m": 0, "angle_sigma_rad": 0}, effects=[{"name": "range_shimmer", "sigma_per_m": 2e-3}])
print(json.dumps({
    "column": float(np.abs(toy.columns[:, 0] - at.share * (1 - at.share)).max()),
    "parameters": toy.parameters(np.array([0.004])),
    "form": float(np.ptp(shimmer.variance[:, 0] / at.range_m**4)),
    "predicted": float(np.abs(model.variance(at) / (2e-3 * at.range_m**2) ** 2 - 1).max()),
    "planned": [each.planned for each in TLS_EFFECTS if each.tag() == "range_shimmer"],
    "schema": "RangeWarmUp" in json.dumps(json_schema("simulation")),
}))
"""


@pytest.fixture
def package(tmp_path: Path) -> dict[str, str]:
    """The environment of a process in which the package is installed."""
    (tmp_path / "toy_effects.py").write_text(EFFECT)
    info = tmp_path / "toy_effects-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-effects\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    paths = [str(tmp_path), str(Path(__file__).parents[1])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def test_gap_schema_and_plans_know_an_effect_of_another_package(package: dict[str, str]) -> None:
    result = subprocess.run([sys.executable, "-c", KNOWS], capture_output=True, text=True, env=package)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["column"] < 1e-12
    assert found["parameters"] == {"amplitude_m": pytest.approx(0.004)}
    assert found["form"] == pytest.approx(0.0, abs=1e-12)
    assert found["predicted"] < 1e-9
    assert found["planned"] == [True]
    assert found["schema"] is True


def test_a_run_records_ranges_with_an_effect_of_another_package(package: dict[str, str], tmp_path: Path) -> None:
    program = "import sys; from pipeline.cli.main import simulate\nfor words in {}: print(simulate(words), file=sys.stderr)"
    small = ["wall.width_m=4", "wall.height_m=3", "epochs=1", "rockfall.count=2"]
    small += ["scanner.azimuth_step_rad=0.002", "scanner.zenith_step_rad=0.002"]
    runs = []
    for out, name in (("wrong", "range_warm_upp"), ("right", "range_warm_up")):
        sets = [*small, f"sensor={{sensor: tls, effects: [{{name: {name}, amplitude_m: 0.02}}]}}"]
        options = [word for each in sets for word in ("--set", each)]
        runs.append(["--sensor", "tls", "--out", str(tmp_path / out), "--quiet", *options])
    done = subprocess.run([sys.executable, "-c", program.format(runs)], capture_output=True, text=True, env=package)
    assert done.returncode == 0, done.stderr
    error, *codes = [line for line in done.stderr.splitlines() if line.strip()]
    assert "did you mean 'range_warm_up'" in error
    assert codes == ["2", "0"]
    assert not (tmp_path / "wrong").exists()
    (model,) = json.loads((tmp_path / "right" / "run.json").read_text())["config"]["sensor"]
    assert model["effects"] == [{"name": "range_warm_up", "amplitude_m": 0.02}]
