"""Import Keras on its backend, and set the precision of its computations."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from scene.common.errors import InputError
from scene.common.extras import how_to_install
from scene.common.native_output import suppress_stderr

_MODULES = {"tensorflow": "tensorflow", "jax": "jax", "torch": "torch"}
"""Python module of each backend."""


def import_keras() -> None:
    """Import Keras, on TensorFlow unless KERAS_BACKEND names another backend; raise InputError if one of them is not installed.

    TensorFlow writes to stderr during its import, whatever its log level. This output is dropped and the log level set to errors,
    unless TF_CPP_MIN_LOG_LEVEL is set; 0 there shows everything.

    oneDNN's convolutions are enabled unless TF_ENABLE_ONEDNN_OPTS is set. TensorFlow by default uses them only on processors with
    instructions for neural networks (AVX-512 VNNI), although they are faster on others too.
    """
    check_installed()
    os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "1")
    if os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3") != "0":
        with suppress_stderr():
            importlib.import_module("keras")


def check_installed() -> str:
    """Return the name of the library on which Keras computes (its backend), such as tensorflow.

    Raises InputError if it, or Keras, is not installed.
    """
    backend = os.environ.get("KERAS_BACKEND") or "tensorflow"
    os.environ["KERAS_BACKEND"] = backend
    if backend not in _MODULES:
        raise InputError(
            f"the backend '{backend}' is unknown",
            where="KERAS_BACKEND",
            allowed=", ".join(_MODULES),
            remedy="set the variable to one of these names",
        )
    missing = [name for name in ("keras", _MODULES[backend]) if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed",
            where="the detector",
            remedy=how_to_install("detect"),
        )
    return backend


@contextmanager
def computing_precision(precision: Literal["float32", "bfloat16"]) -> Iterator[None]:
    """Within the `with` block, let compiled functions compute convolutions and products in a precision; variables stay float32.

    precision: bfloat16 is faster on some processors. Raises InputError for it on another backend than TensorFlow.
    """
    if precision == "float32":
        yield
        return
    import keras

    backend = keras.backend.backend()
    if backend != "tensorflow":
        raise InputError(
            f"bfloat16 does not work with KERAS_BACKEND={backend}",
            where="training.precision",
            allowed="bfloat16 on tensorflow, float32 on every backend",
            remedy="set training.precision to float32, or KERAS_BACKEND to tensorflow",
        )
    import tensorflow as tf

    option = "auto_mixed_precision_onednn_bfloat16"
    tf.config.optimizer.set_experimental_options({option: True})
    try:
        yield
    finally:
        tf.config.optimizer.set_experimental_options({option: False})
