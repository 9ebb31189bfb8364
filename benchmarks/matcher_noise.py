"""Fit the simulated matching noise to the errors of semi-global matching, and tabulate both (docs/validation/matching.md).

The fit uses differential evolution and a simplex search on two rendered walls, once for SGBM and once for SGBM with refinement.
It is validated on walls and real pictures (the Middlebury motorcycle) that it has not seen. Pixels are those of the matched
pictures; the model's lengths, in px of the full frame, are scaled by the reduction (4 at medium quality).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matcher_cases import MATCHERS, SGBM, Case, Raster, motorcycle, rendered

from sensors.models.sensor_model import StereoModel

FITTED_ON = (("glendale", 7), ("bulga", 7))
VALIDATED_ON = (("glendale", 11), ("bismantova", 3))
LAGS = (1, 2, 4, 8)
QUANTILES = (50, 68, 90, 95, 99)
RIM_PX = 3
"""How far beside a depth step fattening is looked for, cells."""
BOUNDS = ((0.0, 0.3), (0.0, 0.6), (1.0, 8.0), (0.0, 1.2), (0.0, 3.0), (0.0, 3.0), (-0.15, 0.15))
"""Of the parameters of `model`, px of the matched pictures; a refined match has no locking left to be fitted."""
INTEGER = (False, False, False, False, False, True, False)
POLISHING = 250
"""Evaluations of the simplex search that follows the evolution."""
SEED = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motorcycle", type=Path, default=Path("/work/shared/data/stereo_motorcycle"))
    parser.add_argument("--generations", type=int, default=10, help="of the differential evolution")
    chosen = parser.parse_args()
    fitted_on = [rendered(*wall) for wall in FITTED_ON]
    models = {matcher: fit([case.middle() for case in fitted_on], matcher, chosen.generations) for matcher in MATCHERS}
    for matcher, values in models.items():
        print(f"{matcher}, px of the frame at medium quality: {describe(model(values, 4))}\n")
    print("| pair | errors of | matched % | bias | MAD-sigma | 95 % | > 1 px % | kurtosis | r(1) | r(8) | locking | fattened % |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for case in fitted_on:
        report(case, models, "fitted on")
    for wall in VALIDATED_ON:
        report(rendered(*wall), models, "not seen")
    if chosen.motorcycle.exists():
        report(motorcycle(chosen.motorcycle), models, "not seen")


def model(values: Sequence[float], reduction: int) -> StereoModel:
    """Return the sensor model, px of the frame, of parameters in px of the matched pictures.

    values: white noise; sigma, step and tail of heavy-tailed noise; smoothing; fattening; and locking, if there is any.
    """
    white, sigma, step, tail, smoothing, radius, *rest = (float(value) for value in values)
    locking = rest[0] if rest else 0.0
    return StereoModel(
        noise={"parallax_sigma_px": white * reduction, "regularization_sigma_px": 0.0},
        effects=[
            {"name": "edge_fattening", "radius_px": radius * reduction},
            {"name": "smoothing", "sigma_px": smoothing * reduction},
            {"name": "heavy_tailed_noise", "sigma_px": sigma * reduction, "step_px": step * reduction, "tail": tail},
            {"name": "pixel_locking", "amplitude_px": locking * reduction},
        ],
    )


def describe(fitted: StereoModel) -> str:
    effects = (effect.model_dump(exclude_none=True) for effect in fitted.effects)
    named = ({key: value if isinstance(value, str) else round(value, 3) for key, value in effect.items()} for effect in effects)
    return f"parallax_sigma_px {fitted.noise.parallax_sigma_px:.3f}; " + "; ".join(str(effect) for effect in named)


def fit(cases: Sequence[Case], matcher: str, generations: int) -> list[float]:
    """Return the parameters of `model` whose errors are most like the matcher's in all of `cases`."""
    from scipy.optimize import differential_evolution, minimize

    bounds = np.array(BOUNDS if matcher == SGBM else BOUNDS[:-1])
    integer = np.array(INTEGER)[: len(bounds)]
    wanted = [Errors.of(case.found[matcher], case.true, case.found[matcher]).features() for case in cases]

    def distance(values: Sequence[float]) -> float:
        total = 0.0
        for case, target in zip(cases, wanted, strict=True):
            found = case.simulated(model(values, case.reduction), SEED)
            total += float(np.mean(np.square(Errors.of(found, case.true, case.found[matcher]).features() - target)))
        return total

    result = differential_evolution(
        distance, bounds, integrality=integer, popsize=5, maxiter=generations, seed=SEED, tol=1e-3, polish=False, init="sobol"
    )
    free = ~integer

    def completed(part: np.ndarray) -> np.ndarray:
        values = result.x.copy()
        values[free] = part
        return values

    steps = np.diag(np.ptp(bounds[free], axis=1) / 20)
    options = {"maxfev": POLISHING, "initial_simplex": np.vstack([result.x[free], result.x[free] + steps])}
    polished = minimize(
        lambda part: distance(completed(part)), result.x[free], method="Nelder-Mead", bounds=bounds[free], options=options
    )
    evaluations = result.nfev + polished.nfev
    print(
        f"{matcher}: mean square of the differences {polished.fun / len(cases):.2f} after {evaluations} evaluations", flush=True
    )
    return list(completed(polished.x))


