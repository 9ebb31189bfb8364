"""Detection that averages over a map's mirror images: its answer for a mirrored map, and how it is switched on."""

from __future__ import annotations

import json
from typing import get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.cli.main import main
from pipeline.detection.inference import operating_point, weights
from pipeline.detection.network.config import DetectorConfig, HeadConfig, ProposalConfig
from pipeline.detection.products import run
from scene.common.errors import InputError

SIDE = 64
SMALL = DetectorConfig(
    backbone="fine",
    image_px=SIDE,
    pyramid_channels=8,
    proposal=ProposalConfig(candidates=100, proposals=20),
    head=HeadConfig(mask_size_px=28, hidden_units=16, detections=10),
)
WAYS = get_args(HeadConfig.model_fields["mirrored"].annotation)
"""What a config may say of mirrored views."""


@pytest.fixture(autouse=True, scope="module")
def _network() -> None:
    """Import what needs Keras only where a test runs, as TensorFlow takes seconds to import."""
    global VIEWS, MaskRCNN, MirroredMaskRCNN, build_network
    from pipeline.detection.inference.mirrored import VIEWS, MirroredMaskRCNN, build_network
    from pipeline.detection.network.model import MaskRCNN


@pytest.fixture(scope="module")
def model() -> MirroredMaskRCNN:
    """A network with weights large enough that its output varies over the map and depends on the map's orientation."""
    random, result = np.random.default_rng(4), MirroredMaskRCNN(SMALL)
    for head in (result.proposal_head, result.box_head, result.mask_head):
        for variable in head.weights:
            variable.assign(variable + random.normal(0, 0.1, variable.shape))
    return result


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """Noise (4, h, w, 2) without gaps: one map, mirrored in each way of VIEWS["both"]."""
    noise = np.random.default_rng(5).normal(0, 1, (SIDE, SIDE)).astype(np.float32)
    return np.stack([np.stack([np.flip(noise, axes), np.ones_like(noise)], axis=-1) for axes in VIEWS["both"]])


