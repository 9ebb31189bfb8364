"""Define the options of `scarpsim monitor`, and read its file of stable areas."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from pipeline.monitoring.stable_areas import StableArea
from scene.common.config import load_yaml
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

NO_DETECTOR = "none"


@dataclass(frozen=True)
class MonitorOptions:
    """Options of `scarpsim monitor`, except for the epochs and the folder of the results.

    Attributes
    ----------
    reference : Path or None
        File of the reference epoch; None: the first epoch.
    position : (3,) array or None
        Where the sensor stood, or any place in front of the wall, survey coordinates, m; None: as the files state.
    direction : (3,) array or None
        Direction along which change is measured, towards the sensor, survey coordinates; None: the normal of the mean plane.
    views : int or None
        Number of views: parts of the wall that are mapped along directions of their own; None: as many as its shape needs.
    gsd_m : float or None
        Side of a pixel of the maps, m; None: derived from the density of the reference's points.
    stable : tuple of StableArea
        Areas of stable rock, on the map or in survey coordinates, m; empty: `monitor` finds stable rock itself.
    targets : Path or None
        CSV file of targets that were measured in each epoch, which replace ICP; None: there are none.
    unit : str or None
        Unit of the coordinates: "m", "cm", "mm", "ft" or "us-ft"; None: as the files state.
    columns : tuple of str
        Names of the columns of text files, in order; empty: as their header states.
    scanner, model : str and Path, or None
        Scanner for which a level of detection is also predicted: name of a preset, or path of a model.yaml; None: no prediction.
    photographs : bool
        Whether the epochs were reconstructed from photographs; no level of detection is predicted then.
    detector : str
        "none": events are regions beyond the level of detection; else the name or folder of a detector of `scarpsim detect`.
    seed : int
        Seed of the random numbers that choose subsets of the points for the registration.
    """

    reference: Path | None = None
    position: FloatArray | None = None
    direction: FloatArray | None = None
    views: int | None = None
    gsd_m: float | None = None
    stable: tuple[StableArea, ...] = ()
    targets: Path | None = None
    unit: str | None = None
    columns: tuple[str, ...] = ()
    scanner: str | None = None
    model: Path | None = None
    photographs: bool = False
    detector: str = NO_DETECTOR
    seed: int = 1

    def to_dict(self) -> dict[str, Any]:
        """Return the options of `scarpsim monitor` as monitor.json stores them: by name, as JSON types."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        plain = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}
        return {name: str(value) if isinstance(value, Path) else value for name, value in plain.items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MonitorOptions:
        """Return the options of `scarpsim monitor` as monitor.json stores them.

        values: options by name. Names that are not known are ignored. Raises ValueError or TypeError for wrong values.
        """
        known: dict[str, Any] = {name: values[name] for name in cls.__dataclass_fields__ if values.get(name) is not None}
        known |= {name: np.array(known[name], dtype=np.float64) for name in ("position", "direction") if name in known}
        known |= {name: Path(known[name]) for name in ("reference", "targets", "model") if name in known}
        known["stable"] = TypeAdapter(tuple[StableArea, ...]).validate_python(known.get("stable", ()))
        known["columns"] = tuple(known.get("columns", ()))
        return cls(**known)


def read_areas(path: Path) -> tuple[StableArea, ...]:
    """Read stable areas, on which `monitor` registers epochs, from a YAML or JSON file with a list of boxes or polygons.

    Boxes [x0, y0, x1, y1] and polygons [[x, y], ...] are in the wall frame, m. Boxes [x0, y0, z0, x1, y1, z1] and polygons
    [[x, y, z], ...] are in survey coordinates, m, and can lie on any view (separately mapped part) of the wall. The list may
    stand under the key `stable_areas`. Raises InputError for anything else.
    """
    values = load_yaml(path)
    areas = values.get("stable_areas") if isinstance(values, dict) else values
    try:
        found = TypeAdapter(tuple[StableArea, ...]).validate_python(areas)
    except ValidationError as error:
        wrong = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise InputError(
            f"the file is not a list of areas ({wrong})",
            where=str(path),
            allowed="boxes [x0, y0, x1, y1] or polygons [[x, y], ...] on the map, or the same with x, y, z in survey coordinates",
            remedy="write the stable areas in this form, in metres",
        ) from None
    if not found:
        raise InputError(
            "the file contains no area", where=str(path), remedy="add a box or polygon to the file, or leave --stable out"
        )
    return found
