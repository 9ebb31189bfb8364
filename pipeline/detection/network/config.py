"""The config of a detector and of its training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from pipeline.config.overrides import Override, apply_overrides, read_with_overrides
from scene.common.config import Config, load_yaml, parse

CHECKPOINT, BEST, STAGE, EVENTS, CURVES = "checkpoint", "best", "stage", "events", "losses.png"
"""Names of what a training writes into its folder."""
Mirroring = Literal["none", "left_right", "both"]
Loss = Literal["proposal_class", "proposal_box", "class", "box", "mask"]


class NormalisationConfig(Config):
    """How a difference map, m, becomes the network's input.

    `minmax` maps the valid pixels of each image to 0...1, and so loses the size of a difference. `fixed` gives asinh(d /
    scale_m), `level_of_detection` asinh(d / (1.96 NMAD of the image)); both keep the size of a difference d, in metres or in
    multiples of the level of detection. Pixels without data become 0 (`minmax`: the image's median).
    """

    method: Literal["minmax", "fixed", "level_of_detection"] = Field("fixed", description="how values are scaled")
    scale_m: float = Field(0.05, ge=1e-6, le=1e6, description="difference that becomes asinh(1) = 0.88; for `fixed`")
    validity_channel: bool = Field(True, description="add a second channel: 1 where there is data, 0 elsewhere")

    @property
    def channels(self) -> int:
        """Number of channels of the network's input: 1 for the differences, and 1 for where there is data, if that is added."""
        return 2 if self.validity_channel else 1


class ProposalConfig(Config):
    """Settings of the region proposal network, which finds boxes that may contain a block (Ren et al. 2015)."""

    anchor_sizes_px: tuple[Annotated[float, Field(gt=0, le=1e4)], ...] = Field(
        (8, 16, 32, 64, 128), min_length=5, max_length=5, description="one per pyramid level"
    )
    anchor_ratios: tuple[Annotated[float, Field(ge=0.01, le=100)], ...] = Field(
        (0.5, 1.0, 2.0), min_length=1, max_length=12, description="height over width"
    )
    convolution_px: Literal[1, 3] = Field(3, description="side of the head's hidden convolution; 1 needs a ninth of the time")
    positive_iou: float = Field(0.6, gt=0, le=1, description="IoU with a block from which an anchor is positive")
    negative_iou: float = Field(0.3, ge=0, lt=1, description="IoU with every block below which an anchor is background")
    sampled_anchors: int = Field(
        256, ge=4, le=100_000, description="anchors per image in the loss, at most half of them positive"
    )
    candidates: int = Field(1000, ge=1, le=5000, description="best anchors per image that enter the suppression")
    suppression_iou: float = Field(0.7, gt=0, le=1, description="IoU above which only the better of two proposals stays")
    proposals: int = Field(256, ge=1, le=5000, description="proposals per image after the suppression")


class HeadConfig(Config):
    """Settings of the network's heads, which classify proposed boxes and draw masks (He et al. 2017), and of detection."""

    mask_size_px: Literal[28, 56, 112] = Field(56, description="side of a mask within its box")
    sampled_proposals: int = Field(96, ge=3, le=5000, description="proposals per image in the loss, a third of them positive")
    positive_iou: float = Field(0.5, gt=0, le=1, description="IoU with a block from which a proposal is positive")
    hidden_units: int = Field(256, ge=1, le=8192, description="units of the two dense layers of the box head")
    detections: int = Field(150, ge=1, le=5000, description="largest number of blocks detected in one image")
    suppression_iou: float = Field(0.4, gt=0, le=1, description="IoU above which only the better of two detections stays")
    mask_margin_px: float = Field(
        1.0,
        ge=0,
        le=64,
        description="margin around a detection's box in which its mask is predicted, so that a slightly too small box does not "
        "cut it; used in detection only",
    )
    mirrored: Mirroring = Field(
        "none",
        description="mirrored views over which `detect --mirrored` averages, besides the map itself: left-right, or left-right, "
        "up-down and both ways; used in detection only, see training.flips",
    )
    score_shift: float = Field(
        0.0,
        ge=-100,
        le=100,
        description="added to the log odds of a block; set by `scarpsim train` so that a score of 0.95 gives the largest F1",
    )
    score_per_doubling: float = Field(
        0.0,
        ge=-100,
        le=100,
        description="added to the log odds for each doubling of a box's side above 16 px, subtracted for each halving; set "
        "by `scarpsim train` together with score_shift",
    )
    mirrored_score_shift: float | None = Field(
        None, ge=-100, le=100, description="score_shift with mirrored views (null: the same); set by `scarpsim train`"
    )
    mirrored_score_per_doubling: float | None = Field(
        None, ge=-100, le=100, description="score_per_doubling with mirrored views (null: the same); set by `scarpsim train`"
    )

    @property
    def shifts(self) -> tuple[float, float]:
        """What detection adds to the log odds of a block of 16 px, and for each doubling of its side, to calibrate scores.

        If `mirrored` names views, these are the values that were fitted with them.
        """
        if self.mirrored == "none":
            return self.score_shift, self.score_per_doubling
        shift, slope = self.mirrored_score_shift, self.mirrored_score_per_doubling
        return self.score_shift if shift is None else shift, self.score_per_doubling if slope is None else slope


class DetectorConfig(Config):
    """Settings of the network, a Mask R-CNN with a feature pyramid (He et al. 2017, Lin et al. 2017).

    `normalisation` has the settings of its input, `proposal` of the search for boxes that may hold a block, and `head` of the
    parts that classify these boxes and draw masks.
    """

    backbone: Literal["fine", "light", "resnet50", "resnet101"] = Field(
        "light", description="light and fine suit CPUs; fine suits blocks of a few pixels"
    )
    pyramid_channels: int = Field(
        64, ge=8, le=1024, multiple_of=8, description="channels of the feature pyramid and of the heads; 256 in the papers"
    )
    image_px: int = Field(512, ge=64, le=4096, multiple_of=64, description="side of the network's images")
    most_blocks: int = Field(100, ge=1, le=5000, description="largest number of blocks in one training image")
    normalisation: NormalisationConfig = NormalisationConfig()
    proposal: ProposalConfig = ProposalConfig()
    head: HeadConfig = HeadConfig()

    @property
    def strides(self) -> tuple[int, ...]:
        """Distance of neighbouring features in each level of the feature pyramid, P2 to P6, px of the image.

        Larger blocks are detected in levels with larger distances.
        """
        finest = 2 if self.backbone == "fine" else 4
        return tuple(finest << level for level in range(5))


class TrainingConfig(Config):
    """Settings of the training of a detector."""

    start: str | None = Field(
        None, min_length=1, description="initial weights: a trained detector's folder, or default (null: random)"
    )
    epochs: int = Field(350, ge=1, le=100_000, description="largest number of passes over the training images")
    batch: int = Field(2, ge=1, le=1024, description="images per step")
    optimizer: Literal["adamw", "sgd"] = Field("adamw", description="sgd has a momentum of 0.9")
    learning_rate: float = Field(1e-3, gt=0, le=100, description="after the warm-up")
    schedule: Literal["constant", "cosine"] = Field("cosine", description="cosine decays to a hundredth over the epochs")
    warm_up_steps: int = Field(200, ge=0, le=10**9, description="steps over which the learning rate rises from zero")
    weight_decay: float = Field(1e-4, ge=0, le=1000, description="decay of the weights towards zero")
    clip_norm: float = Field(5.0, gt=0, le=1e9, description="largest norm of the gradient")
    loss_weights: dict[Loss, Annotated[float, Field(gt=0, le=1e6)]] = Field(
        {},
        description="factors of the losses (proposal_class, proposal_box, class, box, mask) in their sum; 1 for those not listed",
    )
    precision: Literal["float32", "bfloat16"] = Field(
        "float32",
        description="bfloat16: convolutions and products with 8 bits of mantissa, weights and losses in float32; faster on "
        "processors that support it (avx512_bf16, amx); TensorFlow only",
    )
    flips: bool | Literal["left_right"] = Field(
        True, description="mirror images at random: left-right and up-down (true), left-right only, or not (false)"
    )
    crop_px: int | None = Field(
        None, ge=64, multiple_of=64, description="train on random windows of this side (default: whole images)"
    )
    data: Literal["streamed", "resident"] = Field(
        "streamed",
        description="streamed: tiles are read and windows cut while the network trains on the previous ones; resident: all tiles "
        "are kept in the memory of a graphics card and windows are cut there, needs KERAS_BACKEND=jax",
    )
    stop_window: int = Field(
        10, ge=2, le=100_000, description="epochs over which the decrease of the validation loss is averaged"
    )
    stop_slope: float = Field(
        0.0, ge=0, description="stop when the validation loss decreases by less than this per epoch; 0: never"
    )
    keep_epochs: int = Field(
        0,
        ge=0,
        description="also keep the detector every so many epochs, in folders stage_0004, ... (0: only the best and the last)",
    )
    seed: int = Field(
        1,
        ge=0,
        lt=2**63,
        description="seed of the initial weights, of the order and mirroring of images, and of the random choice of proposals",
    )


class TrainConfig(Config):
    """Settings of a detector and its training, as `scarpsim train --config` reads them."""

    detector: DetectorConfig = DetectorConfig()
    training: TrainingConfig = TrainingConfig()

    @model_validator(mode="after")
    def _check_crop(self) -> TrainConfig:
        crop = self.training.crop_px
        if crop is not None and crop > self.detector.image_px:
            raise ValueError(f"training.crop_px must not exceed detector.image_px ({self.detector.image_px})")
        return self


def load_train_config(path: Path, overrides: Sequence[str] = ()) -> TrainConfig:
    """Read the config of a detector and its training.

    path: YAML file. overrides: changes of its values, `key.path=value`. Raises InputError for any mistake.
    """
    values = load_yaml(path) or {}

    def read(changes: Sequence[str | Override]) -> TrainConfig:
        return parse(TrainConfig, apply_overrides(values, changes) if isinstance(values, dict) else values, where=str(path))

    return read_with_overrides(read, overrides, str(path))
