"""From the files that people have to the folder of a measurement, with words and a picture on how they were understood."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.presets import read_preset
from pipeline.formats.measurements.measurement import read_model
from pipeline.formats.point_cloud import PointCloud
from pipeline.measurement.folder import Content, Understood, write
from pipeline.measurement.photogrammetry import looking, read_pair, seen_by
from pipeline.measurement.reference import HALF, Reference, from_file, half_of
from pipeline.measurement.request import Request
from pipeline.measurement.scans import RawScan, read_scans
from pipeline.measurement.station import Station, find_station
from pipeline.measurement.units import check_extent, check_same_unit
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from scene.meshes.rounding import rounded_axes
from sensors.models.sensor_model import StereoModel, TlsModel

_ONE_PLACE_M = 0.05
"""Stations that stand nearer to each other than this are one, set up again: its scans are epochs."""

_NAME_SCANNER = (
    "name a preset such as riegl_vz400i, or give --model FILE; of a cloud from photographs name --cameras, or say --photographs "
    "where they are not at hand"
)
_PLANES = "angles of incidence are those to planes through 24 points of it: its triangles lean by noise and relief between points"


def build(request: Request, out: Path) -> Understood:
    """Write the folder `out`: measurement.yaml, model.yaml, the points, the reference, what was understood in words and picture.

    Raises InputError where a file cannot be used, nothing tells the scanner's place, or points and reference do not meet.
    """
    model, model_words = _model(request)
    scans = _scans(request)
    stations = _stations(scans, request)
    station = stations[0]
    reference = half_of(scans[0], station) if request.reference == HALF else _given(request, scans[0], *_eye(station))
    if reference.rows is not None:
        scans = [scans[0].part(reference.rows), *scans[1:]]
        stations = [_part(stations[0], reference.rows), *stations[1:]]
    scans, stations, echo_words = _single_echoes(scans, stations)
    model, noise_words = _with_rounding(model, scans[0], station)
    about = {
        "scan": tuple(f"{scan.name}: {len(scan.cloud.points):,} points{_said(scan)}" for scan in scans) + echo_words,
        "scanner": station.words + _of_others(scans, stations),
        "reference": (*reference.words, *((_PLANES,) if reference.of_points else ())),
        "cannot show": reference.limits,
        "model": (*model_words, *noise_words),
    }
    keys = _where_from(stations)
    if "scanner" in keys and station.pattern is not None and request.reference != HALF and not echo_words:
        keys["pattern"] = station.pattern
    if reference.of_points:
        keys |= {"incidence": "planes", "reference_error_m": float(f"{reference.error_m:.3g}")}
    clouds = [_for_file(scan, each) for scan, each in zip(scans, stations, strict=True)]
    content = Content("tls", clouds, reference.mesh, model, _eye(station), ", ".join(scan.name for scan in scans), keys=keys)
    found = Understood(out, about)
    write(out, content, found)
    return found


def build_stereo(request: Request, cameras: Path, labels: tuple[str, str] | None, out: Path) -> Understood:
    """The same of clouds from photographs, with the pair's calibration; labels: which two cameras of a project.

    Raises InputError as `build` does, and for a cloud that the pair does not see.
    """
    if request.reference == HALF:
        raise InputError("is for scans: neighbours in a matched cloud share their errors", where="--reference half",
                         remedy="name a mesh, a cloud or a DEM")  # fmt: skip
    pair = read_pair(cameras, labels)
    model = StereoModel() if request.model is None else read_model(request.model)
    if not isinstance(model, StereoModel):
        raise InputError("is the model of a laser scanner", where=str(request.model), allowed="sensor: stereo")
    scans = _scans(request)
    eye = pair.left.position, looking(pair.left)
    words = seen_by(pair, scans[0].cloud.points, scans[0].name)
    reference = _given(request, scans[0], *eye)
    kept = ("pixel_x", "pixel_y")
    clouds = [
        replace(scan.cloud, extra={name: scan.cloud.extra[name] for name in kept if name in scan.cloud.extra}) for scan in scans
    ]
    of_model = (
        f"as in {request.model}" if request.model else "the default of a stereo pair: 0.3 px white, 0.1 px smooth over 32 px"
    )
    about = {
        "points": tuple(f"{scan.name}: {len(scan.cloud.points):,} points{_said(scan)}" for scan in scans),
        "cameras": words,
        "reference": reference.words,
        "cannot show": reference.limits,
        "model": (of_model,),
    }
    found = Understood(out, about)
    write(out, Content("stereo", clouds, reference.mesh, model, eye, scans[0].name, cameras=pair), found)
    return found


def _eye(station: Station) -> tuple[FloatArray, FloatArray]:
    return station.position, station.rotation


def _for_file(scan: RawScan, station: Station) -> PointCloud:
    """The cloud with its scan lines, without what only reading needed."""
    return replace(scan.cloud, extra={} if station.line is None else {"line": station.line})


def _scans(request: Request) -> list[RawScan]:
    found = []
    if len(set(request.scans)) < len(request.scans):
        raise InputError("names a file twice", where="SCAN", remedy="give each epoch a file of its own")
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
    """The station of each scan; one half of a scan can be the reference of no other place."""
    position = None if request.position is None else np.array(request.position)
    stations = [find_station(scan, position) for scan in scans]
    for scan, station in zip(scans[1:], stations[1:], strict=True):
        if request.reference == HALF and (away := _away(station, stations[0])) > _ONE_PLACE_M:
            raise InputError(
                f"stands {away:.3g} m from the place of {scans[0].name}, whose half is the reference", where=scan.name,
                remedy="name a mesh, a cloud or a DEM; --scan N picks one scan of a file",
            )  # fmt: skip
    return stations


def _of_others(scans: list[RawScan], stations: list[Station]) -> tuple[str, ...]:
    """Words for scans from other places than the first's."""
    pairs = zip(scans[1:], stations[1:], strict=True)
    return tuple(
        f"{scan.name}: {each.words[0]}, {_away(each, stations[0]):.3g} m from the first: with a pose of its own"
        for scan, each in pairs
        if _away(each, stations[0]) > _ONE_PLACE_M
    )


