"""Training in bfloat16: compiled code computes in it, other code does not, and the losses are as in float32."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_model import SMALL, make_set

from pipeline.detection.inference import weights
from pipeline.detection.network.config import TrainConfig, TrainingConfig
from pipeline.detection.network.keras_backend import computing_precision
from scene.common.errors import InputError

_FLAGS = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
bfloat16_processor = pytest.mark.skipif("avx512_bf16" not in _FLAGS, reason="this processor has no bfloat16")


def _error_of_a_product() -> float:
    """Return the largest relative error of a compiled convolution of positive numbers."""
    import tensorflow as tf

    random = np.random.default_rng(1)
    image, kernel = random.uniform(1, 2, (2, 32, 32, 16)), random.uniform(1, 2, (3, 3, 16, 16))
    convolved = tf.function(lambda x, k: tf.nn.relu(tf.nn.conv2d(x, k, 1, "VALID")))
    exact = tf.nn.conv2d(tf.constant(image), tf.constant(kernel), 1, "VALID")
    found = convolved(tf.constant(image, tf.float32), tf.constant(kernel, tf.float32))
    return float(np.abs(np.asarray(found) / np.asarray(exact) - 1).max())


@bfloat16_processor
def test_products_have_eight_bits_inside_and_all_of_them_outside():
    with computing_precision("bfloat16"):
        assert 1e-4 < _error_of_a_product() < 1e-2
    assert _error_of_a_product() < 1e-5
    with computing_precision("float32"):
        assert _error_of_a_product() < 1e-5


def test_another_backend_is_refused(monkeypatch):
    import keras

    monkeypatch.setattr(keras.backend, "backend", lambda: "jax")
    with pytest.raises(InputError, match=r"training\.precision.*tensorflow"), computing_precision("bfloat16"):
        pass
    with computing_precision("float32"):
        pass


@bfloat16_processor
@pytest.mark.slow
def test_a_training_in_bfloat16_has_the_losses_of_one_in_float32(tmp_path):
    """They agree to a hundredth of the initial losses; weights are saved in float32."""
    from pipeline.detection.training.training import train

    make_set(tmp_path / "set" / "train", 4, 1)
    make_set(tmp_path / "set" / "val", 2, 2)
    short = {"batch": 2, "warm_up_steps": 2, "epochs": 2, "learning_rate": 1e-3}
    histories = {}
    for precision in ("float32", "bfloat16"):
        training = TrainingConfig(**short, precision=precision)
        histories[precision] = train(tmp_path / "set", TrainConfig(detector=SMALL, training=training), tmp_path / precision)
    one, other = histories["float32"], histories["bfloat16"]
    assert other.total == pytest.approx(one.total, rel=0.01)
    assert all(variable.dtype == "float32" for variable in weights.load(tmp_path / "bfloat16" / "best").weights)
