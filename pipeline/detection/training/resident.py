"""Train with the whole data set in the memory of a graphics card: windows are cut there, and all steps of an epoch are one call.

It works with JAX only. A graphics card finishes a window before a processor has read and cut the next one; here, only the losses
leave the card.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from pipeline.detection.network.boxes import Axes
from pipeline.detection.network.config import DetectorConfig, TrainingConfig
from pipeline.detection.network.data import MIRRORED, CocoFolder, network_input
from pipeline.detection.network.model import MaskRCNN, total_loss
from scene.common.errors import InputError

Array = Any
"""An array of JAX."""
Batch = dict[str, Array]
"""Inputs of the network by name for a batch of tiles, in the device's memory."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ResidentSet:
    """Training tiles in the memory of a graphics card: n tiles of s x s pixels with c channels and up to g blocks each.

    Attributes
    ----------
    images : (n, s, s, c) float16, normalised as the network takes them.
    labels : (n, s, s) uint16, 1 + the index of a pixel's block, 0 for none.
    boxes : (n, g, 4) float32 y0, x0, y1, x1 of the blocks, px; places without a block are empty.
    valid : (n, g) 1 for a block, -1 for one left out of the loss, 0 for an empty place.
    areas : (n, g) pixels of each block.
    """

    images: Array
    labels: Array
    boxes: Array
    valid: Array
    areas: Array

    @property
    def tiles(self) -> int:
        """Number of training tiles in the graphics card's memory."""
        return int(self.images.shape[0])

    @property
    def side_px(self) -> int:
        """Side of the training tiles, px."""
        return int(self.images.shape[1])


def load_resident_set(folder: CocoFolder, detector: DetectorConfig, window_px: int) -> ResidentSet:
    """Load all tiles of a folder to the memory of a graphics card; each is normalised as a whole, as in detection.

    Parameters
    ----------
    folder : The tiles.
    detector : Settings of the network's input.
    window_px : Side of the windows that will be cut from them, px.

    Raises
    ------
    InputError
        If the tiles are not squares of one size, of `window_px` or more.
    """

    def read(index: int) -> tuple[NDArray[Any], ...]:
        each = network_input(folder.labelled(index), detector)
        areas = np.bincount(each["labels"].ravel(), minlength=detector.most_blocks + 1)[1:]
        image, labels = each["image"].astype(np.float16), each["labels"].astype(np.uint16)
        return image, labels, each["boxes"], each["valid"], areas.astype(np.int32)

    shapes = sorted({(image["height"], image["width"]) for image in folder.images})
    if len(shapes) != 1 or shapes[0][0] != shapes[0][1] or shapes[0][0] < window_px:
        raise InputError(
            "the images have " + ", ".join(f"{height} x {width}" for height, width in shapes[:5]) + " px",
            where=str(folder.folder),
            allowed=f"squares of one size, {window_px} px or more, with training.data=resident",
            remedy="make the set with tiles.size_px, or train with training.data=streamed",
        )
    with ThreadPoolExecutor() as pool:
        columns = zip(*pool.map(read, range(len(folder))), strict=True)
        return ResidentSet(*(jnp.asarray(np.stack(column)) for column in columns))


def cut_on_device(data: ResidentSet, tile: Array, corner: Array, size: int) -> Batch:
    """Cut a training window out of a tile in the memory of a graphics card, as `data.cut_window` does in main memory.

    A block that the window cuts is kept if at least half of it is inside, and is background otherwise.

    Parameters
    ----------
    data : The tiles.
    tile : Index of the tile.
    corner : (2,) row and column of the window's first pixel.
    size : Side of the window, px.

    Returns
    -------
    The network's input by name, as `data.network_input` has it: `image` of the window, and its blocks.
    """
    at = (tile, corner[0], corner[1])
    image = jax.lax.dynamic_slice(data.images, (*at, 0), (1, size, size, data.images.shape[3]))[0]
    labels = jax.lax.dynamic_slice(data.labels, at, (1, size, size))[0].astype(jnp.int32)
    areas = data.areas[tile]
    inside = jnp.sum(labels[..., None] == jnp.arange(1, len(areas) + 1), axis=(0, 1))
    valid = jnp.where(2 * inside >= jnp.maximum(areas, 1), data.valid[tile], 0.0)
    kept = jnp.concatenate([jnp.zeros(1), valid]) != 0
    boxes = jnp.clip(data.boxes[tile] - jnp.concatenate([corner, corner]), 0, size)
    return {
        "image": image.astype(jnp.float32),
        "labels": jnp.where(kept[labels], labels, 0),
        "boxes": jnp.where(valid[:, None] != 0, boxes, 0.0),
        "valid": valid,
    }


def mirrored_window(window: Batch, axis: int) -> Batch:
    """Mirror a training window and its blocks, in the memory of a graphics card, to vary training images.

    window: network's input by name, as `cut_on_device` returns it. axis: 0 for up-down, 1 for left-right.
    """
    size = window["labels"].shape[0]
    low, high = window["boxes"][:, axis], window["boxes"][:, axis + 2]
    boxes = window["boxes"].at[:, axis].set(size - high).at[:, axis + 2].set(size - low)
    return {
        "image": jnp.flip(window["image"], axis),
        "labels": jnp.flip(window["labels"], axis),
        "boxes": jnp.where(window["valid"][:, None] != 0, boxes, 0.0),
        "valid": window["valid"],
    }