def _away(station: Station, other: Station) -> float:
    """How far apart two stations stand, m."""
    return float(np.linalg.norm(station.position - other.position))


def _where_from(stations: list[Station]) -> dict[str, Any]:
    """`scanner` of epochs from one place, `scanners` of scans from places of their own."""
    poses = [{"position_m": each.position.tolist(), "rotation": each.rotation.tolist()} for each in stations]
    one = all(_away(each, stations[0]) <= _ONE_PLACE_M for each in stations[1:])
    return {"scanner": poses[0]} if one else {"scanners": poses}


def _given(request: Request, scan: RawScan, position: FloatArray, rotation: FloatArray) -> Reference:
    """The reference out of its file, as seen from a place (3,) m with a rotation (3, 3) to the points' frame."""
    reference = from_file(Path(request.reference), request.reference_unit, position, rotation)
    check_same_unit(scan.cloud.points, reference.mesh.vertices, scan.name, request.unit, request.reference_unit)
    return reference


def _model(request: Request) -> tuple[TlsModel, tuple[str, ...]]:
    if request.model is not None:
        model = read_model(request.model)
        if not isinstance(model, TlsModel):
            raise InputError("is the model of a stereo pair", where=str(request.model), allowed="sensor: tls")
        return model, (f"as in {request.model}",)
    if request.scanner is None:
        raise InputError("is missing", where="--scanner", remedy=_NAME_SCANNER)
    preset = read_preset(request.scanner)
    return preset.model(), (f"of the preset {preset.name}: what its data sheet states, what it does not state by default",)


def _with_rounding(model: TlsModel, scan: RawScan, station: Station) -> tuple[TlsModel, tuple[str, ...]]:
    """The model with what rounding did to the coordinates in its white noise of the range."""
    own, rounding = model.noise.range_sigma_m, _rounding_m(scan.cloud.points, station.position)
    if rounding <= 0.1 * own:
        return model, (f"range noise {1e3 * own:.3g} mm",)
    total = float(np.hypot(own, rounding))
    parts = f"{1e3 * own:.3g} mm of the instrument and {1e3 * rounding:.2g} mm of the rounding of the coordinates"
    return replace_noise(model, total), (f"range noise {1e3 * total:.3g} mm: {parts}",)


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
