"""Find the commands that README.md and docs/ show, parse them, and resolve their configs like the program, without
running them.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.cli.main import COMMANDS, command_parser
from pipeline.comparison.sensor_setups import sensor_setups
from pipeline.config.bundled import bundled_config, config_path
from pipeline.config.overrides import Override, read_override
from pipeline.config.presets import model_file, read_preset
from pipeline.config.simulation import load_config
from pipeline.dataset.config import load_dataset_config
from pipeline.detection.network.config import load_train_config
from scene.common.config import load_yaml

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_FENCED = re.compile(r"^ *```[^\n]*\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
_LINE = re.compile(r"^ *(?:\$ )?((?:scarpsim|simulate) .*)$", re.MULTILINE)
_INDENTED = re.compile(r"^ {4,}(?:scarpsim|simulate) .*$", re.MULTILINE)
_INLINE = re.compile(r"`((?:scarpsim|simulate)\s[^`]+)`")
_END = re.compile(r"\s(?:\||>|#).*$")


def commands(page: Path) -> list[str]:
    """Return the commands of a page, in fenced and indented blocks and in sentences, each once, without comments and pipes."""
    text = page.read_text(encoding="utf-8")
    prose = _FENCED.sub("", text)
    found = [line for block in _FENCED.findall(text) for line in _LINE.findall(block)]
    found += [line.strip() for line in _INDENTED.findall(prose)] + _INLINE.findall(_INDENTED.sub("", prose))
    return list(dict.fromkeys(_plain(each) for each in found))


def _plain(command: str) -> str:
    joined = " ".join(command.split())
    return joined if "[" in joined and "|" in joined and "'" not in joined else _END.sub("", joined)  # a synopsis keeps its bars


def parsed(command: str) -> tuple[str, argparse.Namespace]:
    """Parse a command with the program's own parser; return its name and arguments, or raise InputError as the program would."""
    program, *words = shlex.split(command)
    name = "simulate" if program == "simulate" else words.pop(0)
    return name, command_parser(f"scarpsim {name}", COMMANDS[name]).parse(words)


def flags_of(command: str) -> set[str]:
    """Return the flags in a command or a synopsis."""
    return set(re.findall(r"(?<![\w-])--[a-z][\w-]*", command))


def known_flags(name: str) -> set[str]:
    """Return the flags that a command's parser accepts."""
    parser = command_parser(f"scarpsim {name}", COMMANDS[name])
    return {flag for action in parser._actions for flag in action.option_strings}


def resolved(command: str) -> Iterator[dict[str, Any]]:
    """Return the configs that a command would use, as plain values; the files that it names must exist."""
    name, given = parsed(command)
    overrides = getattr(given, "overrides", [])
    if name == "simulate":
        path = config_path("sites", given.config) if given.config else bundled_config("", "demo")
        yield load_config(path, overrides, given.sensor, given.seed).model_dump(mode="json")
    elif name == "inspect" or (name == "gap" and given.identifiability and not given.measurement[0].is_dir()):
        path = config_path("sites", given.config if name == "inspect" else given.measurement[0])
        yield load_config(path, overrides, given.sensor, None).model_dump(mode="json")
    elif name == "calibrate" and given.config:
        yield load_config(config_path("sites", given.config), overrides, given.sensor, None).model_dump(mode="json")
    elif name == "icp-study" and not given.source.is_dir():
        yield load_config(config_path("sites", given.source), overrides, given.sensor, None).model_dump(mode="json")
    elif name == "compare":
        names = [str(ROOT / each) if each.startswith("configs/") else each for each in given.configs]  # typed in a checkout
        yield from (each.config.model_dump(mode="json") for each in sensor_setups(names, overrides, given.seed))
    elif name == "dataset" and given.words[0] not in ("verify", "merge", "split"):
        yield load_dataset_config(config_path("datasets", Path(given.words[0])), overrides).model_dump(mode="json")
    elif name == "train":
        path = config_path("detectors", given.config) if given.config else bundled_config("detectors", "light")
        yield load_train_config(path, overrides).model_dump(mode="json")


def check_overrides(command: str) -> None:
    """Assert that each `--set` of a command changes the resolved config: a preset by the scanner's name, a model by
    its values.
    """
    _, given = parsed(command)
    for config in resolved(command):
        for override in map(read_override, getattr(given, "overrides", [])):
            check_override(config, override)


def check_override(config: Mapping[str, Any], override: Override) -> None:
    """Assert that the override is in the config."""
    if override.path in (("scanner",), ("scanner", "preset")) and isinstance(override.value, str):
        preset = read_preset(override.value)
        expected = {key: _as_json(value) for key, value in preset.scanner_values().items()}
        assert expected.items() <= {key: _as_json(value) for key, value in config["scanner"].items()}.items(), override.text
        assert preset.model().model_dump(mode="json") in config["sensor"], override.text
    elif override.path == ("sensor",) and isinstance(override.value, str):
        model = load_yaml(model_file(override.value))
        assert any(holds(found, model) for found in config["sensor"]), override.text
    elif override.path == ("sensor",):
        assert any(holds(found, override.value) for found in config["sensor"]), override.text
    elif override.path[0] == "walls" and override.path[-1] == "set":  # of a site, whose config the wall resolves to
        for text in override.value:
            check_override(config["walls"][override.path[1]], read_override(text))
    else:
        place: Any = config
        for part in override.path:
            place = place[int(part)] if isinstance(place, list) else place[part]
        assert holds(place, override.value), override.text


def holds(found: Any, given: Any) -> bool:
    """Return whether resolved values contain the given ones: sections may have more keys, numbers become floats, names become
    paths.
    """
    if isinstance(given, Mapping):
        return isinstance(found, Mapping) and all(key in found and holds(found[key], given[key]) for key in given)
    if isinstance(given, list):
        return isinstance(found, list) and len(found) == len(given) and all(map(holds, found, given))
    if isinstance(found, Mapping):  # a short form: a spread's or a constant's only number
        return given in found.values()
    return bool(found == given)


def _as_json(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
