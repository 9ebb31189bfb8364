"""Keras, found or asked for, and quiet."""

from __future__ import annotations

import importlib.util
import os

from scene.errors import InputError

_MODULES = {"tensorflow": "tensorflow", "jax": "jax", "torch": "torch"}


def keras_ready() -> None:
    """Make sure that Keras can be imported, on TensorFlow unless KERAS_BACKEND says otherwise; else an InputError."""
    backend = os.environ.setdefault("KERAS_BACKEND", "tensorflow")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    missing = [name for name in ("keras", _MODULES.get(backend, backend)) if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{' and '.join(missing)} is not installed",
            where="the detector",
            remedy="install the extra: uv sync --extra detect (in a checkout), or pip install 'scarpsim[detect]'",
        )
