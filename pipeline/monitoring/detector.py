"""Find changed regions with a detector of `scarpsim detect` instead of the level of detection."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from pycocotools import mask as coco_mask

from pipeline.detection.inference.weights import check_detector
from pipeline.detection.products.run import BASELINE, detector_folder
from pipeline.monitoring.events import Change, ChangedRegion, region_of_mask
from pipeline.monitoring.options import NO_DETECTOR
from scene.common.errors import InputError, OutsideError

CONFIDENCE = 0.9
"""Lowest score that counts."""
_COMMAND = "import sys; from pipeline.cli.main import main; sys.exit(main(sys.argv[1:]))"
_WRONG_INPUT = 2


def check_detector_name(detector: str) -> None:
    """Raise InputError, naming the option --detector, if a detector cannot be used, as far as can be checked in a second.

    detector: name or folder, as for `scarpsim detect`, or "none".
    """
    if detector in (NO_DETECTOR, BASELINE):
        return
    try:
        check_detector(detector_folder(detector))
    except InputError as error:
        remedy = f"choose one of: default, {BASELINE}, {NO_DETECTOR}, or a folder made by `scarpsim train`"
        raise InputError(error.what, where=f"--detector {detector}", allowed=error.allowed, remedy=remedy) from None


def regions_of_detector(detector: str, difference: Path, change: Change) -> list[ChangedRegion]:
    """Find changed regions in a difference map with a trained detector, instead of with the level of detection.

    The detector runs in a process of its own, because TensorFlow and the ray tracer's compiler disturb each other in the same
    one.

    Parameters
    ----------
    detector : str
        Name or folder of the detector, as for `scarpsim detect`.
    difference : Path
        GeoTIFF of the difference map.
    change : Change
        The same map with its levels of detection, in which depth, volume and significance of the detections are measured.

    Returns
    -------
    list of ChangedRegion
        The detections with a score of at least 0.9, the largest volume first.

    Raises
    ------
    InputError
        If the detector cannot be used.
    """
    with tempfile.TemporaryDirectory(prefix="scarpsim_detect_") as folder:
        words = [detector, str(difference), "--out", str(Path(folder) / "found"), f"--confidence={CONFIDENCE:g}", "--quiet"]
        command = [sys.executable, "-c", _COMMAND, "detect", *words, "--no-pictures"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            lines = done.stderr.strip().splitlines()
            message = (
                f"scarpsim detect failed: {lines[-1].removeprefix('error: ')}"
                if lines
                else "the detector's process ended without a message; run `scarpsim detect` on a difference map to see more"
            )
            raise InputError(message) if done.returncode == _WRONG_INPUT else OutsideError(message)
        found = json.loads((Path(folder) / "found" / f"detections_{CONFIDENCE:g}.json").read_text(encoding="utf-8"))
    regions = []
    for each in found["annotations"]:
        column, row, width, height = (int(value) for value in each["bbox"])
        whole = coco_mask.decode(each["segmentation"]) > 0
        mask = np.ascontiguousarray(whole[row : row + height, column : column + width])
        region = region_of_mask(mask, row, column, float(each["score"]), change)
        regions += [] if region is None else [region]
    return sorted(regions, key=lambda region: -region.volume_m3)
