"""Public reports about camera files: Metashape XML and COLMAP text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.field_reports.report import Report, refused
from pipeline.formats.cameras.colmap import read_colmap
from pipeline.formats.cameras.metashape import read_metashape

_POSE = "1 0 0 3 0 0 1 -20 0 -1 0 2 0 0 0 1"
_RESOLUTION = '<resolution width="8192" height="5460"/>'


def _metashape(folder: Path, calibrations: str, kind: str = "frame", pose: str = _POSE) -> Path:
    """Write a camera XML of one camera."""
    (folder / "cameras.xml").write_text(
        f'<document version="2.0.0"><chunk label="Chunk 1" enabled="true"><sensors next_id="1">'
        f'<sensor id="0" label="camera" type="{kind}">{_RESOLUTION}{calibrations}</sensor></sensors>'
        '<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>'
        "<rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>1</scale></transform></component>"
        "</components>"
        '<cameras next_id="1" next_group_id="0"><camera id="0" sensor_id="0" component_id="0" label="left" enabled="true">'
        f"<transform>{pose}</transform></camera></cameras></chunk></document>"
    )
    return folder / "cameras.xml"


def _calibration(kind: str, f: float, centre: str = "", sort: str = "frame") -> str:
    return f'<calibration type="{sort}" class="{kind}">{_RESOLUTION}<f>{f}</f>{centre}<k1>-0.045</k1></calibration>'


def _initial_and_adjusted(folder: Path) -> str:
    both = _calibration("initial", 8198.1, "<cx>13.8</cx>") + _calibration("adjusted", 8196.7, "<cx>15.5</cx>")
    camera = read_metashape(_metashape(folder, both)).cameras["left"]
    assert (camera.f_px, camera.cx_px) == (8196.7, 15.5), camera
    return "takes the adjusted one: f 8196.7 px"


def _none(folder: Path) -> str:
    return refused(lambda: read_metashape(_metashape(folder, "")), folder, "calibration")


def _no_principal_point(folder: Path) -> str:
    camera = read_metashape(_metashape(folder, _calibration("adjusted", 8196.7))).cameras["left"]
    assert (camera.cx_px, camera.cy_px) == (0.0, 0.0)
    return "takes it as 0, as Metashape leaves out what is 0"


def _windows_exponents(folder: Path) -> str:
    pose = "1.0000000000000000e+000 0 0 3.0000000000000000e+000 0 0 1 -2.0000000000000000e+001 0 -1 0 2 0 0 0 1"
    camera = read_metashape(_metashape(folder, _calibration("adjusted", 8196.7), pose=pose)).cameras["left"]
    assert np.allclose(camera.position, [3.0, -20.0, 2.0])
    return "reads the pose"


def _fisheye(folder: Path) -> str:
    path = _metashape(folder, _calibration("adjusted", 8196.7, sort="equidistant_fisheye"), kind="equidistant_fisheye")
    return refused(lambda: read_metashape(path), folder, "fisheye")


def _unequal_focal_lengths(folder: Path) -> str:
    (folder / "cameras.txt").write_text("1 PINHOLE 4000 3000 3000 3012 2003 1498\n")
    (folder / "images.txt").write_text("1 1 0 0 0 0 0 0 1 left.jpg\n\n")
    camera = read_colmap(folder)["left.jpg"]
    assert (camera.f_px + camera.b1, camera.f_px) == (3000.0, 3012.0)
    return "keeps both focal lengths: f 3012 px, b1 -12 px"


REPORTS = (
    Report(
        "nerfstudio-project/nerfstudio#3324", "an initial and an adjusted calibration", "take the adjusted", _initial_and_adjusted
    ),
    Report("EnricoAhlers/agi2nerf#1", "a camera without a calibration", "refuse it", _none),
    Report("uhlik/bpy#39", "a calibration without `cx` and `cy`", "take them as 0", _no_principal_point),
    Report("uhlik/bpy#19", "numbers with exponents of three digits", "read them", _windows_exponents),
    Report("agisoft-llc/metashape-scripts#72", "a fisheye camera", "refuse it", _fisheye),
    Report("SBCV/Blender-Addon-Photogrammetry-Importer#89", "two focal lengths", "keep both", _unequal_focal_lengths),
)
