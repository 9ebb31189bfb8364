"""`--set a.b=c`: single values of a config, given on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import yaml

from scene.common.errors import InputError
from scene.common.yaml_text import parse_yaml


@dataclass(frozen=True)
class Override:
    """A value for a place of a config. path: keys, and indices into lists counted from 0; text: as it was given."""

    path: tuple[str, ...]
    value: Any
    text: str


def read_override(text: str) -> Override:
    """The override that `key.path=value` stands for.

    The value is read as YAML: a number, true or false, null, a text, or a collection such as [1, 2] or {a: 1}. Raises
    InputError where the text is malformed.
    """
    key, equals, value = text.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    where, remedy = f"--set {text}", "write --set section.key=value"
    if not equals:
        raise InputError("has no '='", where=where, remedy=remedy)
    if not all(path):
        raise InputError("a part of the key is empty", where=where, remedy=remedy)
    if not value.strip():
        raise InputError("has no value", where=where, remedy=f"write {key}=null for none, {key}='\"\"' for an empty text")
    try:
        return Override(path, parse_yaml(value), text)
    except yaml.YAMLError as error:
        problem = getattr(error, "problem", None) or error
        raise InputError(f"the value is not valid YAML ({problem})", where=where, remedy="put a text in quotes") from None


def apply_overrides(values: dict[str, Any], overrides: Sequence[str | Override]) -> dict[str, Any]:
    """A copy of the config `values` with each override, `key.path=value`, put into its place, in the order given.

    Sections that are not there yet are made; whether a key exists is for the config model to say. Raises InputError where an
    override is malformed or leads through a plain value or past a list's end.
    """
    result = deepcopy(values)
    for given in overrides:
        override = read_override(given) if isinstance(given, str) else given
        _put(result, override.path, deepcopy(override.value), where=f"--set {override.text}")
    return result


def _put(root: dict[str, Any], path: tuple[str, ...], value: Any, where: str) -> None:
    container: Any = root
    for depth, part in enumerate(path[:-1]):
        place = _place(container, part, ".".join(path[:depth]), where)
        if isinstance(container, dict) and container.get(place) is None:
            container[place] = {}  # an absent or empty section
        container = container[place]
    container[_place(container, path[-1], ".".join(path[:-1]), where)] = value


def _place(container: Any, part: str, name: str, where: str) -> str | int:
    """`part` as the key or index into `container`, which stands in the config under `name`."""
    if isinstance(container, dict):
        return part
    if not isinstance(container, list):
        raise InputError(f"'{name}' is {container!r} and has no '{part}' in it", where=where)
    if not (part.isdecimal() and int(part) < len(container)):
        allowed = f"0 to {len(container) - 1}" if container else f"none, the list is empty; set it as a whole: {name}=[...]"
        raise InputError(f"'{part}' is no index of the list '{name}'", where=where, allowed=allowed)
    return int(part)
