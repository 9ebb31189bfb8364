"""A page for each scanner preset of configs/scanners: figures, their sources, and what the simulation makes of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import yaml

from pipeline.config.bundled import configs_folder
from pipeline.config.presets import read_preset
from sensors.laser.presets import ScannerPreset
from sensors.models.sensor_model import TlsModel, TlsNoise

_INTRODUCTION = """# Scanners

Presets in `configs/scanners`, chosen with `--set scanner=NAME` or `scanner: NAME` in a config. A preset of your own is a YAML
file of the same form, named by its path. *Precision*, the scatter of repeated measurements, becomes noise. *Accuracy* bounds a
deviation that is mostly systematic: it never becomes noise. What is not known is left out of a preset and has the program's
default.
"""
_DIVERGENCE = (
    "The divergence is stated as a {angle} angle at {level} of the intensity on the axis; the effect `beam_divergence` takes"
    " the full angle at 1/e² of a Gaussian beam, {full:.3g} mrad."
)


def pages() -> dict[str, str]:
    """Return the index and a page for each preset."""
    names = sorted(path.stem for path in (configs_folder() / "scanners").glob("*.yaml"))
    presets = {name: read_preset(name) for name in names}
    rows = ["| preset | instrument | ranging | range precision | beam, full angle at 1/e² |", "|---|---|---|---|---|"]
    rows += [_index_row(name, preset) for name, preset in presets.items()]
    made = {f"reference/scanners/{name}.md": _page(name, preset) for name, preset in presets.items()}
    return {"reference/scanners/index.md": _INTRODUCTION + "\n" + "\n".join(rows) + "\n", **made}


def _index_row(name: str, preset: ScannerPreset) -> str:
    precision = ", ".join(f"{each.value:g} mm{_at(each)}" for each in preset.range_precision_mm) or "not known"
    beam = "not known" if preset.divergence_mrad is None else f"{preset.divergence_mrad.full_angle:.3g} mrad"
    return f"| [{name}]({name}.md) | {preset.name} | {preset.ranging} | {precision} | {beam} |"


def _page(name: str, preset: ScannerPreset) -> str:
    rows = [
        "| figure | value | kind | meaning | source |",
        "|---|---|---|---|---|",
        *(_row(key, figure) for key, figure in _figures(preset)),
    ]
    parts = [
        f"# {preset.name}",
        f"Preset `{name}`, ranging by {'pulses' if preset.ranging == 'pulse' else 'phase'}.",
        "## Figures",
        "\n".join(rows),
        "## In the simulation",
        _in_words(preset),
        f"```yaml\n{_section(preset)}```",
        "## Use",
        f"```bash\nsimulate --sensor tls --set scanner={name}\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _figures(preset: ScannerPreset) -> Iterator[tuple[str, Any]]:
    for key in type(preset).model_fields:
        value = getattr(preset, key)
        if value is None or isinstance(value, str):
            continue
        yield from ((key, each) for each in (value if isinstance(value, tuple) else (value,)))


def _row(key: str, figure: Any) -> str:
    words, _, unit = key.rpartition("_")
    unit = unit.replace("hz", "Hz")
    value = " to ".join(f"{each:g}" for each in figure.value) if isinstance(figure.value, tuple) else f"{figure.value:,g}"
    if unit == "Hz":
        value = f"{figure.value:,.0f}"
    more = f" + {figure.ppm:g} ppm" if getattr(figure, "ppm", 0) else ""
    kind = f"{figure.level}, {figure.angle} angle" if hasattr(figure, "level") else getattr(figure, "kind", "")
    meaning = ScannerPreset.model_fields[key].description
    return f"| {words.replace('_', ' ')} | {value} {unit}{more}{_at(figure)} | {kind} | {meaning} | {figure.source} |"


def _at(figure: Any) -> str:
    return "" if getattr(figure, "at_m", None) is None else f" at {figure.at_m:g} m"


def _in_words(preset: ScannerPreset) -> str:
    noise, default = preset.model().noise, TlsNoise()
    kept = [key for key in TlsNoise.model_fields if key not in preset.model().noise.model_fields_set]
    words = f"Range noise: {noise.range_sigma_m * 1e3:.3g} mm"
    words += f" and {noise.range_ppm:.3g} ppm of the range." if noise.range_ppm else "."
    if "angle_sigma_rad" in kept:
        words += f" Noise of the angles: the default of {default.angle_sigma_rad:g} rad, as no precision of angles is known."
    if "range_sigma_m" in kept:
        words += " No precision of the range is known, so its noise has the default."
    beam = preset.divergence_mrad
    if beam is None:
        return f"{words} The divergence is not known: the beam is a line unless `beam_divergence` is added."
    return f"{words} {_DIVERGENCE.format(angle=beam.angle, level=beam.level.replace('1/e2', '1/e²'), full=beam.full_angle)}"


def _section(preset: ScannerPreset) -> str:
    """Return the config sections that the preset stands for."""
    known = preset.scanner_values().items()
    scanner = {key: [round(each, 6) for each in value] if isinstance(value, tuple) else value for key, value in known}
    model: TlsModel = preset.model()
    values = {"scanner": scanner, "sensor": {"sensor": "tls"} | model.model_dump(mode="json", exclude_defaults=True)}
    if model.effects:
        dumped = values["sensor"]["effects"]
        values["sensor"]["effects"] = [{"name": each.name} | left for each, left in zip(model.effects, dumped, strict=True)]
    return yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=110)
