"""Collect all effects that a config may name into registries.

A class becomes an effect by its presence: in a module of this folder, or in another package that names it under the entry
point `scarpsim.effects` ("name = package.module:Class"). Everything that is known about an effect is declared on its class.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import entry_points
from inspect import isabstract
from pkgutil import iter_modules
from typing import Annotated, Any, Union

from pydantic import AfterValidator, BeforeValidator, Discriminator

from scene.common.errors import nearest
from sensors.effects.base import Effect, Sensor

Effects = tuple[type[Effect], ...]

PLUG_INS = "scarpsim.effects"
"""Group of entry points by which other packages add effects."""


def _own() -> Iterator[type[Effect]]:
    """Yield the effects in this folder."""
    for module in iter_modules(__path__, f"{__name__}."):
        held = vars(import_module(module.name)).values()
        yield from (each for each in held if _is_effect(each) and each.__module__ == module.name)


def _is_effect(value: Any) -> bool:
    """Return whether a value is a concrete effect class."""
    return isinstance(value, type) and issubclass(value, Effect) and not isabstract(value) and "name" in value.__annotations__


def _registered() -> Effects:
    """Return the effects of this folder and of other packages, in the order of the sensors' chains, then by name."""
    found = {effect.tag(): effect for effect in _own()}
    for entry in sorted(entry_points(group=PLUG_INS), key=lambda entry: entry.name):
        effect = entry.load()
        if not _is_effect(effect):
            raise TypeError(f"entry point '{entry.value}' of {PLUG_INS}: needs a subclass of sensors.effects.base.Effect")
        if effect.tag() in found:
            raise ValueError(f"entry point '{entry.value}' of {PLUG_INS}: there is an effect '{effect.tag()}' already")
        found[effect.tag()] = effect
    return tuple(sorted(found.values(), key=lambda effect: (effect.stage, effect.order, effect.tag())))


EFFECTS: Effects = _registered()
_BY_NAME = {effect.tag(): effect for effect in EFFECTS}
TLS_EFFECTS: Effects = tuple(each for each in EFFECTS if each.sensor == "tls" and each.catalogue)
STEREO_EFFECTS: Effects = tuple(each for each in EFFECTS if each.sensor == "stereo" and each.catalogue)
FURTHER_EFFECTS: Effects = tuple(each for each in EFFECTS if not each.catalogue and not each.empirical)
"""Effects beyond the shared catalogue: for simulation only, not candidates of `scarpsim gap`."""


def effect_of(name: str) -> type[Effect]:
    """Return the class of a sensor effect (a systematic error or noise) by its name, such as "tls.wobble" or "wobble".

    Raises KeyError for an unknown name.
    """
    return _BY_NAME[name.rpartition(".")[2]]


def catalogue(sensor: Sensor) -> Effects:
    """Return the effects (systematic errors and noise) of one sensor that `scarpsim gap` may name as a cause.

    sensor: "tls" (laser scanner) or "stereo".
    """
    return TLS_EFFECTS if sensor == "tls" else STEREO_EFFECTS


def _named(effects: Effects) -> Any:
    """Return the type of one entry of an `effects:` list: a mapping whose `name` selects the class among `effects`."""
    names = [effect.tag() for effect in effects]
    prefix = f"{effects[0].sensor}."

    def check(value: Any) -> Any:
        if isinstance(value, dict):
            name = str(value.get("name", "")).removeprefix(prefix)
            if name not in names:
                known = nearest(name, names) or f"allowed: {', '.join(names)}"
                raise ValueError(f"unknown {effects[0].sensor} effect '{name}'; {known}")
            return {**value, "name": name}
        return value

    checks = BeforeValidator(check), AfterValidator(_doing_something)
    return Annotated[Union[effects], Discriminator("name"), *checks]  # noqa: UP007 (built at run time)


def _doing_something(effect: Effect) -> Effect:
    """Refuse an effect without the parameter that switches it on. One whose parameter is explicitly set to null is allowed."""
    switches = list(effect.nulls()) or [key for key in type(effect).model_fields if key.startswith("values_")]
    if effect.is_null and not effect.model_fields_set.intersection(switches):
        raise ValueError(f"{effect.name} does nothing without {' or '.join(switches)}; give a value")
    return effect


TlsEffect = _named(tuple(each for each in EFFECTS if each.sensor == "tls"))
StereoEffect = _named(tuple(each for each in EFFECTS if each.sensor == "stereo"))
"""What a config may name: the catalogue, and the empirical effects that `scarpsim gap` adds for what it does not explain."""
