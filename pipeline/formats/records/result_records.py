"""Read run.json and gap.json, with checks of the types of everything that commands use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints

from scene.common.config import parse
from scene.common.regular_file import read_json

RUN_FILE, GAP_FILE = "run.json", "gap.json"
_FARTHEST_M, _FEW_DIGITS = 1e8, 1e-6
"""Largest coordinate of a survey, m, and largest deviation of a rotation from orthonormal."""
_Coordinate = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
_Box = Annotated[list[_Coordinate], Field(min_length=6, max_length=6)]
_Vector = Annotated[list[_Coordinate], Field(min_length=3, max_length=3)]


class _Record(BaseModel):
    """A part of a file that may have more keys."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True)


def _orthonormal(rotation: list[list[float]]) -> list[list[float]]:
    """Raise ValueError if a matrix is not a rotation."""
    rows = np.array(rotation)
    if np.abs(rows @ rows.T - np.eye(3)).max() > _FEW_DIGITS or np.linalg.det(rows) < 0:
        raise ValueError("is not a rotation matrix")
    return rotation


_Rotation = Annotated[list[_Vector], Field(min_length=3, max_length=3), AfterValidator(_orthonormal)]
_Row = Annotated[list[_Coordinate], Field(min_length=4, max_length=4)]


class _Registration(_Record):
    """Registration of an epoch."""

    rotation: _Rotation
    translation_m: _Vector
    rms_m: float | None = None


class _Differences(_Record):
    """Statistics of pixels; None if there are none."""

    count: int
    median_m: float | None
    nmad_m: float | None


class _Statistics(_Record):
    """Statistics of an epoch."""

    sigma_m: float = Field(gt=0, le=_FARTHEST_M)
    outside_blocks: _Differences | None = None


class _Block(_Record):
    """A fallen block."""

    label: int
    shape: str
    size_m: _Vector
    volume_m3: float
    bbox_m: _Box
    position_m: _Vector
    world_position_m: _Vector | None = None
    measured_area_m2: float
    measured_volume_m3: float
    measured_mean_depth_m: float | None


class _WallFrame(_Record):
    """The wall frame."""

    matrix_world_to_wall: Annotated[list[_Row], Field(min_length=4, max_length=4)]
    rotation: _Rotation
    origin_m: _Vector


class _EpochRecord(_Record):
    """An epoch."""

    epoch: int = Field(ge=0, le=9999)
    points: int = Field(0, ge=0)
    registration: _Registration | None = None
    statistics: _Statistics | None = None
    blocks: list[_Block] = []


class _Wall(_Record):
    """The wall."""

    name: str


class _Products(_Record):
    """Settings of the written files."""

    crs: str | None = None


class _Config(_Record):
    """The parts of the config that are used."""

    products: _Products | None = None


class _RunRecord(_Record):
    """Content of run.json. products: checksums of each finished epoch's files."""

    sensor: Literal["stereo", "tls"]
    config: _Config
    wall: _Wall | None = None
    wall_frame: _WallFrame | None = None
    epochs: list[_EpochRecord] = Field([], max_length=10_000)
    products: dict[Annotated[str, StringConstraints(pattern=r"^epoch_\d+$")], dict[str, str]] = {}


class _RunImage(_Record):
    """An image of a run's annotations."""

    id: int
    epoch: int


class _RunAnnotation(_Record):
    """An annotation of a run."""

    image_id: int
    block: int


class _RunAnnotations(_Record):
    """Content of a run's annotations.json."""

    images: list[_RunImage]
    annotations: list[_RunAnnotation]


class _Change(_Record):
    """A change of the scene."""

    bbox_m: _Box
    volume_m3: float


class _Effect(_Record):
    """A named effect."""

    name: str


class _Gap(_Record):
    """Content of gap.json."""

    sensor: Literal["stereo", "tls"]
    verdict: str
    scene_changes: list[_Change] = Field([], max_length=10_000)
    effects: list[_Effect] = Field([], max_length=100)


def read_run(path: Path, remedy: str) -> dict[str, Any]:
    """Read and check run.json, the record of a simulation, finished or not.

    Each epoch in the result has a list of blocks, perhaps empty; null values are left out. remedy: what the user can do, the end
    of an error. Raises InputError if the file is not such a record.
    """
    values = read_json(path, remedy=remedy)
    parse(_RunRecord, values, str(path))
    epochs = [{"blocks": [], **_without_null(each, "statistics")} for each in values.get("epochs", [])]
    return {**_without_null(values, "wall", "wall_frame"), "epochs": epochs}


def read_annotations(path: Path) -> dict[str, Any]:
    """Read annotations.json of a run, which has the fallen blocks in its difference maps, in COCO's format.

    Each image also has the number of its epoch (`epoch`), and each annotation that of its block (`block`). Raises InputError for
    any other file.
    """
    values = read_json(path, remedy="make the run again")
    parse(_RunAnnotations, values, str(path))
    return dict(values)


def _without_null(values: dict[str, Any], *names: str) -> dict[str, Any]:
    """Leave out some keys if they are null."""
    return {key: value for key, value in values.items() if key not in names or value is not None}


def read_gap(path: Path) -> dict[str, Any]:
    """Read gap.json, the record of a diagnosis by `scarpsim gap`; raise InputError if the file is not one."""
    values = read_json(path, remedy="run scarpsim gap again")
    parse(_Gap, values, str(path))
    return dict(values)
