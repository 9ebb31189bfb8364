"""Inject known effects into one half of a scan whose other half is the reference, to see what is named beside the noise of both.

    OMP_NUM_THREADS=1 python benchmarks/gap_reference_points.py [--out runs/reference_points] [--write]

The scan is that of a workshop in closed form (benchmarks/workshop.py); the effects are those injected into real scans
(benchmarks/gap_injections/formulas.py). --write puts the table into docs/validation/gap_reference_points.md.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.documents import write_between
from benchmarks.gap_injections.bases import put_scanned
from benchmarks.workshop import scan
from pipeline.formats.measurements.measurement import read_measurement
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import write_laz
from pipeline.gap.naming.workflow import GapDiagnosis, diagnose
from pipeline.gap.report.wording import format_parameters as in_words
from pipeline.measurement.build import build
from pipeline.measurement.request import Request

PAGE, MARKS = Path("docs/validation/gap_reference_points.md"), ("<!-- reference points -->", "<!-- end of reference points -->")
STEP_DEG = 0.2
MODEL = {"sensor": "tls", "noise": {"range_sigma_m": 0.001, "angle_sigma_rad": 5e-5}}
PUT: dict[str, tuple[str, dict[str, float]]] = {
    "a cyclic error of 2 mm, 0.6 m": ("range_cyclic", {"amplitude_m": 0.002, "period_m": 0.6, "phase_rad": 0.8}),
    "an incidence bias of 3 mm": ("range_incidence_bias", {"coefficient_m": 0.003}),
    "an offset of 4 mm": ("range_offset", {"offset_m": 0.004}),
    "a wobble of 400 microradians, 9 lines": ("wobble", {"amplitude_rad": 0.0004, "lines_per_cycle": 9, "phase_rad": 0.5}),
    "a vertical index of 1 mrad": ("vertical_index", {"offset_rad": 0.001}),
}


def made(out: Path) -> Path:
    """Make the measurement of the scan's one half against the other, with a model of 1 mm noise."""
    out.mkdir(parents=True)
    (out / "model.yaml").write_text(yaml.safe_dump(MODEL))
    write_laz(out / "scan.laz", PointCloud(scan(STEP_DEG)[0]))
    build(Request([out / "scan.laz"], "half", model=out / "model.yaml", position=(0.0, 0.0, 0.0)), out / "half")
    return out / "half"


def changed(folder: Path, out: Path, model: dict[str, Any], left_out: tuple[str, ...] = ()) -> Path:
    """Copy the measurement with another model, and without some keys of its measurement.yaml."""
    shutil.copytree(folder, out)
    (out / "model.yaml").write_text(yaml.safe_dump(model))
    values = yaml.safe_load((out / "measurement.yaml").read_text())
    (out / "measurement.yaml").write_text(yaml.safe_dump({key: each for key, each in values.items() if key not in left_out}))
    return out


def row(title: str, folder: Path) -> tuple[str, GapDiagnosis]:
    """Diagnose a measurement and return a line of the table."""
    found = diagnose(read_measurement(folder))
    named = "; ".join(f"`{each.name}` ({in_words(each)})" for each in found.effects) or "nothing"
    gap = found.gap
    figures = "" if gap is None else f"{1e3 * gap.before:.2f} to {1e3 * gap.after:.2f}, floor {1e3 * gap.floor:.2f}"
    line = f"| {title} | {found.verdict} | {named} | {figures} |"
    print(line, flush=True)
    return line, found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/reference_points"))
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE}")
    arguments = parser.parse_args()
    shutil.rmtree(arguments.out, ignore_errors=True)
    folder = made(arguments.out)
    first, found = row("nothing", folder)
    lines = ["| put into the half that is compared | verdict | named | gap, mm |", "|---|---|---|---|", first]
    after = found.model_after.model_dump(mode="json")
    lines.append(
        row("nothing; compared with the corrected model of the first row", changed(folder, arguments.out / "after", after))[0]
    )
    unsaid = ("incidence", "reference_error_m", "notes")
    mesh = changed(folder, arguments.out / "mesh", MODEL, unsaid)
    lines.append(row("nothing; the error of the reference is not stated", mesh)[0])
    for number, (title, (effect, values)) in enumerate(PUT.items()):
        put_scanned(folder, arguments.out / effect, effect, values, number)
        lines.append(row(title, arguments.out / effect)[0])
    if arguments.write:
        write_between(PAGE, MARKS, "\n".join(lines))


if __name__ == "__main__":
    main()
