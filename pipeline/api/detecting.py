"""`detect`: rockfalls in difference maps."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.api.configs import Show
from pipeline.api.maps import raster_of
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.tables import boxes
from pipeline.detection.products import run
from pipeline.detection.products.events import Event, read_events
from pipeline.formats.files.atomic import empty_folder
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.report.notebook_progress import python_progress
from scene.common.errors import InputError, OutsideError

if TYPE_CHECKING:
    import geopandas

_COMMAND = "import sys; from pipeline.cli.main import main; sys.exit(main(sys.argv[1:]))"
_WRONG_INPUT = 2
_SHOWN = 10
"""Blocks in a notebook's view."""
_WAITING = "the detector, after TensorFlow, which takes ten seconds and more to load"


def detect(
    maps: Any,
    model: Path | str = "default",
    *,
    confidence: float | Sequence[float] = run.CONFIDENCES,
    out: Path | str | None = None,
    unmirrored: bool = False,
    progress: Show = "auto",
) -> Detections:
    """Find the blocks in difference maps; the same as `scarpsim detect`.

    maps: DataArrays (y, x) in m, runs, TIFF files, folders with annotations.json, one or a list; model: "default" (the weights
    that come with scarpsim) or a trained detector's folder, either by TensorFlow in a process of its own, or "baseline", a
    threshold. out: a folder for COCO files, tables, masks and overlays; none: a temporary one, removed when the result goes.
    unmirrored: the network looks at maps as they are, not at their mirror images too, which is faster and finds less.
    """
    confidences = run.sorted_confidences([confidence] if isinstance(confidence, int | float) else confidence)
    kept = tempfile.TemporaryDirectory(prefix="scarpsim_detect_") if out is None else None
    folder = Path(kept.name) / "found" if kept else empty_folder(Path(str(out)))
    with tempfile.TemporaryDirectory(prefix="scarpsim_maps_") as written:
        places = [_place(each, Path(written), number) for number, each in enumerate(_several(maps), start=1)]
        if model == run.BASELINE:
            with python_progress(progress) as shown:
                found = run.detect(str(model), places, folder, confidences, True, shown, unmirrored=unmirrored)
        else:
            with python_progress(progress) as shown, shown.stage(_WAITING):
                _in_another_process(str(model), places, folder, confidences, unmirrored=unmirrored)
            found = read_events(folder / f"events_{min(confidences):g}.csv")
    return Detections(folder, tuple(found), min(confidences), kept)


@dataclass(frozen=True, repr=False)
class Detections:
    """What was found. folder: of the files; found: the events with a score of `confidence` and more, best first in each map."""

    folder: Path
    found: tuple[Event, ...]
    confidence: float
    temporary: tempfile.TemporaryDirectory[str] | None = None

    def __len__(self) -> int:
        return len(self.found)

    @property
    def events(self) -> geopandas.GeoDataFrame:
        """A row for each event: image, number, place, area, depth, volume, score; SI; geometry: its rectangle, wall frame."""
        bounds = [
            [each.x_m - each.width_m / 2, each.y_m - each.height_m / 2, each.x_m + each.width_m / 2, each.y_m + each.height_m / 2]
            for each in self.found
        ]
        return boxes(map(asdict, self.found), bounds, [field.name for field in fields(Event)])

    @property
    def volume_m3(self) -> float:
        """Of all events together."""
        return sum(each.volume_m3 for each in self.found)

    def plot(self, image: str | None = None) -> Picture:
        """The outlines over a map, by the stem of its name; none: the first."""
        drawn = {path.name.removesuffix("_detections.png"): path for path in sorted(self.folder.glob("*_detections.png"))}
        return Picture(pick(drawn, image, "plot").read_bytes())

    def summary(self) -> str:
        """One line."""
        return f"{len(self)} blocks with a score of {self.confidence:g} or more, {self.volume_m3:.3g} m³"

    def __repr__(self) -> str:
        return f"<Detections: {self.summary()}>"

    def _repr_html_(self) -> str:
        rows = {
            f"{each.image}, {each.number}": f"{each.volume_m3:.3g} m³, score {each.score:.2f}" for each in self.found[:_SHOWN]
        }
        more = {"and": f"{len(self) - _SHOWN} more, in .events"} if len(self) > _SHOWN else {}
        return html_table(self.summary(), rows | more, self.plot())


def _several(maps: Any) -> list[Any]:
    found = list(maps) if isinstance(maps, list | tuple) else [maps]
    found = [part for each in found for part in (list(each) if _is_array(each) and each.ndim == 3 else [each])]
    if not found:
        raise InputError("names no map", where="detect")
    return found


def _is_array(value: Any) -> bool:
    return hasattr(value, "dims") and hasattr(value, "coords")


def _place(given: Any, folder: Path, number: int) -> Path:
    """The path of an input; a DataArray is written first."""
    if not _is_array(given):
        return Path(getattr(given, "folder", given))
    path = folder / f"{given.name or 'map'}_{number:03d}.tif"
    write_geotiff(path, *raster_of(given.drop_vars("epoch", errors="ignore"), f"map {number}"))
    return path


def _in_another_process(model: str, places: Sequence[Path], out: Path, confidences: Sequence[float], *, unmirrored: bool) -> None:
    """`scarpsim detect` as a command: TensorFlow and the ray tracer's compiler do not belong into one process."""
    words = [model, *map(str, places), "--out", str(out), *(f"--confidence={value:g}" for value in confidences), "--quiet"]
    command = [sys.executable, "-c", _COMMAND, "detect", *words, *["--unmirrored"] * unmirrored]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        message = done.stderr.strip().splitlines()[-1].removeprefix("error: ") if done.stderr.strip() else "ended without a word"
        raise InputError(message) if done.returncode == _WRONG_INPUT else OutsideError(message)
