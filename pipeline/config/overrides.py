"""Apply `--set a.b=c`: single values of a config, given on the command line."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, TypeVar

import yaml

from scene.common.errors import InputError
from scene.common.yaml_text import parse_yaml

ConfigT = TypeVar("ConfigT")


@dataclass(frozen=True)
class Override:
    """A new value for one key of a config, as `--set` gives it.

    path: names of the keys from the outermost on, and list indices from 0. value: the new value. text: the override as the user
    gave it, for errors.
    """

    path: tuple[str, ...]
    value: Any
    text: str


def read_override(text: str) -> Override:
    """Parse the text of a `--set` option, `key.path=value`, which changes a key of a config.

    The value is read as YAML: a number, true or false, null, a text, or a collection such as [1, 2] or {a: 1}. Raises
    InputError if the text is malformed.
    """
    key, equals, value = text.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    where = f"--set {text}"
    if not equals:
        raise InputError("the override has no '='", where=where, remedy="write --set section.key=value")
    if not all(path):
        raise InputError("a part of the key is empty", where=where, remedy="write --set section.key=value")
    if not value.strip():
        raise InputError("the key has no value", where=where, remedy=f"write {key}=null for none, {key}='\"\"' for an empty text")
    try:
        return Override(path, parse_yaml(value), text)
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or error
        raise InputError(
            f"the value is not valid YAML ({problem})",
            where=where,
            remedy="correct the value, and put a text with special characters in quotes",
        ) from None


def read_with_overrides(
    read: Callable[[Sequence[str | Override]], ConfigT], overrides: Sequence[str | Override], file: str
) -> ConfigT:
    """Read a config with overrides, and name the `--set` options in the error if they caused it.

    Parameters
    ----------
    read : callable
        Reads the config with the overrides that it is given. Raises InputError.
    overrides : sequence of str or Override
        The changes. Those that are text were given as `--set`.
    file : str
        The config file, as errors of `read` name it.

    Returns
    -------
    The config that `read` returns.

    Raises
    ------
    InputError
        As `read`. If the file is valid without the overrides, the message names the options that make it invalid.
    """

    def is_wrong(changes: Sequence[str | Override]) -> bool:
        try:
            read(changes)
        except InputError:
            return True
        return False

    try:
        return read(overrides)
    except InputError as error:
        given, fixed = ([each for each in overrides if isinstance(each, str) is text] for text in (True, False))
        if not given or error.where.startswith("--set ") or is_wrong(fixed):
            raise
        options = ", ".join(f"--set {each}" for each in [each for each in given if is_wrong([*fixed, each])] or given)
        where = error.where.replace(file, options) if file in error.where else f"{options}: {error.where}"
        raise InputError(error.what, where=where, allowed=error.allowed, remedy=error.remedy) from None


def apply_overrides(values: dict[str, Any], overrides: Sequence[str | Override]) -> dict[str, Any]:
    """Return a copy of a config's values with changes (overrides) applied in order, as `--set key.path=value` asks for them.

    values: content of the config file. overrides: the changes. Missing sections are created; whether a key exists is
    checked later. Raises InputError if an override is malformed, names a key inside a value that is no section, or an
    index beyond a list's end.
    """
    result = deepcopy(values)
    for given in overrides:
        override = read_override(given) if isinstance(given, str) else given
        _put(result, override.path, deepcopy(override.value), where=f"--set {override.text}")
    return result


def _put(root: dict[str, Any], path: tuple[str, ...], value: Any, where: str) -> None:
    """Set one value, and create missing sections."""
    container: Any = root
    for depth, part in enumerate(path[:-1]):
        place = _place(container, part, ".".join(path[:depth]), where)
        if isinstance(container, dict) and container.get(place) is None:
            container[place] = {}  # a missing or empty section
        container = container[place]
    container[_place(container, path[-1], ".".join(path[:-1]), where)] = value


def _place(container: Any, part: str, name: str, where: str) -> str | int:
    """Return `part` as key or index into `container`, which the config has under `name`."""
    if isinstance(container, dict):
        return part
    if not isinstance(container, list):
        raise InputError(
            f"'{name}' is the value {container!r}, which contains no key '{part}'",
            where=where,
            remedy=f"remove '{part}' from the key, or set '{name}' as a whole",
        )
    if not (part.isdecimal() and int(part) < len(container)):
        allowed = f"0 to {len(container) - 1}" if container else f"none, the list is empty; set it as a whole: {name}=[...]"
        raise InputError(
            f"'{part}' is not an index of the list '{name}'",
            where=where,
            allowed=allowed,
            remedy="write the number of an entry, from 0",
        )
    return int(part)
