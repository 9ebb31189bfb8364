"""Interpret the column names of a text file, as programs write them, and the units in them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.formats.points.text_layout import HeaderLine, TextLayout
from pipeline.formats.units import metres_of_word
from scene.common.errors import InputError

_AXES = ("x", "y", "z")
SKIPPED = "-"
"""A column with this name is left out."""
_SYNONYMS = {
    "x": ("e", "east", "easting", "xcoord", "xcoordinate", "coordx", "coordinatex", "posx", "pointx", "utme", "utmeasting",
          "rechtswert", "ostwert", "ost", "est", "este", "leste"),
    "y": ("n", "north", "northing", "ycoord", "ycoordinate", "coordy", "coordinatey", "posy", "pointy", "utmn", "utmnorthing",
          "hochwert", "nordwert", "nord", "norte"),
    "z": ("h", "height", "elevation", "elev", "alt", "altitude", "zcoord", "zcoordinate", "coordz", "coordinatez", "posz",
          "pointz", "hoehe", "höhe", "cota", "quota", "altura", "orthoheight", "ellipsoidalheight"),
    "intensity": ("i", "reflectance", "amplitude", "scalarintensity", "intensität", "intensitaet", "intensité", "intensidad"),
    "red": ("scalarred",), "green": ("scalargreen",), "blue": ("scalarblue",),
    "gps_time": ("time", "gpstime", "timestamp", "scalargpstime"),
}  # fmt: skip
"""Our column names, and other words for them, in lower case without spaces and punctuation."""
_MEANING = {word: name for name, words in _SYNONYMS.items() for word in (*words, name.replace("_", ""))}
"""Our column name of each word."""
_DEGREES = {"lat", "latitude", "lon", "long", "lng", "longitude", "breite", "länge", "laenge"}
"""Names of geographic coordinates."""
_ANGLES = {"deg": math.pi / 180, "degree": math.pi / 180, "degrees": math.pi / 180, "°": math.pi / 180, "rad": 1.0, "mrad": 1e-3,
           "gon": math.pi / 200, "grad": math.pi / 200}  # fmt: skip
"""Length of each unit of angle, rad."""
_TIMES = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9,
          "min": 60.0}  # fmt: skip
"""Length of each unit of time, s."""
_BRACKETS = re.compile(r"^(?P<name>.*?)[\s_]*[\[({<]\s*(?P<unit>[^\])}>]*?)\s*[\])}>]$")
"""A name with its unit in brackets."""
_SUFFIX = re.compile(r"^(?P<name>[^\s_]+)[\s_/]+(?P<unit>[^\s_]+)$")
"""A name with its unit after a space, slash or underscore."""
_NAME = re.compile(r"[^\s\[({]+(?:\s*[\[({][^\])}]*[\])}])?")
"""A name between white space, with its unit in brackets."""
_PROJECT = "project the points to a coordinate system in metres, such as UTM, and export them again"
_HOW = (
    "name the columns x, y, z in this line, or with --columns where a command has it; if the line is a title or remark, delete it"
)


@dataclass(frozen=True)
class Column:
    """What one column of a text file of points contains.

    Attributes
    ----------
    name : Name of the channel in scarpsim, such as x or intensity.
    unit : Unit as the file states it; "": none.
    factor : Factor that converts values to SI units.
    decibels : Whether values are decibels of a power.
    """

    name: str
    unit: str = ""
    factor: float = 1.0
    decibels: bool = False


@dataclass(frozen=True)
class NamedColumns:
    """What the header of a text file of points says of its columns.

    Attributes
    ----------
    columns : Name and unit of each column, in order; empty if the header names none.
    notes : Notes for the user on header lines that were ignored, because they name no columns.
    """

    columns: tuple[Column, ...] = ()
    notes: tuple[str, ...] = ()


def named_columns(layout: TextLayout, where: str) -> NamedColumns:
    """Interpret the column names of a text file of points.

    They are in the last line above the points that names x, y and z, by these or other words, such as easting and northing.

    Parameters
    ----------
    layout : Header and form of the file, as `layout_of` found them.
    where : Name of the file, for errors.

    Raises
    ------
    InputError
        If names are of degrees, do not match the number of columns, or lack x, y or z.
    """
    header = _with_unit_line(layout)
    for line, words in reversed(header):
        if _is_prose(words, layout):
            continue
        columns = understood(words, f"{where}, line {line.number:,}")
        axes = {column.name for column in columns} & set(_AXES)
        if len(axes) == 3:
            return NamedColumns(_checked(columns, words, line, layout, where))
        if len(words) == layout.form.columns and (not line.comment or len(axes) == 2):
            named = ", ".join(f"'{word}'" for word in words)
            raise InputError(
                f"the line names the columns {named:.200}, which do not include x, y and z",
                where=f"{where}, line {line.number:,}",
                allowed="x y z, easting northing height",
                remedy=_HOW,
            )
    passed = [f"line {line.number} is ignored: '{line.text:.60}'" for line, _ in header if not line.comment]
    return NamedColumns((), tuple(passed))


def with_stated_units(columns: Sequence[Column], layout: TextLayout, where: str) -> tuple[Column, ...]:
    """Return the columns that the user names, with the units that the header of the text file states for them.

    columns: the user's. layout: header and form of the file, as `layout_of` found them. where: its name, for errors.
    """
    for line, words in reversed(_with_unit_line(layout)):
        if len(words) == len(columns):
            units = [_parts(word)[1] for word in words]
            named = (column.name if column.unit or not unit else f"{column.name} [{unit}]"
                     for column, unit in zip(columns, units, strict=True))  # fmt: skip
            return understood(list(named), f"{where}, line {line.number:,}")
    return tuple(columns)


def _with_unit_line(layout: TextLayout) -> list[tuple[HeaderLine, list[str]]]:
    """Return the lines before the points with their names; a line of units only is merged into the names above it."""
    lines = [(line, _split(line, layout)) for line in layout.header]
    if len(lines) < 2:
        return lines
    (line, names), (_, words) = lines[-2:]
    units = [word.strip("[](){}<> ") for word in words]
    known = all(metres_of_word(unit) or unit.lower() in {*_ANGLES, *_TIMES, "", "-", "db", "%"} for unit in units)
    if not known or not any(map(metres_of_word, units)) or len(names) != len(units):
        return lines
    joined = [f"{name} [{unit}]" if unit not in ("", "-") else name for name, unit in zip(names, units, strict=True)]
    return [*lines[:-2], (line, joined)]


def _is_prose(words: Sequence[str], layout: TextLayout) -> bool:
    """Whether a line is a sentence: its words do not match the number of columns, and most are not names."""
    names = sum(_key(_parts(word)[0]) in _MEANING for word in words)
    return len(words) != layout.form.columns and names <= len(words) / 2


def _split(line: HeaderLine, layout: TextLayout) -> list[str]:
    """Split a line into names at the file's separator, or at another one if only that gives a name for each column."""
    ways = [re.split(re.escape(mark), line.text) for mark in (layout.form.separator, ";", "\t", ",", "|") if mark]
    ways.insert(0 if layout.form.separator is None else 1, _NAME.findall(line.text.replace(",", " ")))
    cleaned = [[word.strip().strip("\"'").strip() for word in words] for words in ways]
    cleaned = [words[:-1] if len(words) == layout.form.columns + 1 and not words[-1] else words for words in cleaned]
    return next((words for words in cleaned if len(words) == layout.form.columns), cleaned[0])


