"""Provide `detect`, which finds rockfalls in difference maps."""

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
from pipeline.report.words import counted
from scene.common.errors import InputError, OutsideError

if TYPE_CHECKING:
    import geopandas

_COMMAND = "import sys; from pipeline.cli.main import main; sys.exit(main(sys.argv[1:]))"
_WRONG_INPUT = 2
_SHOWN = 10
"""Most events that the notebook view lists."""
_WAITING = "detector (TensorFlow takes ten seconds or more to load)"


def detect(
    maps: Any,
    model: Path | str = "default",
    *,
    confidence: float | Sequence[float] = run.CONFIDENCES,
    out: Path | str | None = None,
    mirrored: bool = False,
    progress: Show = "auto",
) -> Detections:
    """Find fallen blocks in difference maps, as `scarpsim detect` does.

    A network runs in a process of its own, because TensorFlow and the ray tracer cannot share one.

    Parameters
    ----------
    maps : DataArray, Run, path, or a list of them
        Difference maps (y, x) in m, runs, TIFF files, or folders with annotations.json.
    model : path or str
        "default" (the network that comes with scarpsim), "baseline" (a threshold, no network), or the folder of a trained
        detector.
    confidence : float or sequence of floats
        Smallest score, 0 to 1, of a detection that is accepted. Of several values, the returned result uses the smallest.
    out : path, optional
        Folder for COCO files, tables, masks and overlays. Default: a temporary folder, which is deleted together with the
        result.
    mirrored : bool
        Also search mirror images of the maps with the network. This takes three to four times as long and gives better
        outlines.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.

    Returns
    -------
    Detections
        The events that were found.
    """
    confidences = run.sorted_confidences([confidence] if isinstance(confidence, int | float) else confidence)
    kept = tempfile.TemporaryDirectory(prefix="scarpsim_detect_") if out is None else None
    folder = Path(kept.name) / "found" if kept else empty_folder(Path(str(out)))
    with tempfile.TemporaryDirectory(prefix="scarpsim_maps_") as written:
        places = [_place(each, Path(written), number) for number, each in enumerate(_several(maps), start=1)]
        if model == run.BASELINE:
            with python_progress(progress) as shown:
                found = run.detect(str(model), places, folder, confidences, True, shown, mirrored=mirrored)
        else:
            with python_progress(progress) as shown, shown.stage(_WAITING):
                _in_another_process(str(model), places, folder, confidences, mirrored=mirrored)
            found = read_events(folder / f"events_{min(confidences):g}.csv")
    return Detections(folder, tuple(found), min(confidences), kept)


@dataclass(frozen=True, repr=False)
class Detections:
    """Result of `detect`.

    Attributes
    ----------
    folder : Path
        Folder with the written files.
    found : tuple of Event
        The events with a score of at least `confidence`, in each map sorted by descending score.
    confidence : float
        Smallest accepted score.
    temporary : TemporaryDirectory, optional
        Owner of a temporary `folder`, which it deletes when the result is no longer used.
    """

    folder: Path
    found: tuple[Event, ...]
    confidence: float
    temporary: tempfile.TemporaryDirectory[str] | None = None

    def __len__(self) -> int:
        return len(self.found)

    @property
    def events(self) -> geopandas.GeoDataFrame:
        """The detected rockfalls, one row per event; SI units.

        The columns include image and number (of the map, and of the event in it), x_m and y_m (centre, wall frame), area_m2,
        depth_m (largest), volume_m3 and score (confidence, 0 to 1). The geometry of a row is the event's bounding rectangle,
        wall frame, m.
        """
        bounds = [
            [each.x_m - each.width_m / 2, each.y_m - each.height_m / 2, each.x_m + each.width_m / 2, each.y_m + each.height_m / 2]
            for each in self.found
        ]
        return boxes(map(asdict, self.found), bounds, [field.name for field in fields(Event)])

    @property
    def volume_m3(self) -> float:
        """Total volume of rock that fell in all detected events, m3."""
        return sum(each.volume_m3 for each in self.found)

    def plot(self, image: str | None = None) -> Picture:
        """Return a difference map with the outlines of the detected rockfalls.

        image: name of the map's file without its suffix; by default the first map.
        """
        drawn = {path.name.removesuffix("_detections.png"): path for path in sorted(self.folder.glob("*_detections.png"))}
        return Picture(pick(drawn, image, "plot").read_bytes())

    def summary(self) -> str:
        """Return the number of detected rockfalls and their total volume as one line of text."""
        return f"{counted(len(self), 'block')} with a score of {self.confidence:g} or more, {self.volume_m3:.3g} m³"

    def __repr__(self) -> str:
        return f"<Detections: {self.summary()}>"

    def _repr_html_(self) -> str:
        rows = {
            f"{each.image}, {each.number}": f"{each.volume_m3:.3g} m³, score {each.score:.2f}" for each in self.found[:_SHOWN]
        }
        more = {"and": f"{len(self) - _SHOWN} more, in .events"} if len(self) > _SHOWN else {}
        return html_table(self.summary(), rows | more, self.plot())


def _several(maps: Any) -> list[Any]:
    """Return the maps as a list; arrays with an epoch axis become one map per epoch."""
    found = list(maps) if isinstance(maps, list | tuple) else [maps]
    found = [part for each in found for part in (list(each) if _is_array(each) and each.ndim == 3 else [each])]
    if not found:
        raise InputError("no map is given", where="detect", remedy="give at least one difference map or run")
    return found


def _is_array(value: Any) -> bool:
    """Return whether a value is an xarray.DataArray, without importing xarray."""
    return hasattr(value, "dims") and hasattr(value, "coords")


def _place(given: Any, folder: Path, number: int) -> Path:
    """Return the path of an input; a DataArray is first written as a GeoTIFF into `folder`."""
    if not _is_array(given):
        return Path(getattr(given, "folder", given))
    path = folder / f"{given.name or 'map'}_{number:03d}.tif"
    write_geotiff(path, *raster_of(given.drop_vars("epoch", errors="ignore"), f"map {number}"))
    return path


def _in_another_process(model: str, places: Sequence[Path], out: Path, confidences: Sequence[float], *, mirrored: bool) -> None:
    """Run `scarpsim detect` as a command, because TensorFlow and the ray tracer's compiler cannot share a process."""
    words = [model, *map(str, places), "--out", str(out), *(f"--confidence={value:g}" for value in confidences), "--quiet"]
    command = [sys.executable, "-c", _COMMAND, "detect", *words, *["--mirrored"] * mirrored]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        message = (
            f"scarpsim detect failed: {done.stderr.strip().splitlines()[-1].removeprefix('error: ')}"
            if done.stderr.strip()
            else "the detector's process ended without a message; run `scarpsim detect` in a terminal to see more"
        )
        raise InputError(message) if done.returncode == _WRONG_INPUT else OutsideError(message)
