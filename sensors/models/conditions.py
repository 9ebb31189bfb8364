"""Change a sensor's effects and pose from one epoch of a series to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, Tag

from scene.common.config import Config, parse
from scene.common.course import Course
from scene.common.errors import nearest
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.effects import EFFECTS, effect_of
from sensors.effects.base import Effect
from sensors.models.sensor_model import StereoModel, TlsModel

_WHERE = "series.conditions"
_AXES = ("x", "y", "z")

AxisCourses = Annotated[
    Annotated[Course, Tag("all axes")] | Annotated[tuple[Course, Course, Course], Tag("per axis")],
    Discriminator(lambda value: "per axis" if isinstance(value, list | tuple) else "all axes"),
]
"""One course (a quantity over time: random walk, drift, cycle or table) for all three axes, or a list of three, x, y, z.

A random walk is drawn for each axis independently.
"""


class PoseCourses(Config):
    """How the sensor's real pose departs from the surveyed one over a series of epochs.

    The pose is position and rotation. Each quantity is a course, that is a function of time: a random walk, a drift, a cycle or
    a table.
    """

    position_m: AxisCourses | None = Field(None, description="real minus surveyed position, world x, y, z [m]")
    rotation_rad: AxisCourses | None = Field(
        None, description="rotation of the real against the surveyed pose about world x, y, z; of cameras about their own [rad]"
    )


def _parameters(values: Any) -> Any:
    """Check the names of effects and parameters; a course directly under an effect is that of its only main parameter."""
    if not isinstance(values, dict):
        return values
    return {name: _of_effect(str(name), courses) for name, courses in values.items()}


def _of_effect(name: str, courses: Any) -> Any:
    """Return the courses (changes over time) of one effect's parameters, by parameter."""
    names = [effect.tag() for effect in EFFECTS]
    if name.rpartition(".")[2] not in names:
        raise ValueError(f"unknown effect '{name}'; {nearest(name, names) or 'see the effects of the reference'}")
    kind = effect_of(name)
    known = [key for key, info in kind.model_fields.items() if isinstance(info.json_schema_extra, dict)]
    if isinstance(courses, dict) and courses and set(courses) <= set(Course.model_fields):
        main = list(kind.nulls())
        if len(main) != 1:
            raise ValueError(f"'{name}' has several parameters, so name one: {', '.join(known)}")
        return {main[0]: courses}
    for key in courses if isinstance(courses, dict) else ():
        if key not in known:
            raise ValueError(f"'{name}' has no parameter '{key}'; {nearest(str(key), known) or 'allowed: ' + ', '.join(known)}")
    return courses


EffectCourses = Annotated[dict[str, dict[str, Course]], BeforeValidator(_parameters)]
"""Changes of effects' parameters over time: a course for each parameter, by effect and parameter."""


@dataclass(frozen=True)
class PoseShift:
    """Difference of a sensor's real from its surveyed pose (position and rotation) at one epoch, world frame.

    position_m: (3,) displacement along the axes, m. rotation_rad: (3,) rotation about the axes, rad.
    """

    position_m: FloatArray
    rotation_rad: FloatArray

    @property
    def is_null(self) -> bool:
        """Whether the sensor's real pose is the surveyed one: no displacement and no rotation."""
        return not (self.position_m.any() or self.rotation_rad.any())


def pose_shifts(courses: PoseCourses | None, hours: FloatArray, random: KeyedRandom) -> list[PoseShift]:
    """Draw the difference of a sensor's real from its surveyed pose at each of n epochs.

    Parameters
    ----------
    courses : PoseCourses, optional
        How the pose departs over time; None: not at all.
    hours : (n,) array
        Times of the epochs, h after the first.
    random : KeyedRandom
        Source of random numbers.

    Returns
    -------
    list of n PoseShift
    """
    found = np.zeros((2, len(hours), 3))
    for row, name in enumerate(("position_m", "rotation_rad")):
        given: AxisCourses | None = None if courses is None else getattr(courses, name)
        if given is None:
            continue
        for axis, course in enumerate(given if isinstance(given, tuple) else (given,) * 3):
            found[row, :, axis] = course.values(hours, random.child(name, _AXES[axis]))
    return [PoseShift(found[0, number], found[1, number]) for number in range(len(hours))]


def effect_values(courses: EffectCourses, hours: FloatArray, random: KeyedRandom) -> dict[str, dict[str, FloatArray]]:
    """Draw by how much each parameter of a sensor's errors (effects) is larger than configured at each of n epochs.

    Parameters
    ----------
    courses : mapping
        By effect and parameter, how the parameter departs over time.
    hours : (n,) array
        Times of the epochs, h after the first.
    random : KeyedRandom
        Source of random numbers.

    Returns
    -------
    dict of dict of (n,) arrays
        Departures by effect and parameter, in the parameter's unit.
    """
    return {
        name: {key: course.values(hours, random.child(name, key)) for key, course in parameters.items()}
        for name, parameters in courses.items()
    }


def with_effects(model: TlsModel, values: Mapping[str, Mapping[str, float]]) -> TlsModel:
    """Return a scanner's model with changed parameters of its errors, such as those of one epoch of a time series.

    Parameters
    ----------
    model : TlsModel
        The model as configured.
    values : mapping
        What to add, by effect and parameter. Effects of other sensors are ignored. An effect that the model does not have
        begins at its null values, at which it is off.

    Raises
    ------
    InputError
        If a value is then out of its bounds.
    """
    return model.model_copy(update={"effects": _changed(model.effects, "tls", values)})


def with_stereo_effects(model: StereoModel, values: Mapping[str, Mapping[str, float]], shift: PoseShift) -> StereoModel:
    """Return a stereo pair's model with changed parameters of its errors, such as those of one epoch of a time series.

    Parameters
    ----------
    model : StereoModel
        The model as configured.
    values : mapping
        What to add, by effect and parameter. Effects of other sensors are ignored.
    shift : PoseShift
        Difference of the real from the surveyed pose of both cameras.
    """
    effects = _changed(model.effects, "stereo", values)
    if not shift.is_null:
        moved = [{"name": "camera_shift", **dict(zip(("x_m", "y_m", "z_m"), shift.position_m.tolist(), strict=True))}]
        turned = zip(("camera_omega", "camera_phi", "camera_kappa"), shift.rotation_rad.tolist(), strict=True)
        moved += [{"name": name, "angle_rad": angle} for name, angle in turned]
        effects += tuple(parse(effect_of(each["name"]), {**each, "camera": "both"}, f"{_WHERE}.pose") for each in moved)
    return model.model_copy(update={"effects": effects})


def _changed(effects: tuple[Any, ...], sensor: str, values: Mapping[str, Mapping[str, float]]) -> tuple[Effect, ...]:
    """Return the effects with the parameters of those of one sensor increased by `values`, by effect and parameter."""
    found: list[Effect] = list(effects)
    for name, parameters in values.items():
        kind = effect_of(name)
        if kind.sensor != sensor:
            continue
        if not any(each.name == kind.tag() for each in found):
            found.append(kind.model_validate({"name": kind.tag()}))
        for place, each in enumerate(found):
            if each.name == kind.tag():
                now = {key: getattr(each, key) + value for key, value in parameters.items()}
                found[place] = parse(kind, {**each.model_dump(), **now}, f"{_WHERE}.effects.{name}")
    return tuple(found)
