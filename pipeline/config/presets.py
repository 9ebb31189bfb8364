"""Scanner presets and sensor models as files: those in configs/scanners and configs/noise by name, a user's own by path.

Which of a preset and a key wins: of those named together, in one file or on one command line, the key, a deliberate refinement
of the preset; otherwise what is named later, so a preset of `--set` before the keys of the file.
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
    """Whether a preset or model is named by a file instead of by a bundled one's name."""
    return name.endswith((".yaml", ".yml")) or "/" in name or "\\" in name


def read_preset(name: str) -> ScannerPreset:
    """The preset of a bundled name such as `riegl_vz400i`, or out of a YAML file.

    Raises InputError for an unknown name, with the nearest one, and for whatever is wrong in the file.
    """
    path = Path(name) if is_path(name) else bundled_config("scanners", name)
    return parse(ScannerPreset, load_yaml(path), str(path))


def model_file(name: str) -> Path:
    """The file of a sensor model: a bundled name such as `glendale_high`, or a YAML file itself."""
    return Path(name) if is_path(name) else bundled_config("noise", name)


def spelled_out(overrides: Sequence[str | Override]) -> list[Override]:
    """The overrides, with `scanner=NAME` as `scanner.preset=NAME`: another instrument keeps the pattern that is scanned."""
    found = [read_override(each) if isinstance(each, str) else each for each in overrides]
    return [
        replace(each, path=("scanner", "preset")) if each.path == ("scanner",) and isinstance(each.value, str) else each
        for each in found
    ]


def without_what_a_preset_sets(values: dict[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
    """A file's values, ready for overrides (`spelled_out`): where these name a preset, what it sets goes out of the file's.

    So the preset wins over the file: the keys of `scanner` that it knows go, and a laser scanner's model gives way to the
    preset's, in its place. What the file says beyond that stays. Keys among the overrides are put in afterwards and win.
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
    """A config's values with the preset that its `scanner` names written out.

    `scanner` is a preset's name or file, or a section with the key `preset`, whose other keys go before the preset's. The
    preset's sensor model is added where the config has no laser scanner's model of its own.
    """
    values = _with_section(values)
    own = values.get("scanner")
    if not isinstance(own, dict) or "preset" not in own:
        return values
    if not isinstance(own["preset"], str):
        raise InputError(f"'scanner.preset': expected a name or a file, got {own['preset']!r:.80}")
    preset = read_preset(own["preset"])
    section = preset.scanner_values() | {key: value for key, value in own.items() if key != "preset"}
    return {**values, "scanner": section, "sensor": _with_model(values.get("sensor"), preset)}


def _with_section(values: dict[str, Any]) -> dict[str, Any]:
    """The values with a scanner that is only named, `scanner: NAME`, as a section: keys can then stand beside the preset."""
    scanner = values.get("scanner")
    return {**values, "scanner": {"preset": scanner}} if isinstance(scanner, str) else values


def _in_place(sensor: Any, preset: ScannerPreset) -> Any:
    """The `sensor` section with the preset's model instead of a laser scanner's; without one as it is."""
    if isinstance(sensor, list | tuple):
        return [_in_place(model, preset) for model in sensor]
    return preset.model().model_dump(mode="json") if _kind(sensor) == "tls" else sensor


def _with_model(sensor: Any, preset: ScannerPreset) -> Any:
    """The `sensor` section with the preset's model in it, unless it has a laser scanner's already (or is no section at all)."""
    models = [sensor] if isinstance(sensor, dict) else sensor or ()
    if not isinstance(models, list | tuple) or any(_kind(model) == "tls" for model in models):
        return sensor
    return [*models, preset.model()]


def _kind(model: Any) -> Any:
    return model.get("sensor") if isinstance(model, dict) else getattr(model, "sensor", None)
