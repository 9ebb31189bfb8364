"""Losses against hand-computed values; targets of anchors, proposals and masks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.detection.network.config import HeadConfig, ProposalConfig

STRIDES = (4, 8, 16, 32, 64)


@pytest.fixture(autouse=True, scope="module")
def _network() -> None:
    """Import what needs Keras only where a test runs, as TensorFlow takes seconds to import."""
    global anchor_targets, anchors, binary_cross_entropy, box_targets, cross_entropy, encode, keras, mask_targets
    global share_inside, smooth_l1
    import keras

    from pipeline.detection.network.boxes import anchors, encode, share_inside
    from pipeline.detection.network.losses import binary_cross_entropy, cross_entropy, smooth_l1
    from pipeline.detection.network.targets import anchor_targets, box_targets, mask_targets


def test_binary_cross_entropy_by_hand():
    logits = np.array([0.0, 2.0, -2.0, 90.0], np.float32)
    targets = np.array([1.0, 1.0, 1.0, 0.0], np.float32)
    each = np.array([np.log(2), np.log1p(np.exp(-2)), np.log1p(np.exp(2)), 90])
    assert_allclose(binary_cross_entropy(logits, targets, np.ones(4, np.float32)), each.mean(), rtol=1e-6)
    assert_allclose(binary_cross_entropy(logits, targets, np.array([1, 0, 1, 0], np.float32)), (each[0] + each[2]) / 2, rtol=1e-6)


def test_cross_entropy_by_hand():
    logits = np.array([[[1.0, 3.0], [0.0, 0.0]]], np.float32)
    wanted = np.array([[1, 0]])
    assert_allclose(cross_entropy(logits, wanted, np.ones((1, 2), np.float32)), (np.log1p(np.exp(-2)) + np.log(2)) / 2, rtol=1e-6)


def test_smooth_l1_by_hand():
    codes = np.array([[[0.5, 0, 0, 0], [3, -2, 0, 0]]], np.float32)
    zero = np.zeros_like(codes)
    assert_allclose(smooth_l1(codes, zero, np.array([[1, 1]], np.float32)), (0.125 + 2.5 + 1.5) / 2, rtol=1e-6)
    assert_allclose(smooth_l1(codes, zero, np.array([[1, 0]], np.float32)), 0.125, rtol=1e-6)
    assert_allclose(smooth_l1(codes, zero, np.zeros((1, 2), np.float32)), 0)


def test_anchors_near_a_block_and_the_nearest_are_positive():
    config = ProposalConfig(sampled_anchors=64)
    places = anchors(128, 128, STRIDES, config.anchor_sizes_px, config.anchor_ratios)
    blocks = np.zeros((1, 3, 4), np.float32)
    blocks[0, 0] = places[100]  # an anchor's own place
    blocks[0, 1] = (60, 60, 65, 64)  # nothing comes near it: its best anchor has to do
    valid = np.array([[1, 1, 0]], np.float32)
    found = anchor_targets(places, blocks, valid, config, keras.random.SeedGenerator(1))
    positive = np.asarray(found.positive)[0][np.asarray(found.positive_weight)[0] > 0]
    assert 100 in positive
    code = np.asarray(found.code)[0][np.asarray(found.positive_weight)[0] > 0]
    assert_allclose(code[list(positive).index(100)], 0, atol=1e-5)
    small = [index for index in positive if abs(places[index][:2] - blocks[0, 1, :2]).max() < 10]
    assert small, "the block that no anchor fits has an anchor"
    negative = np.asarray(found.negative)[0][np.asarray(found.negative_weight)[0] > 0]
    assert not set(negative) & set(positive)
    assert len(negative) + len(positive) == 64


def test_in_a_block_to_ignore_nothing_is_sampled():
    """As with COCO's crowd regions, a box of which half or more lies in such a block is neither a block nor background."""
    config = ProposalConfig(sampled_anchors=512)
    places = anchors(64, 64, STRIDES, config.anchor_sizes_px, config.anchor_ratios)
    blocks = np.array([[[4, 4, 40, 40], [48, 48, 60, 60]]], np.float32)
    seed = keras.random.SeedGenerator(1)
    found = anchor_targets(places, blocks, np.array([[-1, 1]], np.float32), config, seed)
    sampled = np.asarray(found.positive)[0][np.asarray(found.positive_weight)[0] > 0]
    negative = np.asarray(found.negative)[0][np.asarray(found.negative_weight)[0] > 0]
    inside = np.asarray(share_inside(places, blocks[0]))[:, 0]
    assert len(negative) > 0
    assert inside[negative].max() < 0.5
    assert inside[sampled].max() < 0.5
    proposals = np.array([[[6, 6, 38, 38], [48, 48, 60, 61], [2, 44, 20, 60]]], np.float32)
    chosen = box_targets(proposals, blocks, np.array([[-1, 1]], np.float32), HeadConfig(sampled_proposals=12), seed)
    boxes = np.asarray(chosen.boxes)[0][np.asarray(chosen.weight)[0] > 0]
    assert sorted(boxes[:, 0].tolist()) == [2, 48, 48]


def test_an_image_without_blocks_gives_background_alone():
    config = ProposalConfig(sampled_anchors=64)
    places = anchors(64, 64, STRIDES, config.anchor_sizes_px, config.anchor_ratios)
    found = anchor_targets(
        places, np.zeros((1, 2, 4), np.float32), np.zeros((1, 2), np.float32), config, keras.random.SeedGenerator(1)
    )
    assert np.asarray(found.positive_weight).sum() == 0
    assert np.asarray(found.negative_weight).sum() == 64
    assert np.isfinite(np.asarray(found.code)).all()


def test_proposals_near_a_block_are_positive_and_blocks_are_proposals():
    blocks = np.array([[[10, 10, 30, 30], [50, 50, 80, 60]]], np.float32)
    proposals = np.array([[[11, 10, 31, 30], [0, 0, 0, 0], [90, 90, 99, 99], [12, 40, 20, 60]]], np.float32)
    found = box_targets(
        proposals, blocks, np.ones((1, 2), np.float32), HeadConfig(sampled_proposals=12), keras.random.SeedGenerator(3)
    )
    weight = np.asarray(found.weight)[0]
    assert found.positives == 4
    assert weight[:4].sum() == 3  # the first proposal and both blocks
    assert weight[4:].sum() == 2  # the empty proposal is none
    boxes, block = np.asarray(found.boxes)[0], np.asarray(found.block)[0]
    for place in np.flatnonzero(weight[:4]):
        assert_allclose(np.asarray(found.code)[0, place], encode(blocks[0, block[place]], boxes[place]), atol=1e-5)


def test_masks_of_boxes_are_cut_from_the_labels():
    labels = np.zeros((1, 40, 40), np.int32)
    labels[0, 10:20, 8:24] = 2
    labels[0, 20:30, 8:24] = 1
    boxes = np.array([[[10, 8, 30, 24], [10, 8, 30, 24], [0, 0, 40, 40]]], np.float32)
    found = np.asarray(mask_targets(labels, boxes, np.array([[1, 0, 1]]), 8))[0]
    assert_array_equal(found[0], np.repeat([[1], [0]], 4, axis=0) * np.ones((1, 8)))
    assert_array_equal(found[1], 1 - found[0])
    assert_allclose(found[2].mean(), 160 / 1600, atol=0.02)
