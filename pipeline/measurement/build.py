"""Build the measurement folder of laser scans, or of clouds from a stereo pair.

A record of how the files were interpreted is part of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.config.presets import read_preset
from pipeline.formats.measurements.model_file import read_model
from pipeline.formats.point_cloud import PointCloud
from pipeline.measurement.folder import STABLE_ROCK, Interpretation, MeasurementContent, write
from pipeline.measurement.photogrammetry import describe_view, read_pair, viewing_rotation
from pipeline.measurement.reference import HALF, Reference, reference_from_file, reference_from_half
from pipeline.measurement.request import Request
from pipeline.measurement.scans import RawScan, read_scans
from pipeline.measurement.station import Station, find_station
from pipeline.measurement.units import check_extent, check_same_unit
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from scene.meshes.rounding import rounded_axes
from sensors.models.sensor_model import StereoModel, TlsModel

_ONE_PLACE_M = 0.05
"""Stations nearer to each other than this, m, count as one station that was set up again: their scans are epochs."""

_NAME_SCANNER = (
    "name a preset such as riegl_vz400i, or give --model FILE; for a cloud from photographs give --cameras, or --photographs "
    "if the cameras are unknown"
)
_PLANES = "incidence angles refer to planes through 24 of its points, as noise and relief tilt its triangles"


@dataclass(frozen=True)
class ScanMaterial:
    """Laser scans in memory, with all that a measurement folder says of them.

    Attributes
    ----------
    scans : Points of each scan, m, in the frame of the reference.
    stations : Place of the scanner in each scan, in the same frame.
    reference : The surface with which the scans are compared.
    model : Noise model of the scanner.
    model_words : Where the model comes from, for the user.
    stable_words : How much of each scan lies on stable rock, for the user; empty if all points are compared.
    whole : Whether the first scan has all of its points, so that missing returns can be told.
    registered_alone : Whether each scan was registered by itself, so that it has a pose of its own even at one station.
    """

    scans: Sequence[RawScan]
    stations: Sequence[Station]
    reference: Reference
    model: TlsModel
    model_words: tuple[str, ...]
    stable_words: tuple[str, ...] = ()
    whole: bool = True
    registered_alone: bool = False


def build(request: Request, out: Path) -> Interpretation:
    """Convert raw laser scans to a measurement folder, the input of `scarpsim gap`.

    The folder has measurement.yaml, model.yaml (the scanner's noise), the points, the reference surface, and a record of how the
    files were interpreted.

    Parameters
    ----------
    request : The raw files, and what the user says of them: reference, scanner, position, units.
    out : Folder to write.

    Returns
    -------
    How the files were interpreted.

    Raises
    ------
    InputError
        If a file cannot be used, the scanner's place is unknown, or points and reference do not overlap.
    """
    request.check_reference()
    model, model_words = read_scanner_model(request)
    scans = _scans(request)
    stations = _stations(scans, request)
    station = stations[0]
    reference = (
        reference_from_half(scans[0], station)
        if request.reference == HALF
        else _reference_as_given(request, scans[0], *_eye(station))
    )
    if reference.rows is not None:
        scans = [scans[0].part(reference.rows), *scans[1:]]
        stations = [stations[0].part(reference.rows), *stations[1:]]
    whole = request.reference != HALF
    return write_scans(ScanMaterial(scans, stations, reference, model, model_words, whole=whole), out)


def write_scans(material: ScanMaterial, out: Path) -> Interpretation:
    """Write the measurement folder, the input of `scarpsim gap`, of laser scans in memory, and check that `gap` can read it.

    Parameters
    ----------
    material : Scans, places of the scanner, reference and model.
    out : Folder to write.

    Returns
    -------
    How the scans were interpreted.

    Raises
    ------
    InputError
        If points and reference do not overlap.
    """
    reference = material.reference
    scans, stations, echo_words = _single_echoes(list(material.scans), list(material.stations))
    station = stations[0]
    model, noise_words = _with_rounding(material.model, scans[0], station)
    about = {
        "scan": tuple(f"{scan.name}: {len(scan.cloud.points):,} points{_notes_of(scan)}" for scan in scans) + echo_words,
        "scanner": station.words + _other_stations_in_words(scans, stations),
        "reference": (*reference.words, *((_PLANES,) if reference.of_points else ())),
        **({STABLE_ROCK: material.stable_words} if material.stable_words else {}),
        "cannot show": reference.limits,
        "model": (*material.model_words, *noise_words),
    }
    keys = _pose_keys(stations, material.registered_alone)
    if "scanner" in keys and station.pattern is not None and material.whole and not echo_words:
        keys["pattern"] = station.pattern
    if reference.of_points:
        keys |= {"incidence": "planes", "reference_error_m": float(f"{reference.error_m:.3g}")}
    if reference.noise_is_known:
        keys["reference_error_kind"] = "scanner"
    clouds = [_for_file(scan, each) for scan, each in zip(scans, stations, strict=True)]
    content = MeasurementContent(
        "tls", clouds, reference.mesh, model, _eye(station), ", ".join(scan.name for scan in scans), keys=keys
    )
    found = Interpretation(out, about)
    write(out, content, found)
    return found


def build_stereo(request: Request, cameras: Path, labels: tuple[str, str] | None, out: Path) -> Interpretation:
    """Convert photogrammetric clouds with a known stereo pair to a measurement folder, the input of `scarpsim gap`.

    Parameters
    ----------
    request : The raw files, and what the user says of them: reference, scanner, position, units.
    cameras : File or folder with the calibration and pose of the cameras.
    labels : Names of the left and right camera, if `cameras` has more than two; else None.
    out : Folder to write.

    Returns
    -------
    How the files were interpreted.

    Raises
    ------
    InputError
        If a file cannot be used, the reference is to be half of the cloud, the sensor model is not that of a stereo pair, the
        pair does not see the cloud, or points and reference do not overlap.
    """
    if request.reference == HALF:
        raise InputError(
            "half works only with laser scans: neighbouring points of a photogrammetric cloud share their errors",
            where="--reference half",
            remedy="name a mesh, a cloud or a DEM",
        )
    request.check_reference()
    pair = read_pair(cameras, labels)
    model = StereoModel() if request.model is None else read_model(request.model)
    if not isinstance(model, StereoModel):
        raise InputError(
            "the model is of a laser scanner, but the points come from a stereo pair",
            where=str(request.model),
            allowed="sensor: stereo",
            remedy="name a model of a stereo pair with --model",
        )
    scans = _scans(request)
    eye = pair.left.position, viewing_rotation(pair.left)
    words = describe_view(pair, scans[0].cloud.points, scans[0].name)
    reference = _reference_as_given(request, scans[0], *eye)
    kept = ("pixel_x", "pixel_y")
    clouds = [
        replace(scan.cloud, extra={name: scan.cloud.extra[name] for name in kept if name in scan.cloud.extra}) for scan in scans
    ]
    of_model = f"as in {request.model}" if request.model else "stereo default: 0.3 px white noise, 0.1 px correlated over 32 px"
    about = {
        "points": tuple(f"{scan.name}: {len(scan.cloud.points):,} points{_notes_of(scan)}" for scan in scans),
        "cameras": words,
        "reference": reference.words,
        "cannot show": reference.limits,
        "model": (of_model,),
    }
    found = Interpretation(out, about)
    write(out, MeasurementContent("stereo", clouds, reference.mesh, model, eye, scans[0].name, cameras=pair), found)
    return found


def _eye(station: Station) -> tuple[FloatArray, FloatArray]:
    """Return position and rotation of a station."""
    return station.position, station.rotation


def _for_file(scan: RawScan, station: Station) -> PointCloud:
    """Return the cloud with its scan lines, and without channels that only reading needs."""
    return replace(scan.cloud, extra={} if station.line is None else {"line": station.line})


def _scans(request: Request) -> list[RawScan]:
    """Read all scans of the request, or one scan of each file."""
    found = []
    twice = [path for number, path in enumerate(request.scans) if path in request.scans[:number]]
    if twice:
        raise InputError(f"a file is given twice: {twice[0]}", where="SCAN", remedy="give another file for each epoch")
    for path in request.scans:
        each = read_scans(path, request.unit, request.columns)
        if request.number is not None:
            if request.number > len(each):
                raise InputError(
                    f"there is no scan {request.number}",
                    where="--scan",
                    allowed=f"1 to {len(each)} in {path.name}",
                    remedy="choose the number of a scan of this file",
                )
            each = [each[request.number - 1]]
        for scan in each:
            check_extent(scan.cloud.points, str(path), request.unit)
        found.extend(each)
    return found


def _stations(scans: list[RawScan], request: Request) -> list[Station]:
    """Find the station of each scan.

    Raises InputError if half of the first scan would be the reference of a scan from elsewhere.
    """
    position = None if request.position is None else np.array(request.position)
    stations = [find_station(scan, position) for scan in scans]
    for scan, station in zip(scans[1:], stations[1:], strict=True):
        if request.reference == HALF and (away := _distance_m(station, stations[0])) > _ONE_PLACE_M:
            raise InputError(
                f"the scanner of this scan stood {away:.3g} m from that of {scans[0].name}, whose half is the reference",
                where=scan.name,
                remedy="name a mesh, a cloud or a DEM with --reference, or pick one scan of the file with --scan N",
            )  # fmt: skip
    return stations


def _other_stations_in_words(scans: list[RawScan], stations: list[Station]) -> tuple[str, ...]:
    """Describe the scans from other stations than the first."""
    pairs = zip(scans[1:], stations[1:], strict=True)
    return tuple(
        f"{scan.name}: {each.words[0]}, {_distance_m(each, stations[0]):.3g} m from the first, so it has its own pose"
        for scan, each in pairs
        if _distance_m(each, stations[0]) > _ONE_PLACE_M
    )


def _distance_m(station: Station, other: Station) -> float:
    """Return the distance of two stations, m."""
    return float(np.linalg.norm(station.position - other.position))


def _pose_keys(stations: list[Station], registered_alone: bool) -> dict[str, Any]:
    """Return the key `scanner` for epochs from one station, or `scanners` for scans from several or with poses of their own."""
    poses = [{"position_m": each.position.tolist(), "rotation": each.rotation.tolist()} for each in stations]
    one = all(_distance_m(each, stations[0]) <= _ONE_PLACE_M and not registered_alone for each in stations[1:])
    return {"scanner": poses[0]} if one else {"scanners": poses}


def _reference_as_given(request: Request, scan: RawScan, position: FloatArray, rotation: FloatArray) -> Reference:
    """Read the reference from its file, as seen from a position (3,), m, with a rotation (3, 3) to the points' frame."""
    reference = reference_from_file(Path(request.reference), request.reference_unit, position, rotation)
    check_same_unit(scan.cloud.points, reference.mesh.vertices, scan.name, request.unit, request.reference_unit)
    return reference


def read_scanner_model(request: Request) -> tuple[TlsModel, tuple[str, ...]]:
    """Return the scanner's noise model, from the request's file or preset, with a description for the user.

    request: names the file or preset. Raises InputError if it names neither, or the model of a stereo pair.
    """
    if request.model is not None:
        model = read_model(request.model)
        if not isinstance(model, TlsModel):
            raise InputError(
                "the model is of a stereo pair, but the points come from a laser scanner",
                where=str(request.model),
                allowed="sensor: tls",
                remedy="name a model of a laser scanner with --model, or a preset with --scanner",
            )
        return model, (f"as in {request.model}",)
    if request.scanner is None:
        raise InputError("the scanner, and so its noise, is unknown", where="--scanner", remedy=_NAME_SCANNER)
    preset = read_preset(request.scanner)
    return preset.model(), (f"preset {preset.name}: values of its data sheet, defaults where it states none",)


def _with_rounding(model: TlsModel, scan: RawScan, station: Station) -> tuple[TlsModel, tuple[str, ...]]:
    """Add the rounding of the coordinates to the model's white range noise, where it matters, and describe the result."""
    own, rounding = model.noise.range_sigma_m, _rounding_m(scan.cloud.points, station.position)
    if rounding <= 0.1 * own:
        return model, (f"range noise {1e3 * own:.3g} mm",)
    total = float(np.hypot(own, rounding))
    parts = f"{1e3 * own:.3g} mm of the instrument and {1e3 * rounding:.2g} mm from rounded coordinates"
    return replace_noise(model, total), (f"range noise {1e3 * total:.3g} mm: {parts}",)


def replace_noise(model: TlsModel, sigma_m: float) -> TlsModel:
    """Return a laser scanner's model with another standard deviation, m, of the white noise of its ranges."""
    return model.model_copy(update={"noise": model.noise.model_copy(update={"range_sigma_m": sigma_m})})


def _rounding_m(points: FloatArray, position: FloatArray) -> float:
    """Return the standard deviation along the lines of sight, m, that rounding added to the coordinates."""
    steps = {each.axis: each.step_m for each in rounded_axes(points)}
    if not steps:
        return 0.0
    sight = points - position
    sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-9)
    error = np.einsum("ni,i->n", sight**2, np.array([steps.get(axis, 0.0) for axis in "xyz"]) ** 2)
    return float(np.sqrt(error.mean() / 12))


def _single_echoes(scans: list[RawScan], stations: list[Station]) -> tuple[list[RawScan], list[Station], tuple[str, ...]]:
    """Remove points of pulses with several echoes, which are at edges and in vegetation."""
    kept = [scan.cloud.extra.get("number_of_returns", np.ones(len(scan.cloud.points))) == 1 for scan in scans]
    lost = sum(int((~rows).sum()) for rows in kept)
    if not lost:
        return scans, stations, ()
    words = (f"{lost:,} points of pulses with several echoes (edges, vegetation) are left out",)
    parts = [(scan.part(rows), station.part(rows)) for scan, station, rows in zip(scans, stations, kept, strict=True)]
    return [part[0] for part in parts], [part[1] for part in parts], words


def _notes_of(scan: RawScan) -> str:
    """Return the notes on a scan, for a line of text."""
    return "" if not scan.words else "; " + "; ".join(scan.words)
