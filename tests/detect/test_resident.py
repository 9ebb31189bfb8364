"""Training with the data set in the accelerator's memory: it sees the same windows as streamed training, learns, and resumes."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_model import make_set

from pipeline.detection.network.config import DetectorConfig, NormalisationConfig, TrainConfig, TrainingConfig
from pipeline.detection.network.data import CocoFolder, cut_window, mirrored, network_input
from scene.common.errors import InputError

FIXED = DetectorConfig(image_px=128, most_blocks=8, normalisation=NormalisationConfig(method="fixed"))


@pytest.fixture(autouse=True, scope="module")
def _network() -> None:
    """Import what needs Keras only where a test runs, as TensorFlow takes seconds to import."""
    global cut_on_device, jnp, load_resident_set, mirrored_window, train
    import jax.numpy as jnp

    from pipeline.detection.training.resident import cut_on_device, load_resident_set, mirrored_window
    from pipeline.detection.training.training import train


class _At:
    """A fake random generator that draws a given corner."""

    def __init__(self, *corner: int) -> None:
        self._left = list(corner)

    def integers(self, _low: int, _high: int) -> int:
        return self._left.pop(0)


@pytest.mark.parametrize("corner", [(0, 0), (17, 40), (64, 3)])
@pytest.mark.parametrize("axes", [(), (0,), (0, 1)])
def test_windows_are_those_of_the_streamed_training(tmp_path, corner, axes):
    """Windows cut and mirrored by NumPy and on the device agree; the device keeps block numbers, NumPy numbers them again."""
    folder = CocoFolder(make_set(tmp_path, 2, 6, blocks=4))
    expected = cut_window(folder.labelled(1), 64, _At(*corner))
    found = cut_on_device(load_resident_set(folder, FIXED, 64), jnp.int32(1), jnp.array(corner), 64)
    for axis in axes:
        expected, found = mirrored(expected, axis), mirrored_window(found, axis)
    wanted = network_input(expected, FIXED)
    assert_allclose(found["image"], wanted["image"], rtol=1e-3, atol=1e-4)  # half precision
    kept = np.flatnonzero(found["valid"])
    assert len(kept) == len(expected.boxes)
    assert_array_equal(np.asarray(found["boxes"])[kept], expected.boxes)
    numbers = np.zeros(1 + FIXED.most_blocks, int)
    numbers[kept + 1] = np.arange(1, len(kept) + 1)
    assert_array_equal(numbers[np.asarray(found["labels"])], expected.labels)


def test_blocks_to_ignore_stay_so(tmp_path):
    make_set(tmp_path, 1, 6, blocks=2)
    path = tmp_path / "annotations.json"
    content = json.loads(path.read_text())
    content["annotations"][1]["ignore"] = 1
    path.write_text(json.dumps(content))
    data = load_resident_set(CocoFolder(tmp_path), FIXED, 64)
    assert_array_equal(np.asarray(data.valid)[0, :3], [1, -1, 0])


def test_tiles_that_are_too_small_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"64 x 64 px.*96 px or more.*streamed"):
        load_resident_set(CocoFolder(make_set(tmp_path, 1, 6, side=64, blocks=1)), FIXED, 96)


def test_another_backend_is_refused(tmp_path):
    for part in ("train", "val"):
        make_set(tmp_path / "set" / part, 1, 6, side=64, blocks=1)
    config = TrainConfig(detector=DetectorConfig(image_px=64), training=TrainingConfig(data="resident"))
    with pytest.raises(InputError, match="KERAS_BACKEND=jax"):
        train(tmp_path / "set", config, tmp_path / "out")


_LEARNED = """
from pathlib import Path

from pipeline.detection.network.keras_backend import import_keras

import_keras()
import keras
import numpy as np
from keras import ops

from pipeline.detection.network.config import DetectorConfig, NormalisationConfig, TrainingConfig
from pipeline.detection.network.data import CocoFolder
from pipeline.detection.network.model import LOSSES
from pipeline.detection.training.resident import ResidentLearner, load_resident_set


class Darkest(keras.Model):
    # Tells pixels of blocks from others by a line, noise of its own in it; the losses that it has not are nought.
    def __init__(self):
        super().__init__()
        self.size, self.samples = 64, keras.random.SeedGenerator(1)
        self.line = keras.layers.Dense(1)
        self.line.build((None, 2))
        self.built = True

    def call(self, inputs, training=False):
        logits = self.line(inputs["image"])[..., 0]
        logits = logits + 0.1 * keras.random.normal(ops.shape(logits), seed=self.samples)
        wanted = ops.cast(inputs["labels"] > 0, "float32")
        mask = ops.mean(ops.binary_crossentropy(wanted, ops.sigmoid(logits)))
        return {name: mask if name == "mask" else ops.zeros(()) for name in LOSSES}


detector = DetectorConfig(image_px=128, most_blocks=4, normalisation=NormalisationConfig(method="fixed"))
model = Darkest()
model.compile(optimizer=keras.optimizers.AdamW(3e-3, global_clipnorm=5.0))
model.optimizer.build(model.trainable_variables)
data = [load_resident_set(CocoFolder(Path(part)), detector, 64) for part in ("train", "val")]
learner = ResidentLearner(model, *data, TrainingConfig(batch=2, crop_px=64, data="resident"))
variables = [*model.variables, *model.optimizer.variables]
losses, kept, judged = [], [], []
for epoch in range(4):
    losses += learner.learn(epoch, [0.1] * 8)
    judged.append(learner.validate())
    kept.append([keras.ops.convert_to_numpy(variable) for variable in variables])
assert [len(each) for each in judged] == [2] * 4
means = [np.mean([batch["mask"] for batch in each]) for each in judged]
assert means[3] < 0.5 * means[0], means
assert losses[3]["mask"] < 0.5 * losses[0]["mask"], losses
for variable, value in zip(variables, kept[1], strict=True):
    variable.assign(value)
assert [learner.learn(epoch, [0.1] * 8)[0] for epoch in (2, 3)] == losses[2:]
assert all(np.array_equal(variable, value) for variable, value in zip(variables, kept[3], strict=True))
still = [keras.ops.convert_to_numpy(variable) for variable in model.trainable_variables]
learner.learn(4, [0.0] * 8)
assert all(np.array_equal(variable, value) for variable, value in zip(model.trainable_variables, still, strict=True))
"""


def test_it_learns_and_goes_on_as_if_nothing_had_been(tmp_path):
    """JAX trains a network of three numbers, which compiles fast, in a process of its own.

    32 steps halve the losses of both sets; resumed from the state after 16 steps, training ends with the same numbers; with
    learning rate zero the weights stay. (Mask R-CNN itself was trained this way on a GPU: docs/validation/detector.md.)
    """
    for part, count in (("train", 16), ("val", 3)):
        make_set(tmp_path / part, count, 6, blocks=2)
    environment = {**os.environ, "KERAS_BACKEND": "jax"}
    ended = subprocess.run(
        [sys.executable, "-c", _LEARNED], cwd=tmp_path, env=environment, timeout=600, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
