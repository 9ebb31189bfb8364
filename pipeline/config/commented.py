"""A config as YAML that shows every key: those of a file of one's own live, all others as comments with their defaults.

A line `#key: value` is a key that can be had by taking the `#` away; what is to be read begins with `# `.
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
"""A section of no more keys, inside another and all default, takes one line."""
_ABSENT: Any = object()
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
"""The units that a key's last part stands for."""
_BOUNDS = {"ge": "from {}", "gt": "above {}", "le": "up to {}", "lt": "below {}", "min_length": "at least {} entries"}


def commented_yaml(config: BaseModel, own: Mapping[str, Any]) -> str:
    """The config as YAML that loads into the same config, each key with what it is, its unit and its bounds.

    own: the keys and values, as in a file, that `config` was made of; they are live, the others are comments that stay right
    when their `#` is taken away.
    """
    title = _first_line(type(config))
    return "\n".join([f"# {title}" if title else "", _HOW_TO, "", *_section(config, own, 0)]).strip("\n") + "\n"


def _section(config: BaseModel, own: Mapping[str, Any], depth: int) -> Iterator[str]:
    """The section's lines; short forms in `own`, keys that the config resolves to others, come first."""
    fields = type(config).model_fields
    for name in own:
        if name not in fields:
            yield f"{_INDENT * depth}{name}: {yaml_line(own[name])}"
    for name, field in fields.items():
        value = getattr(config, name)
        lines = list(_entry(name, value, own.get(name, _ABSENT), depth, _comment(name, field, value)))
        yield from ["", *lines] if depth == 0 and len(lines) > 1 else lines


def _entry(name: str, value: Any, own: Any, depth: int, words: str = "") -> Iterator[str]:
    """A key with its value. own: what the file has for it, `_ABSENT`: nothing, so that the key is a comment."""
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
    """A list of sections, those beyond the file's own as comments."""
    listed = [own] if isinstance(own, Mapping) else own
    for number, section in enumerate(sections):
        live = number < len(listed)
        yield f"{_INDENT * depth}{'' if live else '#'}-"
        yield from _section(section, listed[number] if live else {}, depth + 1)


def _in_one_line(section: BaseModel, own: Any, depth: int) -> bool:
    """Whether a section is written as it stands in the file (a number, a name), or is too small to be spread out."""
    fields = type(section).model_fields
    return not fields or (depth > 0 and len(fields) <= _SMALL if own is _ABSENT else not isinstance(own, Mapping))


def _explained(line: str, words: str, depth: int) -> Iterator[str]:
    """A line with its comment behind it, or above it where that gets too long."""
    whole = f"{line}  # {words}"
    if words and len(whole) > _WIDTH:
        start = f"{_INDENT * depth}# "
        yield from textwrap.wrap(words, _WIDTH, initial_indent=start, subsequent_indent=start)
    yield whole if words and len(whole) <= _WIDTH else line


def _plain(value: Any) -> Any:
    """The value in YAML's own types."""
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
    told = _description(field, value)
    parts = [told, "" if _has_unit(told, name) else _UNITS.get(_ending(name), ""), _bounds(field), _choices(field.annotation)]
    default = field.default
    if default is not PydanticUndefined and default != value and not isinstance(default, BaseModel):
        parts.append(f"default {yaml_line(_plain(default))}")
    return "; ".join(part for part in parts if part)


def _ending(name: str) -> str:
    """The key's last part, where the unit stands."""
    return name.rpartition("_")[2] if "_" in name else ""


def _has_unit(description: str, name: str) -> bool:
    """Whether a description says the unit of its key itself."""
    return _ending(name) in re.findall(r"[\w']+", description) or description.endswith("]")


def _description(field: FieldInfo, value: Any) -> str:
    """What the field says of itself, else what its section does."""
    told = field.description or (_first_line(type(value)) if isinstance(value, BaseModel) else "")
    return told.rstrip(".")


def _first_line(section: type[BaseModel]) -> str:
    return (section.__doc__ or "").strip().partition("\n")[0]


def _bounds(field: FieldInfo) -> str:
    found = [form.format(getattr(item, key)) for item in field.metadata for key, form in _BOUNDS.items() if hasattr(item, key)]
    return " ".join(found)


def _choices(annotation: Any) -> str:
    """The words that a Literal or an enumeration allows, or the kinds of sections that a union does."""
    if get_origin(annotation) is Literal:
        words = [str(word) for word in get_args(annotation)]
        return f"one of {', '.join(words)}" if len(words) > 1 else ""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return f"one of {', '.join(str(member.value) for member in annotation)}"
    named = dict.fromkeys(kind for option in _sections(annotation) if (kind := _kind(option)))
    return f"kinds: {', '.join(named)}" if len(named) > 1 else ""


def _sections(annotation: Any) -> Iterator[type[BaseModel]]:
    """The config models that an annotation allows, in its order."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _sections(inner)


def _kind(section: type[BaseModel]) -> str:
    """The word by which a section of a union is told, its only field with one allowed word; "" where there is none."""
    for name, field in section.model_fields.items():
        if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1:
            return f"{name}={get_args(field.annotation)[0]}"
    return ""
