"""Simulate the two sensors, a stereo pair and a terrestrial laser scanner, with their systematic errors and noise.

Surfaces and maps are made from observations in `pipeline`. The names below can be imported from `sensors` itself by code that
adds an effect or a sensor of its own. Start with `laser/tls.py` or `stereo/stereo_pair.py`; each error of a sensor is one file
in `effects`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene.common.lazy import lazy_attributes

if TYPE_CHECKING:
    from sensors.cameras.camera import Camera as Camera
    from sensors.cameras.camera import CameraPair as CameraPair
    from sensors.effects.base import Effect as Effect
    from sensors.effects.base import parameter as parameter
    from sensors.effects.laser import RangeEffect as RangeEffect
    from sensors.effects.laser import RangeSpread as RangeSpread
    from sensors.models.sensor_model import StereoModel as StereoModel
    from sensors.models.sensor_model import TlsModel as TlsModel
    from sensors.numerics.functions import Functions as Functions
    from sensors.signal_chain.observation import Observation as Observation
    from sensors.signal_chain.observation import Sensor as Sensor
    from sensors.signal_chain.pulses import PulseGeometry as PulseGeometry

_MODULES = {
    "sensors.cameras.camera": ("Camera", "CameraPair"),
    "sensors.effects.base": ("Effect", "parameter"),
    "sensors.effects.laser": ("RangeEffect", "RangeSpread"),
    "sensors.numerics.functions": ("Functions",),
    "sensors.models.sensor_model": ("StereoModel", "TlsModel"),
    "sensors.signal_chain.observation": ("Observation", "Sensor"),
    "sensors.signal_chain.pulses": ("PulseGeometry",),
}
__all__ = [name for names in _MODULES.values() for name in names]  # noqa: PLE0604, RUF100
__getattr__, __dir__ = lazy_attributes(__name__, {name: module for module, names in _MODULES.items() for name in names})
