"""Scanner presets and sensor models as files: those in configs/scanners and configs/noise by name, a user's own by path."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.bundled import bundled_config
from scene.config import load_yaml, parse
from scene.errors import InputError
from sensors.presets import ScannerPreset


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


def with_preset(values: dict[str, Any]) -> dict[str, Any]:
    """A config's values with the preset that its `scanner` names written out.

    `scanner` is a preset's name or file, or a section with the key `preset`, whose other keys go before the preset's. The
    preset's sensor model is added where the config has no laser scanner's model of its own.
    """
    scanner = values.get("scanner")
    own = {"preset": scanner} if isinstance(scanner, str) else scanner
    if not isinstance(own, dict) or "preset" not in own:
        return values
    if not isinstance(own["preset"], str):
        raise InputError(f"'scanner.preset': expected a name or a file, got {own['preset']!r:.80}")
    preset = read_preset(own["preset"])
    section = preset.scanner_values() | {key: value for key, value in own.items() if key != "preset"}
    return {**values, "scanner": section, "sensor": _with_model(values.get("sensor"), preset)}


def _with_model(sensor: Any, preset: ScannerPreset) -> Any:
    """The `sensor` section with the preset's model in it, unless it has a laser scanner's already (or is no section at all)."""
    models = [sensor] if isinstance(sensor, dict) else sensor or ()
    if not isinstance(models, list | tuple) or any(_kind(model) == "tls" for model in models):
        return sensor
    return [*models, preset.model()]


def _kind(model: Any) -> Any:
    return model.get("sensor") if isinstance(model, dict) else getattr(model, "sensor", None)
