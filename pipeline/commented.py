"""A config as YAML with every key explained: description, unit, bounds, default."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from enum import Enum
from typing import Any, Literal, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

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
    summary = [f"# {line}" for line in (type(config).__doc__ or "").strip().splitlines()[:1]]
    return "\n".join([*summary, "", *_section(config, 0)]).lstrip("\n") + "\n"


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
        yield f"{indent}{name}: {_flow(value)}"


def _flow(value: Any) -> str:
    """A value on one line."""
    text = yaml.safe_dump(_plain(value), default_flow_style=True, width=10**9, allow_unicode=True, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")


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
    parts = [(field.description or name.replace("_", " ")).rstrip("."), unit, _bounds(field), _choices(field.annotation)]
    default = field.default
    if default is not PydanticUndefined and default != value and not isinstance(default, BaseModel):
        parts.append(f"default {_flow(default)}")
    return "; ".join(part for part in parts if part)


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
    kinds = [_kind(option) for option in get_args(annotation)]
    named = [kind for kind in kinds if kind]
    return f"kinds: {', '.join(named)}" if len(named) > 1 else ""


def _kind(option: Any) -> str:
    """The word by which a section of a union is told, its only field with one allowed word; "" where there is none."""
    if not (isinstance(option, type) and issubclass(option, BaseModel)):
        return ""
    for name, field in option.model_fields.items():
        if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1:
            return f"{name}={get_args(field.annotation)[0]}"
    return ""
