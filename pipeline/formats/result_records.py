"""run.json and gap.json as commands read them: of the right types, as far as they are used."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, field_validator

from scene.config import parse
from scene.regular_file import read_json

RUN_FILE, GAP_FILE = "run.json", "gap.json"
_FARTHEST_M, _FEW_DIGITS = 1e8, 1e-6
"""No coordinate system of a survey reaches farther; and how far a rotation may be from orthonormal."""
_Coordinate = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
_Box = Annotated[list[_Coordinate], Field(min_length=6, max_length=6)]
_Vector = Annotated[list[_Coordinate], Field(min_length=3, max_length=3)]


class _Record(BaseModel):
    """Part of a file that holds more."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False, strict=True)


class _Registration(_Record):
    rotation: Annotated[list[_Vector], Field(min_length=3, max_length=3)]
    translation_m: _Vector

    @field_validator("rotation")
    @classmethod
    def _orthonormal(cls, rotation: list[list[float]]) -> list[list[float]]:
        rows = np.array(rotation)
        if np.abs(rows @ rows.T - np.eye(3)).max() > _FEW_DIGITS or np.linalg.det(rows) < 0:
            raise ValueError("is no rotation matrix")
        return rotation


class _Statistics(_Record):
    sigma_m: float = Field(gt=0, le=_FARTHEST_M)


class _Block(_Record):
    label: int
    shape: str
    size_m: _Vector
    volume_m3: float
    bbox_m: _Box
    position_m: _Vector
    measured_area_m2: float
    measured_volume_m3: float
    measured_mean_depth_m: float | None


class _EpochRecord(_Record):
    epoch: int = Field(ge=0, le=9999)
    registration: _Registration | None = None
    statistics: _Statistics | None = None
    blocks: list[_Block] = []


class _Wall(_Record):
    name: str


class _RunRecord(_Record):
    """schema: of the file; products: checksums of each finished epoch's files."""

    sensor: Literal["stereo", "tls"]
    config: dict[str, Any]
    wall: _Wall | None = None
    epochs: list[_EpochRecord] = Field([], max_length=10_000)
    products: dict[Annotated[str, StringConstraints(pattern=r"^epoch_\d+$")], dict[str, str]] = {}


class _Change(_Record):
    bbox_m: _Box
    volume_m3: float


class _Effect(_Record):
    name: str


class _Gap(_Record):
    sensor: Literal["stereo", "tls"]
    verdict: str
    scene_changes: list[_Change] = Field([], max_length=10_000)
    effects: list[_Effect] = Field([], max_length=100)


def read_run(path: Path, remedy: str) -> dict[str, Any]:
    """The record of a run, finished or not. Raises InputError, which ends with `remedy`, for a file that is none."""
    values = read_json(path, remedy=remedy)
    parse(_RunRecord, values, str(path))
    return dict(values)


def read_gap(path: Path) -> dict[str, Any]:
    """The record of a diagnosis; raises InputError for a file that is none."""
    values = read_json(path, remedy="run scarpsim gap again")
    parse(_Gap, values, str(path))
    return dict(values)
