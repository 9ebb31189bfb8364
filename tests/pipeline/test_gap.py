"""`scarpsim gap` on measurements of an independent generator (tests/gap_cases.py): verdicts, values, files, printed output."""

from __future__ import annotations

import ast
import json
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from gap_cases import Scan, write_scan

from pipeline.cli.main import main
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import STEPS, GapDiagnosis, diagnose
from pipeline.gap.report.covariate_ranking import rank_disagreements
from pipeline.gap.report.report import summarise, to_dict
from pipeline.gap.report.wording import paragraph
from scene.common import threads
from scene.common.backend import dr
from sensors.numerics.curve import Axis, interpolate_on_host

ROOT = Path(__file__).parents[2]


def found_in(folder: Path, seed: int, step_rad: float = 0.008, **case: Any) -> GapDiagnosis:
    write_scan(folder, seed, step_rad=step_rad, **case)
    return diagnose(read_measurement(folder))


def test_the_generator_shares_no_code_with_what_it_tests() -> None:
    tree = ast.parse((ROOT / "tests/gap_cases.py").read_text())
    modules = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    modules |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import) for name in node.names}
    assert not {str(module).split(".")[0] for module in modules} & {"scene", "sensors", "pipeline"}


def test_nothing_is_found_where_there_is_nothing(tmp_path: Path) -> None:
    assert found_in(tmp_path, 1).verdict == "no_gap"


def test_a_rockfall_is_a_change_of_the_scene(tmp_path: Path) -> None:
    found = found_in(tmp_path, 16, fall=(20.0, 12.0, 0.4))
    assert found.effects == ()  # no sensor is blamed; whether what remains passes its own test at 1 % is another matter
    (change,) = found.changes
    x0, _, z0, x1, _, z1 = change.to_dict(read_measurement(tmp_path).frame)["bbox_m"]
    assert x0 - 0.5 < 20.0 < x1 + 0.5
    assert z0 - 0.5 < 12.0 < z1 + 0.5
    assert 0.2 < change.volume_m3 < 1.2  # 1.2 x 1.2 x 0.4 m


def wobbling(azimuth: Any, _zenith: Any, line: Any) -> Any:
    """Return recorded minus true angles: 80 microradians in zenith, with a period of 37 lines."""
    return 0 * azimuth, 8e-5 * np.sin(2 * np.pi * line / 37 + 1)


def test_a_wobble_is_named_with_its_values_and_closes_the_gap(tmp_path: Path) -> None:
    found = found_in(tmp_path, 11, angles=wobbling)
    (effect,) = found.effects
    assert (found.verdict, effect.name) == ("named", "tls.wobble")
    assert abs(effect.entry["amplitude_rad"] - 8e-5) < 4 * effect.std["amplitude_rad"]
    assert abs(effect.entry["lines_per_cycle"] - 37) < 0.5
    assert found.gap is not None
    assert (found.gap.closed or 0.0) > 0.7


def test_noise_that_falls_with_intensity_is_named(tmp_path: Path) -> None:
    def ranges(scan: Scan) -> Any:
        return scan.R + 0.004 * scan.power**-0.5 * scan.rng.standard_normal(len(scan.R))

    found = found_in(tmp_path, 10, ranges=ranges)
    assert [effect.name for effect in found.effects] == ["tls.range_noise_intensity"]
    assert found.effects[0].entry["a_m"] == pytest.approx(0.004, rel=0.1)


def test_a_jump_in_azimuth_is_unknown(tmp_path: Path) -> None:
    found = found_in(tmp_path, 18, step_rad=0.013, ranges=lambda scan: scan.R + 0.003 * np.where(scan.az > 1.6, 1.0, -1.0))
    assert found.verdict == "unknown"
    assert found.effects[0].kind == "empirical"
    assert "depends on" in paragraph(found, rank_disagreements(found))
    assert "_empirical (covariate" in summarise(found)


def test_a_range_error_that_jumps_is_folded_with_its_high_overtones(tmp_path: Path) -> None:
    """A square wave is first found as the sine of a cyclic error.

    With overtones up to the fifth, 6.7 % of its variance remain (correlation 0.966), which used to be taken for noise; up to the
    eleventh, 3.4 % remain (0.983).
    """
    length = 2.6

    def square(range_m: Any) -> Any:
        return 0.003 * np.sign(np.sin(2 * np.pi * range_m / length + 0.4))

    found = found_in(tmp_path, 22, ranges=lambda scan: scan.R + square(scan.R))
    (effect,) = found.effects
    assert (found.verdict, effect.name, effect.entry["covariate"]) == ("unknown", "tls.range_empirical", "range")
    assert effect.entry["along"]["period"] == pytest.approx(length, rel=0.01)
    range_m = found.residuals.covariates["range"]
    curve = interpolate_on_host(range_m, range_m, Axis(**effect.entry["along"]), Axis(), effect.entry["values_m"])
    assert np.corrcoef(curve, square(range_m))[0, 1] > 0.975


