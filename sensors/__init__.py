"""Cameras, laser scanner, placement, effects; what one's own sensor or effect is made of stands at the top level."""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene.lazy import lazily

if TYPE_CHECKING:
    from sensors.camera import Camera as Camera
    from sensors.camera import CameraPair as CameraPair
    from sensors.effects.base import Effect as Effect
    from sensors.effects.base import parameter as parameter
    from sensors.effects.laser import RangeEffect as RangeEffect
    from sensors.effects.laser import RangeSpread as RangeSpread
    from sensors.functions import Functions as Functions
    from sensors.model import StereoModel as StereoModel
    from sensors.model import TlsModel as TlsModel
    from sensors.observation import Observation as Observation
    from sensors.observation import Sensor as Sensor
    from sensors.pulses import PulseGeometry as PulseGeometry

_MODULES = {
    "sensors.camera": ("Camera", "CameraPair"),
    "sensors.effects.base": ("Effect", "parameter"),
    "sensors.effects.laser": ("RangeEffect", "RangeSpread"),
    "sensors.functions": ("Functions",),
    "sensors.model": ("StereoModel", "TlsModel"),
    "sensors.observation": ("Observation", "Sensor"),
    "sensors.pulses": ("PulseGeometry",),
}
__all__ = [name for names in _MODULES.values() for name in names]  # noqa: PLE0604, RUF100
__getattr__, __dir__ = lazily(__name__, {name: module for module, names in _MODULES.items() for name in names})
