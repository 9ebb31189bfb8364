"""A real rock face of which much moved between two epochs: whichever epoch is the reference, the sensor is not blamed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.formats.measurements.measurement import read_measurement
from pipeline.gap.naming.workflow import diagnose
from pipeline.measurement.build import build
from pipeline.measurement.request import Request

ROCKS = Path(__file__).parents[3] / "shared" / "data" / "tls_rock_blocks" / "Blocs_EGU_avant.txt"
POSITION = (547449.975, 149565.052, 724.844)
"""In front of the face: the file does not say where the scanner stood."""


@pytest.fixture(scope="module")
def epochs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """before.xyz: every second point; after.xyz: the others, with twelve of the largest patches pushed back, most in their
    middle.
    """
    points = np.loadtxt(ROCKS)
    pairs = cKDTree(points[:, :3]).query_pairs(0.6, output_type="ndarray")
    patch = connected_components(coo_array((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points))))[1]
    rng = np.random.default_rng(5)
    before, after, of = points[0::2], points[1::2].copy(), patch[1::2]
    for number in rng.choice(np.argsort(-np.bincount(patch))[:30], 12, replace=False):
        rows = of == number
        sight = after[rows, :3] - POSITION
        off = np.linalg.norm(after[rows, :3] - after[rows, :3].mean(axis=0), axis=1)
        depth = rng.uniform(0.2, 0.9) * np.clip(1 - (off / (1.2 * off.max())) ** 2, 0, 1)
        after[rows, :3] += depth[:, None] * sight / np.linalg.norm(sight, axis=1, keepdims=True)
    folder = tmp_path_factory.mktemp("epochs")
    for name, cloud in (("before", before), ("after", after)):
        np.savetxt(folder / f"{name}.xyz", cloud, fmt="%.4f")
    return folder


@pytest.mark.skipif(not ROCKS.exists(), reason=f"the real rock face is not there: {ROCKS}")
@pytest.mark.parametrize(("measured", "reference"), [("after", "before"), ("before", "after")])
def test_much_moved_rock_is_no_agreement(epochs: Path, tmp_path: Path, measured: str, reference: str) -> None:
    """The second order used to give `no_gap`: few patches remain, so the gap is uncertain, and p = 0.012 does not reject."""
    request = Request(
        [epochs / f"{measured}.xyz"], str(epochs / f"{reference}.xyz"), "riegl_vz400i",
        position=POSITION, columns=("x", "y", "z", "intensity"),
    )  # fmt: skip
    build(request, tmp_path / "out")
    found = diagnose(read_measurement(tmp_path / "out"))
    assert (found.verdict, found.effects) == ("insufficient_data", ())
    assert found.remaining["moved"] > 0.5
    assert found.remaining["wide"] > 1.5
    assert "add stable_areas" in found.remaining["note"]
