"""What other packages add, found by entry points: wall styles, readers, scanners, other configs (effects: sensors/effects)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib.metadata import entry_points
from typing import Any

from scene.common.errors import InputError


def plugged(group: str, needs: str, is_one: Callable[[Any], bool], taken: Collection[str]) -> dict[str, Any]:
    """What the entry points of a group name ("name = package.module:object"), in the order of their names.

    needs: what an object has to be, in words, is_one whether it is; taken: names that there are already. Raises InputError for
    one that does not load, is something else, or has a name that is taken.
    """
    found: dict[str, Any] = {}
    for entry in sorted(entry_points(group=group), key=lambda entry: entry.name):
        where = f"entry point '{entry.name} = {entry.value}' of {group}"
        if entry.name in taken or entry.name in found:
            raise InputError(f"there is a '{entry.name}' already", where=where, remedy="choose another name for it")
        try:
            value = entry.load()
        except Exception as error:  # the code of another package fails in any way
            problem = f"does not load ({type(error).__name__}: {error})"
            raise InputError(problem, where=where, remedy="mend or uninstall that package") from error
        if not is_one(value):
            raise InputError(f"is a {type(value).__name__}", where=where, allowed=needs)
        found[entry.name] = value
    return found
