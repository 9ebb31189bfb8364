"""Make the measurement folder of a finished monitoring: the stable rock of each epoch against the reference epoch.

`scarpsim gap` reads it as any other measurement: one model for all epochs, and a pose for each. Points are taken from the files
that `monitor` read, as these have intensities, times and scan lines, and moved by the registration that it found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.measurement.build import ScanMaterial, read_scanner_model, write_scans
from pipeline.measurement.folder import Interpretation
from pipeline.measurement.reference import Reference, reference_from_file, reference_from_scans
from pipeline.measurement.request import Request
from pipeline.measurement.scans import RawScan
from pipeline.measurement.station import Station, find_station
from pipeline.monitoring.reading import read_laser_scans
from pipeline.monitoring.recorded import RecordedEpoch, RecordedMonitoring, read_monitoring
from pipeline.monitoring.repeated_directions import repeated_noise
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import TlsModel

_MOST_POINTS = 4_000_000
"""Points of all epochs together that are written, twice as many as `gap` works with."""
_FEWEST = 100
"""Smallest number of points of an epoch on stable rock."""
_ONE_PLACE_M = 0.05
"""Stations of the reference nearer to each other than this, m, count as one."""
_LIMIT = "what monitor found to have changed is left out, and with it a sensor error that looks like a change of the rock"


@dataclass(frozen=True)
class _StableScan:
    """A scan of an epoch on the reference: its stable points and the place of its scanner. words: how many these are."""

    scan: RawScan
    station: Station
    words: str


def build_from_monitoring(
    folder: Path,
    out: Path,
    *,
    scanner: str | None = None,
    model: Path | TlsModel | None = None,
    position: tuple[float, float, float] | None = None,
) -> Interpretation:
    """Convert a folder of results of `scarpsim monitor` to a measurement folder, the input of `scarpsim gap`.

    The later epochs are its scans, with the points on stable rock alone. The reference epoch, meshed as the scanner saw it, is
    its reference, and the scatter of its points counts as the reference's error.

    Parameters
    ----------
    folder : The folder that `monitor` wrote.
    out : Folder to write.
    scanner : Name or file of a scanner preset, which gives the noise model; None: as given to `monitor`.
    model : The scanner's noise model or its file, instead of a preset.
    position : (3,) position of the scanner, survey coordinates, m; None: as given to `monitor`, or as the files state.

    Returns
    -------
    How the epochs were interpreted.

    Raises
    ------
    InputError
        If the monitoring is not finished or not of laser scans, its files were changed, or the scanner's noise or place is
        unknown.
    """
    monitoring = read_monitoring(folder)
    _check_laser(monitoring)
    scanner_model, model_words = _model(monitoring, scanner, model)
    given = monitoring.options.position if position is None else np.array(position, dtype=np.float64)
    scans = [each for epoch in monitoring.epochs for each in _stable_scans(monitoring, epoch, given)]
    reference = _reference(monitoring, given, scans)
    material = ScanMaterial(
        [each.scan for each in scans],
        [each.station for each in scans],
        reference,
        scanner_model,
        model_words,
        stable_words=(*(each.words for each in scans), _LIMIT),
        whole=False,
        registered_alone=True,
    )
    return write_scans(material, out)


def _model(
    monitoring: RecordedMonitoring, scanner: str | None, model: Path | TlsModel | None
) -> tuple[TlsModel, tuple[str, ...]]:
    """Return the scanner's model, as given or else as it was given to `monitor`, with a description for the user."""
    if isinstance(model, TlsModel):
        return model, ("as given",)
    if scanner is None and model is None:
        scanner, model = monitoring.options.scanner, monitoring.options.model
    if scanner is None and model is None:
        raise InputError(
            "the monitoring was made without a model of the scanner, so its noise is unknown",
            where=str(monitoring.folder),
            remedy="add --scanner with a preset such as riegl_vz400i, or --model FILE",
        )
    return read_scanner_model(Request([], "", scanner if model is None else None, model))


