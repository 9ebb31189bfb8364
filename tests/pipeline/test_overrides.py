"""The option `--set`, and the YAML values that it takes."""

from __future__ import annotations

from typing import Any

import pytest
import yaml

from pipeline.config.overrides import apply_overrides
from scene.common.errors import InputError
from scene.common.yaml_text import parse_yaml

VALUES: dict[str, Any] = {"seed": 1, "wall": None, "sensor": [{"noise": {"range_sigma_m": 0.003}}, {"noise": {}}], "effects": []}


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("seed=7", ["seed"], 7),
        ("sensor.0.noise.range_sigma_m=2e-3", ["sensor", 0, "noise", "range_sigma_m"], 0.002),
        ("sensor.1={noise: {angle_sigma_rad: 1e-5}}", ["sensor", 1], {"noise": {"angle_sigma_rad": 1e-5}}),
        ("wall.size_m=[70, 45.0]", ["wall", "size_m"], [70, 45.0]),
        ("new.section.key=true", ["new", "section", "key"], True),
        ("name=a=b", ["name"], "a=b"),
        ("seed=null", ["seed"], None),
        ("name=''", ["name"], ""),
        (" seed = -3 ", ["seed"], -3),
        ("effects=[{name: range_offset}]", ["effects"], [{"name": "range_offset"}]),
    ],
)
def test_an_override_lands_in_its_place(override: str, path: list[Any], value: Any) -> None:
    found: Any = apply_overrides(VALUES, [override])
    for part in path:
        found = found[part]
    assert found == value
    assert type(found) is type(value)


def test_the_rest_and_the_original_stay_as_they_are() -> None:
    before = repr(VALUES)
    changed = apply_overrides(VALUES, ["sensor.0.noise.range_sigma_m=1", "seed=2", "seed=3"])
    assert repr(VALUES) == before
    assert changed == {**VALUES, "seed": 3, "sensor": [{"noise": {"range_sigma_m": 1}}, {"noise": {}}]}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("seed", "no '='"),
        ("=3", "key is empty"),
        ("sensor..x=3", "key is empty"),
        ("seed=", "no value"),
        ("seed=[1, 2", "not valid YAML"),
        ("seed=!!python/object/apply:os.getcwd []", "not valid YAML"),
        ("seed.x=3", "'seed' is the value 1"),
        ("seed.x.y=3", "'seed' is the value 1"),
        ("sensor.2.noise=3", "allowed: 0 to 1"),
        ("sensor.-1=3", "allowed: 0 to 1"),
        ("sensor.noise.x=3", "not an index of the list 'sensor'"),
        ("effects.0.name=x", "set it as a whole: effects=[...]"),
    ],
)
def test_a_malformed_override_is_named(override: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        apply_overrides(VALUES, [override])
    assert str(caught.value).startswith(f"--set {override}: ")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("-2E5", -2e5),
        ("+.5", 0.5),
        ("010", 10),
        ("0x1F", 31),
        ("1:30", "1:30"),
        ("2026-11-21", "2026-11-21"),
        ("no", "no"),
        ("True", True),
        ("~", None),
        ("1_000", "1_000"),
        ("{a: &x {k: 1e3}, b: {<<: *x, j: 2}}", {"a": {"k": 1000.0}, "b": {"k": 1000.0, "j": 2}}),
    ],
)
def test_yaml_is_the_core_schema(text: str, value: Any) -> None:
    found = parse_yaml(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("text", ["a: 1\nb: 2\na: 3", "x: {a: 1, a: 2}", "!!python/name:os.system", "[" * 5000, "*missing"])
def test_yaml_refuses_what_would_go_wrong_silently(text: str) -> None:
    with pytest.raises(yaml.YAMLError):
        parse_yaml(text)
