"""Study which settings of ICP suit a run.

These are the two sensitivity studies of the thesis (3.6), with the error against the true transform beside the RMS.

The true transform of an epoch is known in a simulation. T(s) is the rigid motion that brings what a sensor measured, s, onto
the true wall of that epoch, by a point-to-plane fit over all points. To lie on the reference, the epoch has to be moved by
T(reference)^-1 T(epoch). An epoch is first displaced by a known motion D of size `offset_m`, as if nobody had aligned it, so
that the transform to be found is M = T(reference)^-1 T(epoch) D^-1. The error of a found transform F is F M^-1: at each point
x of the reference F M^-1 x - x. Its component along the surface's normal is what a difference map shows.

The RMS of the inliers alone cannot select the outlier threshold, because it grows with the threshold whatever the pose. The
error can.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from pipeline.config.simulation import SensorName, SimulationConfig, load_config
from pipeline.formats.records.result_files import read_surface
from pipeline.formats.records.result_records import RUN_FILE, read_run
from pipeline.formats.records.run_files import epoch_folder
from pipeline.icp_study.results import IcpStudy, Parameter, PoseError, Recommendation, StudyRow
from pipeline.registration.closest_points import ReferenceSurface
from pipeline.registration.register import IcpConfig, measure_fit, register_to
from pipeline.registration.rigid import RigidTransform
from pipeline.report.progress import Progress
from pipeline.run.epoch import observe_epoch, observe_reference
from pipeline.run.site import prepare_site
from scene.common.errors import InputError
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray, TriangleMesh, area_normals

RATIOS = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
"""Shares of the points that are left out."""
_THRESHOLDS = np.geomspace(0.5, 12.0, 13)
"""Outlier thresholds, in NMADs of the residuals at the true pose."""
_SAMPLE, _FIT_SAMPLE = 20_000, 200_000
"""Number of points from which the error and the RMS are computed."""
_TOLERANCE, _LEAST_TOLERANCE_M = 1.1, 1e-4
"""A setting is as good as the best if its error is at most 10 % or 0.1 mm larger."""
_TO_TRUTH = IcpConfig(outlier_distance_threshold=0.2, threshold=0.0, delta_threshold=1e-7, max_iteration=60)
"""Settings with which the true transform is found."""


@dataclass(frozen=True)
class StudyEpoch:
    """An epoch of an ICP study: it is moved away from the reference by a known motion, and ICP has to bring it back.

    Attributes
    ----------
    number : int
        Number of the epoch.
    points : (n, 3) array
        Measured points after the known motion, wall frame, m.
    true : RigidTransform
        True motion that brings `points` to the reference.
    applied : RigidTransform or None
        Registration that the command `simulate` estimated for the points before the known motion; None if it used no ICP.
    true_applied : RigidTransform
        True motion that brings the points before the known motion to the reference, to compare `applied` with.
    """

    number: int
    points: FloatArray
    true: RigidTransform
    applied: RigidTransform | None
    true_applied: RigidTransform


@dataclass(frozen=True)
class EpochSurfaces:
    """Measured and true surface of an epoch, from which an ICP study finds the true registration.

    Attributes
    ----------
    number : Number of the epoch, from 0; 0 is the reference.
    measured : Surface that the sensor measured, before registration, wall frame, m.
    truth : True surface, wall frame, m.
    applied : Registration that the command `simulate` estimated and applied to the epoch; None if it applied none.
    """

    number: int
    measured: TriangleMesh
    truth: TriangleMesh
    applied: RigidTransform | None = None


def surfaces_of_run(folder: Path, epochs: int) -> tuple[SimulationConfig, str, list[EpochSurfaces]]:
    """Read config, measured and true surfaces from the folder of a simulation run, for an ICP study.

    Parameters
    ----------
    folder : Path
        Folder that the command `simulate` wrote.
    epochs : int
        Number of epochs to read after the reference.

    Returns
    -------
    (SimulationConfig, str, list of EpochSurfaces)
        Config of the run, its sensor ("stereo" or "tls"), and the surfaces of the reference and the epochs.

    Raises
    ------
    InputError
        If the folder is no run, or has fewer epochs.
    """
    path = folder / RUN_FILE
    if not path.exists():
        raise InputError(
            f"this is not the folder of a run, because it contains no {RUN_FILE}",
            where=str(folder),
            remedy="name a run's folder or a config file",
        )
    run = read_run(path, "run it again with simulate")
    sensor, records = run["sensor"], [(record["epoch"], _applied(record)) for record in run.get("epochs", [])]
    if len(records) < 2:
        raise InputError(
            "the run has no epoch after the reference", where=str(folder), remedy="finish the run with scarpsim simulate --resume"
        )
    if epochs >= len(records):
        raise InputError(
            f"the option asks for {epochs} epochs",
            where="--epochs",
            allowed=f"1 to {len(records) - 1}, as many epochs as {folder} has",
            remedy="choose a number in this range",
        )
    config = load_config(path, [], None, None)
    found = []
    for number, applied in records[: epochs + 1]:
        epoch = epoch_folder(folder, number)
        found.append(EpochSurfaces(number, read_surface(epoch / "surface.ply"), read_surface(epoch / "truth.ply"), applied))
    return config, sensor, found


def _applied(record: dict[str, Any]) -> RigidTransform | None:
    """Return the transform in an epoch's record in run.json; None without ICP."""
    registered = record.get("registration")
    if not registered:
        return None
    return RigidTransform(np.array(registered["rotation"], float), np.array(registered["translation_m"], float))