def _check_laser(monitoring: RecordedMonitoring) -> None:
    """Raise InputError if the epochs are not of a laser scanner."""
    runs = [each.run for each in (monitoring.reference, *(epoch.source for epoch in monitoring.epochs)) if each.run is not None]
    if not monitoring.options.photographs and all(run["sensor"] == "tls" for run in runs):
        return
    raise InputError(
        "the epochs are not of a laser scanner but from photographs, whose errors scarpsim gap cannot find here",
        where=str(monitoring.folder),
        allowed="epochs of a laser scanner",
        remedy="compare one epoch with a known surface: scarpsim gap EPOCH --reference FILE --photographs",
    )


def _stable_scans(monitoring: RecordedMonitoring, epoch: RecordedEpoch, position: FloatArray | None) -> list[_StableScan]:
    """Return the scans of an epoch, moved onto the reference, with their points on stable rock."""
    found = []
    most = _MOST_POINTS // len(monitoring.epochs)
    for number, scan in enumerate(read_laser_scans(epoch.source, monitoring.options)):
        station = _station(scan, position)
        points = monitoring.registered(epoch, scan.cloud.points)
        stable, event = monitoring.stable_rock(epoch, points)
        rows = np.flatnonzero(stable)
        name = epoch.source.name if number == 0 else f"{epoch.source.name}, scan {number + 1}"
        if len(rows) < _FEWEST:
            raise InputError(
                f"the epoch has only {len(rows)} points on stable rock",
                where=name,
                allowed=f"{_FEWEST} or more",
                remedy="name stable areas with scarpsim monitor --stable, or leave this epoch out",
            )
        words = (
            f"epoch {epoch.number}, {name}: {100 * len(rows) / len(points):.0f} % of {len(points):,} points are on stable rock, "
            f"{100 * float(event.mean()):.1f} % in events"
        )
        if len(rows) > most:
            random = KeyedRandom(monitoring.options.seed).child("stable rock", epoch.number, number).generator()
            rows = np.sort(random.choice(rows, most, replace=False))
            words += f"; {most:,} of those on stable rock are used"
        moved = replace(scan, name=name, cloud=replace(scan.cloud, points=points))
        found.append(_StableScan(moved.part(rows), _moved(monitoring, epoch, station.part(rows)), words))
    return found


def _moved(monitoring: RecordedMonitoring, epoch: RecordedEpoch, station: Station) -> Station:
    """Return the place of a scanner after the registration of its epoch."""
    position = monitoring.registered(epoch, station.position[None])[0]
    turn = monitoring.frame.rotation.T @ epoch.to_reference.rotation @ monitoring.frame.rotation
    return replace(station, position=position, rotation=turn @ station.rotation)


def _station(scan: RawScan, position: FloatArray | None) -> Station:
    """Find the place of the scanner, and say how to state it if nothing tells."""
    try:
        return find_station(scan, position)
    except InputError as error:
        raise InputError(
            "neither the monitoring, the file nor its scan lines say where the scanner stood",
            where=error.where,
            remedy="add --position X,Y,Z, in the coordinates of the epochs, m; a few metres of error do no harm",
        ) from None


def _reference(monitoring: RecordedMonitoring, given: FloatArray | None, later: Sequence[_StableScan]) -> Reference:
    """Return the reference epoch as a surface, as seen from its scanner; of a mesh or DEM, from that of the first later scan."""
    source = monitoring.reference
    if source.is_surface:
        return reference_from_file(source.files[0], monitoring.options.unit, later[0].station.position, later[0].station.rotation)
    scans = read_laser_scans(source, monitoring.options)
    stations = [_station(scan, given) for scan in scans]
    if any(np.linalg.norm(each.position - stations[0].position) > _ONE_PLACE_M for each in stations[1:]):
        raise InputError(
            f"the reference has {len(scans)} scans from different places, but must be seen from a single place",
            where=source.name,
            remedy="make a mesh of the reference (scarpsim surface), and give it to scarpsim gap EPOCH ... --reference MESH",
        )
    position, rotation = stations[0].position, stations[0].rotation
    noise = (
        repeated_noise(scans[0].cloud.points, [each.scan.cloud.points for each in later], position) if len(scans) == 1 else None
    )
    return reference_from_scans(scans, source.path, position, rotation, noise=noise)
