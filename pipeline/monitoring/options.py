"""What `monitor` is asked to do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from pipeline.change.areas import Area
from scene.common.config import load_yaml
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

NO_DETECTOR = "none"


@dataclass(frozen=True)
class MonitorOptions:
    """All options beside the epochs and the folder of the results.

    Attributes
    ----------
    reference : Path or None
        Another reference than the first epoch.
    position : (3,) array or None
        Where the sensor stood, or any place before the wall, survey coordinates, m.
    direction : (3,) array or None
        Direction along which change is measured, towards the sensor; None: the normal of the mean plane.
    views : int or None
        Number of views of the wall, each along a direction of its own; None: as many as its shape needs.
    gsd_m : float or None
        Side of a pixel of the maps; None: by the density of the reference.
    stable : tuple of Area
        Stable rock, wall frame, m; empty: found by itself.
    unit : str or None
        Of the coordinates, a key of METRES; None: as the files state.
    columns : tuple of str
        Of text files.
    scanner, model : str and Path, or None
        What is believed about the scanner: a preset, or a model.yaml.
    photographs : bool
        The epochs are from photographs.
    detector : str
        "none": regions beyond the level of detection; else a detector of `scarpsim detect`.
    seed : int
        Of the random subsets of the registration.
    """

    reference: Path | None = None
    position: FloatArray | None = None
    direction: FloatArray | None = None
    views: int | None = None
    gsd_m: float | None = None
    stable: tuple[Area, ...] = ()
    unit: str | None = None
    columns: tuple[str, ...] = ()
    scanner: str | None = None
    model: Path | None = None
    photographs: bool = False
    detector: str = NO_DETECTOR
    seed: int = 1

    def to_dict(self) -> dict[str, Any]:
        """As monitor.json holds it."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        plain = {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values.items()}
        return {name: str(value) if isinstance(value, Path) else value for name, value in plain.items()}


def read_areas(path: Path) -> tuple[Area, ...]:
    """Read stable areas from a YAML or JSON file: a list of boxes [x0, y0, x1, y1] or polygons [[x, y], ...], wall frame, m.

    The list may stand under the key `stable_areas`. Raises InputError for anything else.
    """
    values = load_yaml(path)
    areas = values.get("stable_areas") if isinstance(values, dict) else values
    try:
        found = TypeAdapter(tuple[Area, ...]).validate_python(areas)
    except ValidationError as error:
        wrong = error.errors()[0]["msg"]
        raise InputError(
            f"is not a list of areas ({wrong})",
            where=str(path),
            allowed="a list of boxes [x0, y0, x1, y1] or polygons [[x, y], ...]",
        ) from None
    if not found:
        raise InputError("contains no area", where=str(path), remedy="leave --stable out, or draw an area")
    return found
