"""Write a config as YAML that shows every key: those that a file sets are active, all others are comments with their defaults.

A line `#key: value` becomes active when the `#` is removed; explanations begin with `# `.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from scene.common.yaml_text import yaml_line

_WIDTH = 120
_INDENT = "  "
_SMALL = 2
"""A section with at most so many keys, inside another one and all default, takes one line."""
_ABSENT: Any = object()
"""Marks a key that the file does not set."""
_HOW_TO = "# A key after `#` has the value that is shown; take the `#` away, and that of the section it is in, to change it."
_UNITS = {
    "m": "m",
    "m2": "m²",
    "m3": "m³",
    "mm": "mm",
    "um": "µm",
    "nm": "nm",
    "rad": "rad",
    "deg": "degrees",
    "px": "pixels",
    "s": "s",
    "hz": "Hz",
    "ppm": "ppm",
}
"""Units by the last part of a key."""
_BOUNDS = {"ge": "from {}", "gt": "above {}", "le": "up to {}", "lt": "below {}", "min_length": "at least {} entries"}
"""Words for the limits of a value."""


def commented_yaml(config: BaseModel, own: Mapping[str, Any]) -> str:
    """Write a config as YAML that loads into the same config, each key with its meaning, unit and limits as a comment.

    config: the checked config. own: the keys and values of the config file from which it was made. Only these are
    active. All other keys are comments with their defaults, which remain valid when their `#` is removed.
    """
    title = _first_line(type(config))
    return "\n".join([f"# {title}" if title else "", _HOW_TO, "", *_section(config, own, 0)]).strip("\n") + "\n"


def _section(config: BaseModel, own: Mapping[str, Any], depth: int) -> Iterator[str]:
    """Yield the lines of a section. Short forms in `own` (keys that the config replaces by others) come first."""
    fields = type(config).model_fields
    for name in own:
        if name not in fields:
            yield f"{_INDENT * depth}{name}: {yaml_line(own[name])}"
    for name, field in fields.items():
        value = getattr(config, name)
        lines = list(_entry(name, value, own.get(name, _ABSENT), depth, _comment(name, field, value)))
        yield from ["", *lines] if depth == 0 and len(lines) > 1 else lines


def _entry(name: str, value: Any, own: Any, depth: int, words: str = "") -> Iterator[str]:
    """Yield the lines of a key with its value. own: what the file has for it, or `_ABSENT`, which makes it a comment."""
    live = own is not _ABSENT and own not in ({}, [], ())
    start = f"{_INDENT * depth}{'' if live else '#'}"
    if isinstance(value, BaseModel) and not _in_one_line(value, own, depth):
        yield from _explained(f"{start}{name}:", words, depth)
        yield from _section(value, own if live else {}, depth + 1)
    elif isinstance(value, list | tuple) and value and all(isinstance(item, BaseModel) for item in value):
        yield from _explained(f"{start}{name}:", words, depth)
        yield from _items(value, own if live else (), depth + 1)
    else:
        written = own if live and isinstance(value, BaseModel) else value
        yield from _explained(f"{start}{name}: {yaml_line(_plain(written))}", words, depth)


def _items(sections: Sequence[BaseModel], own: Any, depth: int) -> Iterator[str]:
    """Yield the lines of a list of sections; those that the file does not have are comments."""
    listed = [own] if isinstance(own, Mapping) else own
    for number, section in enumerate(sections):
        live = number < len(listed)
        yield f"{_INDENT * depth}{'' if live else '#'}-"
        yield from _section(section, listed[number] if live else {}, depth + 1)


def _in_one_line(section: BaseModel, own: Any, depth: int) -> bool:
    """Return whether a section is written as in the file (a number, a name), or is small enough for one line."""
    fields = type(section).model_fields
    return not fields or (depth > 0 and len(fields) <= _SMALL if own is _ABSENT else not isinstance(own, Mapping))


def _explained(line: str, words: str, depth: int) -> Iterator[str]:
    """Yield a line with its comment behind it, or above it if that is too long."""
    whole = f"{line}  # {words}"
    if words and len(whole) > _WIDTH:
        start = f"{_INDENT * depth}# "
        yield from textwrap.wrap(words, _WIDTH, initial_indent=start, subsequent_indent=start)
    yield whole if words and len(whole) <= _WIDTH else line


def _plain(value: Any) -> Any:
    """Convert a value to YAML's own types."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _comment(name: str, field: FieldInfo, value: Any) -> str:
    """Return the comment of a key: meaning, unit, limits, choices and default."""
    told = _description(field, value)
    parts = [told, "" if _has_unit(told, name) else _UNITS.get(_ending(name), ""), _bounds(field), _choices(field.annotation)]
    default = field.default
    if default is not PydanticUndefined and default != value and not isinstance(default, BaseModel):
        parts.append(f"default {yaml_line(_plain(default))}")
    return "; ".join(part for part in parts if part)


def _ending(name: str) -> str:
    """Return the last part of a key, which states the unit."""
    return name.rpartition("_")[2] if "_" in name else ""


def _has_unit(description: str, name: str) -> bool:
    """Return whether a description states the unit of its key."""
    return _ending(name) in re.findall(r"[\w']+", description) or description.endswith("]")


def _description(field: FieldInfo, value: Any) -> str:
    """Return the description of a field, or else that of its section."""
    told = field.description or (_first_line(type(value)) if isinstance(value, BaseModel) else "")
    return told.rstrip(".")


def _first_line(section: type[BaseModel]) -> str:
    """Return the first line of a section's docstring."""
    return (section.__doc__ or "").strip().partition("\n")[0]


def _bounds(field: FieldInfo) -> str:
    """Return the limits of a value in words."""
    found = [form.format(getattr(item, key)) for item in field.metadata for key, form in _BOUNDS.items() if hasattr(item, key)]
    return " ".join(found)


def _choices(annotation: Any) -> str:
    """Return the words that a Literal or an enumeration allows, or the kinds of sections of a union."""
    if get_origin(annotation) is Literal:
        words = [str(word) for word in get_args(annotation)]
        return f"one of {', '.join(words)}" if len(words) > 1 else ""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return f"one of {', '.join(str(member.value) for member in annotation)}"
    named = dict.fromkeys(kind for option in _sections(annotation) if (kind := _kind(option)))
    return f"kinds: {', '.join(named)}" if len(named) > 1 else ""


def _sections(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the config models that an annotation allows, in its order."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _sections(inner)


def _kind(section: type[BaseModel]) -> str:
    """Return the word that distinguishes a section within a union (its only field with one allowed word), or ""."""
    for name, field in section.model_fields.items():
        if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1:
            return f"{name}={get_args(field.annotation)[0]}"
    return ""
