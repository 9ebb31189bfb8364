"""Make JSON schemas of the config files, with which editors complete keys, show descriptions and mark mistakes."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel, RootModel

from pipeline.config.simulation import SensorModel, SimulationConfig
from pipeline.dataset.config import DatasetConfig
from pipeline.detection.network.config import TrainConfig
from pipeline.formats.measurements.config import MeasurementConfig
from scene.common.errors import InputError, nearest
from sensors.laser.presets import ScannerPreset

KINDS: dict[str, type[BaseModel]] = {
    "simulation": SimulationConfig,
    "dataset": DatasetConfig,
    "detector": TrainConfig,
    "scanner": ScannerPreset,
    "model": RootModel[SensorModel],
    "measurement": MeasurementConfig,
}
"""The model of each kind of file after reading; `_with_short_forms` adds the short forms that a file may use."""
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_NUMBER, _NAME = {"type": "number"}, {"type": "string"}
_NUMBER_ALLOWED = ("DrawnParameter", "Constant")
"""Models that a file may give as a plain number."""


def json_schema(kind: str) -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of one kind of config file, with which editors check and complete it.

    kind: simulation, dataset, detector, scanner, model or measurement. Raises InputError for another.
    """
    if kind not in KINDS:
        raise InputError(
            f"there is no schema '{kind}'",
            where="scarpsim schema",
            allowed=", ".join(KINDS),
            remedy=nearest(kind, KINDS) or "choose one of these names",
        )
    found = KINDS[kind].model_json_schema()
    return {"$schema": _DRAFT, **_with_short_forms(found), "title": f"scarpsim: {kind}"}


def schema_text(kind: str) -> str:
    """Return the JSON schema of one kind of config file (simulation, dataset, detector, ...) as text."""
    return json.dumps(json_schema(kind), indent=1) + "\n"


def schema_name(kind: str) -> str:
    """Return the file name of the JSON schema that `scarpsim init` writes next to a config.

    kind: the kind of config: simulation, dataset, detector, scanner, model or measurement.
    """
    return f"scarpsim.{kind}.schema.json"


def schema_line(kind: str) -> str:
    """Return the first line of a config file, a YAML comment that tells editors where its JSON schema is.

    kind: the kind of config: simulation, dataset, detector, scanner, model or measurement.
    """
    return f"# yaml-language-server: $schema={schema_name(kind)}\n"


def _with_short_forms(schema: dict[str, Any]) -> dict[str, Any]:
    """Add to a schema the short forms that the reader resolves: names of presets, models and sites, and plain numbers."""
    known = schema.get("$defs", {})
    for name in _NUMBER_ALLOWED:
        if name in known:
            known[name] = {"anyOf": [known[name], _NUMBER]}
    simulations = [part for part in (schema, known.get("SimulationConfig")) if part and "rockfall" in part.get("properties", {})]
    for part in simulations:
        _add_names(part["properties"], known)
    if "ScaledModel" in known:
        model = known["ScaledModel"]["properties"]
        model["model"] = {"anyOf": [_NAME, model["model"]]}
    if "walls" in schema.get("properties", {}):
        by_name = schema["properties"]["walls"]["patternProperties"]
        for pattern, wall in by_name.items():
            by_name[pattern] = {"anyOf": [_site(), wall]}
    return schema


def _site() -> dict[str, Any]:
    """Return the schema of a data set's wall that is given by its site."""
    overrides = {"type": "array", "items": _NAME, "description": "key=value, as --set takes them"}
    site = _NAME | {"description": "a bundled site's name or a config file"}
    return {"type": "object", "properties": {"site": site, "set": overrides}, "required": ["site"], "additionalProperties": False}


def _add_names(sections: dict[str, Any], known: dict[str, Any]) -> None:
    """Allow names of models, cameras and scanners in the sections of a simulation's schema."""
    models, cameras = sections["sensor"], sections["cameras"]
    one = models["items"]
    sections["sensor"] = {key: value for key, value in models.items() if key not in ("items", "type")}
    sections["sensor"]["anyOf"] = [{"type": "array", "items": one}, one, _NAME]
    sections["cameras"] = {"anyOf": [{"oneOf": cameras.pop("oneOf")}, _NAME], **cameras}
    scanner = known["ScannerConfig"]
    scanner["properties"]["preset"] = _NAME | {
        "description": "a bundled scanner's name or a preset file; other keys go before it"
    }
    section = sections["scanner"]
    sections["scanner"] = {"anyOf": [{"$ref": section.pop("$ref")}, _NAME], **section}
