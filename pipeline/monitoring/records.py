"""What is kept of each epoch while a monitoring goes on, so that an interrupted one goes on where it stopped."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask

from pipeline.change.annotate import run_length_encoding
from pipeline.formats.files.atomic import write_json
from pipeline.monitoring.events import ChangedRegion
from pipeline.registration.rigid import RigidTransform

KEPT = ".monitor"
"""Folder of the records within the folder of the results."""


@dataclass(frozen=True)
class EpochRecord:
    """The result of one epoch.

    Attributes
    ----------
    number : int
        Of the epoch; the reference is 0.
    inputs : dict
        SHA-256 of its files by path.
    points : int
    notes : tuple of str
    transform : RigidTransform
        From the points as read to the reference, wall frame.
    registration : dict
        As monitor.json holds it.
    level_m, predicted_level_m : float
        Median level of detection, and what the sensor's model predicts (NaN without a model).
    area_m2 : float
        Of the wall that is compared.
    regions : tuple of ChangedRegion
        Without numbers of events.
    """

    number: int
    inputs: Mapping[str, str]
    points: int
    notes: tuple[str, ...]
    transform: RigidTransform
    registration: dict[str, Any]
    level_m: float
    predicted_level_m: float
    area_m2: float
    regions: tuple[ChangedRegion, ...]

    def write(self, folder: Path, fingerprint: str, shapes: Sequence[tuple[int, ...]]) -> None:
        """Keep the record; fingerprint: of the reference and the options; shapes: of the maps of all views."""
        values = {name: getattr(self, name) for name in ("number", "inputs", "points", "notes", "registration", "area_m2")}
        levels = {
            "level_m": self.level_m,
            "predicted_level_m": None if np.isnan(self.predicted_level_m) else self.predicted_level_m,
        }
        regions = [_plain(region, shapes[region.view - 1]) for region in self.regions]
        write_json(
            _file(folder, self.number),
            {"fingerprint": fingerprint, **values, **levels, "transform": self.transform.to_dict(), "regions": regions},
        )


def kept(folder: Path, number: int, inputs: Mapping[str, str], fingerprint: str) -> EpochRecord | None:
    """The record of an epoch of these files, made with these options and this reference; None where there is none."""
    path = _file(folder, number)
    if not path.is_file():
        return None
    values = json.loads(path.read_text(encoding="utf-8"))
    if values["fingerprint"] != fingerprint or values["inputs"] != dict(inputs):
        return None
    transform = RigidTransform(np.array(values["transform"]["rotation"]), np.array(values["transform"]["translation_m"]))
    predicted = values["predicted_level_m"]
    return EpochRecord(
        number=number,
        inputs=inputs,
        points=values["points"],
        notes=tuple(values["notes"]),
        transform=transform,
        registration=values["registration"],
        level_m=values["level_m"],
        predicted_level_m=float("nan") if predicted is None else predicted,
        area_m2=values["area_m2"],
        regions=tuple(_region(each) for each in values["regions"]),
    )


def without_numbers(region: ChangedRegion) -> ChangedRegion:
    """The region as yet of no event."""
    return replace(region, identity=0)


def _file(folder: Path, number: int) -> Path:
    return folder / KEPT / f"epoch_{number:03d}.json"


def _plain(region: ChangedRegion, shape: tuple[int, ...]) -> dict[str, Any]:
    numbers = region.numbers()
    score = None if np.isnan(region.score) else region.score
    size = list(region.mask.shape)
    return {
        **numbers,
        "score": score,
        "size": size,
        "mask": run_length_encoding(region.mask, region.row, region.column, shape),
    }


def _region(values: dict[str, Any]) -> ChangedRegion:
    height, width = values.pop("size")
    whole = coco_mask.decode(values.pop("mask")) > 0
    row, column = values["row"], values["column"]
    values["score"] = float("nan") if values["score"] is None else values["score"]
    mask = np.ascontiguousarray(whole[row : row + height, column : column + width])
    return ChangedRegion(mask=mask, marks=tuple(values.pop("marks")), identity=values.pop("id"), **values)
