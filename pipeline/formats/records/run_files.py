"""The files of a run's folder, by what they hold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.cameras.crs import wkt_of
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.rasters.geotiff import read_geotiff
from pipeline.formats.records.result_files import read_own_points, read_surface
from pipeline.formats.records.result_records import RUN_FILE, read_run
from scene.common.errors import InputError
from scene.geometry.grid import Grid
from scene.geometry.mesh import TriangleMesh

RESUME = "go on with it by simulate --resume"


def epoch_folder(run: Path, number: int) -> Path:
    """The folder of an epoch's own files in that of a run."""
    return run / f"epoch_{number:03d}"


@dataclass(frozen=True)
class RunFiles:
    """A run's folder, read and checked when it is asked for. Raises InputError there for what is no run or was not written."""

    folder: Path

    @cached_property
    def record(self) -> dict[str, Any]:
        """run.json, as `read_run` gives it."""
        return read_run(self.folder / RUN_FILE, RESUME)

    def surface(self, number: int, name: str = "surface") -> TriangleMesh:
        """The measured surface of an epoch, wall frame; with the name `truth` the wall as it really is."""
        return read_surface(self._written(number, f"{name}.ply"))

    def points(self, number: int) -> PointCloud:
        """The sensor's points of an epoch, wall frame."""
        return read_own_points(self._written(number, "points.laz"))

    def survey_points(self, number: int) -> tuple[PointCloud, str]:
        """The points of an epoch, and the WKT of their coordinates, "" where the config names none.

        In the wall's own coordinates where the run wrote those, else in the wall frame.
        """
        world = epoch_folder(self.folder, number) / "points_world.laz"
        if not world.is_file():
            return self.points(number), ""
        crs = (self.record["config"].get("products") or {}).get("crs")
        return read_own_points(world), wkt_of(crs, "products.crs") if crs else ""

    def difference(self, number: int) -> tuple[NDArray[np.float32], Grid]:
        """(h, w) reference minus epoch, m, and its grid."""
        return read_geotiff(self.folder / f"difference_{number:03d}.tif")

    def _written(self, number: int, name: str) -> Path:
        path = epoch_folder(self.folder, number) / name
        if not path.is_file():
            raise InputError(f"the run did not write {name}", where=str(path.parent), remedy="see `products` in the config")
        return path
