"""Store the result of each epoch while `monitor` works, so that an interrupted one can be resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
CAUTION = "caution: "
"""Beginning of the remarks on an epoch without which its result would mislead."""


def can_be_resumed(out: Path) -> bool:
    """Return whether a folder has anything that `monitor` wrote, even if it was killed before the first epoch was finished."""
    return (out / KEPT).exists() or (out / "monitor.json").exists() or any(out.glob("*difference_*.tif"))


@dataclass(frozen=True)
class EpochRecord:
    """The result of comparing one epoch with the reference, as it is stored so that an interrupted `monitor` can go on.

    Attributes
    ----------
    number : int
        Number of the epoch; the reference is 0.
    inputs : dict
        SHA-256 of its files by path.
    points : int
        Number of its points.
    notes : tuple of str
        Remarks on the epoch for the user.
    transform : RigidTransform
        Moves the points, as they were read, to the reference, wall frame.
    registration : dict
        Shift, rotation and their uncertainty, as monitor.json stores them.
    level_m, predicted_level_m : float
        Median level of detection, measured and predicted by the sensor's model (NaN without one), m.
    area_m2 : float
        Area of the wall that was compared, m2.
    regions : tuple of ChangedRegion
        Regions that changed; their events do not have numbers yet.
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
        """Write the result of the epoch into the folder of the results, so that an interrupted `monitor` can go on.

        Parameters
        ----------
        folder : Path
            Folder of the results.
        fingerprint : str
            Checksum of the reference and the options, with which a later call tells whether the stored result still applies.
        shapes : sequence of (int, int)
            Rows and columns of the map of each view (separately mapped part) of the wall.
        """
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
    """Read the result of an epoch that an interrupted `monitor` stored, so that it need not be computed again.

    Parameters
    ----------
    folder : Path
        Folder of the results.
    number : int
        Number of the epoch.
    inputs : mapping
        SHA-256 of the epoch's files by path.
    fingerprint : str
        Checksum of the reference and the options.

    Returns
    -------
    EpochRecord or None
        None if there is none, or if it was made from other files, options or another reference.
    """
    found = stored(folder, number, fingerprint)
    return found if found is not None and found.inputs == dict(inputs) else None


def points_note(folder: Path, number: int) -> Path:
    """Return the path of a small file that tells whether the registered points of an epoch have to be written again.

    It holds a checksum of all that they depended on when they were last written.

    folder: the folder of the results. number: number of the epoch.
    """
    return folder / KEPT / f"points_{number:03d}.txt"


def discard(folder: Path, number: int) -> None:
    """Remove the stored result of an epoch, if there is one, because it does not apply any more.

    folder: the folder of the results. number: number of the epoch.
    """
    _file(folder, number).unlink(missing_ok=True)


def stored(folder: Path, number: int, fingerprint: str) -> EpochRecord | None:
    """Read the stored result of an epoch, without checking that the epoch's files are still the same.

    folder: the folder of the results. number: number of the epoch. fingerprint: checksum of the reference and the options.
    Returns None if there is no result for these.
    """
    path = _file(folder, number)
    if not path.is_file():
        return None
    values = json.loads(path.read_text(encoding="utf-8"))
    if values["fingerprint"] != fingerprint:
        return None
    transform = RigidTransform(np.array(values["transform"]["rotation"]), np.array(values["transform"]["translation_m"]))
    predicted = values["predicted_level_m"]
    return EpochRecord(
        number=number,
        inputs=values["inputs"],
        points=values["points"],
        notes=tuple(values["notes"]),
        transform=transform,
        registration=values["registration"],
        level_m=values["level_m"],
        predicted_level_m=float("nan") if predicted is None else predicted,
        area_m2=values["area_m2"],
        regions=tuple(_region(each) for each in values["regions"]),
    )


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
