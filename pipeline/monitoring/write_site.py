"""Write a config that simulates the site of a monitoring: its wall, its scanner's place, its noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from pipeline.formats.files.atomic import write_text
from pipeline.formats.meshes.ply import write_ply
from pipeline.monitoring.products import Result
from pipeline.monitoring.significance import NORMAL_95
from pipeline.monitoring.site import ReferenceSite
from pipeline.surface.raster_mesh import mesh_of_raster
from scene.common.errors import InputError
from scene.geometry.mesh import TriangleMesh

_HEAD = """# The site of {name}, as `scarpsim monitor` saw it: simulate it with
#   simulate --sensor tls --config {file}
# The noise is white noise of the range that gives the measured level of detection; `scarpsim calibrate` fits it better.
"""


def write_site(result: Result, path: Path) -> None:
    """Write a config from a result of `monitor`, with which `scarpsim simulate` simulates the same wall and noise.

    The mesh of the reference's surface is written beside it.

    result: the result. path: file of the config. Raises InputError if the reference has no surface, or if one of the files
    exists.
    """
    site = result.site
    wall = path.with_name(f"{path.stem}_wall.ply")
    for file in (path, wall):
        if file.exists():
            raise InputError("the file exists already", where=str(file), remedy="choose another name with --write-site")
    mesh = _mesh(site)
    if not len(mesh.faces):
        raise InputError(
            "the epoch gives no surface: no pixels with data lie side by side",
            where=site.source.name,
            remedy="give a larger --gsd",
        )
    write_ply(wall, mesh)
    middle = np.array(
        [site.grid.x_min + site.grid.width * site.grid.gsd / 2, site.grid.y_max - site.grid.height * site.grid.gsd / 2, 0]
    )
    step = site.grid.gsd / 1.5 / float(np.linalg.norm(site.station - middle))
    scanner: dict[str, object] = {"azimuth_step_rad": float(f"{step:.3g}"), "zenith_step_rad": float(f"{step:.3g}")}
    if result.options.scanner:
        scanner |= {"preset": result.options.scanner}
    config = {
        "wall": {"mesh": wall.name},
        "frame": {"normal": [float(value) for value in site.frame.rotation[2]]},
        "station": {"position_m": [float(f"{value:.4f}") for value in site.frame.to_world(site.station)]},
        "scanner": scanner,
        "difference": {"gsd_m": site.grid.gsd},
        "sensor": [{"sensor": "tls", "noise": {"range_sigma_m": float(f"{_range_sigma(result):.3g}"), "angle_sigma_rad": 0.0}}],
    }
    text = yaml.safe_dump(config, sort_keys=False, default_flow_style=None)
    write_text(path, _HEAD.format(name=site.source.name, file=path.name) + text)


def _mesh(site: ReferenceSite) -> TriangleMesh:
    """The reference's surface, that of all views, survey coordinates, m."""
    parts = [(view, mesh_of_raster(view.raster.height, view.grid).submesh()) for view in site.views]
    first = np.cumsum([0, *(len(mesh.vertices) for _, mesh in parts)])
    vertices = np.concatenate([view.frame.to_world(mesh.vertices) for view, mesh in parts])
    faces = [mesh.faces + start for (_, mesh), start in zip(parts, first[:-1], strict=True)]
    return TriangleMesh(vertices, np.concatenate(faces).astype(np.int32))


def _range_sigma(result: Result) -> float:
    """White noise of a point along the wall's normal, m, that explains the median level of detection."""
    raster = result.site.views[0].raster
    share = float(np.nanmedian(raster.sigma / raster.scatter))
    level = float(np.median([epoch.record.level_m for epoch in result.epochs]))
    return level / NORMAL_95 / np.sqrt(2.0) / max(share, 1e-6)
