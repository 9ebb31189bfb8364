"""Recognise the format of a camera file by its content, read it, and select the two cameras of a pair."""

from __future__ import annotations

import warnings
from pathlib import Path

from pipeline.formats.cameras.colmap import read_colmap
from pipeline.formats.cameras.metashape import MetashapeCameras, read_calibration, read_metashape
from pipeline.formats.cameras.metashape_project import is_project, project_files
from pipeline.formats.cameras.opencv import read_opencv, read_opencv_text
from pipeline.formats.files.xml_file import read_root
from scene.common.errors import InputError
from scene.common.regular_file import check_file
from sensors.cameras.camera import Camera, CameraPair

_COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")


def read_oriented(path: Path) -> MetashapeCameras | None:
    """Read the cameras of a Metashape or COLMAP file, with calibrations and poses (world frame), by their labels.

    path: Metashape's camera XML or project, or COLMAP's text model (its folder or one of its files). Returns None for other kinds
    of file, such as scarpsim's cameras.yaml. Raises InputError for a calibration without poses.
    """
    if path.is_dir() or path.name in _COLMAP_FILES:
        return MetashapeCameras(read_colmap(path if path.is_dir() else path.parent), ())
    root = _xml_root(path)
    if root == "document":
        return read_metashape(path)
    if root or _is_opencv_yaml(path):
        raise InputError(
            "the file contains a calibration but no poses",
            where=str(path),
            remedy="name this file as `calibration:` of a camera in cameras.yaml, beside position_m and rotation",
        )
    return None


def oriented_files(path: Path) -> list[Path]:
    """Return all files that `read_oriented` reads for `path`, to tell by their checksums whether the cameras were changed.

    They are those of COLMAP's model or of a Metashape project; else `path` alone.
    """
    if path.is_dir() or path.name in _COLMAP_FILES:
        folder = path if path.is_dir() else path.parent
        return [folder / name for name in sorted(_COLMAP_FILES) if (folder / name).exists()]
    return project_files(path) if is_project(path) else [path]


def read_lens(path: Path) -> Camera:
    """Read the calibration of a single camera from a file that states no pose; the returned camera is at the origin.

    path: Metashape's calibration XML, a file of OpenCV's FileStorage, or a text file (.txt) of numbers as OpenCV has them.
    """
    root = _xml_root(path)
    if root == "document":
        raise InputError(
            "the file is a camera XML, not a calibration", where=str(path), remedy="name this file as cameras.file in the config"
        )
    if root not in ("", "opencv_storage"):
        return read_calibration(path)
    return read_opencv_text(path) if path.suffix.lower() == ".txt" else read_opencv(path)


def stereo_pair(found: MetashapeCameras, left: str | None, right: str | None, where: str) -> CameraPair:
    """Select the two cameras of a stereo pair among those of a file.

    Cameras without an estimated pose (not aligned) are left out with a warning.

    Parameters
    ----------
    found : The cameras of a file.
    left, right : Their labels; None: the only two, ordered by their positions.
    where : Name of the file, for errors.

    Raises
    ------
    InputError
        If a label is unknown, or there are not exactly two cameras.
    """
    known = ", ".join(found.cameras)
    for label in (label for label in (left, right) if label is not None and label not in found.cameras):
        problem = "is not aligned" if label in found.unaligned else "is not in the file"
        problem = "belongs to a rig, whose relative poses cannot be read" if label in found.rigged else problem
        raise InputError(
            f"the pair cannot be read: the camera '{label}' {problem}",
            where=where,
            allowed=known,
            remedy="choose one of these cameras",
        )
    if left is not None and right is not None:
        return CameraPair(found.cameras[left], found.cameras[right])
    if left is not None or right is not None or len(found.cameras) != 2:
        raise InputError(
            f"the file has {len(found.cameras)} aligned cameras, but a pair has two",
            where=where,
            allowed=known,
            remedy="name both as cameras.left and cameras.right",
        )
    if found.unaligned:
        warnings.warn(f"{where}: left out as not aligned: {', '.join(found.unaligned)}", stacklevel=2)
    if found.rigged:
        words = f"{where}: left out because poses in a rig cannot be read: {', '.join(found.rigged)}"
        warnings.warn(words, stacklevel=2)
    first, second = found.cameras.values()
    swapped = first.rotation[:, 0] @ (second.position - first.position) < 0
    return CameraPair(second, first) if swapped else CameraPair(first, second)


def _xml_root(path: Path) -> str:
    """Return the tag of an XML file's root; "" if the file is not XML."""
    return read_root(path).tag if path.suffix.lower() == ".xml" or _start(path).startswith(b"<") else ""


def _is_opencv_yaml(path: Path) -> bool:
    """Whether a file is OpenCV's YAML."""
    start = _start(path)
    return start.startswith(b"%YAML") and b"opencv-matrix" in start


def _start(path: Path) -> bytes:
    """Return the first bytes of a file."""
    check_file(path)
    try:
        with path.open("rb") as file:
            return file.read(4096).lstrip()
    except OSError as error:
        raise InputError(
            f"the file cannot be read ({error.strerror})",
            where=str(path),
            remedy="give the path of an existing camera file that you may read",
        ) from None
