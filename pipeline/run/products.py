"""Write the files of an epoch. A folder gets its final name when all its files are written.

The checksums of everything written are recorded, so that a later call can tell whether it is complete.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.change.annotate import LabelledImage, by_kind, coco
from pipeline.change.difference import statistics
from pipeline.change.m3c2 import M3c2Map
from pipeline.change.tiles import tiles
from pipeline.config.simulation import SimulationConfig
from pipeline.formats.cameras.crs import wkt_of
from pipeline.formats.files.atomic import explained, give_name, note, noting, to_disk, write_json
from pipeline.formats.files.checksum import sha256
from pipeline.formats.files.inside import inside
from pipeline.formats.meshes.ply import write_ply
from pipeline.formats.point_cloud import PointCloud
from pipeline.formats.rasters.geotiff import write_geotiff, write_tiff
from pipeline.formats.records.run_files import epoch_folder
from pipeline.run.acquisition import Acquisition
from pipeline.run.epoch import LaterEpoch, ReferenceEpoch
from pipeline.run.recorded_points import at_time, recorded_points, scans_of
from pipeline.run.site import SensorSite
from pipeline.surface.metashape_export import write_metashape_export
from scene.blocks.block import Blocks
from scene.blocks.carve import block_meshes
from scene.geometry.mesh import WALL, FloatArray, TriangleMesh
from scene.walls.imported import ImportedWall

EPOCH_RECORD = "epoch.json"
"""File in an epoch's folder that holds its record."""
Checksums = dict[str, str]
"""SHA-256 of files by their names relative to the run's folder."""
M3C2_ANNOTATIONS = "annotations_m3c2"
"""Key in an epoch's record, and the name of the run's file."""
CHANGE_ANNOTATIONS = "annotations_change"
"""The same for the maps of the change since the epoch before, in a series."""


def is_whole(out: Path, checksums: Checksums, where: Path) -> bool:
    """Check whether an epoch's files are all there and unchanged, so that a resumed run need not make it again.

    Parameters
    ----------
    out : Path
        Folder of the run.
    checksums : dict
        SHA-256 of the epoch's files, by name relative to `out`.
    where : Path
        File from which the checksums come, for error messages.

    Returns
    -------
    bool
        True if every listed file exists with its checksum; False if one is missing or changed, or if `checksums` is
        empty.

    Raises
    ------
    InputError
        If a name leads out of the folder.
    """
    files = {inside(out, name, where): digest for name, digest in checksums.items()}
    return bool(files) and all(path.is_file() and sha256(path) == digest for path, digest in files.items())


def write_reference(
    out: Path, config: SimulationConfig, site: SensorSite, reference: ReferenceEpoch, seen: Acquisition
) -> Checksums:
    """Write the files of the first epoch: its folder epoch_000 and the hillshade.

    Parameters
    ----------
    out : Path
        Folder of the run.
    config : SimulationConfig
        Says which files are wanted.
    site : SensorSite
        Wall and sensor.
    reference : ReferenceEpoch
        The first epoch.
    seen : Acquisition
        What the sensor recorded in it.

    Returns
    -------
    dict
        SHA-256 of each file, by name relative to `out`.
    """
    from pipeline.run import pictures  # loads slowly, so not before it is needed

    with noting() as written, _folder(out, 0) as folder:
        _write_common(folder, config, site, 0, seen, reference.surface, reference.caster.mesh, [])
        pictures.write_reference_pictures(out, reference)
        record = {
            "epoch": 0,
            **_seen_record(seen),
            "blocks": [],
            **_time(config, 0),
            "annotations": _annotations(config, [], 1 if config.series else 0),
        }
        write_json(folder / EPOCH_RECORD, record)
    return _checksums(out, written)


def write_epoch(out: Path, config: SimulationConfig, site: SensorSite, reference: ReferenceEpoch, epoch: LaterEpoch) -> Checksums:
    """Write the files of a later epoch: its folder, difference map, tiles and pictures.

    Parameters
    ----------
    out : Path
        Folder of the run.
    config : SimulationConfig
        Says which files are wanted.
    site : SensorSite
        Wall and sensor.
    reference : ReferenceEpoch
        The first epoch, whose grid the maps have.
    epoch : LaterEpoch
        The epoch.

    Returns
    -------
    dict
        SHA-256 of each file, by name relative to `out`.
    """
    from pipeline.run import pictures  # loads slowly, so not before it is needed

    name = f"difference_{epoch.number:03d}"
    grid = reference.raster.grid
    with noting() as written, _folder(out, epoch.number) as folder:
        _write_common(folder, config, site, epoch.number, epoch.seen, epoch.surface, epoch.carved.mesh, epoch.blocks)
        write_geotiff(
            out / f"{name}.tif", epoch.difference, grid, description="reference minus epoch, m; missing rock is positive"
        )
        if config.products.block_meshes:
            _write_block_meshes(folder / "blocks", site.mesh, epoch.solids)
        if epoch.m3c2 is not None:
            _write_m3c2(out, epoch.number, epoch.m3c2)
        if epoch.since_last is not None:
            path, words = out / f"change_{epoch.number:03d}.tif", "epoch before minus epoch, m; missing rock is positive"
            write_geotiff(path, epoch.since_last.difference, grid, description=words)
        images = list(_images(out, config, epoch, reference, name))
        sigma = max(epoch.statistics.outside.nmad, 1e-4) if epoch.statistics.outside.count else 1e-3
        pictures.write_epoch_pictures(out, epoch, grid, sigma)
        write_json(folder / EPOCH_RECORD, _record(config, epoch, images, sigma))
    return _checksums(out, written)


