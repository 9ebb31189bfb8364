"""Define the base class of all config sections and turn YAML or JSON into them, with errors that name the mistaken key."""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin

import pydantic
import yaml
from pydantic import BaseModel, ConfigDict
from pydantic_core import ErrorDetails

from scene.common.errors import InputError, nearest
from scene.common.regular_file import read_json, read_text
from scene.common.yaml_text import parse_yaml, yaml_problem


class Config(BaseModel):
    """Base class of every config section: immutable, and unknown keys are errors.

    Field names carry their unit (`_m`, `_rad`, `_px`, `_ppm`). Infinite and NaN values are refused. A subclass lists in
    `short_forms` the keys that a file may contain although they are no fields of the section, such as `preset`. They are
    replaced by the keys that they stand for before the section is parsed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    short_forms: ClassVar[tuple[str, ...]] = ()
    """Further keys that a file may use in this section. Error messages list them as allowed."""


ConfigT = TypeVar("ConfigT", bound=BaseModel)


def parse(model: type[ConfigT], values: Any, where: str) -> ConfigT:
    """Check values that a user gave and turn them into a config section of class `model`.

    Parameters
    ----------
    model : type of pydantic model
        The config section.
    values : mapping
        Keys and values, as read from a file or given in Python.
    where : str
        The file or option that the values came from; every message starts with it.

    Returns
    -------
    An instance of `model`.

    Raises
    ------
    InputError
        If a key or value is wrong. One message lists all mistakes, with the nearest valid key for a misspelt one.
    """
    if not isinstance(values, Mapping):
        raise InputError(
            f"the content must be a mapping of keys, but is of the type {type(values).__name__}",
            where=where,
            remedy="write `key: value` lines",
        )
    try:
        return model.model_validate(dict(values))
    except pydantic.ValidationError as error:
        raise InputError(
            f"keys or values are wrong: {_listed([_mistake_and_hint(model, item) for item in error.errors()])}", where=where
        ) from None


_MOST_YAML_BYTES = 4_000_000
"""Largest YAML file that is read: parsing this much takes about twenty seconds."""


def load_yaml(path: Path) -> Any:
    """Read a config file: YAML without tags for Python objects or, by its suffix, JSON.

    Returns plain data (dict, list, str, numbers, None). Raises InputError if the file cannot be read or is malformed.
    """
    if path.suffix == ".json":
        return read_json(path)
    try:
        return parse_yaml(read_text(path, most_bytes=_MOST_YAML_BYTES, if_too_large="give it as .json, which is fast"))
    except yaml.YAMLError as error:
        raise InputError(
            f"the file is not valid YAML: {yaml_problem(error)}",
            where=str(path),
            remedy="correct the syntax there",
        ) from None


_MOST_MISTAKES = 4
"""Number of mistakes that a message spells out; the rest are only counted, because in a file of another kind every key is
    wrong.
    """


def _listed(mistakes: list[str]) -> str:
    """Join the descriptions of mistakes into one message."""
    more = len(mistakes) - _MOST_MISTAKES
    return "; ".join(mistakes[:_MOST_MISTAKES] + ([f"and {more} more"] if more > 0 else []))


def _mistake_and_hint(model: type[BaseModel], item: ErrorDetails) -> str:
    """Describe one validation error as `section.key: message, got value`, with a suggestion for an unknown key."""
    keys, sections = _place(model, item["loc"])
    key = ".".join(keys)
    if item["type"] == "extra_forbidden":
        return _unknown(keys, sections)
    if item["type"] == "missing":
        return f"'{key}' is missing"
    message = item["msg"].removeprefix("Value error, ")
    if not key:  # the error concerns the whole section, whose value would be too long to print
        return message
    hint = _hint(keys, item)
    return f"'{key}': {message[0].lower()}{message[1:]}, got {_shown(item['input'])}" + (f"; {hint}" if hint else "")


def _unknown(keys: list[str], sections: list[_Section]) -> str:
    """Describe a key that is not allowed: it belongs to another variant of this section, or to none."""
    key, name = ".".join(keys), keys[-1]
    owners = list(dict.fromkeys(section.kind for section in sections if name in section.names()))
    picked = [section for section in sections if section.picked]
    known = sorted({each for section in picked for each in section.names()})
    allowed = f"allowed: {', '.join(known)}" if known else ""
    if owners and name not in known:
        more = f" and {len(owners) - _MOST_MISTAKES} more" if len(owners) > _MOST_MISTAKES else ""
        return f"'{key}' belongs to {', '.join(owners[:_MOST_MISTAKES])}{more}, not to {picked[0].kind}; {allowed}"
    if owners:  # the variants of this section have no key that names them
        return f"'{key}' cannot be combined with the other keys of '{'.'.join(keys[:-1])}'; leave it or them out"
    hint = nearest(name, known) or allowed
    return f"unknown key '{key}'; {hint}" if hint else f"unknown key '{key}'"


def _hint(keys: list[str], item: ErrorDetails) -> str:
    """Return what was probably meant (a word in another spelling, an angle in degrees), or ""."""
    value, told = item["input"], item.get("ctx", {})
    if item["type"] == "literal_error" and isinstance(value, str):
        return nearest(value.lower(), re.findall(r"'([^']*)'", told["expected"]))
    if item["type"] == "union_tag_invalid":
        return nearest(str(told["tag"]).lower(), re.findall(r"'([^']*)'", told["expected_tags"]))
    in_radians = any(part.endswith("_rad") for part in keys)
    if in_radians and item["type"].startswith(("less", "greater")) and isinstance(value, int | float) and value:
        return f"angles are in radians: {value:g} degrees are {math.radians(value):.4g}"
    return ""


def _shown(value: Any) -> str:
    """Return the value as it would be written in code, shortened: YAML aliases can make a small file describe a huge value."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    short.maxdict = short.maxlist = 6
    short.maxlevel = 2
    return short.repr(value)


