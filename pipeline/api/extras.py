"""Load the optional libraries, mostly of the extra `notebook`, when one of their types is needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from scene.common.errors import InputError
from scene.common.extras import how_to_install

EXTRAS = {"open3d": "poisson"}
"""Extra that installs a library; libraries not listed belong to `notebook`."""


def library(name: str) -> Any:
    """Import an optional library, such as pandas, by its name.

    Raises InputError that names the extra (optional part of scarpsim) to install if it does not load.
    """
    try:
        return import_module(name)
    except ImportError as error:
        extra = EXTRAS.get(name, "notebook")
        raise InputError(
            f"this function needs the package {name}, which does not load ({error})",
            where="Python interface",
            remedy=how_to_install(extra),
        ) from None
