"""Read and write the calibration of a stereo pair in the project's own YAML: sections `left` and `right` of cameras.yaml."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.formats.cameras.camera_files import read_lens
from pipeline.formats.files.atomic import write_text
from scene.common.config import Config, load_yaml, parse
from sensors.cameras.camera import INTERIOR, CameraConfig, CameraPair


class PairConfig(Config):
    """Content of cameras.yaml, the file of a stereo pair: calibration and pose of the left and the right camera."""

    left: CameraConfig
    right: CameraConfig

    def pair(self) -> CameraPair:
        """Return the two cameras of the file (calibration and pose), world frame."""
        return CameraPair(self.left.camera(), self.right.camera())


def read_cameras_yaml(path: Path) -> CameraPair:
    """Read the cameras of a stereo pair from cameras.yaml: nominal calibration and pose of `left` and `right`, world frame.

    A camera may name a calibration file of Metashape or OpenCV as its `calibration`, relative to cameras.yaml, instead of its
    width, height and interior orientation.
    """
    values = load_yaml(path)
    if isinstance(values, dict):
        values = {side: _with_lens(camera, path.parent) for side, camera in values.items()}
    return parse(PairConfig, values, str(path)).pair()


def cameras_yaml_files(path: Path) -> list[Path]:
    """Return all files that `read_cameras_yaml` reads, to tell by their checksums whether the cameras were changed.

    They are cameras.yaml itself, `path`, and the calibration files that it names.
    """
    values = load_yaml(path)
    cameras = values.values() if isinstance(values, dict) else ()
    return [path, *(path.parent / camera["calibration"] for camera in cameras if _names_lens(camera))]


def write_cameras_yaml(path: Path, pair: CameraPair) -> None:
    """Write the calibration and the poses of a stereo pair, world frame, to the file `path`, usually called cameras.yaml."""
    lines = ["# Rotation maps camera (x right, y down, z forward) to world; the camera model is Agisoft Metashape's."]
    for side, camera in (("left", pair.left), ("right", pair.right)):
        interior = {name: float(getattr(camera, name)) for name in INTERIOR}
        lines += [f"{side}:", f"  width: {camera.width}", f"  height: {camera.height}"]
        lines += [f"  {name}: {_number(value)}" for name, value in interior.items()]
        rows = ", ".join(_row(row) for row in camera.rotation)
        lines += [f"  position_m: {_row(camera.position)}", f"  rotation: [{rows}]"]
    write_text(path, "\n".join(lines) + "\n")


def _with_lens(camera: Any, folder: Path) -> Any:
    """Replace the name of a calibration file by its content."""
    if not _names_lens(camera):
        return camera
    lens = read_lens(folder / camera["calibration"])
    interior = {"width": lens.width, "height": lens.height} | {name: float(getattr(lens, name)) for name in INTERIOR}
    return interior | {key: value for key, value in camera.items() if key != "calibration"}


def _names_lens(camera: Any) -> bool:
    """Whether a camera names a calibration file."""
    return isinstance(camera, dict) and isinstance(camera.get("calibration"), str)


def _row(values: Any) -> str:
    """Format a vector."""
    return f"[{', '.join(_number(value) for value in values)}]"


def _number(value: float) -> str:
    """Format a float with all its digits, in a form that every YAML reader takes for a number (1.0e-05, not 1e-05)."""
    text = repr(float(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
