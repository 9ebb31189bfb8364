"""Read the stereo pair of a photogrammetric cloud; pixels and disparities of the points follow by projection."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.formats.cameras.camera_files import read_oriented, stereo_pair
from pipeline.formats.cameras.cameras import read_cameras_yaml
from pipeline.formats.measurements.checks import check_seen
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray
from sensors.cameras.camera import Camera, CameraPair


def read_pair(path: Path, labels: tuple[str, str] | None) -> CameraPair:
    """Read a stereo pair, with calibration and poses in the world frame, from a camera file.

    Parameters
    ----------
    path : cameras.yaml, a Metashape file or the folder of a COLMAP text model.
    labels : Names of the left and right camera in the Metashape or COLMAP file; None if it has only two.

    Raises
    ------
    InputError
        If the file does not exist or does not determine a pair.
    """
    if not path.exists():
        raise InputError(
            "there is no such file",
            where=str(path),
            allowed="cameras.yaml, Metashape XML or .psx, a COLMAP folder",
            remedy="give the path of an existing camera file or folder",
        )
    found = read_oriented(path)
    if found is None:
        return read_cameras_yaml(path)
    if labels is None and len(found.cameras) != 2:
        raise InputError(
            f"the file has {len(found.cameras)} aligned cameras, but a pair has two", where=str(path),
            allowed=", ".join(sorted(found.cameras)[:20]), remedy="name two of them with --pair LEFT,RIGHT",
        )  # fmt: skip
    left, right = labels or (None, None)
    return stereo_pair(found, left, right, str(path))


def viewing_rotation(camera: Camera) -> FloatArray:
    """Return the rotation (3, 3) to the world from a frame like a laser scanner's at a camera, to draw and mesh from there.

    The frame has x along the viewing direction, y to the left and z up in the photograph.
    """
    right, down, forward = camera.rotation.T
    return np.stack([forward, -right, -down], axis=1)


def describe_view(pair: CameraPair, points: FloatArray, where: str) -> tuple[str, ...]:
    """Describe how much of a cloud a stereo pair sees, and how precisely, as lines of text for the user.

    Parameters
    ----------
    pair : The stereo pair.
    points : (n, 3) points of the cloud, world frame, m.
    where : Name of the file, for errors.

    Raises
    ------
    InputError
        If the pair sees almost nothing of the cloud.
    """
    both = check_seen(pair, points, where)
    left = pair.left
    middle = float(np.median((points - left.position) @ left.rotation[:, 2]))
    tenth = 1e3 * middle**2 / (left.f_px * pair.base_m) * 0.1
    return (
        f"cameras {left.width} x {left.height} px, f {left.f_px:.1f} px, base {pair.base_m:.4g} m, depth {middle:.4g} m (median)",
        f"0.1 px of disparity is {tenth:.3g} mm of depth",
        f"both see {100 * both:.3g} % of the points; pixels and disparities are computed by projection",
    )
