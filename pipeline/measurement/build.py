"""From the files that people have to the folder of a measurement, with words and a picture on how they were understood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.presets import read_preset
from pipeline.formats.atomic import filling, write_bytes, write_json, write_text
from pipeline.formats.laz import EXACT_INTENSITY, write_laz
from pipeline.formats.measurement import FILE, Measurement, read_measurement, read_model
from pipeline.formats.measurement_checks import check_near
from pipeline.formats.ply import write_ply
from pipeline.measurement.picture import picture
from pipeline.measurement.reference import HALF, Reference, from_file, half_of
from pipeline.measurement.scans import RawScan, read_scans
from pipeline.measurement.station import Station, find_station
from pipeline.measurement.units import check_extent, check_same_unit
from scene.errors import InputError
from scene.mesh import FloatArray
from scene.rounding import rounded_axes
from scene.yaml_text import yaml_line
from sensors.model import TlsModel

UNDERSTOOD = "understood.json"
_ONE_PLACE_M = 0.05
"""Stations that stand nearer to each other than this are one, set up again."""


@dataclass(frozen=True)
class Request:
    """What is asked for. scans: files, each an epoch; reference: a file, or `half`; scanner: a preset's name or file, or model: a
    file model.yaml; position: (3,) m; unit, reference_unit: of the files' coordinates; columns: of text files; number: which scan
    of a file of several, from 1."""

    scans: Sequence[Path]
    reference: str
    scanner: str | None = None
    model: Path | None = None
    position: tuple[float, float, float] | None = None
    unit: str = "m"
    reference_unit: str = "m"
    columns: Sequence[str] = ()
    number: int | None = None


@dataclass(frozen=True)
class Understood:
    """How files were understood: lines of words by what they are about, and the command that comes next."""

    folder: Path
    about: dict[str, tuple[str, ...]]
    next_command: str

    def summary(self) -> str:
        """The words for people, a line each."""
        lines = [f"{name}: {line}" for name, words in self.about.items() for line in words]
        return "\n".join([*lines, f"next: {self.next_command}"])

    def to_dict(self) -> dict[str, Any]:
        return {"schema": 1, "folder": str(self.folder), **{name: list(words) for name, words in self.about.items()},
                "next": self.next_command}  # fmt: skip


def build(request: Request, out: Path) -> Understood:
    """Write the folder `out`: measurement.yaml, model.yaml, the points, the reference, what was understood in words and picture.

    Raises InputError where a file cannot be used, nothing tells the scanner's place, or points and reference do not meet.
    """
    model, model_words = _model(request)
    scans = _scans(request)
    stations = _stations(scans, request)
    station = stations[0]
    reference = half_of(scans[0], station) if request.reference == HALF else _given(request, scans[0], station)
    if reference.rows is not None:
        scans = [scans[0].part(reference.rows), *scans[1:]]
        stations = [_part(stations[0], reference.rows), *stations[1:]]
    scans, stations, echo_words = _single_echoes(scans, stations)
    model, noise_words = _with_known_errors(model, scans[0], station, reference)
    about = {
        "scan": tuple(f"{scan.name}: {len(scan.cloud.points):,} points{_said(scan)}" for scan in scans) + echo_words,
        "scanner": station.words,
        "reference": reference.words,
        "cannot show": reference.limits,
        "model": (*model_words, *noise_words),
    }
    found = Understood(out, about, f"scarpsim gap {out} --out {out}_gap")
    pattern = None if request.reference == HALF or echo_words else station.pattern
    with filling(out) as folder:
        _write(folder, scans, stations, reference, model, found, pattern)
        _tried(folder, out)
    return found


def _scans(request: Request) -> list[RawScan]:
    found = []
    for path in request.scans:
        each = read_scans(path, request.unit, request.columns)
        if request.number is not None:
            if request.number > len(each):
                raise InputError(f"got {request.number}", where="--scan", allowed=f"1 to {len(each)} of {path.name}")
            each = [each[request.number - 1]]
        for scan in each:
            check_extent(scan.cloud.points, str(path), request.unit)
        found.extend(each)
    return found


def _stations(scans: list[RawScan], request: Request) -> list[Station]:
    """The station of each scan; all have to stand in one place."""
    position = None if request.position is None else np.array(request.position)
    stations = [find_station(scan, position) for scan in scans]
    for scan, station in zip(scans[1:], stations[1:], strict=True):
        away = float(np.linalg.norm(station.position - stations[0].position))
        if away > _ONE_PLACE_M:
            raise InputError(
                f"stands {away:.3g} m from the place of {scans[0].name}", where=scan.name,
                allowed="epochs from one place", remedy="build a folder for each place; --scan N picks one scan of a file",
            )  # fmt: skip
    return stations


def _given(request: Request, scan: RawScan, station: Station) -> Reference:
    path = Path(request.reference)
    reference = from_file(path, request.reference_unit, station)
    check_same_unit(scan.cloud.points, reference.mesh.vertices, scan.name, request.unit, request.reference_unit)
    return reference


def _model(request: Request) -> tuple[TlsModel, tuple[str, ...]]:
    if request.model is not None:
        model = read_model(request.model)
        if not isinstance(model, TlsModel):
            raise InputError("is the model of a stereo pair", where=str(request.model), allowed="sensor: tls")
        return model, (f"as in {request.model}",)
    if request.scanner is None:
        raise InputError("is missing", where="--scanner", remedy="name a preset such as riegl_vz400i, or give --model FILE")
    preset = read_preset(request.scanner)
    return preset.model(), (f"of the preset {preset.name}: what its data sheet states, what it does not state by default",)


def _with_known_errors(
    model: TlsModel, scan: RawScan, station: Station, reference: Reference
) -> tuple[TlsModel, tuple[str, ...]]:
    """The model with the errors that the files themselves are known to have, in its white noise of the range."""
    rounding = _rounding_m(scan.cloud.points, station.position)
    more = {"the reference's error": reference.error_m, "the rounding of the coordinates": rounding}
    more = {name: value for name, value in more.items() if value > 0.1 * model.noise.range_sigma_m}
    if not more:
        return model, (f"range noise {1e3 * model.noise.range_sigma_m:.3g} mm",)
    total = float(np.sqrt(model.noise.range_sigma_m**2 + sum(value**2 for value in more.values())))
    parts = ", ".join(f"{1e3 * value:.2g} mm of {name}" for name, value in more.items())
    words = f"range noise {1e3 * total:.3g} mm: {1e3 * model.noise.range_sigma_m:.3g} mm of the instrument and {parts}"
    return replace_noise(model, total), (words,)


def replace_noise(model: TlsModel, sigma_m: float) -> TlsModel:
    """The model with another white noise of the range."""
    return model.model_copy(update={"noise": model.noise.model_copy(update={"range_sigma_m": sigma_m})})


def _rounding_m(points: FloatArray, position: FloatArray) -> float:
    """Standard deviation along the lines of sight of what rounding did to the coordinates, m."""
    steps = {each.axis: each.step_m for each in rounded_axes(points)}
    if not steps:
        return 0.0
    sight = points - position
    sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
    error = np.einsum("ni,i->n", sight**2, np.array([steps.get(axis, 0.0) for axis in "xyz"]) ** 2)
    return float(np.sqrt(error.mean() / 12))


def _single_echoes(scans: list[RawScan], stations: list[Station]) -> tuple[list[RawScan], list[Station], tuple[str, ...]]:
    """Without the points of pulses that came back more than once: they stand at edges and in vegetation."""
    kept = [scan.cloud.extra.get("number_of_returns", np.ones(len(scan.cloud.points))) == 1 for scan in scans]
    lost = sum(int((~rows).sum()) for rows in kept)
    if not lost:
        return scans, stations, ()
    words = (f"{lost:,} points of pulses with several echoes (edges, vegetation) are left out",)
    parts = [(scan.part(rows), _part(station, rows)) for scan, station, rows in zip(scans, stations, kept, strict=True)]
    return [part[0] for part in parts], [part[1] for part in parts], words


def _part(station: Station, rows: Any) -> Station:
    geometry = station.geometry
    if geometry is None:
        return station
    columns = {name: getattr(geometry, name)[rows] for name in ("range_m", "azimuth", "zenith", "line", "pulse")}
    return replace(station, geometry=replace(geometry, **columns))


def _said(scan: RawScan) -> str:
    return "" if not scan.words else "; " + "; ".join(scan.words)


def _write(
    folder: Path,
    scans: list[RawScan],
    stations: list[Station],
    reference: Reference,
    model: TlsModel,
    found: Understood,
    pattern: dict[str, list[float]] | None,
) -> None:
    station, names = stations[0], [f"scan_{number}.laz" for number in range(len(scans))]
    for name, scan, each in zip(names, scans, stations, strict=True):
        extra: dict[str, Any] = {} if each.line is None else {"line": each.line}
        if scan.cloud.intensity is not None:
            extra[EXACT_INTENSITY] = np.asarray(scan.cloud.intensity, dtype=np.float32)
        write_laz(folder / name, scan.cloud.points, gps_time=scan.cloud.gps_time, extra=extra)
    write_ply(folder / "reference.ply", reference.mesh)
    values: dict[str, Any] = {
        "sensor": "tls",
        "reference": "reference.ply",
        "points": names[0] if len(names) == 1 else names,
        "frame": "world",
        "scanner": {"position_m": station.position.tolist(), "rotation": station.rotation.tolist()},
    }
    if pattern is not None:
        values["pattern"] = pattern
    values |= {"model": "model.yaml", "notes": [f"the reference: {words}" for words in reference.limits]}
    write_text(folder / FILE, "".join(f"{key}: {yaml_line(value)}\n" for key, value in values.items()))
    head = "".join(f"# {line}\n" for line in found.about["model"])
    body = model.model_dump(mode="json")
    write_text(folder / "model.yaml", head + "".join(f"{key}: {yaml_line(value)}\n" for key, value in body.items()))
    write_text(folder / "understood.txt", found.summary() + "\n")
    write_json(folder / UNDERSTOOD, found.to_dict())
    title = ", ".join(dict.fromkeys(scan.name for scan in scans))
    seen = np.concatenate([scan.cloud.points for scan in scans])
    write_bytes(folder / "understood.png", picture(seen, reference.mesh, station.position, station.rotation, title))


def _tried(folder: Path, out: Path) -> Measurement:
    """The measurement as `gap` will read it. Raises InputError, with the folder's later name, where points and reference do not
    meet."""
    try:
        found = read_measurement(folder)
        check_near(found.fit)
    except InputError as error:
        where = error.where.replace(str(folder), str(out))
        raise InputError(error.what, where=where, allowed=error.allowed, remedy=error.remedy) from None
    return found
