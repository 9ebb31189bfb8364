"""Read scanner presets and sensor models: those in configs/scanners and configs/noise by name, a user's own by path.

If a preset and a key are named together, in one file or on one command line, the key wins, because it refines the preset.
Otherwise the later one wins: a preset of `--set` replaces the keys of the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.config.bundled import bundled_config
from pipeline.config.overrides import Override, apply_overrides, read_override
from scene.common.config import load_yaml, parse
from scene.common.errors import InputError
from sensors.laser.presets import ScannerPreset


def is_path(name: str) -> bool:
    """Return whether `name` is a file (of a scanner preset or a sensor model) and not the name of a bundled one."""
    return name.endswith((".yaml", ".yml")) or "/" in name or "\\" in name


def read_preset(name: str) -> ScannerPreset:
    """Read a scanner preset: the scan pattern, reach and noise of an instrument on the market.

    name: a bundled name such as `riegl_vz400i`, or a YAML file. Raises InputError for an unknown name, with the most similar
    one, and for mistakes in the file.
    """
    path = Path(name) if is_path(name) else bundled_config("scanners", name)
    return parse(ScannerPreset, load_yaml(path), str(path))


def model_file(name: str) -> Path:
    """Return the YAML file of a sensor model. name: a bundled name such as `glendale_high`, or the path of the file itself."""
    return Path(name) if is_path(name) else bundled_config("noise", name)


def expand_shorthand(overrides: Sequence[str | Override]) -> list[Override]:
    """Return config overrides in which `scanner=NAME` is written out as `scanner.preset=NAME`.

    So the instrument alone is replaced, and what it scans (the other keys of `scanner`) is kept.
    """
    found = [read_override(each) if isinstance(each, str) else each for each in overrides]
    return [
        replace(each, path=("scanner", "preset")) if each.path == ("scanner",) and isinstance(each.value, str) else each
        for each in found
    ]


def without_keys_of_preset(values: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """Remove from a config's values what a scanner preset sets, if the user's changes name a preset, so that the preset wins.

    These are the instrument's keys in the section `scanner`, and the laser scanner's sensor model; everything else stays.
    Without a preset in the changes, nothing is removed. Other changes are applied afterwards, so they win over the
    preset.

    Parameters
    ----------
    values : dict
        Values of the config file.
    overrides : sequence of Override
        The user's changes, as from `expand_shorthand`.

    Returns
    -------
    dict
        The remaining values.
    """
    values = _with_section(values)
    later = apply_overrides({}, [each for each in overrides if each.path[0] == "scanner"]).get("scanner")
    named = later.get("preset") if isinstance(later, dict) else None
    if not isinstance(named, str):
        return values
    preset = read_preset(named)
    scanner, sensor = values.get("scanner"), values.get("sensor")
    if isinstance(scanner, dict):
        values = {**values, "scanner": {key: value for key, value in scanner.items() if key not in preset.scanner_values()}}
    return {**values, "sensor": _in_place(load_yaml(model_file(sensor)) if isinstance(sensor, str) else sensor, preset)}


def with_preset(values: dict[str, Any]) -> dict[str, Any]:
    """Replace the scanner preset that a config names by the keys and the sensor model that it stands for.

    values: the config's values. Its `scanner` is a preset's name or file, or a section with the key `preset` and further
    keys, which win over the preset's. The preset's sensor model is only added if the config has none of a laser scanner.
    Returns the new values.
    """
    values = _with_section(values)
    own = values.get("scanner")
    if not isinstance(own, dict) or "preset" not in own:
        return values
    if not isinstance(own["preset"], str):
        raise InputError(
            f"the value must be the name or the file of a scanner preset, but is {own['preset']!r:.80}",
            where="scanner.preset",
            remedy="write for example preset: riegl_vz400i",
        )
    preset = read_preset(own["preset"])
    section = preset.scanner_values() | {key: value for key, value in own.items() if key != "preset"}
    return {**values, "scanner": section, "sensor": _with_model(values.get("sensor"), preset)}


def _with_section(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values with `scanner: NAME` as a section, so that keys can be added beside the preset."""
    scanner = values.get("scanner")
    return {**values, "scanner": {"preset": scanner}} if isinstance(scanner, str) else values


def _in_place(sensor: Any, preset: ScannerPreset) -> Any:
    """Return the `sensor` section with the preset's model in place of a laser scanner's."""
    if isinstance(sensor, list | tuple):
        return [_in_place(model, preset) for model in sensor]
    return preset.model().model_dump(mode="json") if _kind(sensor) == "tls" else sensor


def _with_model(sensor: Any, preset: ScannerPreset) -> Any:
    """Return the `sensor` section with the preset's model added.

    It stays as it is if it already has a laser scanner's model or is not a section.
    """
    models = [sensor] if isinstance(sensor, dict) else sensor or ()
    if not isinstance(models, list | tuple) or any(_kind(model) == "tls" for model in models):
        return sensor
    return [*models, preset.model()]


def _kind(model: Any) -> Any:
    """Return which sensor a model is of."""
    return model.get("sensor") if isinstance(model, dict) else getattr(model, "sensor", None)
