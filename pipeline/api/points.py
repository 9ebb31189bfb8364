"""Provide `Points`, a structured array of points that plots itself, writes files and converts to other libraries."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pipeline.api.extras import library
from pipeline.api.pictures import Picture, html_table
from pipeline.formats.meshes.ply import write_ply_points
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.points.laz import EXACT_INTENSITY
from pipeline.formats.points.pcd import write_pcd
from pipeline.formats.points.xyz import write_xyz
from pipeline.run.clouds import write_cloud
from scene.common.errors import InputError
from scene.geometry.mesh import FloatArray

_MOST_DRAWN = 100_000
_AXES = ("x", "y", "z")


class Points(np.ndarray[Any, Any]):
    """Measured points as a structured array (n,): x, y, z (float64, m), then the recorded or computed values (channels).

    `points["x"]` is an array; `points[points["intensity"] > 0.5]` is a `Points` again.
    """

    @classmethod
    def of(cls, cloud: PointCloud) -> Self:
        """Return a point cloud of the simulator as a structured array, in its frame; the recorded values keep their types.

        cloud: the PointCloud, m.
        """
        channels = {name: cloud.points[:, axis] for axis, name in enumerate(_AXES)}
        optional = {"intensity": cloud.intensity, "gps_time": cloud.gps_time}
        channels |= {name: np.asarray(values) for name, values in (optional | cloud.extra).items() if values is not None}
        table = np.empty(len(cloud.points), dtype=[(name, values.dtype) for name, values in channels.items()])
        for name, values in channels.items():
            table[name] = values
        return table.view(cls)

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        return found if getattr(found, "dtype", None) is not None and found.dtype.names else np.asarray(found)[()]

    @property
    def xyz(self) -> FloatArray:
        """Coordinates of the points as an array (n, 3), m."""
        return np.stack([self[name] for name in _AXES], axis=-1)

    def cloud(self) -> PointCloud:
        """Return the points as a PointCloud, the type that the file writers take."""
        further = {name: self[name] for name in self.dtype.names or () if name not in _AXES}
        intensity = further.pop("intensity", further.pop(EXACT_INTENSITY, None))
        return PointCloud(self.xyz, intensity, further.pop("gps_time", None), further)

    def save(self, path: Path | str) -> Path:
        """Write the points to a file, whose suffix gives the format; return its path.

        Suffixes are .laz (.copc.laz for COPC), .las, .ply, .pcd and .xyz. Raises InputError for another.
        """
        path, cloud = Path(path), self.cloud()
        if path.suffix in (".laz", ".las"):
            write_cloud(path, cloud)
        elif path.suffix == ".ply":
            write_ply_points(path, cloud)
        elif path.suffix == ".pcd":
            write_pcd(path, cloud)
        elif path.suffix in (".xyz", ".txt"):
            write_xyz(path, cloud)
        else:
            raise InputError(
                f"unknown format '{path.suffix}'",
                where=str(path),
                allowed=".laz .copc.laz .las .ply .pcd .xyz",
                remedy="choose a file name with one of these endings",
            )
        return path

    def to_open3d(self) -> Any:
        """Convert the points to an open3d.geometry.PointCloud, grey by intensity if there is one, for the library Open3D."""
        geometry, utility = library("open3d").geometry, library("open3d").utility
        cloud = geometry.PointCloud(utility.Vector3dVector(self.xyz))
        if "intensity" in (self.dtype.names or ()):
            grey = np.clip(np.asarray(self["intensity"], dtype=np.float64), 0, 1)
            cloud.colors = utility.Vector3dVector(np.repeat(grey[:, None], 3, axis=1))
        return cloud

    def to_pyvista(self) -> Any:
        """Convert the points to a pyvista.PolyData, with the recorded values as point data, for the library PyVista."""
        cloud = library("pyvista").PolyData(self.xyz)
        for name in self.dtype.names or ():
            if name not in _AXES:
                cloud.point_data[name] = np.ascontiguousarray(self[name])
        return cloud

    def plot(self, channel: str = "z") -> Picture:
        """Return a plot of the points over x and y. At most 100,000 points are drawn.

        channel: name of the values by which they are coloured, such as z or intensity.
        """
        if channel not in (self.dtype.names or ()):
            raise InputError(
                f"there is no channel '{channel}'",
                where="points",
                allowed=", ".join(self.dtype.names or ()),
                remedy="choose one of these channels",
            )
        return scatter(self.xyz[:, :2], np.asarray(self[channel], dtype=np.float64), channel)

    def _repr_html_(self) -> str:
        if not self.dtype.names or self.ndim != 1:
            return f"<pre>{self!r}</pre>"
        return html_table(f"{len(self):,} points", {name: _range(self[name]) for name in self.dtype.names})


def scatter(at: NDArray[Any], values: NDArray[Any], label: str, limit: float | None = None) -> Picture:
    """Draw points coloured by their values.

    Parameters
    ----------
    at : (n, 2) array
        Positions, m. At most 100,000 of them are drawn, at regular steps.
    values : (n,) array
        Values to colour by.
    label : str
        Label of the colour bar.
    limit : float, optional
        Ends of a diverging colour scale, -limit to limit, red above zero. Default: a sequential scale over all values.

    Returns
    -------
    Picture
        The figure.
    """
    from matplotlib.figure import Figure

    from pipeline.report.figures import COLOURS, DPI, SEQUENTIAL, label_axes, png_bytes

    step = max(1, -(-len(at) // _MOST_DRAWN))
    figure = Figure(figsize=(9.6, 5.4), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    scale = {"cmap": SEQUENTIAL} if limit is None else {"cmap": COLOURS, "vmin": -limit, "vmax": limit}
    drawn: Any = axes.scatter(*at[::step].T, c=values[::step], s=1.5, linewidths=0, **scale)
    axes.set_aspect("equal")
    label_axes(axes, "x, m", "y, m")
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.8)
    return Picture(png_bytes(figure))


def _range(values: NDArray[Any]) -> str:
    """Return the smallest and the largest finite value as text."""
    known = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    return f"{known.min():.6g} to {known.max():.6g}" if len(known) else "none"
