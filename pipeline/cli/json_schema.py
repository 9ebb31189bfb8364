"""JSON schemas of the config files, for editors: completion, descriptions, and mistakes marked while one types."""

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
"""What a file of each kind holds once it is read; `_with_short_forms` adds the short forms that a file may have."""
_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_NUMBER, _NAME = {"type": "number"}, {"type": "string"}
_NUMBER_ALLOWED = ("DrawnParameter", "Constant")
"""Sections for which a plain number may stand."""


def json_schema(kind: str) -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of one kind of file; raises InputError for an unknown kind."""
    if kind not in KINDS:
        raise InputError(f"there is no schema '{kind}'", allowed=", ".join(KINDS), remedy=nearest(kind, KINDS))
    found = KINDS[kind].model_json_schema()
    return {"$schema": _DRAFT, **_with_short_forms(found), "title": f"scarpsim: {kind}"}


def schema_text(kind: str) -> str:
    """The schema as JSON."""
    return json.dumps(json_schema(kind), indent=1) + "\n"


def schema_name(kind: str) -> str:
    """The name of the schema's file beside a config."""
    return f"scarpsim.{kind}.schema.json"


def schema_line(kind: str) -> str:
    """The comment by which editors with a YAML language server find the schema beside the file that it stands in."""
    return f"# yaml-language-server: $schema={schema_name(kind)}\n"


def _with_short_forms(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema with the short forms that the reading of a file resolves: names of presets, models and sites, plain numbers."""
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
    """A wall of a data set, told by the site that it is on."""
    overrides = {"type": "array", "items": _NAME, "description": "key=value, as --set takes them"}
    site = _NAME | {"description": "a bundled site's name or a config file"}
    return {"type": "object", "properties": {"site": site, "set": overrides}, "required": ["site"], "additionalProperties": False}


def _add_names(sections: dict[str, Any], known: dict[str, Any]) -> None:
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
