"""Define what an ICP study finds: the error of each registration, and the recommended settings."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.registration.register import IcpConfig

Parameter = Literal["subsample_ratio", "outlier_distance_threshold"]
"""A setting of ICP that is studied: the share of points that are left out, or the distance, m, beyond which a pair is ignored."""


@dataclass(frozen=True)
class PoseError:
    """Error of an estimated registration: how far it moves the reference's points from where the true registration puts them.

    Attributes
    ----------
    normal_m, displacement_m : float
        RMS over the points of the displacement's component along the surface normal, and of the whole displacement, m.
    translation_m : (3,) tuple
        Displacement of the points' centroid, wall frame, m.
    rotation_rad : (3,) tuple
        Rotation vector of the error: its axis times its angle, wall frame, rad.
    """

    normal_m: float
    displacement_m: float
    translation_m: tuple[float, ...]
    rotation_rad: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the error of the registration by the names of its attributes, as icp_study.json stores it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class StudyRow:
    """Result of one ICP registration in a study, in which one setting of ICP is varied.

    Results are None if ICP found too few pairs of points.

    Attributes
    ----------
    parameter, value
        The setting that is varied ("subsample_ratio", the share of points left out, or "outlier_distance_threshold"), and its
        value (a share, or m).
    gradual : bool
        Whether the outlier threshold decreased to its value over the first iterations, or was constant.
    epoch, repeat : int
        Number of the epoch, and of the repetition with another random subsample of its points.
    rms_m, inlier_share
        RMS residual of the points within the outlier threshold, m, and the share of points within it. They are computed from
        points of the whole cloud, not only of the subsample that was registered.
    normal_error_m, displacement_m
        RMS displacement of the reference's points by the error of the registration: along the surface normals, and in all, m.
    iterations, seconds
        Iterations and duration of the registration.
    """

    parameter: Parameter
    value: float
    gradual: bool
    epoch: int
    repeat: int
    rms_m: float | None
    normal_error_m: float | None
    displacement_m: float | None
    inlier_share: float | None
    iterations: int | None
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the result of the registration by the names of its attributes, as the study's JSON and CSV files store it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class Recommendation:
    """A recommended value of an ICP setting, for the report of a study.

    Attributes
    ----------
    parameter : str
        The setting: "subsample_ratio", the share of points that are left out, or "outlier_distance_threshold".
    value : float
        The recommended value: a share, or m.
    good : (float, float)
        Lowest and highest value whose error is nearly the smallest: at most 10 % or 0.1 mm above that of the best value.
    normal_error_m : float
        RMS error along the surface normals that remains with the recommended value, m.
    """

    parameter: Parameter
    value: float
    good: tuple[float, float]
    normal_error_m: float

    def to_dict(self) -> dict[str, Any]:
        """Return the recommendation by the names of its attributes, as icp_study.json stores it."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class IcpStudy:
    """The result of an ICP study: how the error of the registration depends on the settings of ICP.

    Attributes
    ----------
    sensor : str
        "stereo" or "tls" (laser scanner).
    config : IcpConfig
        Settings of ICP that were not varied.
    offset_m : float
        Size of the known motion by which each epoch was moved before its registration, m.
    sigma_m : float
        Noise: robust standard deviation (NMAD) of the distances along the normals at the true pose, m. The outlier thresholds
        that were tried are multiples of it.
    rows : list of StudyRow
        All registrations.
    recommended : list of Recommendation
        The recommended settings.
    applied : dict
        Error of the registration that the command `simulate` applied, by number of the epoch; None for an epoch without ICP.
    """

    sensor: str
    config: IcpConfig
    offset_m: float
    sigma_m: float
    rows: list[StudyRow]
    recommended: list[Recommendation]
    applied: dict[int, PoseError | None]

    def to_dict(self) -> dict[str, Any]:
        """Return the whole study as icp_study.json stores it."""
        return {
            "schema": 1,
            "sensor": self.sensor,
            "icp": self.config.model_dump(mode="json"),
            "offset_m": self.offset_m,
            "sigma_m": self.sigma_m,
            "recommended": [each.to_dict() for each in self.recommended],
            "applied": [{"epoch": k, **({} if e is None else e.to_dict())} for k, e in self.applied.items()],
            "rows": [row.to_dict() for row in self.rows],
        }
