"""Inject known effects into real measurements, diagnose each like `scarpsim gap`, and score the answers.

    OMP_NUM_THREADS=1 python benchmarks/gap_injections/run.py --out /tmp/injections [--page docs/validation/gap_injections.md]

An interrupted run continues. Under --out are bases/ (the unchanged measurements), cases/ (with an effect; each is a folder for
`scarpsim gap`), answers/ and results.json. The data are in ../shared/data.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
import traceback
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.gap_injections.bases import BASES
from benchmarks.gap_injections.cases import CASES, Case
from benchmarks.gap_injections.page import page
from benchmarks.gap_injections.score import BeforeInjection, Json, scored
from pipeline.change.robust import nmad
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.residuals.alignment import compute_residuals, fit_pose_robustly
from pipeline.gap.residuals.residuals import Residuals
from scene.common.errors import InputError

_ROUNDS = 3
_NOISES = {
    "tls.range_noise": "range_sigma_m",
    "tls.angle_noise": "angle_sigma_rad",
    "stereo.parallax_noise": "parallax_sigma_px",
}
"""White noise that a model has as its own parameters."""


def base_folder(name: str, out: Path) -> Path:
    """Return the folder of an unchanged measurement, with the white noise that its own diagnosis proposes.

    It is made and diagnosed once.
    """
    folder = out / "bases" / name
    answer = out / "answers" / f"{name}.json"
    if folder.exists() and answer.exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    BASES[name].make(folder)
    model = yaml.safe_load((folder / "model.yaml").read_text())
    said = diagnosed(folder)
    found: Json = {"as_it_is": said, "noise": {}}
    for _ in range(_ROUNDS):
        noise = white_noise(said, model["noise"])
        if not noise:
            break
        model["noise"] |= noise
        (folder / "model.yaml").write_text(yaml.safe_dump(model))
        said = diagnosed(folder)
        found |= {"noise": found["noise"] | noise, "as_diagnosed": said}
    _write(answer, found)
    return folder


def white_noise(said: Json, believed: dict[str, float]) -> dict[str, float]:
    """Return values of a model's noise according to a diagnosis: too large, or with additional white noise."""
    found = dict(said["lower_noise"])
    for each in said["effects"]:
        key = _NOISES.get(each["name"])
        if key:
            more = [value["value"] for name, value in each["parameters"].items() if "sigma" in name]
            found[key] = float(np.hypot(found.get(key, believed[key]), max(more)))
    return found


def diagnosed(folder: Path) -> Json:
    """Return gap.json of a folder's diagnosis, with the processor time."""
    start = time.process_time()
    try:
        return {**told(diagnose(read_measurement(folder))), "cpu_s": time.process_time() - start}
    except InputError as error:
        return {"verdict": "refused", "error": str(error), "effects": [], "lower_noise": {}}
    except Exception:
        return {"verdict": "error", "error": traceback.format_exc()[-2000:], "effects": [], "lower_noise": {}}


def told(found: GapDiagnosis) -> Json:
    gap = found.gap
    return {
        "verdict": found.verdict,
        "effects": [each.to_dict() for each in found.effects],
        "changes": len(found.changes),
        "points": len(found.residuals),
        "p_value": found.remaining["p_value"],
        "note": found.remaining["note"],
        "lower_noise": found.remaining["lower_noise"],
        "gap": None if gap is None else {key: getattr(gap, key) for key in ("before", "after", "floor", "closed")},
    }


def strength(effect: str, base: Path, folder: Path) -> float | None:
    """Return the signal-to-noise ratio of an injection in white noise; None if a folder cannot be read.

    It is that of the change of the residuals' mean that a pose does not explain, or, for noise, of the change of their variance.
    """
    try:
        before, after = registered_residuals(base), registered_residuals(folder)
    except InputError:
        return None
    there, spread = after.values_at(after.value, before.index), nmad(before.value[before.usable] / before.sigma[before.usable])
    used = before.usable & np.isfinite(there) & (np.abs(before.value) < 4 * spread * before.sigma)
    if not used.any():
        return None
    sigma = spread * before.sigma[used]
    if "noise" in effect:
        return float(abs(nmad(there[used] / sigma) ** 2 - nmad(before.value[used] / sigma) ** 2) * np.sqrt(used.sum() / 2))
    columns, change = before.pose_jacobian[used] / sigma[:, None], (there - before.value)[used] / sigma
    return float(np.linalg.norm(change - columns @ np.linalg.lstsq(columns, change, rcond=None)[0]))


@cache
def registered_residuals(folder: Path) -> Residuals:
    """Return the residuals of a measurement's folder after registration."""
    found = compute_residuals(read_measurement(folder))
    return replace(found, value=fit_pose_robustly(found)[0])


def answered(case: Case, out: Path) -> Json:
    """Return the answer to a case, kept under `out`."""
    path = out / "answers" / f"{case.name}.json"
    if path.exists():
        return json.loads(path.read_text())
    base, folder = base_folder(case.base, out), out / "cases" / case.name
    BASES[case.base].put(base, folder, case.effect, case.values, case.number)
    found = {"case": asdict(case), "strength": strength(case.effect, base, folder), **diagnosed(folder)}
    _write(path, found)
    return found


def before_injection(case: Case, out: Path) -> BeforeInjection:
    """Return the effects and the noise that the measurement of a case had before the injection."""
    found = json.loads((out / "answers" / f"{case.base}.json").read_text())
    said = [each for answer in (found["as_it_is"], found.get("as_diagnosed", {"effects": []})) for each in answer["effects"]]
    effects = {each["name"].partition(".")[2]: each for each in said if each["kind"] == "physical"}
    return BeforeInjection(effects, missing_noise(case, out) if "noise" in case.effect else 1.0)


def missing_noise(case: Case, out: Path) -> float:
    """Return the factor on an injected noise that makes it equal to all the noise that the model lacks.

    The injection adds the variance after - before, in units of the predicted one, but the model lacks after - 1.
    """
    before, after = (registered_residuals(out / part) for part in (Path("bases") / case.base, Path("cases") / case.name))
    there = after.values_at(after.value, before.index)
    used = before.usable & np.isfinite(there)
    was, now = (nmad((value / before.sigma)[used]) ** 2 for value in (before.value, there))
    return float(np.sqrt(max(now - 1, 0.0) / (now - was))) if now > was else 1.0


def _write(path: Path, values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=1, default=float))


def run(out: Path, cases: tuple[Case, ...] = CASES) -> list[Json]:
    """Return the scored answers to all cases."""
    found = []
    for case in cases:
        row = scored(answered(case, out), before_injection(case, out))
        print(f"{case.name} {case.base} {case.effect} {row['judgement']}: {row['verdict']} {row['named']}", flush=True)
        found.append(row)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=[], metavar="BASE", help="measurements to use (default: all)")
    parser.add_argument("--page", type=Path, help="write the table there")
    parser.add_argument("--answered", action="store_true", help="make no further answers, score those that are there")
    arguments = parser.parse_args()
    wanted = [case for case in CASES if not arguments.only or case.base in arguments.only]
    if arguments.answered:
        wanted = [case for case in wanted if (arguments.out / "answers" / f"{case.name}.json").exists()]
    rows = run(arguments.out, tuple(wanted))
    bases = {name: json.loads((arguments.out / "answers" / f"{name}.json").read_text()) for name in {row["base"] for row in rows}}
    _write(arguments.out / "results.json", {"rows": rows, "bases": bases})
    if arguments.page:
        arguments.page.write_text(page(rows, bases))


if __name__ == "__main__":
    main()
