"""From the folder of `scarpsim monitor` to a diagnosis: `scarpsim gap` on the stable rock of each epoch.

The scans come from `monitor_cases`: closed form, without our own code.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from monitor_cases import ANGLE_NOISE_RAD, NOISE_M, STATION, las, points, scan

from pipeline import diagnose, measure
from pipeline.calibration.reference_error import ReferenceError
from pipeline.calibration.single_ranges import SingleRanges
from pipeline.cli import main as cli
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.points.laz import read_laz
from pipeline.monitoring.repeated_directions import repeated_noise
from pipeline.monitoring.stable_measurement import build_from_monitoring
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import TlsModel, TlsNoise

pytestmark = pytest.mark.usefixtures("undrawn")

POSITION = np.array([float(each) for each in STATION.split()])
STEP_RAD = 0.0022
COEFFICIENT_M = 0.008
FALL = (8.0, 5.0, 1.2, 0.3)


def incidence_bias(distance: FloatArray, cosine: FloatArray) -> FloatArray:
    """Return the error of ranges that are too long by 8 mm at 60 degrees of incidence."""
    return COEFFICIENT_M * (1 / cosine - 1)


def scans(folder: Path, seed: int, later: int, **how: Any) -> list[Path]:
    """Write a reference epoch without effects and some later epochs; how: what `scan` does to the later ones."""
    folder.mkdir()
    shifts = 0.002 * np.random.default_rng(seed).normal(size=(later, 3))
    written = [las(folder / "march.las", scan(seed, step_rad=STEP_RAD))]
    for number, shift in enumerate(shifts, start=1):
        moved = scan(seed + number, step_rad=STEP_RAD, **how) + shift
        written.append(las(folder / f"later_{number}.las", moved))
    return written


def run(*words: object) -> int:
    return cli.main([*map(str, words), "--quiet"])


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "model.yaml"
    path.write_text(f"sensor: tls\nnoise: {{range_sigma_m: {NOISE_M}, angle_sigma_rad: {ANGLE_NOISE_RAD}}}\n")
    return path


def diagnosed(folder: Path, model: Path, seed: int, **how: Any) -> dict[str, Any]:
    """Monitor and diagnose two later epochs, and return gap.json."""
    assert run("monitor", *scans(folder / "scans", seed, 2, **how), "--model", model, "--out", folder / "found") == 0
    assert run("gap", folder / "found", "--out", folder / "gap") == 0
    return dict(json.loads((folder / "gap" / "gap.json").read_text()))


def test_nothing_is_named_where_rock_fell(model: Path, tmp_path: Path) -> None:
    found = diagnosed(tmp_path, model, 10, block=FALL)
    assert (found["verdict"], found["effects"], found["scene_changes"]) == ("no_gap", [], [])
    assert "are on stable rock" in (tmp_path / "gap" / "report.html").read_text()


def test_what_fell_is_left_out(model: Path, tmp_path: Path) -> None:
    assert run("monitor", *scans(tmp_path / "scans", 10, 2, block=FALL), "--model", model, "--out", tmp_path / "found") == 0
    build_from_monitoring(tmp_path / "found", tmp_path / "measurement")
    told = yaml.safe_load((tmp_path / "measurement" / "measurement.yaml").read_text())
    assert told["points"] == ["scan_0.laz", "scan_1.laz"]
    assert told["reference_error_m"] == pytest.approx(NOISE_M, rel=0.2)
    np.testing.assert_allclose([each["position_m"] for each in told["scanners"]], [POSITION, POSITION], atol=0.02)
    assert "are on stable rock" in told["notes"][0]
    events = read_laz(tmp_path / "found" / "epoch_001.laz")
    used = read_laz(tmp_path / "measurement" / "scan_0.laz").points
    fallen = events.points[events.extra["event"] > 0]
    assert len(fallen) > 10
    assert np.linalg.norm(used[:, None] - fallen[None, ::10], axis=2).min() > 1e-3
    measurement = read_measurement(tmp_path / "measurement")
    right = SingleRanges.of(measurement, measurement.model)
    noisy = TlsNoise(range_sigma_m=3 * NOISE_M, angle_sigma_rad=ANGLE_NOISE_RAD)
    wrong = SingleRanges.of(measurement, TlsModel(noise=noisy))
    assert right is not None
    assert wrong is not None
    assert (right.agrees, wrong.agrees) == (True, False)
    assert "both find the same noise" in right.words
    assert "neighbouring points share errors" in wrong.words
    error = ReferenceError.of(measurement)
    assert error is not None
    assert (error.shared, error.repeated) == (True, True)


def test_an_error_of_the_later_epochs_is_named(model: Path, tmp_path: Path) -> None:
    found = diagnosed(tmp_path, model, 20, ranges=incidence_bias)
    (effect,) = found["effects"]
    assert effect["name"] == "tls.range_incidence_bias"
    value = effect["parameters"]["coefficient_m"]
    assert abs(value["value"] - COEFFICIENT_M) < 4 * value["std"]


@pytest.mark.parametrize("later", [1, 2, 3])
def test_the_noise_of_a_reference_is_found_where_later_scans_repeat_its_directions(later: int) -> None:
    clouds = [scan(seed, step_rad=STEP_RAD) for seed in range(later + 1)]
    found = repeated_noise(clouds[0], clouds[1:], POSITION)
    assert found is not None
    assert found.sigma_m == pytest.approx(NOISE_M, rel=0.1)
    assert repeated_noise(clouds[0], [*clouds[1:], scan(9, step_rad=1.37 * STEP_RAD)], POSITION) is None


def test_more_noise_of_later_epochs_is_not_that_of_the_reference() -> None:
    clouds = [scan(seed, step_rad=STEP_RAD, noise_m=noise) for seed, noise in enumerate([NOISE_M, 3 * NOISE_M, 3 * NOISE_M])]
    found = repeated_noise(clouds[0], clouds[1:], POSITION)
    assert found is not None
    assert found.sigma_m == pytest.approx(NOISE_M, rel=0.25)


@pytest.fixture(scope="module")
def unordered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two epochs whose points are in no order, so that only the user can say where the scanner stood."""
    folder = tmp_path_factory.mktemp("unordered")
    for number, name in enumerate(("march.las", "april.las"), start=1):
        las(folder / name, points(30_000, number))
    return folder