def _checked(
    columns: tuple[Column, ...], words: Sequence[str], line: HeaderLine, layout: TextLayout, where: str
) -> tuple[Column, ...]:
    """Return the columns, or raise InputError if their number differs from the rows'."""
    if len(columns) == layout.form.columns:
        return columns
    raise InputError(
        f"the line names {len(columns)} columns ({', '.join(words):.200}), but the rows have {layout.form.columns} columns",
        where=f"{where}, line {line.number:,}", allowed="a name for each column", remedy=_HOW,
    )  # fmt: skip


def understood(words: Sequence[str], where: str) -> tuple[Column, ...]:
    """Interpret the column names of a text file of points.

    words: a name for each column. A column with one of scarpsim's own names takes precedence over one with a synonym. where:
    name of the file, for errors. Raises InputError for coordinates in degrees or in an unknown unit.
    """
    parts = [_parts(word) for word in words]
    names: list[str | None] = [name if name in _MEANING.values() else None for name in (part[0] for part in parts)]
    for index, (name, _) in enumerate(parts):
        meaning = _MEANING.get(_key(name))
        if names[index] is None and meaning is not None and meaning not in names:
            names[index] = meaning
    names = _colours(names, parts)
    found: list[Column] = []
    for index, (meaning, word) in enumerate(zip(names, words, strict=True)):
        column = _column(meaning, *parts[index], word, where)
        taken = {each.name for each in found}
        if column.name in taken and column.name != SKIPPED:
            column = Column(f"{word.lower() or 'column'}_{index + 1}")
        found.append(column if column.name else Column(f"column_{index + 1}"))
    return tuple(found)


