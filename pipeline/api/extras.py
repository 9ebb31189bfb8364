"""Libraries of the extra `notebook`, loaded where one of their types is asked for."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from scene.common.errors import InputError
from scene.common.extras import how_to_install

EXTRAS = {"open3d": "poisson"}
"""The extra of a library; of all others it is `notebook`."""


def library(name: str) -> Any:
    """The module `name` of an optional library; raises InputError that names the extra where it does not load."""
    try:
        return import_module(name)
    except ImportError as error:
        extra = EXTRAS.get(name, "notebook")
        raise InputError(
            f"needs {name}, which does not load ({error})",
            where="Python interface",
            remedy=how_to_install(extra),
        ) from None
