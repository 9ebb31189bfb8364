"""The page of licences: every distribution that scarpsim needs, as its own metadata state them."""

from __future__ import annotations

import platform
from importlib import metadata

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

_INTRODUCTION = """# Licences of the dependencies

scarpsim is under the MIT licence. It installs the distributions below. The list is what `pip
install scarpsim` and its extras bring, directly or through another, in the versions of the environment that built this page
(Linux, Python {python}); the licence is the SPDX expression, field or classifier of the distribution's metadata.
"""
_CLASSIFIER = "License :: OSI Approved :: "
_LONGEST = 60


def pages() -> dict[str, str]:
    """One page."""
    parts = [_INTRODUCTION.format(python=platform.python_version())]
    project = metadata.distribution("scarpsim")
    extras = project.metadata.get_all("Provides-Extra") or []
    shown = _closure("scarpsim", frozenset())
    parts.append(_table("Always", shown))
    for extra in sorted(extras):
        further = _closure("scarpsim", frozenset({extra})) - shown
        parts.append(_table(f"With the extra `{extra}`", further))
    return {"reference/licences.md": "\n".join(parts)}


def _closure(name: str, extras: frozenset[str]) -> set[str]:
    """Canonical names of all that `name` with `extras` needs here, itself left out; what is not installed is left out too."""
    found: set[tuple[str, frozenset[str]]] = set()
    waiting = [(canonicalize_name(name), extras)]
    while waiting:
        entry = waiting.pop()
        if entry in found:
            continue
        found.add(entry)
        try:
            requires = metadata.requires(entry[0]) or []
        except metadata.PackageNotFoundError:
            found.discard(entry)
            continue
        for text in requires:
            needed = Requirement(text)
            if needed.marker is None or any(needed.marker.evaluate({"extra": extra}) for extra in (entry[1] or {""})):
                waiting.append((canonicalize_name(needed.name), frozenset(needed.extras)))
    return {entry[0] for entry in found} - {canonicalize_name(name)}


def _table(title: str, names: set[str]) -> str:
    rows = [f"## {title}\n", "| distribution | version | licence |", "|---|---|---|"]
    rows += [f"| {name} | {metadata.version(name)} | {_licence(metadata.metadata(name))} |" for name in sorted(names)]
    return "\n".join(rows) + "\n"


def _licence(stated: metadata.PackageMetadata) -> str:
    """Return the shortest sure statement: expression, else the field where it is a name and no text, else classifiers."""
    classifiers = [each.removeprefix(_CLASSIFIER) for each in stated.get_all("Classifier") or [] if each.startswith(_CLASSIFIER)]
    field = (stated.get("License") or "").strip()
    named = field if 0 < len(field) <= _LONGEST and "\n" not in field else ""
    return stated.get("License-Expression") or named or ", ".join(classifiers) or "not stated in the metadata"
