"""Write cameras and depth maps for Agisoft Metashape, with a script for its Python console that loads them.

Metashape imports depth maps with `Chunk.importDepthImages` (Metashape Python Reference 2.2, class Metashape.Chunk). It needs
each beside an image of the same name and shape, with the depth along the camera's axis and 0 where there is none. Poses and
calibrations are imported with `Chunk.importCameras` and matched by label. Images, depth maps and cameras therefore all have
the depth map's pixels.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.formats.cameras.metashape import write_metashape
from pipeline.formats.files.atomic import write_bytes, write_text
from pipeline.formats.rasters.geotiff import write_tiff
from pipeline.surface.depth_maps import DepthMap

SIDES = ("left", "right")

SCRIPT = '''"""Load scarpsim's cameras and depth maps into Metashape Professional 2.x: Tools > Run Script.

API: https://www.agisoft.com/pdf/metashape_python_api_2_2_0.pdf, Chunk.importDepthImages and Chunk.importCameras.
"""

from pathlib import Path

import Metashape

FOLDER = Path(__file__).resolve().parent
SIDES = ("left", "right")

chunk = Metashape.app.document.addChunk()
chunk.label = "scarpsim " + FOLDER.parent.name
(FOLDER / "imported").mkdir(exist_ok=True)
chunk.importDepthImages(
    filenames=[str(FOLDER / "depth" / (side + ".tif")) for side in SIDES],
    color_filenames=[str(FOLDER / "images" / (side + ".png")) for side in SIDES],
    image_path=str(FOLDER / "imported" / "{filename}.tif"),
)
for camera in chunk.cameras:
    camera.label = Path(camera.label).stem
chunk.importCameras(str(FOLDER / "cameras.xml"), format=Metashape.CamerasFormatXML)

loaded = [camera.label for camera in chunk.depth_maps.keys()] if chunk.depth_maps else []
unposed = [camera.label for camera in chunk.cameras if camera.transform is None]
if sorted(loaded) != sorted(SIDES) or unposed:
    raise RuntimeError("depth maps: %s; cameras without a pose: %s" % (loaded, unposed))
print("Loaded: %s. Next: Workflow > Build Model, source data: Depth maps." % ", ".join(loaded))
'''
"""Script that a user runs in Metashape."""


def write_metashape_export(folder: Path, left: DepthMap, right: DepthMap) -> None:
    """Write the depth maps of a stereo pair for Agisoft Metashape, which can build a mesh from them.

    The folder then has the cameras (cameras.xml), depth maps (depth/), images (images/), and a script that loads them in
    Metashape (load_depth_maps.py). Images are shaded depth, because there is no photograph when the matching is simulated.

    Parameters
    ----------
    folder : Path
        Folder to write to.
    left, right : DepthMap
        Depth maps of both cameras, wall frame, m.
    """
    maps = dict(zip(SIDES, (left, right), strict=True))
    write_metashape(folder / "cameras.xml", {side: source.camera for side, source in maps.items()})
    for side, source in maps.items():
        depth = np.nan_to_num(source.depth, nan=0.0)
        write_tiff(folder / "depth" / f"{side}.tif", depth, description="depth along the camera's axis, m; 0: none")
        _, png = cv2.imencode(".png", _shaded(source.depth))
        write_bytes(folder / "images" / f"{side}.png", png.tobytes())
    write_text(folder / "load_depth_maps.py", SCRIPT)


def _shaded(depth: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Shade the depth map: grey values (h, w) by the slope of the depth from row to row, 0 without depth."""
    slope = np.diff(depth, axis=0, prepend=depth[:1])
    valid = np.isfinite(slope)
    scale = np.quantile(np.abs(slope[valid]), 0.9) if valid.any() else 0.0
    shade = 128 + 100 * np.clip(slope / scale, -1, 1) if scale > 0 else np.full(depth.shape, 128.0)
    return np.where(valid, shade, 0).astype(np.uint8)