def _colours(names: list[str | None], parts: Sequence[tuple[str, str]]) -> list[str | None]:
    """Interpret r, g and b as colours if all three exist; r alone may be a range."""
    letters = [name for name, _ in parts]
    if not all(letter in letters for letter in "rgb"):
        return names
    short = {"r": "red", "g": "green", "b": "blue"}
    return [short.get(letter, name) if name is None else name for letter, name in zip(letters, names, strict=True)]


def _parts(word: str) -> tuple[str, str]:
    """Return the name, in lower case, and the unit in a word; units after an underscore or space count only for coordinates."""
    text = word.strip().lower()
    if match := _BRACKETS.match(text):
        return match["name"].strip(), match["unit"]
    match = _SUFFIX.match(text)
    is_coordinate = match is not None and _MEANING.get(_key(match["name"])) in _AXES
    if match is not None and is_coordinate and (metres_of_word(match["unit"]) is not None or match["unit"] in _ANGLES):
        return match["name"], match["unit"]
    return text, ""


def _key(name: str) -> str:
    """Return a name without punctuation, for look-up."""
    return re.sub(r"[^\w°]|_", "", name)


def _column(meaning: str | None, name: str, unit: str, word: str, where: str) -> Column:
    """Interpret one column."""
    if meaning in _AXES:
        return _coordinate(str(meaning), unit, word, where)
    if _key(name) in _DEGREES:
        raise InputError(f"the column '{word}' has coordinates in degrees", where=where, allowed="metres", remedy=_PROJECT)
    if meaning == "intensity":
        return Column("intensity", unit, 0.01 if unit == "%" else 1.0, decibels=unit == "db")
    if meaning == "gps_time":
        return Column("gps_time", unit, _TIMES.get(unit, 1.0))
    if meaning is not None:
        return Column(meaning, unit)
    return _further(name, unit, word)


def _coordinate(axis: str, unit: str, word: str, where: str) -> Column:
    """Interpret a column of coordinates."""
    metres = metres_of_word(unit) if unit else 1.0
    if metres is not None:
        return Column(axis, unit, metres)
    if unit in _ANGLES:
        raise InputError(f"the column '{word}' has coordinates in degrees", where=where, allowed="metres", remedy=_PROJECT)
    raise InputError(
        f"the column '{word}' has the unknown unit '{unit}'",
        where=where,
        allowed="m, cm, mm, km, ft, us-ft",
        remedy="correct the unit in the column's name, or remove it",
    )


def _further(name: str, unit: str, word: str) -> Column:
    """Return another column; lengths, angles and times are converted to m, rad and s, which then end the name."""
    for factor, si in ((metres_of_word(unit), "m"), (_ANGLES.get(unit), "rad"), (_TIMES.get(unit), "s")):
        if unit and factor is not None:
            return Column(f"{name}_{si}", unit, factor)
    return Column(word.strip().lower(), unit)
