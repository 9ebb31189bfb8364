"""`scarpsim surface`: mesh a point cloud, for use as a wall or as a reference."""

from __future__ import annotations

import argparse
from pathlib import Path

from pipeline.cli.command_output import CommandOutput
from pipeline.cli.imports import fast_imports
from pipeline.cli.parser import add_output_options, between, one_of
from scene.common.errors import InputError
from scene.common.lengths import METRES

SUMMARY = "mesh a point cloud, so that it can be a wall or a reference"
EXAMPLE = """  scarpsim surface scan.laz --seen-from 345180.0 6389420.0 121.6 --out wall.ply
  scarpsim init --mesh wall.ply --out my_site.yaml"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `scarpsim surface` on its parser."""
    parser.add_argument("cloud", type=Path, metavar="CLOUD", help="points (.laz .las .ply .e57 .xyz)")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="mesh to write (.ply), in the points' coordinates, m"
    )
    parser.add_argument(
        "--seen-from",
        type=between(-1e8, 1e8),
        nargs=3,
        required=True,
        metavar=("X", "Y", "Z"),
        help="position of a sensor in the points' coordinates, m; the surface faces it",
    )
    parser.add_argument(
        "--unit",
        type=one_of(*METRES),
        metavar="|".join(METRES),
        help="unit of the points (default: as the file states, otherwise m); the mesh is in m",
    )
    parser.add_argument(
        "--method",
        choices=("triangulation", "poisson"),
        default="triangulation",
        help="triangulation: connect the points as the sensor sees them (default); poisson: for points from several sides",
    )
    parser.add_argument(
        "--trim",
        type=between(0.1, 1000.0),
        default=3.0,
        metavar="N",
        help="poisson: largest distance of the surface from a point, in point spacings (default: 3)",
    )
    parser.add_argument(
        "--depth",
        type=int,
        choices=range(4, 17),
        metavar="N",
        help="poisson: depth of the octree, 4 to 16 (default: from the points' density)",
    )
    add_output_options(parser)


def run(arguments: argparse.Namespace) -> CommandOutput:
    """Reconstruct a surface from a point cloud and write it as a PLY file."""
    out = arguments.out
    if out.suffix.lower() != ".ply":
        raise InputError(
            f"the file name ends in '{out.suffix}'", where="--out", allowed=".ply", remedy="choose a file name that ends in .ply"
        )
    if out.exists():
        raise InputError("the file exists already", where=str(out), remedy="choose another name with --out")
    with fast_imports():
        import numpy as np

        from pipeline.formats.meshes.ply import write_ply
        from pipeline.formats.points.points import joined, read_placed_scans
        from pipeline.surface.from_cloud import CloudConfig, surface_of_cloud

    config = CloudConfig(method=arguments.method, poisson_depth=arguments.depth, poisson_trim_spacings=arguments.trim)
    cloud = joined([scan.cloud for scan in read_placed_scans(arguments.cloud, arguments.unit)])
    surface = surface_of_cloud(cloud, np.array(arguments.seen_from), config, str(arguments.cloud))
    mesh = surface.mesh
    write_ply(out, mesh)
    counts = {"points": len(cloud.points), "vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
    told = (
        f"{counts['points']:,} points, {counts['triangles']:,} triangles: {out}; make a config with: scarpsim init --mesh {out}"
    )
    notes = [*(f"{arguments.cloud.name}: {note}" for note in cloud.notes), *surface.notes]
    told = "\n".join([*(f"note: {note}" for note in notes), told])
    return CommandOutput(told, lambda: {"file": str(out), **counts, "notes": notes})