@dataclass(frozen=True)
class _Section:
    """A model that may stand at one place of a config.

    Attributes
    ----------
    model : type of pydantic model
        The section's class.
    kind : str
        The word that selects this model among the variants of a union, such as an effect's name, or that of the section around
        it; "" if there is none.
    picked : bool
        Whether the config selects this variant.
    """

    model: type[BaseModel]
    kind: str = ""
    picked: bool = True

    def names(self) -> set[str]:
        """Return the keys that are allowed in this section."""
        return {*self.model.model_fields, *getattr(self.model, "short_forms", ())}

    def inside(self, field: str) -> list[_Section]:
        """Return the models that the type annotation of a field contains."""
        pending: list[Any] = [self.model.model_fields[field].annotation]
        found = []
        while pending:
            annotation = pending.pop(0)
            if isinstance(annotation, type) and issubclass(annotation, BaseModel):
                found.append(_Section(annotation, _word_of(annotation) or self.kind, self.picked))
            pending.extend(getattr(annotation, "__args__", ()))
        return found


def _word_of(model: type[BaseModel]) -> str:
    """Return the value of the literal field that distinguishes a model within its union, or "" if it has no such field."""
    words = (get_args(field.annotation) for field in model.model_fields.values() if get_origin(field.annotation) is Literal)
    return next((str(word[0]) for word in words if len(word) == 1), "")


def _place(model: type[BaseModel], location: tuple[str | int, ...]) -> tuple[list[str], list[_Section]]:
    """Locate a validation error.

    Returns the keys that lead to it, without the tags of unions, and the sections that may contain the last key.
    """
    keys: list[str] = []
    sections = around = [_Section(model)]
    for depth, part in enumerate(location):
        holders = [section for section in sections if part in section.model.model_fields]
        if holders or isinstance(part, int) or depth == len(location) - 1:
            keys.append(str(part))
        elif any(section.kind == part for section in sections):
            sections = [replace(section, picked=section.picked and section.kind == part) for section in sections]
        if not isinstance(part, int):
            around = sections
        if holders:
            sections = [inner for outer in holders for inner in outer.inside(str(part))]
    return keys, around
