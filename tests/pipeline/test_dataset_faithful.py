"""Data sets that repeat the reference's (thesis) choices: what noise levels scale, measurement at vertices, the
card's samples.
"""

from __future__ import annotations

from typing import Any

import pytest
from tiny_dataset import TINY, tiny

from pipeline.dataset.card import _surfaces
from pipeline.dataset.config import DatasetConfig
from pipeline.dataset.plan import planned_epochs, simulation_of
from pipeline.dataset.statistics import SetStatistics
from scene.common.config import parse
from scene.common.errors import InputError

PRINTED = {
    "sensor": "stereo",
    "noise": {
        "parallax_sigma_px": 0.6,
        "orientation": {"cx_px": 4.5, "k1": {"mean": 0.1, "sigma": 0.005}},
        "orientation_drawn": "both_alike",
    },
}


def with_noise(stereo: dict[str, Any], tls: dict[str, Any] | None = None) -> DatasetConfig:
    level = {"stereo": {"model": PRINTED, **stereo}, "tls": {"model": {"sensor": "tls"}, **(tls or {})}}
    return parse(DatasetConfig, {**TINY, "noise": {"low": level}}, "test")


def test_a_level_scales_the_orientation_alone_or_all_noise() -> None:
    for scaled, parallax in (("orientation", 0.6), ("all", 1.8)):
        level = with_noise({"scale": 3.0, "scaled": scaled}).noise["low"].stereo
        assert level is not None
        noise = level.on("ledge").noise
        assert noise.parallax_sigma_px == pytest.approx(parallax)
        assert (noise.orientation.cx_px.sigma, noise.orientation.k1.mean) == pytest.approx((13.5, 0.3))
        assert noise.orientation_drawn == "both_alike"


def test_a_laser_scanner_has_no_orientation_to_scale() -> None:
    with pytest.raises(InputError, match="a laser scanner has no orientation noise"):
        with_noise({}, {"scaled": "orientation"})


def test_vertices_are_measured_by_the_stereo_pair_alone() -> None:
    wall = {**TINY["walls"]["ledge"], "reconstruction": "vertices"}
    config = tiny(walls={"ledge": wall})
    ways = {epoch.sensor: simulation_of(config, epoch).reconstruction for epoch in planned_epochs(config)}
    assert ways == {"stereo": "vertices", "tls": "direct"}


def record(spacing_m: float | None, edge_m: float, ratios: tuple[float | None, ...] = ()) -> dict[str, Any]:
    block = {"size_m": [edge_m, 0.4, 0.5], "area": 30, "bbox": [0, 0, 6, 10]}
    annotations = [{**block, "signal_to_noise": ratio} for ratio in ratios or (5.0,)]
    return {
        "epoch": {"split": "test", "sensor": "tls", "wall": "w", "noise": "n", "size": "s"},
        "tiles": [{"image": {"file_name": "a.tif"}, "annotations": annotations}],
        "outside_blocks": {"standard_deviation_m": 0.01},
        "seed": 1,
        "spacing_m": spacing_m,
    }


@pytest.mark.parametrize(("spacing", "warned"), [(0.05, False), (0.051, True), (None, False)])
def test_a_card_warns_where_samples_are_coarser_than_two_to_the_smallest_edge(spacing: float | None, warned: bool) -> None:
    statistics = SetStatistics()
    statistics.add(record(spacing, 0.3))
    statistics.add(record(spacing, 0.1))
    assert len(statistics.warnings()) == warned
    config = {"sensors": ["tls"], "walls": {"w": {"reconstruction": "vertices"}}}
    text = "\n".join(_surfaces({"sources": {"a": {"config": config}}}, statistics))
    assert "ray-traced samples, triangulated in the sensor's grid (direct), of tls w" in text
    assert ("**tls w: samples are 51 mm apart" in text) == warned


def test_a_card_counts_the_blocks_that_stand_out_and_how_full_their_boxes_are() -> None:
    statistics = SetStatistics()
    statistics.add(record(0.01, 0.3, (4.5, 3.9, None)))
    cell = statistics.cells["test", "tls", "w", "n", "s"]
    assert (cell.with_ratio, cell.stand_out, cell.filled / cell.annotations) == (2, 1, 0.5)
