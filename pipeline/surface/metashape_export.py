"""Cameras and depth maps as Agisoft Metashape loads them, with the script for its Python console beside them.

Metashape takes depth maps from outside by `Chunk.importDepthImages` (Metashape Python Reference 2.2, class Metashape.Chunk); it
wants each beside an image of the same name and shape, with the depth along the camera's axis and 0 where there is none. Poses and
calibrations come by `Chunk.importCameras`, matched by label. So images, depth maps and cameras all are of the depth map's pixels.
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


def write_metashape_export(folder: Path, left: DepthMap, right: DepthMap) -> None:
    """Write cameras.xml, depth/, images/ and load_depth_maps.py into `folder`, all in the wall frame, m.

    The images are shaded depth: no photograph is needed, and none is there where the matching is simulated.
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
    """(h, w) grey by the slope of the depth from row to row, 0 where there is no depth."""
    slope = np.diff(depth, axis=0, prepend=depth[:1])
    valid = np.isfinite(slope)
    scale = np.quantile(np.abs(slope[valid]), 0.9) if valid.any() else 0.0
    shade = 128 + 100 * np.clip(slope / scale, -1, 1) if scale > 0 else np.full(depth.shape, 128.0)
    return np.where(valid, shade, 0).astype(np.uint8)
