"""Write the files of a measurement folder, and check that `gap` can read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.formats.cameras.cameras import write_cameras_yaml
from pipeline.formats.files.atomic import filling, write_bytes, write_json, write_text
from pipeline.formats.measurements.measurement import FILE, read_measurement
from pipeline.formats.meshes.ply import write_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import EXACT_INTENSITY, write_laz
from pipeline.measurement.picture import picture
from scene.common.errors import InputError
from scene.common.yaml_text import yaml_line
from scene.geometry.mesh import FloatArray, TriangleMesh
from sensors.cameras.camera import CameraPair
from sensors.models.sensor_model import StereoModel, TlsModel

INTERPRETATION_FILE = "understood.json"
STABLE_ROCK = "stable rock"
"""Subject of the lines that say how much of each epoch lies on stable rock; the report of `gap` repeats them."""


@dataclass(frozen=True)
class Interpretation:
    """How raw files were interpreted when a measurement folder was made from them, for the user to check.

    Attributes
    ----------
    folder : Path
        The measurement folder, the input of `scarpsim gap`.
    about : dict
        Lines of text by subject, such as "scan", "scanner" and "reference".
    """

    folder: Path
    about: dict[str, tuple[str, ...]]

    @property
    def next_command(self) -> str:
        """The command line with which the user analyses the measurement folder next, `scarpsim gap`."""
        return f"scarpsim gap {self.folder} --out {self.folder}_gap"

    def summary(self) -> str:
        """Return how the raw files were interpreted as text for the user, one line for each statement, and the next command."""
        lines = [f"{name}: {line}" for name, words in self.about.items() for line in words]
        return "\n".join([*lines, f"next: {self.next_command}"])

    def to_dict(self) -> dict[str, Any]:
        """Return how the raw files were interpreted as `understood.json` in the measurement folder stores it."""
        words = {name: list(lines) for name, lines in self.about.items()}
        return {"schema": 1, "folder": str(self.folder), **words, "next": self.next_command}


@dataclass(frozen=True)
class MeasurementContent:
    """What is written into a measurement folder, the input of `scarpsim gap`.

    Attributes
    ----------
    sensor : "tls" (laser scanner) or "stereo".
    clouds : Measured points, world frame, m, one cloud for each scan file of the folder.
    reference : Reference surface, with which the points are compared, world frame, m.
    model : Noise model of the sensor.
    eye : Place from which the picture of points and reference is drawn, the sensor's if it is known: position (3,), world
        frame, m, and rotation (3, 3) from a frame there to the world frame.
    title : Title of that picture.
    cameras : The stereo pair; None if there is none or it is unknown.
    keys : Further keys of measurement.yaml, such as the scanner's pose.
    """

    sensor: str
    clouds: Sequence[PointCloud]
    reference: TriangleMesh
    model: TlsModel | StereoModel
    eye: tuple[FloatArray, FloatArray]
    title: str
    cameras: CameraPair | None = None
    keys: Mapping[str, Any] = field(default_factory=dict)


def write(out: Path, content: MeasurementContent, found: Interpretation) -> None:
    """Write a measurement folder, and check that `scarpsim gap` can read it.

    Parameters
    ----------
    out : Folder to write; it appears only if the check succeeds.
    content : Points, reference, sensor model and further content.
    found : How the raw files were interpreted, which is stored in the folder for the user to check.

    Raises
    ------
    InputError
        If the folder could not be used, for example because points and reference do not overlap.
    """
    with filling(out) as folder:
        names = [f"scan_{number}.laz" for number in range(len(content.clouds))]
        for name, cloud in zip(names, content.clouds, strict=True):
            _write_points(folder / name, cloud)
        write_ply(folder / "reference.ply", content.reference)
        values: dict[str, Any] = {
            "sensor": content.sensor,
            "reference": "reference.ply",
            "points": names[0] if len(names) == 1 else names,
            "frame": "world",
            **content.keys,
        }
        if content.cameras is not None:
            write_cameras_yaml(folder / "cameras.yaml", content.cameras)
            values["cameras"] = "cameras.yaml"
        limits = [*found.about.get(STABLE_ROCK, ()), *(f"the reference: {words}" for words in found.about.get("cannot show", ()))]
        _write_yaml(folder / FILE, values | {"model": "model.yaml", "notes": limits})
        _write_yaml(folder / "model.yaml", content.model.model_dump(mode="json"), found.about["model"])
        write_text(folder / "understood.txt", found.summary() + "\n")
        write_json(folder / INTERPRETATION_FILE, found.to_dict())
        seen = np.concatenate([cloud.points for cloud in content.clouds])
        write_bytes(folder / "understood.png", _picture(content, seen))
        _check_readable(folder, out)


def _picture(content: MeasurementContent, points: FloatArray) -> bytes:
    """Draw the picture of the set-up."""
    sensor = content.sensor == "tls" or content.cameras is not None
    return picture(points, content.reference, *content.eye, content.title, sensor=sensor)


def _write_points(path: Path, cloud: PointCloud) -> None:
    """Write a cloud as LAZ, with the exact intensity as an extra channel."""
    extra = dict(cloud.extra)
    if cloud.intensity is not None:
        extra[EXACT_INTENSITY] = np.asarray(cloud.intensity, dtype=np.float32)
    write_laz(path, PointCloud(cloud.points, gps_time=cloud.gps_time, extra=extra))


def _write_yaml(path: Path, values: Mapping[str, Any], comments: Sequence[str] = ()) -> None:
    """Write keys and values as YAML after comment lines."""
    lines = [*(f"# {line}" for line in comments), *(f"{key}: {yaml_line(value)}" for key, value in values.items())]
    write_text(path, "\n".join(lines) + "\n")


def _check_readable(folder: Path, out: Path) -> None:
    """Raise InputError, with the folder's final name, if `gap` could not use it."""
    try:
        read_measurement(folder).check_near(FILE)
    except InputError as error:
        where = error.where.replace(str(folder), str(out))
        raise InputError(
            f"scarpsim gap cannot use the measurement: {error.what}",
            where=where,
            allowed=error.allowed,
            remedy=error.remedy or "correct the file that is named",
        ) from None
