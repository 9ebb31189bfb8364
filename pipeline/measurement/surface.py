"""Build the measurement folder of a cloud, mesh or elevation model from photographs whose cameras are unknown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.formats.measurements.config import MeasurementConfig
from pipeline.formats.measurements.measurement import Material, SurfaceMeasurement, assembled
from pipeline.formats.measurements.model_file import read_model
from pipeline.formats.measurements.surface_fit import air_side, check_in_metres
from pipeline.formats.point_cloud import PointCloud
from pipeline.gap.residuals.surface_noise import estimate_surface_noise
from pipeline.gap.residuals.surface_residuals import NO_CAMERAS, point_spacing_m
from pipeline.measurement.folder import Interpretation, MeasurementContent, write
from pipeline.measurement.reference import DEMS, HALF, Reference, is_cloud, reference_from_dem, reference_from_file
from pipeline.measurement.request import Request
from pipeline.measurement.scans import RawScan, read_scans
from pipeline.measurement.units import check_extent, check_same_unit
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray, TriangleMesh
from scene.meshes.winding import orient_to_sensors
from scene.walls.imported import read_mesh
from sensors.models.sensor_model import StereoModel, StereoNoise

_LEANING = 0.1
"""Vertical component of a wall's normal below which the side of the air is only a guess."""
_MESHES = (".obj", ".stl", ".off", ".glb", ".gltf")
_FIRST_GUESS = 0.1
"""Noise, as a share of the point spacing, with which a cloud is registered before its own noise is estimated."""


def build_surface(request: Request, out: Path) -> Interpretation:
    """Convert surfaces from photographs whose cameras are unknown to a measurement folder, the input of `scarpsim gap`.

    Parameters
    ----------
    request : The raw files (clouds, meshes or elevation models), and what the user says of them: reference, units, noise model.
    out : Folder to write.

    Returns
    -------
    How the files were interpreted.

    Raises
    ------
    InputError
        If a file cannot be used, cloud and reference do not overlap, or the noise cannot be estimated.
    """
    _check(request)
    request.check_reference()
    clouds = [_read(path, request) for path in request.scans]
    points = clouds[0].cloud.points
    reference, side = _reference(request, points)
    check_same_unit(points, reference.mesh.vertices, clouds[0].name, request.unit, request.reference_unit)
    model, words = _model(request, clouds[0], reference)
    about = {
        "points": tuple(f"{each.name}: {len(each.cloud.points):,} points{_notes_of(each)}" for each in clouds),
        "cameras": (NO_CAMERAS,),
        "reference": (*reference.words, *side),
        "cannot show": reference.limits,
        "model": words,
    }
    found = Interpretation(out, about)
    eye = _view_towards(air_side(reference.mesh), reference.mesh.vertices.mean(axis=0))
    write(out, MeasurementContent("stereo", [each.cloud for each in clouds], reference.mesh, model, eye, clouds[0].name), found)
    return found


def _check(request: Request) -> None:
    """Raise InputError for options that only scans have, or a file that is given twice."""
    if request.reference == HALF:
        raise InputError(
            "half works only with laser scans: neighbouring points of a photogrammetric cloud share their errors",
            where="--reference half",
            remedy="name a mesh, a cloud or a DEM",
        )
    if request.scanner is not None:
        raise InputError(
            "the option needs laser scans, but --photographs is given",
            where="--scanner",
            remedy="leave out --scanner or --photographs",
        )
    if len(set(request.scans)) < len(request.scans):
        raise InputError("a file is given twice", where="SCAN", remedy="give another file for each epoch")


def _read(path: Path, request: Request) -> RawScan:
    """Read the points of a cloud, the vertices of a mesh, or the pixels of an elevation model."""
    if not path.is_file():
        raise InputError(
            "there is no such file", where=str(path), allowed="a cloud, a mesh, a DEM", remedy="give the path of an existing file"
        )
    if path.suffix.lower() in DEMS:
        dem = reference_from_dem(path, request.unit)
        words = ("the heights of an elevation model", *dem.words[1:])
        return RawScan(path.name, PointCloud(dem.mesh.vertices), words=words)
    if path.suffix.lower() in _MESHES or not is_cloud(path):
        mesh, notes = read_mesh(path, request.unit or "m")
        found = RawScan(path.name, PointCloud(mesh.vertices), words=("the vertices of a mesh", *notes))
    else:
        scans = read_scans(path, request.unit, request.columns)
        words = tuple(dict.fromkeys(word for scan in scans for word in scan.words if "intensity" not in word))
        found = RawScan(path.name, PointCloud(np.concatenate([scan.cloud.points for scan in scans])), words=words)
    check_extent(found.cloud.points, str(path), request.unit)
    return found