def _checksums(out: Path, written: list[Path]) -> Checksums:
    """Return the checksums of the files that were written."""
    return {str(path.relative_to(out)): sha256(path) for path in written if path.exists()}


def _record(config: SimulationConfig, epoch: LaterEpoch, images: list[LabelledImage], sigma: float) -> dict[str, Any]:
    """Make the record of an epoch."""
    return {
        "epoch": epoch.number,
        **_seen_record(epoch.seen),
        "volume_balance_m3": epoch.carved.balance_m3,
        "wall_volume_m3": epoch.carved.wall_volume_m3,
        "registration": None if epoch.registration is None else epoch.registration.to_dict(),
        "statistics": {
            "inside_blocks": epoch.statistics.inside.to_dict(),
            "outside_blocks": epoch.statistics.outside.to_dict(),
            "sigma_m": sigma,
        },
        "blocks": epoch.blocks,
        **_time(config, epoch.number),
        "annotations": _annotations(config, images, epoch.rockfalls),
        **_change_record(config, epoch),
        **({} if epoch.m3c2 is None else _m3c2_record(config, epoch.number, epoch.m3c2)),
    }


def _annotations(config: SimulationConfig, images: list[LabelledImage], rockfalls: int) -> dict[str, Any]:
    """Annotate images. In a series, only missing rock is annotated, or all kinds, each as a category of its own."""
    if config.series is not None and not config.series.kinds and rockfalls:
        images = [replace(each, block=np.where(each.block <= rockfalls, each.block, WALL).astype(np.int32)) for each in images]
    found = coco(images, config.annotation)
    return by_kind(found, rockfalls) if config.series is not None and config.series.kinds and rockfalls else found


def _change_record(config: SimulationConfig, epoch: LaterEpoch) -> dict[str, Any]:
    """Make the part of an epoch's record about the change since the epoch before."""
    if epoch.since_last is None:
        return {}
    labels = np.where(np.isnan(epoch.since_last.difference), WALL, epoch.since_last.block).astype(np.int32)
    image = LabelledImage(f"change_{epoch.number:03d}.tif", labels, epoch.raster.grid, epoch.number)
    return {CHANGE_ANNOTATIONS: _annotations(config, [image], epoch.rockfalls)}


def _time(config: SimulationConfig, number: int) -> dict[str, str]:
    """Return the time of an epoch of a series for its record."""
    return {} if config.series is None else {"time": config.series.when(number).isoformat().replace("+00:00", "Z")}


def _m3c2_record(config: SimulationConfig, number: int, found: M3c2Map) -> dict[str, Any]:
    """Make the M3C2 part of an epoch's record."""
    image = LabelledImage(f"m3c2_{number:03d}.tif", found.block, found.grid, number)
    return {"m3c2": found.summary(), M3C2_ANNOTATIONS: coco([image], config.annotation)}


def _write_m3c2(out: Path, number: int, found: M3c2Map) -> None:
    """Write the distances and their levels of detection as maps, the distances as a picture, and everything as points."""
    from pipeline.run import clouds, pictures  # loads slowly, so not before it is needed

    write_geotiff(out / f"m3c2_{number:03d}.tif", found.distance, found.grid, description="M3C2, m; missing rock is positive")
    write_geotiff(out / f"m3c2_lod_{number:03d}.tif", found.level, found.grid, description="M3C2 level of detection 95 %, m")
    calm = statistics(found.distance[found.block == WALL])
    sigma = max(calm.nmad, 1e-4) if calm.count else 1e-3
    pictures.write_m3c2_pictures(out, number, found, sigma)
    maps: dict[str, NDArray[Any]] = {"distance_m": found.distance, "lod_m": found.level, "block": found.block}
    maps["significant"] = found.significant.astype(np.uint8)
    extra = {name: values.ravel()[found.place] for name, values in maps.items()}
    clouds.write_cloud(out / f"m3c2_{number:03d}.laz", PointCloud(found.points, extra=extra))