def simulated_surfaces(config: SimulationConfig, sensor: SensorName, epochs: int, progress: Progress) -> list[EpochSurfaces]:
    """Simulate the epochs of an ICP study as the command `simulate` does, without writing files.

    Parameters
    ----------
    config : SimulationConfig
        The wall, the sensors and what falls.
    sensor : str
        "stereo" or "tls" (laser scanner).
    epochs : int
        Number of epochs after the reference.
    progress : Progress
        Receives the progress.

    Returns
    -------
    list of EpochSurfaces
        The reference, then the epochs.
    """
    random = KeyedRandom(config.seed)
    with progress.stage("wall"):
        site = prepare_site(config, sensor, random)
    reference = observe_reference(config, site, random, progress)
    found = [EpochSurfaces(0, reference.surface, reference.caster.mesh)]
    for number in range(1, epochs + 1):
        epoch = observe_epoch(config, site, reference, number, random, progress)
        applied = None if epoch.registration is None else epoch.registration.transform
        found.append(EpochSurfaces(number, epoch.surface, epoch.carved.mesh, applied))
    return found


def study(
    sensor: str,
    surfaces: Sequence[EpochSurfaces],
    config: IcpConfig,
    random: KeyedRandom,
    *,
    offset_m: float = 0.03,
    repeats: int = 3,
    progress: Progress | None = None,
) -> IcpStudy:
    """Find good settings of ICP: register every epoch to the reference with many subsample ratios and outlier thresholds.

    Parameters
    ----------
    sensor : str
        "stereo" or "tls" (laser scanner), which is stored with the results.
    surfaces : sequence of EpochSurfaces
        The reference, then the epochs.
    config : IcpConfig
        Settings of ICP; in each registration the subsample ratio or the outlier threshold is replaced.
    random : KeyedRandom
        Source of random numbers, for subsamples and for the motions of the epochs.
    offset_m : float
        Size of the random motion by which each epoch is moved before its registration, m; 0 for none.
    repeats : int
        Number of random subsamples drawn for each subsample ratio (share of points left out).
    progress : Progress, optional
        Receives the progress.

    Returns
    -------
    IcpStudy
        All registrations with their errors, and the recommended settings.
    """
    progress = progress or Progress()
    progress.plan({"truth": 2.0, "subsample ratio": float(len(RATIOS) * repeats), "outlier threshold": 2.0 * len(_THRESHOLDS)})
    with progress.stage("truth"):
        reference = surfaces[0].measured
        normals = reference.vertex_normals()
        target = ReferenceSurface.build(reference.vertices, normals)
        to_truth = true_pose(surfaces[0], random)
        epochs = [_displaced(each, to_truth, offset_m, random.child("study", each.number)) for each in surfaces[1:]]
        sigma = _residual_nmad(target, epochs[0])
    judge = _PoseEvaluator(target, reference.vertices, normals, config)
    with progress.stage("subsample ratio"):
        cases = [(ratio, epoch, repeat) for epoch in epochs for ratio in RATIOS for repeat in range(repeats if ratio else 1)]
        rows = [_ratio_row(judge, ratio, epoch, repeat, random) for ratio, epoch, repeat in _counted(cases, progress)]
    with progress.stage("outlier threshold"):
        held = [
            (float(factor * sigma), epoch, gradual) for epoch in epochs for factor in _THRESHOLDS for gradual in (True, False)
        ]
        rows += [
            _threshold_row(judge, threshold, epoch, gradual, random) for threshold, epoch, gradual in _counted(held, progress)
        ]
    applied = {each.number: None if each.applied is None else judge.error(each.applied, each.true_applied) for each in epochs}
    found = [best for name in ("subsample_ratio", "outlier_distance_threshold") if (best := recommend(rows, name)) is not None]
    return IcpStudy(sensor, config, offset_m, sigma, rows, found, applied)