def _reference(request: Request, points: FloatArray) -> tuple[Reference, tuple[str, ...]]:
    """Read the reference and orient it to the side of the air, with a note on how that side was found."""
    path, centre = Path(request.reference), points.mean(axis=0)
    normal = _normal(points)
    given = None if request.position is None else np.array(request.position)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    eye = centre + 2 * extent * (normal if normal[2] >= 0 else -normal) if given is None else given
    position, rotation = _view_towards(eye, centre)
    reference = reference_from_file(path, request.reference_unit, position, rotation, seen_from="before the wall")
    if given is not None:
        mesh = _wound_to(reference.mesh, eye, str(path))
        return Reference(mesh, reference.error_m, reference.words, reference.limits), ()
    if not reference.of_points:
        return reference, ()
    guessed = " is a guess, as it is vertical" if abs(normal[2]) < _LEANING else " was derived from its slope"
    return reference, (f"the side of the wall where the air is{guessed}; --position X,Y,Z (any place in front) changes it",)


def _wound_to(mesh: TriangleMesh, eye: FloatArray, where: str) -> TriangleMesh:
    """Orient the triangles of a mesh to a place."""
    centre = mesh.vertices.mean(axis=0)
    turned = orient_to_sensors(mesh.with_vertices(mesh.vertices - centre), [eye - centre], where)[0]
    return turned.with_vertices(mesh.vertices)


def _normal(points: FloatArray) -> FloatArray:
    """Return the (3,) normal of the least-squares plane, with either sign."""
    few = points[:: max(len(points) // 20_000, 1)]
    few = few - few.mean(axis=0)
    return np.asarray(np.linalg.eigh(np.einsum("ni,nj->ij", few, few))[1][:, 0])


def _view_towards(eye: FloatArray, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the place and the rotation (3, 3) to the world of a frame that looks at `centre`.

    Its x axis points towards the centre; z is up in the picture.
    """
    forward = (centre - eye) / np.linalg.norm(centre - eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    up = up - (up @ forward) * forward
    up /= np.linalg.norm(up)
    return eye, np.stack([forward, np.cross(up, forward), up], axis=1)


def _model(request: Request, cloud: RawScan, reference: Reference) -> tuple[StereoModel, tuple[str, ...]]:
    """Return the noise model of the points, as given or as estimated from the cloud, with a description."""
    if request.model is not None:
        model = read_model(request.model)
        if not isinstance(model, StereoModel):
            raise InputError(
                "the model is of a laser scanner, but the points come from photographs",
                where=str(request.model),
                allowed="sensor: stereo",
                remedy="name a model of a stereo pair with --model",
            )
        check_in_metres(model, str(request.model))
        return model, (f"as in {request.model}",)
    guess = StereoModel(
        noise=StereoNoise(
            parallax_sigma_px=0.0,
            regularization_sigma_px=0.0,
            point_sigma_m=max(_FIRST_GUESS * point_spacing_m(cloud.cloud.points), 1e-6),
        )
    )
    config = MeasurementConfig(sensor="stereo", reference=Path("reference"), points=Path("points"), model=Path("model"))
    material = Material(reference.mesh, {cloud.name: cloud.cloud}, guess)
    measurement = assembled(config, material, request.reference, cloud.name)
    if not isinstance(measurement, SurfaceMeasurement):
        raise TypeError("a measurement without cameras is one of a surface")
    noise = estimate_surface_noise(measurement, cloud.name)
    said = "this cloud cannot show whether that is too much; --model FILE gives other values"
    return noise.model, (noise.summary, said)


def _notes_of(cloud: RawScan) -> str:
    """Return the notes on a cloud, for a line of text."""
    words: Sequence[str] = cloud.words
    return "" if not words else "; " + "; ".join(words)
