"""The target of ICP: the reconstructed reference surface, or the true wall."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.config.simulation import SimulationConfig
from pipeline.report.progress import Progress
from pipeline.run.epoch import observe_epoch, observe_reference
from pipeline.run.site import prepare_site
from scene.common.config import parse
from scene.common.keyed_random import KeyedRandom

SHIFT_M = 0.03


@pytest.mark.parametrize(("target", "off"), [("reference", SHIFT_M), ("true_wall", 0.0)])
def test_both_epochs_come_to_the_target(target: str, off: float) -> None:
    """Real cameras that stand 3 cm beside their nominal place shift every surface rigidly by 3 cm."""
    shifted = {"name": "camera_shift", "camera": "both", "x_m": SHIFT_M}
    quiet = {"parallax_sigma_px": 0, "regularization_sigma_px": 0}
    values = {
        "wall": {"style": "glendale", "width_m": 9.0, "height_m": 6.0, "resolution_m": 0.1, "seed": 2},
        "depth_map": "low",
        "reconstruction": "vertices",
        "icp_target": target,
        "icp": {"delta_threshold": 1e-7, "threshold": 0.0},
        "rockfall": {"count": 4, "size_m": 0.3, "safe_zone_offset_m": 0.3},
        "sensor": [{"sensor": "stereo", "noise": quiet, "effects": [shifted]}],
    }
    config = parse(SimulationConfig, values, "test")
    site = prepare_site(config, "stereo", KeyedRandom(1))
    reference = observe_reference(config, site, KeyedRandom(1), Progress())
    error = np.linalg.norm(reference.surface.vertices - reference.caster.mesh.vertices, axis=1)
    assert np.median(error) == pytest.approx(off, abs=1e-3)
    epoch = observe_epoch(config, site, reference, 1, KeyedRandom(1), Progress())
    assert epoch.registration is not None
    moved = epoch.registration.apply(epoch.surface.vertices)
    left = np.median(np.linalg.norm(moved - epoch.carved.mesh.vertices, axis=1))
    assert left == pytest.approx(off, abs=3e-3)  # the niches pull by a millimetre or two
