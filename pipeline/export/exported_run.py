"""A run's folder as it is exported: surfaces, maps, points and what fell."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.crs import wkt_of
from pipeline.formats.geotiff import read_geotiff
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.result_files import read_own_points, read_surface
from pipeline.formats.result_records import RUN_FILE, read_run
from pipeline.report.figures import SCALE_SIGMAS
from scene.errors import InputError
from scene.grid import Grid
from scene.mesh import TriangleMesh


@dataclass(frozen=True)
class ExportedRun:
    """A run's folder. Raises InputError, here and where its files are read, for what is no finished run or was not written."""

    folder: Path

    @cached_property
    def record(self) -> dict[str, Any]:
        """run.json."""
        found = read_run(self.folder / RUN_FILE, "go on with it by simulate --resume")
        if len(found.get("epochs", [])) < 2:
            raise InputError("holds no finished epoch", where=str(self.folder), remedy="go on with it by simulate --resume")
        return found

    @property
    def last(self) -> int:
        """Number of the last epoch."""
        return len(self.record["epochs"]) - 1

    def limit_m(self, number: int) -> float:
        """Where the colours of an epoch's map end in the report."""
        statistics = self.record["epochs"][number].get("statistics")
        if not statistics:
            problem = f"has no statistics of epoch {number}"
            raise InputError(problem, where=str(self.folder / RUN_FILE), remedy="go on with it by simulate --resume")
        return float(SCALE_SIGMAS * statistics["sigma_m"])

    def blocks(self, number: int) -> list[dict[str, Any]]:
        """What fell in an epoch, the largest first."""
        return sorted(self.record["epochs"][number]["blocks"], key=lambda block: -block["volume_m3"])

    def surface(self, number: int) -> TriangleMesh:
        """The measured surface of an epoch, wall frame."""
        return read_surface(self._file(number, "surface.ply"))

    def points(self, number: int) -> PointCloud:
        """The sensor's points of an epoch, wall frame."""
        return read_own_points(self._file(number, "points.laz"))

    def survey_points(self, number: int) -> tuple[PointCloud, str]:
        """The points of an epoch, and the WKT of their coordinates, "" where the config names none.

        In the wall's own coordinates where the run wrote those, else in the wall frame.
        """
        world = self.folder / f"epoch_{number:03d}" / "points_world.laz"
        if not world.is_file():
            return self.points(number), ""
        crs = (self.record["config"].get("products") or {}).get("crs")
        return read_own_points(world), wkt_of(crs, "products.crs") if crs else ""

    def difference(self, number: int) -> tuple[NDArray[np.float32], Grid]:
        """(h, w) reference minus epoch, m, and its grid."""
        return read_geotiff(self.folder / f"difference_{number:03d}.tif")

    def _file(self, number: int, name: str) -> Path:
        path = self.folder / f"epoch_{number:03d}" / name
        if not path.is_file():
            raise InputError(f"the run did not write {name}", where=str(path.parent), remedy="see `products` in the config")
        return path
