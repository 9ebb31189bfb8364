"""Load what other packages add through entry points: wall styles, readers, scanners, configs (effects: see sensors/effects)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib.metadata import entry_points
from typing import Any

from scene.common.errors import InputError


def load_plug_ins(group: str, needs: str, is_one: Callable[[Any], bool], taken: Collection[str]) -> dict[str, Any]:
    """Load the plug-ins that installed packages offer as entry points of a group ("name = package.module:object").

    Parameters
    ----------
    group : str
        Name of the entry point group.
    needs : str
        What an object has to be, in words, for error messages.
    is_one : callable
        Tells whether a loaded object is of that kind.
    taken : collection of str
        Names that are already in use.

    Returns
    -------
    dict
        The objects by name, in alphabetical order.

    Raises
    ------
    InputError
        If an object cannot be loaded or is of another kind, or if its name is already in use.
    """
    found: dict[str, Any] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        where = f"entry point '{entry.name} = {entry.value}' of {group}"
        if entry.name in taken or entry.name in found:
            raise InputError(
                f"the name '{entry.name}' is already in use",
                where=where,
                remedy="choose another name in the entry point of this package",
            )
        try:
            value = entry.load()
        except Exception as error:  # the code of another package fails in any way
            raise InputError(
                f"the plug-in does not load ({type(error).__name__}: {error})",
                where=where,
                remedy="repair or uninstall the package that provides this plug-in",
            ) from error
        if not is_one(value):
            raise InputError(
                f"the plug-in is an object of the type {type(value).__name__}",
                where=where,
                allowed=needs,
                remedy="correct the entry point in the package that provides the plug-in",
            )
        found[entry.name] = value
    return found