@dataclass(frozen=True)
class Errors:
    """Found minus true disparity, (rows, columns), NaN where unknown; true: the true one; rim: the far side of a depth step."""

    error: Raster
    true: Raster
    rim: np.ndarray

    @classmethod
    def of(cls, found: Raster, true: Raster, where: Raster) -> Errors:
        """Return the errors of the cells where `where` is known too, so that matchers are compared on the same cells."""
        error = np.where(np.isnan(where), np.nan, found - true)
        window = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
        nearest = cv2.dilate(np.where(np.isnan(true), -np.inf, true), window)
        slope = RIM_PX * 0.5  # px: rock as steep as this is no step
        return cls(error, true, nearest - true > slope + 1)

    def features(self) -> np.ndarray:
        """Return what the fit compares, each divided by the difference that counts as one."""
        error = self.error[~np.isnan(self.error)]
        inner = np.where(np.abs(self.error) < 1, self.error, np.nan)
        sizes = np.percentile(np.abs(error), QUANTILES)
        return np.array(
            [
                *np.log(np.maximum(sizes, 1e-3)) / 0.1,
                np.log(max(np.mean(np.abs(error) > 1), 1e-4)) / 0.1,
                self.kurtosis / 0.3,
                *(correlation(inner, lag) / 0.05 for lag in LAGS),
                *self.locking / 0.01,
                self.fattened / 0.02,
            ]
        )

    @property
    def inner(self) -> np.ndarray:
        """(n,) errors below 1 px."""
        return self.error[np.abs(self.error) < 1]

    @property
    def kurtosis(self) -> float:
        """Excess kurtosis of the errors below 1 px."""
        centred = self.inner - self.inner.mean()
        return float(np.mean(centred**4) / np.mean(centred**2) ** 2 - 3)

    @property
    def locking(self) -> np.ndarray:
        """Factors of sine and cosine of the true disparity's fraction in the errors below 1 px, by least squares; px."""
        phase = 2 * np.pi * self.true[np.abs(self.error) < 1]
        design = np.stack([np.ones_like(phase), np.sin(phase), np.cos(phase)], axis=1)
        return np.linalg.lstsq(design, self.inner)[0][1:]

    @property
    def fattened(self) -> float:
        """Beside depth steps, the share of cells more than 1 px too near minus that of cells more than 1 px too far."""
        rim = self.error[self.rim & ~np.isnan(self.error)]
        return float(np.mean(rim > 1) - np.mean(rim < -1)) if rim.size else 0.0


def correlation(error: Raster, lag: int) -> float:
    """Autocorrelation of the errors along the row."""
    first, second = error[:, :-lag].ravel(), error[:, lag:].ravel()
    both = ~np.isnan(first) & ~np.isnan(second)
    return float(np.corrcoef(first[both], second[both])[0, 1])


def report(case: Case, models: dict[str, list[float]], role: str) -> None:
    """Print the rows of one pair: each matcher and its simulation, and the model's defaults."""
    for matcher, values in models.items():
        found = case.found[matcher]
        row(f"{case.name}, {role}", matcher, found, case, found)
        row("", f"simulated as {matcher}", case.simulated(model(values, case.reduction), SEED + 1), case, found)
    row("", "simulated, defaults", case.simulated(StereoModel(), SEED + 1), case, found)


def row(pair: str, name: str, found: Raster, case: Case, where: Raster) -> None:
    errors = Errors.of(found, case.true, where)
    known, inner = errors.error[~np.isnan(errors.error)], np.where(np.abs(errors.error) < 1, errors.error, np.nan)
    figures = [
        (100 * np.count_nonzero(~np.isnan(found) & ~np.isnan(case.true)) / np.count_nonzero(~np.isnan(case.true)), 1),
        (np.median(known), 3),
        (1.4826 * np.median(np.abs(known - np.median(known))), 3),
        (np.percentile(np.abs(known), 95), 2),
        (100 * np.mean(np.abs(known) > 1), 2),
        (errors.kurtosis, 1),
        (correlation(inner, 1), 2),
        (correlation(inner, 8), 2),
        (np.hypot(*errors.locking), 3),
        (100 * errors.fattened, 1),
    ]
    print(f"| {pair} | {name} | " + " | ".join(f"{value:.{digits}f}" for value, digits in figures) + " |", flush=True)


if __name__ == "__main__":
    main()