def _turned(answer: dict[str, np.ndarray], axes: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Return the answer for a mirrored map, mirrored back."""
    result = dict(answer)
    for name in ("boxes", "mask_boxes"):
        edges = answer[name].copy()
        for axis in axes:
            edges[:, axis], edges[:, axis + 2] = SIDE - answer[name][:, axis + 2], SIDE - answer[name][:, axis]
        result[name] = edges
    return result | {"masks": np.flip(answer["masks"], [axis + 1 for axis in axes])}


def test_every_way_of_looking_has_its_views():
    assert tuple(VIEWS) == WAYS


@pytest.mark.parametrize("mirrored", WAYS)
def test_a_mirrored_map_has_mirrored_answers_where_its_mirror_images_are_looked_at(mirrored, model, images):
    """The mean over a group of views is mirrored with the map.

    The network alone does not have this property, nor have views that lack one mirror image.
    """
    model.config = weights.with_head(SMALL, mirrored=mirrored)
    answers = {name: np.asarray(values) for name, values in model({"image": images}).items()}
    for number, axes in enumerate(VIEWS["both"]):
        other = _turned({name: values[number] for name, values in answers.items()}, axes)
        if axes in VIEWS[mirrored]:
            for name, values in answers.items():
                assert_allclose(other[name], values[0], atol=1e-4, err_msg=f"{name}, {axes}")
        else:
            assert np.abs(other["scores"] - answers["scores"][0]).max() > 1e-3
            assert np.abs(other["boxes"] - answers["boxes"][0]).max() > 0.1


def test_one_view_is_the_network_alone_bit_for_bit(model, images):
    model.config = SMALL
    alone = build_network(SMALL)
    assert type(alone) is MaskRCNN
    alone.set_weights(model.get_weights())
    one_view = model({"image": images[:1]})
    for name, values in alone({"image": images[:1]}).items():
        assert_array_equal(one_view[name], values)


def test_mirrored_views_are_used_only_when_asked_for(tmp_path):
    head = {"score_shift": 1.0, "score_per_doubling": 0.25, "mirrored_score_shift": 2.0, "mirrored_score_per_doubling": -0.25}
    weights.save(build_network(weights.with_head(SMALL, mirrored="both", **head)), tmp_path)
    looks, alone = weights.load(tmp_path, mirrored=True), weights.load(tmp_path)
    assert isinstance(looks, MirroredMaskRCNN)
    assert looks.config.head.shifts == (2.0, -0.25)
    assert type(alone) is MaskRCNN
    assert alone.config.head.shifts == (1.0, 0.25)


def test_detectors_of_before_look_at_maps_as_they_are(tmp_path):
    head = SMALL.head.model_dump(mode="json")
    before = {name: value for name, value in head.items() if "mirrored" not in name} | {"score_shift": 1.5}
    (tmp_path / weights.CONFIG).write_text(json.dumps(SMALL.model_dump(mode="json") | {"head": before}))
    config = weights.load_config(tmp_path)
    assert config.head.mirrored == "none"
    assert config.head.shifts == (1.5, 0.0)
    assert weights.with_head(config, mirrored="both").head.shifts == (1.5, 0.0)


def test_scores_are_set_for_each_way_of_looking(tmp_path, monkeypatch):
    """The detections' log odds are best shifted by 1 if only the map itself is used, and by 2 with its mirror images."""
    monkeypatch.setattr(operating_point, "_detect_all", lambda model, images, lowest: model.config.head.mirrored)
    monkeypatch.setattr(operating_point, "best_shifts", lambda _, found: {"none": (1.0, 0.5), "both": (2.0, -0.5)}[found])
    validation = type("Tiles", (), {"images": [], "annotations": []})()
    head = {"score_shift": 0.5, "mirrored_score_shift": 0.25, "mirrored_score_per_doubling": -0.25}
    weights.save(build_network(weights.with_head(SMALL, mirrored="both", **head)), tmp_path)
    assert operating_point.set_operating_point(tmp_path, validation) == 2.25
    set_to = weights.load_config(tmp_path).head
    assert (set_to.mirrored, set_to.score_shift, set_to.score_per_doubling) == ("both", 1.5, 0.5)
    assert (set_to.mirrored_score_shift, set_to.mirrored_score_per_doubling) == (2.25, -0.75)


def test_a_way_of_looking_that_there_is_not_is_named(tmp_path):
    values = SMALL.model_dump(mode="json")
    values["head"]["mirrored"] = "up_down"
    (tmp_path / weights.CONFIG).write_text(json.dumps(values))
    with pytest.raises(InputError, match=r"'head\.mirrored': input should be 'none', 'left_right' or 'both', got 'up_down'"):
        weights.load_config(tmp_path)


def test_the_threshold_has_no_mirrored_views(tmp_path, capsys):
    (tmp_path / "map.tif").write_bytes(b"")
    words = ["detect", "baseline", str(tmp_path / "map.tif"), "--out", str(tmp_path / "out"), "--mirrored"]
    assert main(words) == 2
    assert "--mirrored: the option needs a neural network" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_asking_for_mirrored_views_that_the_detector_does_not_have_is_refused(tmp_path, capsys):
    weights.save(build_network(SMALL), tmp_path / "detector")
    (tmp_path / "map.tif").write_bytes(b"")
    words = ["detect", str(tmp_path / "detector"), str(tmp_path / "map.tif"), "--out", str(tmp_path / "out"), "--mirrored"]
    assert main(words) == 2
    assert "has no mirrored views (`head.mirrored: none`)" in capsys.readouterr().err


def test_the_detector_that_comes_along_looks_at_all_views():
    head = weights.load_config(run.detector_folder("default")).head
    assert head.mirrored == "both"
    assert None not in (head.mirrored_score_shift, head.mirrored_score_per_doubling)
