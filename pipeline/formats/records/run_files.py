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
    """Return the folder of an epoch's own files (points, surface) in a run's folder; epoch 0 is the reference."""
    return run / f"epoch_{number:03d}"


@dataclass(frozen=True)
class RunFiles:
    """Access to the files of a simulation's run in its folder.

    Files are read and checked on request, with InputError if they are not a run's or were not written.
    """

    folder: Path

    @cached_property
    def record(self) -> dict[str, Any]:
        """Content of run.json, the record of the simulation, as `read_run` checks it."""
        if not (self.folder / RUN_FILE).exists():
            problem = f"the folder contains no run ({RUN_FILE} is missing)" if self.folder.is_dir() else "there is no such folder"
            raise InputError(problem, where=str(self.folder), remedy="give the folder that scarpsim simulate wrote")
        return read_run(self.folder / RUN_FILE, RESUME)

    def surface(self, number: int, name: str = "surface") -> TriangleMesh:
        """Read a surface of one of the run's epochs, wall frame, m.

        number: of the epoch. name: "surface" for the measured one, "truth" for the true wall.
        """
        return read_surface(self._written(number, f"{name}.ply"))

    def points(self, number: int) -> PointCloud:
        """Read the points that the sensor measured in one of the run's epochs, wall frame, m. number: of the epoch."""
        return read_own_points(self._written(number, "points.laz"))

    def survey_points(self, number: int) -> tuple[PointCloud, str]:
        """Read the points of one of the run's epochs in survey coordinates, m, and the WKT of their coordinate system.

        number: of the epoch. The WKT is "" if the config of the run names no system. A run that wrote no points_world.laz has no
        survey coordinates; the points are then in the wall frame.
        """
        world = epoch_folder(self.folder, number) / "points_world.laz"
        if not world.is_file():
            return self.points(number), ""
        crs = (self.record["config"].get("products") or {}).get("crs")
        return read_own_points(world), wkt_of(crs, "products.crs") if crs else ""

    def difference(self, number: int) -> tuple[NDArray[np.float32], Grid]:
        """Read the difference map of one of the run's epochs and the grid of its pixels.

        number: of the epoch. The map is (h, w), reference minus epoch, m; NaN without data.
        """
        return read_geotiff(self.folder / f"difference_{number:03d}.tif")

    def _written(self, number: int, name: str) -> Path:
        """Return the path of an epoch's file; raise InputError if the run did not write it."""
        path = epoch_folder(self.folder, number) / name
        if not path.is_file():
            raise InputError(
                f"the run did not write {name}",
                where=str(path.parent),
                remedy=f"add {name} to `products` in the config, and make the run again",
            )
        return path