def test_steps_of_the_range_are_found_to_a_micrometre(tmp_path: Path) -> None:
    found = found_in(tmp_path, 21, ranges=lambda scan: 0.004 * np.rint(scan.R / 0.004))
    assert [effect.name for effect in found.effects] == ["tls.range_quantization"]
    assert found.effects[0].entry["step_m"] == pytest.approx(0.004, abs=1e-6)


def test_losses_of_weak_echoes_are_a_detection_limit(tmp_path: Path) -> None:
    found = found_in(tmp_path, 14, lost=lambda scan: scan.power < 1.2)
    assert [effect.name for effect in found.effects] == ["tls.detection_limit"]
    assert found.effects[0].entry["minimum_power"] == pytest.approx(1.2, rel=0.01)


def test_too_few_points_are_no_data(tmp_path: Path) -> None:
    assert found_in(tmp_path, 1, step_rad=0.05).verdict == "insufficient_data"


def test_the_corrected_model_leaves_no_gap_and_files_are_as_promised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A bias by the incidence is named beside a rockfall, which is no effect of the sensor."""
    case, out = tmp_path / "case", tmp_path / "out"
    case.mkdir()
    write_scan(
        case,
        8,
        ranges=lambda scan: scan.R + 0.008 * (1 / scan.cos_i - 1),
        fall=(20.0, 12.0, 0.4),
        intensity=False,
        step_rad=0.011,
    )
    assert main(["gap", str(case), "--out", str(out)]) == 0
    result = json.loads((out / "gap.json").read_text())
    assert result["verdict"] == "named"
    assert result["effects"][0]["name"] == "tls.range_incidence_bias"
    (change,) = result["scene_changes"]
    x0, _, z0, x1, _, z1 = change["bbox_m"]
    assert x0 - 0.5 < 20.0 < x1 + 0.5
    assert z0 - 0.5 < 12.0 < z1 + 0.5
    assert 0.2 < change["volume_m3"] < 1.2  # 1.2 x 1.2 x 0.4 m
    assert "intensity" in result["remaining"]["note"]
    hidden = {each["name"]: each for each in result["detectable"]}
    assert "tls.range_incidence_bias" not in hidden
    assert 1e-4 < hidden["tls.range_offset"]["size"] < 0.02
    assert hidden["tls.range_intensity_bias"]["size"] is None
    assert "not recorded" in hidden["tls.range_intensity_bias"]["note"]
    assert "would have shown" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} >= {"gap.json", "model_after.yaml", "before.laz", "after.laz", "report.html"}
    (case / "model.yaml").write_text((out / "model_after.yaml").read_text())
    assert yaml.safe_load((case / "model.yaml").read_text())["effects"][0]["name"] == "range_incidence_bias"
    told: list[str] = []
    assert diagnose(read_measurement(case), progress=told.append).verdict == "no_gap"
    assert told == list(STEPS)


def test_the_outcome_does_not_depend_on_the_number_of_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scan(tmp_path, 3, angles=wobbling, step_rad=0.009)
    measurement, before, told = read_measurement(tmp_path), dr.thread_count(), []
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            monkeypatch.setattr(threads, "executor", lambda count=count: ThreadPoolExecutor(count))
            told.append({key: value for key, value in to_dict(diagnose(measurement), measurement).items() if key != "seconds"})
    finally:
        dr.set_thread_count(before)
    assert told[0] == told[1]


def test_a_model_that_is_too_noisy_is_told_so(tmp_path: Path) -> None:
    """The ranges have 3 mm of noise; the model expects 6 mm and the angles' share."""
    write_scan(tmp_path, 31, step_rad=0.007)
    model = tmp_path / "model.yaml"
    model.write_text(model.read_text().replace("range_sigma_m: 0.003", "range_sigma_m: 0.006"))
    found = diagnose(read_measurement(tmp_path))
    assert (found.verdict, found.effects) == ("unknown", ())
    told = re.search(r"the residuals have (\d+) % of the predicted standard deviation", found.remaining["note"])
    assert told is not None
    assert 45 <= int(told[1]) <= 75
    assert found.model_after.noise.range_sigma_m == pytest.approx(0.003, rel=0.15)
    assert found.gap is not None
    assert found.gap.closed > 0.9


def test_noise_by_incidence_is_told_from_noise_of_the_angles(tmp_path: Path) -> None:
    """Each cell has nine points, quiet ones beside noisy ones.

    Without weights the noisy points tilt the cell's plane, and the quiet ones seem noisy too.
    """
    noisy = found_in(
        tmp_path,
        43,
        ranges=lambda scan: scan.R + 0.01 * (1 / scan.cos_i - 1) * scan.rng.standard_normal(len(scan.R)),
        step_rad=0.012,
    )
    (effect,) = noisy.effects
    assert (noisy.verdict, effect.name) == ("named", "tls.range_noise_incidence")
    assert abs(effect.entry["sigma_m"] - 0.01) < 3 * effect.std["sigma_m"]
