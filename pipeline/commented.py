"""A config as YAML with every key explained: description, unit, bounds, default."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from enum import Enum
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from scene.yaml_text import yaml_line

_WIDTH = 110
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


def commented_yaml(config: BaseModel) -> str:
    """The config's values as YAML that loads into the same config, with a comment above each key."""
    title = _first_line(type(config))
    return "\n".join([f"# {title}" if title else "", "", *_section(config, 0)]).strip("\n") + "\n"


def _section(config: BaseModel, depth: int) -> Iterator[str]:
    indent = "  " * depth
    for name, field in type(config).model_fields.items():
        comment = _comment(name, field, getattr(config, name))
        yield from textwrap.wrap(comment, _WIDTH, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")
        yield from _entry(name, getattr(config, name), depth)
        if depth == 0:
            yield ""


def _entry(name: str, value: Any, depth: int) -> Iterator[str]:
    indent = "  " * depth
    if isinstance(value, BaseModel) and type(value).model_fields:
        yield f"{indent}{name}:"
        yield from _section(value, depth + 1)
    elif isinstance(value, list | tuple) and value and all(isinstance(item, BaseModel) for item in value):
        yield f"{indent}{name}:"
        for item in value:
            lines = list(_section(item, depth + 2))
            yield f"{indent}  -"
            yield from lines
    elif isinstance(value, dict) and any(isinstance(item, BaseModel) for item in value.values()):
        yield f"{indent}{name}:"
        for key, item in value.items():
            yield from _entry(str(key), item, depth + 1)
    else:
        yield f"{indent}{name}: {yaml_line(_plain(value))}"


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
    unit = _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""
    parts = [_description(field, value), unit, _bounds(field), _choices(field.annotation)]
    default = field.default
    if default is not PydanticUndefined and default != value and not isinstance(default, BaseModel):
        parts.append(f"default {yaml_line(_plain(default))}")
    return "; ".join(part for part in parts if part)


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
