"""Register epochs by targets that were measured in each of them, before the fit on stable rock."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.registration.rigid import RigidTransform
from scene.common.errors import InputError
from scene.common.regular_file import read_text
from scene.geometry.frame import WallFrame
from scene.geometry.mesh import FloatArray

_COLUMNS = ("epoch", "target", "x", "y", "z")
_FEWEST = 3
_LINE = 1e-3
"""Extent of the targets across a line, relative to that along it, below which a rotation about it is unknown."""
_FAR_M = 0.1
"""Residual above which a target was mistaken or moved, m."""

Targets = Mapping[str, Mapping[str, FloatArray]]
"""Coordinates (3,), m, of each target by name, for each epoch by the name of its file or folder."""


@dataclass(frozen=True)
class TargetFit:
    """Rigid motion from an epoch to the reference that was fitted to survey targets, and how well it fits.

    Attributes
    ----------
    transform : From the epoch's to the reference's coordinates, wall frame, m.
    count : Number of targets.
    rms_m : Root mean square of the distances between transformed and reference targets, m.
    """

    transform: RigidTransform
    count: int
    rms_m: float


def read_targets(path: Path) -> Targets:
    """Read the coordinates of survey targets, which were measured in several epochs, from a CSV file.

    Its columns are epoch (name of the epoch's file), target (name of the target), x, y, z (survey coordinates, m).

    Returns the coordinates (3,) by epoch and target. Raises InputError for other columns and for values that are no numbers.
    """
    table = csv.DictReader(io.StringIO(read_text(path)))
    if not set(_COLUMNS) <= set(table.fieldnames or ()):
        raise InputError(
            f"the file lacks a column; it has {', '.join(table.fieldnames or ()) or 'none'}",
            where=str(path),
            allowed=", ".join(_COLUMNS),
            remedy="name all of these columns in the first line, separated by commas",
        )
    found: dict[str, dict[str, FloatArray]] = {}
    for line, row in enumerate(table, start=2):
        try:
            place = np.array([float(row[axis]) for axis in "xyz"])
        except (TypeError, ValueError):
            place = np.full(3, np.nan)
        if not np.isfinite(place).all():
            raise InputError(
                "the coordinates of the target are no numbers", where=f"{path}, line {line}", remedy="give x, y and z in metres"
            )
        found.setdefault(row["epoch"], {})[row["target"]] = place
    return found


def fit_targets(targets: Targets, reference: str, epoch: str, frame: WallFrame) -> TargetFit:
    """Fit the rigid motion that brings the targets of an epoch to those of the reference (Kabsch 1976), to register the epoch.

    Parameters
    ----------
    targets : mapping
        Survey coordinates (3,), m, by epoch and target, as `read_targets` returns them.
    reference, epoch : str
        Names of the two epochs' files.
    frame : WallFrame
        The wall frame, in which the motion is returned.

    Raises
    ------
    InputError
        If fewer than three targets are common, they lie on a line, or one is more than 0.1 m from its place after the fit.
    """
    before, after = targets.get(reference, {}), targets.get(epoch, {})
    common = sorted(set(before) & set(after))
    if len(common) < _FEWEST:
        raise InputError(
            f"only {len(common)} targets are measured in both {reference} and {epoch}",
            where="--targets",
            allowed=f"at least {_FEWEST}",
            remedy="measure three targets in both epochs; write the epochs' file names into the file's column `epoch`",
        )
    to, moved = (frame.to_wall(np.array([each[name] for name in common])) for each in (before, after))
    centre_to, centre = to.mean(axis=0), moved.mean(axis=0)
    extent = np.linalg.svd(to - centre_to, compute_uv=False)
    if extent[1] < _LINE * extent[0]:
        raise InputError("the targets lie on one line", where="--targets", remedy="add a target that does not lie on this line")
    left, _, right = np.linalg.svd((moved - centre).T @ (to - centre_to))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(right.T @ left.T))])
    rotation = right.T @ flip @ left.T
    transform = RigidTransform(rotation, centre_to - rotation @ centre)
    apart = np.linalg.norm(transform.apply(moved) - to, axis=1)
    if apart.max() > _FAR_M:
        worst = common[int(np.argmax(apart))]
        raise InputError(
            f"target {worst} of {epoch} is {apart.max():.2f} m from its place in {reference} after the fit",
            where="--targets",
            remedy="leave out targets that moved or were mistaken",
        )
    return TargetFit(transform, len(common), float(np.sqrt(np.mean(apart**2))))
