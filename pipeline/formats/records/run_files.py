"""Read the files of a run's folder."""

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

RESUME = "continue it with simulate --resume"


def epoch_folder(run: Path, number: int) -> Path:
    """Return the folder of an epoch's own files in a run's folder."""
    return run / f"epoch_{number:03d}"


@dataclass(frozen=True)
class RunFiles:
    """A run's folder; files are read and checked on request, with InputError if they are not a run's or were not written."""

    folder: Path

    @cached_property
    def record(self) -> dict[str, Any]:
        """run.json, as `read_run` gives it."""
        return read_run(self.folder / RUN_FILE, RESUME)

    def surface(self, number: int, name: str = "surface") -> TriangleMesh:
        """Read the measured surface of an epoch, wall frame, or, with the name `truth`, the true wall."""
        return read_surface(self._written(number, f"{name}.ply"))

    def points(self, number: int) -> PointCloud:
        """Read the sensor's points of an epoch, wall frame."""
        return read_own_points(self._written(number, "points.laz"))

    def survey_points(self, number: int) -> tuple[PointCloud, str]:
        """Read the points of an epoch, and the WKT of their coordinate system, "" if the config names none.

        They are in the wall's own coordinates if the run wrote those, else in the wall frame.
        """
        world = epoch_folder(self.folder, number) / "points_world.laz"
        if not world.is_file():
            return self.points(number), ""
        crs = (self.record["config"].get("products") or {}).get("crs")
        return read_own_points(world), wkt_of(crs, "products.crs") if crs else ""

    def difference(self, number: int) -> tuple[NDArray[np.float32], Grid]:
        """Read the (h, w) difference map of an epoch, reference minus epoch, m, and its grid."""
        return read_geotiff(self.folder / f"difference_{number:03d}.tif")

    def _written(self, number: int, name: str) -> Path:
        """Return the path of an epoch's file; raise InputError if the run did not write it."""
        path = epoch_folder(self.folder, number) / name
        if not path.is_file():
            raise InputError(
                f"the run did not write {name}",
                where=str(path.parent),
                remedy="ask for it in `products` of the config, and make the run again",
            )
        return path
