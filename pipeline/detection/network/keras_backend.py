"""Keras, found or asked for, and quiet."""

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


def keras_ready() -> None:
    """Import Keras, on TensorFlow unless KERAS_BACKEND says otherwise; raises InputError where one of them is not installed.

    TensorFlow writes some lines to stderr while it is imported, whatever the level of its log. They are dropped, and the level
    is set to errors alone, unless TF_CPP_MIN_LOG_LEVEL is set to another: with 0 there TensorFlow says everything.

    Its convolutions are oneDNN's unless TF_ENABLE_ONEDNN_OPTS says otherwise: by itself TensorFlow takes them only where the
    processor has instructions for neural networks (AVX-512 VNNI), though they are faster without these too.
    """
    check_installed()
    os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "1")
    if os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3") != "0":
        with suppress_stderr():
            importlib.import_module("keras")


def check_installed() -> str:
    """The library that Keras computes with; raises InputError where it, or Keras, is not installed."""
    backend = os.environ.get("KERAS_BACKEND") or "tensorflow"
    os.environ["KERAS_BACKEND"] = backend
    if backend not in _MODULES:
        raise InputError(f"is '{backend}'", where="KERAS_BACKEND", allowed=", ".join(_MODULES), remedy="set it to one of them")
    missing = [name for name in ("keras", _MODULES[backend]) if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not installed",
            where="the detector",
            remedy=how_to_install("detect"),
        )
    return backend


@contextmanager
def computing_in(precision: Literal["float32", "bfloat16"]) -> Iterator[None]:
    """Compiled functions called in the body compute convolutions and products in that precision; variables stay float32.

    Raises InputError for bfloat16 on another backend than TensorFlow.
    """
    if precision == "float32":
        yield
        return
    import keras

    backend = keras.backend.backend()
    if backend != "tensorflow":
        raise InputError(
            f"is bfloat16 with KERAS_BACKEND={backend}",
            where="training.precision",
            allowed="bfloat16 on tensorflow, float32 on every backend",
        )
    import tensorflow as tf

    option = "auto_mixed_precision_onednn_bfloat16"
    tf.config.optimizer.set_experimental_options({option: True})
    try:
        yield
    finally:
        tf.config.optimizer.set_experimental_options({option: False})
