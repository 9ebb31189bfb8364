"""Make a run's report from the contents of its folder: the epochs' records and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.run.instrument import instrument_figures
from pipeline.run.page import BlockRow, EpochReport, RegistrationSummary, RunReport, write_report
from pipeline.run.site import SensorSite


def write_run_report(
    out: Path, identity: dict[str, Any], site: SensorSite, records: list[dict[str, Any]], *, complete: bool
) -> Path:
    """Write report.html of a run folder and return its path.

    Parameters
    ----------
    out : Path
        The run's folder.
    identity : dict
        Sensor, seed and config, as in run.json.
    site : SensorSite
        Wall and sensor.
    records : list of dict
        Records of the finished epochs, the reference first.
    complete : bool
        False if the run was interrupted.
    """
    path = out / "report.html"
    reference = out / "reference.png"
    report = RunReport(
        title=f"{site.name.replace('_', ' ').capitalize()}: rockfall seen by {_instrument(identity['sensor'])}",
        sensor=identity["sensor"],
        seed=identity["seed"],
        reference=reference.read_bytes() if reference.exists() else b"",
        epochs=[_epoch(out, record) for record in records[1:] if (out / f"difference_{record['epoch']:03d}.png").exists()],
        total=len(records) - 1,
        config=identity["config"],
        key_figures=_key_figures(site, identity["config"], records),
        complete=complete,
    )
    write_report(path, report)
    return path


def _instrument(sensor: str) -> str:
    """Name the sensor."""
    return "a stereo pair" if sensor == "stereo" else "a laser scanner"


def _key_figures(site: SensorSite, config: dict[str, Any], records: list[dict[str, Any]]) -> dict[str, str]:
    """Return the rows of the table at the top."""
    width, height, _ = site.mesh.bounds[1] - site.mesh.bounds[0]
    figures = {
        **instrument_figures(site),
        "Wall": f"{width:.1f} m x {height:.1f} m, {len(site.mesh.faces):,} triangles",
        "Pixel of the difference map": f"{config['difference']['gsd_m'] * 1e3:g} mm",
        "Points of the reference": f"{records[0]['points']:,}" if records else "none",
    }
    return figures | ({"Repairs of the mesh": "; ".join(site.repairs)} if site.repairs else {})


def _epoch(out: Path, record: dict[str, Any]) -> EpochReport:
    """Collect what the report shows of one epoch."""
    number, annotated = record["epoch"], {annotation["block"] for annotation in record["annotations"]["annotations"]}
    registration = record["registration"]
    pictures = {name: out / f"{name}_{number:03d}.png" for name in ("hillshade", "difference", "histogram", "icp", "blocks")}
    fields = ("rms_m", "inliers", "points", "iterations", "reason")
    return EpochReport(
        number=number,
        points=record["points"],
        inside=record["statistics"]["inside_blocks"],
        outside=record["statistics"]["outside_blocks"],
        sigma_m=record["statistics"]["sigma_m"],
        blocks=[_row(block, block["label"] in annotated) for block in record["blocks"]],
        hillshade=pictures["hillshade"].read_bytes(),
        difference=pictures["difference"].read_bytes(),
        histogram=pictures["histogram"].read_bytes(),
        convergence=pictures["icp"].read_bytes() if registration else None,
        zooms=pictures["blocks"].read_bytes() if pictures["blocks"].exists() else None,
        registration=RegistrationSummary(**{name: registration[name] for name in fields}) if registration else None,
    )


def _row(block: dict[str, Any], annotated: bool) -> BlockRow:
    """Convert a block's record to a row of the report."""
    return BlockRow(
        label=block["label"],
        shape=block["shape"],
        size_m=block["size_m"],
        volume_m3=block["volume_m3"],
        measured_volume_m3=block["measured_volume_m3"] if block["measured_area_m2"] else None,
        position_m=block["position_m"],
        world_position_m=block["world_position_m"],
        annotated=annotated,
    )