class ResidentLearner:
    """Trains and validates a network on tiles in the memory of a graphics card.

    Random choices depend on the training's seed and the epoch only; all other state is in the variables of model and optimizer.

    Parameters
    ----------
    model : A compiled and built model.
    learning, judging : Tiles for training and for validation.
    training : Settings of the training.
    """

    def __init__(self, model: MaskRCNN, learning: ResidentSet, judging: ResidentSet, training: TrainingConfig) -> None:
        """Compile the functions of an epoch; see the class."""
        self._model, self._learning, self._judging, self._training = model, learning, judging, training
        optimizer = model.optimizer
        self._rate = next(n for n, variable in enumerate(optimizer.variables) if variable is optimizer.learning_rate)
        self._epoch: Callable[..., Any] = jax.jit(self._steps)
        self._judged: Callable[..., Any] = jax.jit(self._losses_of_middles)

    def learn(self, epoch: int, rates: Sequence[float]) -> list[dict[str, float]]:
        """Train the network for an epoch: one step for each learning rate. Returns the mean losses by name.

        epoch: its number, on which the random windows depend. rates: learning rate of each step.
        """
        groups = self._variables()
        state = tuple([variable.value for variable in group] for group in groups)
        key = jax.random.fold_in(jax.random.key(self._training.seed), epoch)
        state, losses = self._epoch(state, self._learning, key, jnp.array(rates, jnp.float32))
        for group, values in zip(groups, state, strict=True):
            for variable, value in zip(group, values, strict=True):
                variable.assign(value)
        return [{name: float(np.mean(np.asarray(values))) for name, values in losses.items()}]

    def validate(self) -> list[dict[str, float]]:
        """Return the network's losses by name on the middle windows of all validation tiles, for each batch.

        The last batch is filled with its own first tiles.
        """
        count, size = self._judging.tiles, self._training.batch
        weights, others, _ = ([variable.value for variable in group] for group in self._variables())
        found = []
        for first in range(0, count, size):
            tiles = np.resize(np.arange(first, min(first + size, count)), size)
            found.append({k: float(v) for k, v in self._judged(weights, others, self._judging, tiles).items()})
        return found

    def _variables(self) -> tuple[list[Any], list[Any], list[Any]]:
        """Return trainable, other and optimizer variables."""
        model = self._model
        return model.trainable_variables, model.non_trainable_variables, model.optimizer.variables

    def _steps(self, state: Any, data: ResidentSet, key: Array, rates: Array) -> Any:
        """Make all steps of an epoch, on random windows of all tiles."""
        size = self._training.batch
        order, places = jax.random.split(key)
        tiles = jnp.resize(jax.random.permutation(order, data.tiles), (len(rates), size))
        return jax.lax.scan(partial(self._step, data), state, (tiles, jax.random.split(places, len(rates)), rates))

    def _step(self, data: ResidentSet, state: Any, drawn: Any) -> Any:
        """Make one training step."""
        (weights, others, optimizer), (tiles, key, rate) = state, drawn
        batch = jax.vmap(partial(self._window, data))(jax.random.split(key, len(tiles)), tiles)
        (_, (others, losses)), slopes = jax.value_and_grad(self._loss, has_aux=True)(weights, others, batch)
        optimizer = [*optimizer[: self._rate], rate, *optimizer[self._rate + 1 :]]
        weights, optimizer = self._model.optimizer.stateless_apply(optimizer, slopes, weights)
        return (list(weights), list(others), list(optimizer)), losses

    def _window(self, data: ResidentSet, key: Array, tile: Array) -> Batch:
        """Cut a random window, mirrored at random."""
        place, turn = jax.random.split(key)
        corner = jax.random.randint(place, (2,), 0, data.side_px - self._model.size + 1)
        found = cut_on_device(data, tile, corner, self._model.size)
        axes: Axes = MIRRORED[self._training.flips]
        for axis, chosen in zip(axes, jax.random.bernoulli(turn, 0.5, (len(axes),)), strict=True):
            found = jax.tree.map(partial(jnp.where, chosen), mirrored_window(found, axis), found)
        return found

    def _loss(self, weights: Any, others: Any, batch: Batch, learning: bool = True) -> Any:
        """Return the total loss, and the losses with the model's other variables."""
        losses, others = self._model.stateless_call(weights, others, batch, training=learning)
        return total_loss(losses, self._training.loss_weights), (others, losses)

    def _losses_of_middles(self, weights: Any, others: Any, data: ResidentSet, tiles: Array) -> Any:
        """Return the losses in the middles of tiles."""
        middle = jnp.full(2, (data.side_px - self._model.size) // 2)
        batch = jax.vmap(lambda tile: cut_on_device(data, tile, middle, self._model.size))(tiles)
        return self._loss(weights, others, batch, learning=False)[1][1]
