"""A commented config loads as the same config, explains each key, and stays valid when comments are turned into keys."""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

from pipeline.cli.init import simulation_text
from pipeline.config.bundled import configs_folder
from pipeline.config.commented import commented_yaml
from pipeline.config.presets import read_preset
from pipeline.config.simulation import SimulationConfig
from scene.common.config import Config, parse
from scene.common.yaml_text import parse_yaml


class Style(Enum):
    STRATA, JOINTS = "strata", "joints"


class Imported(Config):
    """A config section: a wall from a file."""

    kind: Literal["imported"] = "imported"
    path: Path = Field(Path("wall.ply"), description="the mesh file")


class Procedural(Config):
    kind: Literal["procedural"] = "procedural"
    size_m: tuple[float, float] = Field((70.0, 45.0), description="width and height")
    style: Style = Style.STRATA


class Effect(Config):
    name: str = Field(description="its name in the catalogue")
    offset_m: float = Field(0.0, gt=-1.0, lt=1.0)
    length_m: float | None = Field(None, description="its length [m]")


class Whole(Config):
    """A config: a simulation."""

    seed: int = Field(1, ge=0, description="seed of all random numbers.")
    wall: Annotated[Imported | Procedural, Field(discriminator="kind")] = Field(Procedural(), description="the wall")
    mode: Literal["fast", "fine"] = "fast"
    sigma_px: float = Field(1e-5, gt=0, le=2, description="noise of the image points")
    note: str = Field("", description="a text: with a colon")
    limit: float | None = None
    effects: list[Effect] = Field([], description="what is wrong with the sensor")
    weights: dict[str, float] = Field({"a": 1.0})


CONFIG = Whole(
    seed=7,
    wall=Imported(path=Path("a b.ply")),
    note="no: really # yes",
    sigma_px=1e-7,
    effects=[Effect(name="range_offset", offset_m=0.004), Effect(name="1e3")],
)


COMMENTED = re.compile(r"^( *)#(?=[^ ])", re.MULTILINE)
OWN = {
    "seed": 7,
    "wall": {"kind": "imported", "path": "a b.ply"},
    "note": "no: really # yes",
    "sigma_px": 1e-7,
    "effects": [{"name": "range_offset", "offset_m": 0.004}, {"name": "1e3"}],
}


def live(text: str) -> dict[str, Any]:
    return dict(parse_yaml(text))


@pytest.mark.parametrize("own", [OWN, {}, {"effects": OWN["effects"]}], ids=["much", "nothing", "a list"])
def test_the_text_loads_into_the_same_config_with_the_same_live_keys(own: dict[str, Any]) -> None:
    config = parse(Whole, own, "own")
    text = commented_yaml(config, own)
    assert parse(Whole, parse_yaml(text) or {}, "text") == config
    assert (parse_yaml(text) or {}) == own
    assert set(live(COMMENTED.sub(r"\1", text))) == set(Whole.model_fields), "a key is missing"


def test_each_key_is_explained() -> None:
    lines = commented_yaml(CONFIG, OWN).splitlines()
    found = {line.strip().lstrip("#").partition(":")[0]: line.partition("  # ")[2] for line in reversed(lines) if "  # " in line}
    assert lines[0] == "# A config: a simulation."
    assert found["seed"] == "seed of all random numbers; from 0; default 1"
    assert found["sigma_px"] == "noise of the image points; pixels; above 0 up to 2; default 1.0e-05"
    assert found["mode"] == "one of fast, fine"
    assert found["wall"] == "the wall; kinds: kind=imported, kind=procedural"
    assert found["offset_m"] == "m; above -1.0 below 1.0; default 0.0"
    assert found["length_m"] == "its length [m]", "the unit twice"


SITES = sorted(path.stem for path in (configs_folder() / "sites").glob("*.yaml"))
INITS = [*((site, None) for site in (None, *SITES)), (None, "zf_5016"), ("glendale", "riegl_vz400i")]
"""Sites and scanners for which `scarpsim init` writes a config; None: those of the demo."""


@pytest.mark.parametrize(("site", "scanner"), INITS, ids=[f"{site or 'demo'}, {scanner}" for site, scanner in INITS])
def test_all_comments_of_init_can_become_keys(site: str | None, scanner: str | None) -> None:
    """All at once, without changing the config; then every key of the model is present."""
    text, name = simulation_text(site, scanner), f"{site}, {scanner}"
    short, whole = parse_yaml(text), parse_yaml(COMMENTED.sub(r"\1", text))
    assert parse(SimulationConfig, whole, name) == parse(SimulationConfig, short, name)
    assert set(whole) == set(SimulationConfig.model_fields)
    assert len([line for line in text.splitlines() if line.strip() and not line.strip().startswith("#")]) < 50


def uncommented_alone(lines: list[str]) -> Iterator[str]:
    """Yield the text with one commented key at a time turned into a key, with its sub-keys.

    The keys are those of sections that are present.
    """
    for number, line in enumerate(lines):
        indent = len(line) - len(line.lstrip())
        above = [other for other in lines[:number] if other.strip() and len(other) - len(other.lstrip()) < indent]
        if not COMMENTED.match(line) or (indent and above[-1].lstrip().startswith("#")):
            continue
        deeper = takewhile((" " * (indent + 1)).__eq__, (other[: indent + 1] for other in lines[number + 1 :]))
        last = number + 1 + len(list(deeper))
        yield "\n".join([*lines[:number], *(COMMENTED.sub(r"\1", each) for each in lines[number:last]), *lines[last:]])


def test_each_comment_of_init_can_become_a_key_alone() -> None:
    text = simulation_text(None, "riegl_vz400i")
    expected = parse(SimulationConfig, parse_yaml(text), "short")
    single = list(uncommented_alone(text.splitlines()))
    assert len(single) > 50
    for changed in single:
        assert parse(SimulationConfig, parse_yaml(changed), "changed") == expected


def test_a_scanner_of_init_is_its_preset_in_front_of_the_site() -> None:
    own = live(simulation_text("glendale", "leica_p40"))
    assert own["scanner"] == {"preset": "leica_p40", "azimuth_step_rad": 0.0002, "zenith_step_rad": 0.0002}
    assert [model["sensor"] for model in own["sensor"]] == ["stereo"]
    assert parse(SimulationConfig, own, "init").tls_model() == read_preset("leica_p40").model()
