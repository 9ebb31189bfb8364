"""Write an epoch's pictures and map styles. The module is imported when the first one is drawn: Matplotlib loads slowly."""

from __future__ import annotations

from pathlib import Path

from pipeline.change.m3c2 import M3c2Map
from pipeline.formats.files.atomic import write_bytes
from pipeline.report.curve_figures import convergence_figure, histogram_figure
from pipeline.report.figures import (
    SCALE_SIGMAS,
    blocks_figure,
    difference_figure,
    hillshade_figure,
)
from pipeline.report.map_styles import difference_style, quantity_style
from pipeline.report.page import litres
from pipeline.run.epoch import LaterEpoch, ReferenceEpoch
from scene.geometry.grid import Grid
from scene.geometry.mesh import WALL


def write_reference_pictures(out: Path, reference: ReferenceEpoch) -> None:
    """Write the hillshade of the first epoch as reference.png.

    out: folder of the run. reference: the first epoch.
    """
    write_bytes(out / "reference.png", hillshade_figure(reference.raster.heights, reference.raster.grid, "Reference"))


def write_epoch_pictures(out: Path, epoch: LaterEpoch, grid: Grid, sigma: float) -> None:
    """Write the pictures of an epoch for the report, and the colour style with which QGIS shows its difference map.

    In a time series, only the epochs in which rocks fell since the epoch before have pictures.

    Parameters
    ----------
    out : Folder of the run.
    epoch : The epoch.
    grid : Grid of its maps.
    sigma : Standard deviation of the difference outside blocks, m, which sets the range of colours.
    """
    number = f"{epoch.number:03d}"
    difference_style(out / f"difference_{number}.tif", SCALE_SIGMAS * sigma)
    if not _is_pictured(epoch):
        return
    masks = epoch.raster.block != WALL
    write_bytes(out / f"difference_{number}.png", difference_figure(epoch.difference, grid, epoch.raster.block, sigma))
    largest = sorted(epoch.blocks, key=lambda record: -record["volume_m3"])
    captions = {record["label"]: f"{litres(record['volume_m3'])} l" for record in largest}
    zooms = blocks_figure(epoch.difference, grid, epoch.raster.block, sigma, captions)
    if zooms is not None:
        write_bytes(out / f"blocks_{number}.png", zooms)
    write_bytes(out / f"hillshade_{number}.png", hillshade_figure(epoch.raster.heights, grid, f"Epoch {epoch.number}"))
    write_bytes(out / f"histogram_{number}.png", histogram_figure(epoch.difference[~masks], epoch.difference[masks]))
    if epoch.registration is not None:
        write_bytes(out / f"icp_{number}.png", convergence_figure(epoch.registration.history))


def _is_pictured(epoch: LaterEpoch) -> bool:
    """Return whether an epoch has pictures."""
    if epoch.since_last is None or not epoch.rockfalls:
        return True
    new = epoch.since_last.block
    return bool(((new > WALL) & (new <= epoch.rockfalls)).any())


def write_m3c2_pictures(out: Path, number: int, found: M3c2Map, sigma: float) -> None:
    """Write the picture of an epoch's M3C2 distances, and the colour styles with which QGIS shows its M3C2 maps.

    Parameters
    ----------
    out : Folder of the run.
    number : Number of the epoch.
    found : M3C2 distances and their levels of detection.
    sigma : Standard deviation of the distances outside blocks, m, which sets the range of colours.
    """
    difference_style(out / f"m3c2_{number:03d}.tif", SCALE_SIGMAS * sigma)
    quantity_style(out / f"m3c2_lod_{number:03d}.tif", found.level, "mm", 1e3)
    write_bytes(out / f"m3c2_{number:03d}.png", difference_figure(found.distance, found.grid, found.block, sigma, "M3C2"))
