"""Write the folder of a calibration: calibrated.yaml, calibration.json, pictures and report.html."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration.calibrate import CalibrationResult, GreedyComparison
from pipeline.calibration.noise_map import noise_map
from pipeline.calibration.report import pictures, scale_m, write_calibration_report
from pipeline.config.simulation import SimulationConfig
from pipeline.formats.files.atomic import filling, write_bytes, write_json, write_text
from pipeline.formats.rasters.geotiff import write_geotiff
from pipeline.report.figures import SCALE_SIGMAS
from pipeline.report.map_styles import difference_style
from pipeline.report.provenance import versions
from scene.common.keyed_random import KeyedRandom
from scene.common.yaml_text import yaml_line
from scene.geometry.mesh import FloatArray

MODEL_FILE, RECORD_FILE, REPORT_FILE = "calibrated.yaml", "calibration.json", "report.html"


def write(out: Path, config: SimulationConfig, result: CalibrationResult, inputs: Sequence[Path]) -> Path:
    """Write all files of a calibration (model, record, maps, report) into a folder, which appears only when complete.

    Parameters
    ----------
    out : Folder to write.
    config : The config with all defaults filled in.
    result : The calibration.
    inputs : Paths from which the maps were read, for the record.

    Returns
    -------
    Path of the report.

    Raises
    ------
    InputError
        If the folder is in use.
    """
    with filling(out) as folder:
        _write(folder, config, result, inputs)
    return out / REPORT_FILE


def _write(out: Path, config: SimulationConfig, result: CalibrationResult, inputs: Sequence[Path]) -> None:
    """Write all files into a folder."""
    write_text(out / MODEL_FILE, model_yaml(result))
    limit = SCALE_SIGMAS * scale_m(result)
    write_geotiff(out / "systematic.tif", result.systematic, result.inputs.grid, description="mean of the measured maps")
    difference_style(out / "systematic.tif", limit)
    whole = None if result.inputs.of_points else _whole_map(config, result)
    if whole is not None:
        write_geotiff(out / "simulated.tif", whole, result.inputs.grid, description="simulated with the calibrated noise")
        difference_style(out / "simulated.tif", limit)
    shown = pictures(result, whole)
    for name, _, png in shown:
        write_bytes(out / f"{name}.png", png)
    record = {"schema": 1, **to_dict(result), "inputs": inputs, "seed": config.seed}
    write_json(out / RECORD_FILE, record | {"config": config.model_dump(mode="json"), "versions": versions()})
    write_calibration_report(out / REPORT_FILE, result, shown, config.model_dump(mode="json"))


def _whole_map(config: SimulationConfig, result: CalibrationResult) -> FloatArray:
    """Simulate one map of the whole wall on the measured maps' grid, m; NaN where those have no data."""
    site = result.simulated_site()
    random = KeyedRandom(config.seed).child("calibrate", "whole")
    values = noise_map(config, site, site, site.caster_of(site.mesh), random, result.inputs.grid)
    return np.where(np.isnan(result.inputs.maps[-1]), np.float32(np.nan), values)


def model_yaml(result: CalibrationResult) -> str:
    """Return the calibrated sensor model as YAML, with the intervals as comments.

    The file can be used as `simulate --set sensor=calibrated.yaml`.
    """
    found, names = result.found, result.parameters.names
    share = result.confidence
    lines = [f"# Calibrated on {len(result.epochs)} difference map(s) by scarpsim calibrate; intervals of {100 * share:.0f} %."]
    for name, value, low, high in zip(names, *(np.exp(each) for each in (found.x, found.low, found.high)), strict=True):
        lines.append(f"# {name}: {value:.4g} ({low:.4g} to {high:.4g})")
    return "\n".join(lines) + "\n" + _yaml(_rounded(result.model.model_dump(mode="json")), 0)


def _yaml(values: dict[str, Any], depth: int) -> str:
    """Format nested mappings as block YAML, and anything else on one line."""
    text = ""
    for key, value in values.items():
        if isinstance(value, dict) and value:
            text += f"{'  ' * depth}{key}:\n{_yaml(value, depth + 1)}"
        else:
            text += f"{'  ' * depth}{key}: {yaml_line(value)}\n"
    return text


def _rounded(value: Any) -> Any:
    """Round all numbers to six digits, and write orientation errors of mean 0 as their sigma alone."""
    if isinstance(value, dict):
        if set(value) == {"mean", "sigma"} and value["mean"] == 0:
            return _rounded(value["sigma"])
        return {key: _rounded(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def to_dict(result: CalibrationResult) -> dict[str, Any]:
    """Return all results of a calibration as the dictionary that is written to `calibration.json`."""
    found, names = result.found, result.parameters.names
    values = zip(names, *(np.exp(each) for each in (found.x, found.low, found.high)), strict=True)
    scatter = np.sqrt(np.diag(found.surface.covariance))
    expected = found.surface.mean(found.x)
    return {
        "sensor": result.sensor,
        "reference_error_m": 0.0 if result.inputs.reference_error is None else result.inputs.reference_error.sigma_m,
        "parameters": {name: {"value": value, "low": low, "high": high} for name, value, low, high in values},
        "confidence": result.confidence,
        "correlation": {"names": names, "matrix": found.correlation},
        "inseparable": [{"names": [first, second], "correlation": value} for first, second, value in result.inseparable()],
        "orientation_patterns": None if result.patterns is None else result.patterns.to_dict(),
        "cost": {
            "value": found.cost,
            "statistics": len(result.statistics),
            "p_value": found.misfit_p,
            "settled": found.converged,
        },
        "statistics": [
            {"name": name, "measured": measured, "expected": mean, "log_sigma": sigma, "standardised": misfit}
            for name, measured, mean, sigma, misfit in zip(
                result.statistics, np.exp(result.observed), np.exp(expected), scatter, found.misfit, strict=True
            )
        ],
        "epochs": [each.to_dict() for each in result.epochs],
        "trend": {"median": result.median_trend.to_dict(), "standard_deviation": result.std_trend.to_dict()},
        "stable": {
            "drawn": result.inputs.drawn,
            "share": float(np.mean(result.inputs.stable)),
            "windows": len(result.windows.corner),
            "window_px": result.windows.side,
        },
        "search": {
            "simulated_maps": found.maps,
            "observations_per_s": result.rate,
            "cells_per_observation": result.cells,
            "seconds": result.seconds,
        },
        "single_ranges": None if result.single_ranges is None else result.single_ranges.to_dict(),
        "greedy": None if result.baseline is None else _baseline(result, result.baseline),
    }


def _baseline(result: CalibrationResult, baseline: GreedyComparison) -> dict[str, Any]:
    """Return the greedy search's part of `calibration.json`."""
    return {
        "parameters": dict(zip(result.parameters.names, np.exp(baseline.result.x), strict=True)),
        "simulated_maps": baseline.result.tests,
        "relative_error_of_std": baseline.result.relative_error,
        "cost": baseline.cost,
        "overtaken_after_maps": baseline.overtaken,
        "cost_here": [{"simulated_maps": maps, "cost": cost} for maps, cost in baseline.costs],
    }