def true_pose(surface: EpochSurfaces, random: KeyedRandom) -> RigidTransform:
    """Find the rigid motion that brings a measured surface onto the true wall: the true registration for an ICP study.

    All measured vertices are fitted, point to plane, to the vertices and centroids of the true triangles.

    surface: measured and true surface of an epoch. random: source of random numbers for the fit.
    """
    truth = surface.truth
    corners = truth.corners()
    across = area_normals(corners)
    flat = np.linalg.norm(across, axis=1) > 0
    points = np.concatenate([truth.vertices, corners[flat].mean(axis=1)])
    normals = np.concatenate([truth.vertex_normals(), across[flat]])
    known = np.isfinite(normals).all(axis=1)
    target = ReferenceSurface.build(points[known], normals[known])
    return register_to(target, surface.measured.vertices, _TO_TRUTH, random.child("truth", surface.number)).transform


def recommend(rows: Iterable[StudyRow], parameter: Parameter) -> Recommendation | None:
    """Recommend a value of an ICP setting from registrations with several values.

    A value is judged by its largest error over all epochs and repetitions. It is good if this error is at most 10 % or 0.1 mm
    above that of the best value. For the subsample ratio (share of points left out) the best value is taken to be the smallest
    ratio, and the largest value of the good range is recommended, to save time. For the outlier threshold the middle of the
    good range around the best value is recommended.

    Parameters
    ----------
    rows : iterable of StudyRow
        Registrations. Only those whose outlier threshold decreased gradually count.
    parameter : str
        The setting, "subsample_ratio" or "outlier_distance_threshold".

    Returns
    -------
    Recommendation or None
        None if all registrations failed.
    """
    chosen = [row for row in rows if row.parameter == parameter and row.gradual]
    values = sorted({row.value for row in chosen})
    errors = {value: _worst_error([row for row in chosen if row.value == value]) for value in values}
    if parameter == "subsample_ratio":
        best = values[0] if values else None
    else:
        best = min(values, key=lambda value: errors[value], default=None)
    if best is None or not np.isfinite(errors[best]):
        return None
    limit = max(_TOLERANCE * errors[best], errors[best] + _LEAST_TOLERANCE_M)
    first = last = values.index(best)
    while first > 0 and errors[values[first - 1]] <= limit:
        first -= 1
    while last + 1 < len(values) and errors[values[last + 1]] <= limit:
        last += 1
    good = values[first : last + 1]
    value = good[-1] if parameter == "subsample_ratio" else good[len(good) // 2]
    return Recommendation(parameter, value, (good[0], good[-1]), errors[value])


class _PoseEvaluator:
    """Runs registrations to one reference and measures their errors."""

    def __init__(self, target: ReferenceSurface, points: FloatArray, normals: FloatArray, config: IcpConfig) -> None:
        self.target, self.config = target, config
        step = max(len(points) // _SAMPLE, 1)
        self.points, self.normals, self.middle = points[::step], normals[::step], points.mean(axis=0)

    def error(self, found: RigidTransform, true: RigidTransform) -> PoseError:
        """Measure the error of a transform."""
        wrong = found.after(true.inverse())
        moved = wrong.apply(self.points) - self.points
        along = np.einsum("ni,ni->n", moved, self.normals)
        shift = wrong.apply(self.middle) - self.middle
        return PoseError(
            float(np.sqrt(np.mean(along**2))),
            float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
            tuple(shift.tolist()),
            tuple(wrong.rotation_vector.tolist()),
        )

    def row(
        self,
        parameter: Parameter,
        value: float,
        config: IcpConfig,
        epoch: StudyEpoch,
        random: KeyedRandom,
        *,
        gradual: bool,
        repeat: int,
    ) -> StudyRow:
        """Register an epoch with one setting and measure the result."""
        began = time.perf_counter()
        try:
            found = register_to(self.target, epoch.points, config, random)
        except InputError:  # fewer than six pairs or points: this setting fails
            return StudyRow(
                parameter, value, gradual, epoch.number, repeat, None, None, None, None, None, time.perf_counter() - began
            )
        error = self.error(found.transform, epoch.true)
        step = max(len(epoch.points) // _FIT_SAMPLE, 1)
        fitted = measure_fit(self.target, found.apply(epoch.points[::step]), config)
        return StudyRow(
            parameter,
            value,
            gradual,
            epoch.number,
            repeat,
            fitted.rms_m,
            error.normal_m,
            error.displacement_m,
            fitted.inliers / fitted.points,
            found.iterations,
            time.perf_counter() - began,
        )


def _ratio_row(judge: _PoseEvaluator, ratio: float, epoch: StudyEpoch, repeat: int, random: KeyedRandom) -> StudyRow:
    """Register an epoch with a subsample ratio."""
    config = judge.config.model_copy(update={"subsample_points": ratio > 0, "subsample_ratio": ratio})
    keyed = random.child("ratio", epoch.number, repeat)
    return judge.row("subsample_ratio", ratio, config, epoch, keyed, gradual=True, repeat=repeat)


def _threshold_row(judge: _PoseEvaluator, threshold: float, epoch: StudyEpoch, gradual: bool, random: KeyedRandom) -> StudyRow:
    """Register an epoch with an outlier threshold."""
    changed: dict[str, Any] = {"outlier_distance_threshold": threshold, "remove_outlier": True}
    config = judge.config.model_copy(update=changed if gradual else changed | {"outlier_threshold_decay_iteration": 1})
    keyed = random.child("threshold", epoch.number)
    return judge.row("outlier_distance_threshold", threshold, config, epoch, keyed, gradual=gradual, repeat=0)


def _displaced(surface: EpochSurfaces, reference_to_truth: RigidTransform, offset_m: float, random: KeyedRandom) -> StudyEpoch:
    """Displace the epoch by a random rigid motion.

    It is a shift of `offset_m`, and a rotation that moves the cloud's edge by as much.
    """
    points = surface.measured.vertices
    true = reference_to_truth.inverse().after(true_pose(surface, random))
    shift, axis = (direction / np.linalg.norm(direction) for direction in random.generator().standard_normal((2, 3)))
    centre = points.mean(axis=0)
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    put_off = RigidTransform.about(centre, axis * offset_m / radius, shift * offset_m)
    moved = put_off.apply(points) if offset_m else points
    return StudyEpoch(surface.number, moved, true.after(put_off.inverse()) if offset_m else true, surface.applied, true)


def _residual_nmad(target: ReferenceSurface, epoch: StudyEpoch) -> float:
    """Return the NMAD of the residuals along the normals at the true pose, m."""
    step = max(len(epoch.points) // _SAMPLE, 1)
    local = epoch.true.apply(epoch.points[::step]) - target.origin
    nearest = target.tree.query(local, 1)[1][:, 0]
    normals = target.normals if target.normals is not None else np.zeros_like(target.points)
    along = np.einsum("ni,ni->n", local - target.points[nearest], normals[nearest])
    return float(stats.median_abs_deviation(along, scale="normal"))


def _worst_error(rows: Sequence[StudyRow]) -> float:
    """Return the largest error along the normals, m; a failed registration counts as infinite."""
    return max(np.inf if row.normal_error_m is None else row.normal_error_m for row in rows)


def _counted(cases: Sequence[Any], progress: Progress) -> Iterable[Any]:
    """Yield the cases and report the progress."""
    for number, case in enumerate(cases):
        progress.advance(number / len(cases))
        yield case