def _seen_record(seen: Acquisition) -> dict[str, Any]:
    """Return the number of points and, with several stations, the registrations of the further ones to the first."""
    points = sum(int(each.valid.sum()) + (0 if each.further is None else len(each.further.cell)) for each in seen.observations)
    registered = () if seen.joined is None else seen.joined.registrations
    return {"points": points} | ({"stations": [found.to_dict() for found in registered]} if registered else {})


def _images(
    out: Path, config: SimulationConfig, epoch: LaterEpoch, reference: ReferenceEpoch, name: str
) -> Iterator[LabelledImage]:
    """Yield the images of the data set: the difference map, or its tiles, which are written here."""
    labels = np.where(np.isnan(epoch.difference), WALL, epoch.raster.block)
    if config.tiles is None:
        yield LabelledImage(f"{name}.tif", labels, reference.raster.grid, epoch.number)
        return
    for tile in tiles(epoch.difference, labels, reference.raster.grid, config.tiles):
        file_name = f"tiles/{name}_{tile.name}.tif"
        write_geotiff(out / file_name, tile.values, tile.grid)
        yield LabelledImage(file_name, tile.block, tile.grid, epoch.number, tile.row, tile.column)


def _write_common(
    folder: Path,
    config: SimulationConfig,
    site: SensorSite,
    number: int,
    seen: Acquisition,
    surface: TriangleMesh,
    truth: TriangleMesh,
    blocks: list[dict[str, Any]],
) -> None:
    """Write what every epoch has: points, depth map, surface, truth, blocks."""
    from pipeline.formats.points.laz import LazHeader, gps_seconds
    from pipeline.run import clouds  # these load slowly, so not before they are needed

    products = config.products
    cloud, header = recorded_points(seen.observations), LazHeader()
    if config.series is not None:
        cloud = at_time(cloud, gps_seconds(config.series.when(number)))
        header = LazHeader(date=config.series.when(number).date(), standard_time=True)
    clouds.write_cloud(folder / "points.laz", cloud, header)
    clouds.write_formats(folder / "points", products.formats, cloud, partial(scans_of, seen.observations), header)
    if seen.observation.sensor == "stereo":
        depth = seen.observation.depth.astype(np.float32)
        write_tiff(folder / "depth_left.tif", depth, description="depth along the left camera's axis, m")
    if products.surface:
        write_ply(folder / "surface.ply", surface)
    if products.truth:
        write_ply(folder / "truth.ply", truth)
    write_json(folder / "blocks.json", blocks)
    if products.world or (products.world is None and isinstance(config.wall, ImportedWall)):
        cloud = replace(cloud, points=site.frame.to_world(cloud.points))
        header = replace(header, wkt=wkt_of(products.crs, "products.crs") if products.crs else "")
        scans = partial(scans_of, seen.observations, site.frame)
        clouds.write_cloud(folder / "points_world.laz", cloud, header)
        clouds.write_formats(folder / "points_world", products.formats, cloud, scans, header)
        if products.surface:
            write_ply(folder / "surface_world.ply", _in_world(surface, site))
    if products.metashape and seen.depth_maps is not None:
        write_metashape_export(folder / "metashape", *seen.depth_maps)


def _write_block_meshes(folder: Path, wall: TriangleMesh, blocks: Blocks) -> None:
    """Write the four meshes of each block (thesis 3.3): wall difference, intersection, niche, removed block."""
    for index in range(len(blocks)):
        meshes = block_meshes(wall, blocks, index)
        for field in fields(meshes):
            write_ply(folder / f"block_{index + 1:04d}_{field.name}.ply", getattr(meshes, field.name))


def _in_world(mesh: TriangleMesh, site: SensorSite) -> TriangleMesh:
    """Convert a mesh to world coordinates."""
    vertices: FloatArray = site.frame.to_world(mesh.vertices)
    return replace(mesh, vertices=vertices)


@contextmanager
def _folder(out: Path, number: int) -> Iterator[Path]:
    """Provide the epoch's folder under a temporary name, and rename it when everything in it and beside it is written."""
    final = epoch_folder(out, number)
    temporary = final.with_name(f".{final.name}")
    temporary.mkdir(parents=True, exist_ok=True)
    yield temporary
    files = [path.relative_to(temporary) for path in sorted(temporary.rglob("*")) if path.is_file()]
    with explained(final):
        if final.exists():
            _give_names(temporary, final, files)
        else:
            give_name(temporary, final)
    for name in files:
        note(final / name)


def _give_names(temporary: Path, final: Path, files: list[Path]) -> None:
    """Move the files into an existing, damaged folder of the epoch, beside what else is in it."""
    for name in files:
        with explained(final / name):
            (final / name).parent.mkdir(parents=True, exist_ok=True)
            (temporary / name).replace(final / name)
            to_disk((final / name).parent)
    shutil.rmtree(temporary)