def no_position(folder: Path, out: Path) -> list[Any]:
    words = ["--direction", "0,-1,0", "--scanner", "riegl_vz400i"]
    assert run("monitor", folder / "march.las", folder / "april.las", *words, "--out", out) == 0
    return [out]


def no_model(folder: Path, out: Path) -> list[Any]:
    where = ",".join(STATION.split())
    assert run("monitor", folder / "march.las", folder / "april.las", "--position", where, "--out", out) == 0
    return [out]


def photographs(folder: Path, out: Path) -> list[Any]:
    words = ["--position", ",".join(STATION.split()), "--photographs"]
    assert run("monitor", folder / "march.las", folder / "april.las", *words, "--out", out) == 0
    return [out, "--scanner", "riegl_vz400i"]


def unfinished(folder: Path, out: Path) -> list[Any]:
    found = no_model(folder, out)
    (out / "monitor.json").unlink()
    return found


def lost(folder: Path, out: Path) -> list[Any]:
    found = no_model(folder, out)
    values = json.loads((out / "monitor.json").read_text())
    values["inputs"][1]["sha256"] = {"elsewhere/april.las": "0"}
    (out / "monitor.json").write_text(json.dumps(values))
    return [*found, "--scanner", "riegl_vz400i"]


def with_reference(folder: Path, out: Path) -> list[Any]:
    return [*no_model(folder, out), "--scanner", "riegl_vz400i", "--reference", folder / "march.las"]


@pytest.mark.parametrize(
    ("made", "problem", "remedy"),
    [
        (no_position, "where the scanner stood", "add --position X,Y,Z"),
        (no_model, "its noise is unknown", "add --scanner"),
        (photographs, "not of a laser scanner", "--photographs"),
        (unfinished, "is not finished", "--resume"),
        (lost, "the file of epoch 1 is not there", "move the file back"),
        (with_reference, "--reference: the option cannot be combined", "leave the option out"),
    ],
)
def test_mistakes(
    made: Callable[[Path, Path], list[Any]],
    problem: str,
    remedy: str,
    unordered: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = made(unordered, tmp_path / "found")
    capsys.readouterr()
    assert run("gap", *words, "--out", tmp_path / "gap") == 2
    told = capsys.readouterr().err
    assert problem in told
    assert remedy in told
    assert told.count("\n") == 1
    assert not (tmp_path / "gap").exists()


def test_python_diagnoses_a_monitoring_as_the_command_does(model: Path, tmp_path: Path) -> None:
    commanded = diagnosed(tmp_path, model, 10, block=FALL)
    found = diagnose(tmp_path / "found", progress=False)
    assert found.to_dict()["gap"] == commanded["gap"]
    assert found.verdict == commanded["verdict"] == "no_gap"


def test_python_tests_the_model_that_it_is_given(model: Path, tmp_path: Path) -> None:
    assert run("monitor", *scans(tmp_path / "scans", 10, 1), "--model", model, "--out", tmp_path / "found") == 0
    given = TlsModel(sensor="tls", noise=TlsNoise(range_sigma_m=3 * NOISE_M, angle_sigma_rad=ANGLE_NOISE_RAD))
    assert measure(tmp_path / "found", model=given).model.noise.range_sigma_m == pytest.approx(3 * NOISE_M)
    with pytest.raises(InputError, match="stereo pair"):
        measure(tmp_path / "found", model={"sensor": "stereo"})
