"""A commented config loads into the same config, and says what each key is."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from pipeline.commented import commented_yaml
from scene.config import Config, parse
from scene.yaml_text import parse_yaml


class Style(Enum):
    STRATA, JOINTS = "strata", "joints"


class Imported(Config):
    """A wall from a file."""

    kind: Literal["imported"] = "imported"
    path: Path = Field(Path("wall.ply"), description="the mesh file")


class Procedural(Config):
    kind: Literal["procedural"] = "procedural"
    size_m: tuple[float, float] = Field((70.0, 45.0), description="width and height")
    style: Style = Style.STRATA


class Effect(Config):
    name: str = Field(description="its name in the catalogue")
    offset_m: float = Field(0.0, gt=-1.0, lt=1.0)


class Whole(Config):
    """A simulation."""

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


def test_the_text_loads_into_the_same_config() -> None:
    for config in (CONFIG, Whole()):
        assert parse(Whole, parse_yaml(commented_yaml(config)), "text") == config


def test_each_key_is_explained() -> None:
    lines = commented_yaml(CONFIG).splitlines()
    above = {line.strip().partition(":")[0]: lines[number - 1].strip() for number, line in enumerate(lines) if ":" in line}
    assert lines[0] == "# A simulation."
    assert above["seed"] == "# seed of all random numbers; from 0; default 1"
    assert above["sigma_px"] == "# noise of the image points; pixels; above 0 up to 2; default 1.0e-05"
    assert above["mode"] == "# one of fast, fine"
    assert above["wall"] == "# the wall; kinds: kind=imported, kind=procedural"
    assert above["offset_m"] == "# m; above -1.0 below 1.0"
