"""Combine several scans with one instrument: all share one set of effects, and each set-up has its own pose."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from pipeline.formats.measurements.measurement import TlsMeasurement
from pipeline.gap.residuals.ray_hits import RayGeometry
from pipeline.gap.residuals.residuals import POINT_COLUMNS
from pipeline.gap.residuals.scan_simulation import simulate_ranges
from pipeline.gap.residuals.tls_residuals import TlsResiduals, tls_residuals
from scene.common.keyed_random import KeyedRandom
from scene.geometry.mesh import FloatArray
from sensors.models.sensor_model import TlsModel


def residuals_of_scans(measurement: TlsMeasurement) -> TlsResiduals:
    """Compute the range residuals (measured minus predicted ranges) of a measurement that consists of several laser scans.

    All scans share the sensor model. The points keep the order of the measurement, and the covariates that all scans have.
    """
    count = 1 + max((scan.set_up for scan in measurement.scans), default=0)
    parts = []
    for scan, rows, one in measurement.each_scan():
        found = tls_residuals(one)
        pose = np.zeros((len(found), 6 * count))
        pose[:, 6 * scan.set_up : 6 * scan.set_up + 6] = found.pose_jacobian
        parts.append(replace(found, pose_jacobian=pose, index=rows[found.index]))
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in POINT_COLUMNS}
    shared = [name for name in parts[0].covariates if all(name in part.covariates for part in parts)]
    columns["covariates"] = {name: np.concatenate([part.covariates[name] for part in parts]) for name in shared}
    pulses: dict[str, Any] = {}
    for field in fields(parts[0].geometry):
        values = [getattr(part.geometry, field.name) for part in parts]
        pulses[field.name] = None if any(value is None for value in values) else np.concatenate(values)
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    whole = replace(parts[0], **columns, geometry=RayGeometry(**pulses), notes=notes)
    return whole.part(np.argsort(whole.index, kind="stable"))


def simulate_range_errors(
    measurement: TlsMeasurement, model: TlsModel, residuals: TlsResiduals, random: KeyedRandom
) -> FloatArray:
    """Simulate the range errors (simulated minus geometric range) that a sensor model gives at measured points.

    Parameters
    ----------
    measurement : One laser scan or several, with the reference surface.
    model : The sensor model to simulate.
    residuals : Residuals of the n points whose rays are simulated.
    random : Source of the random numbers.

    Returns
    -------
    (n,) errors, m; NaN without a return.
    """
    rays = residuals.geometry
    if not measurement.scans:
        return simulate_ranges(measurement, model, rays, random) - np.asarray(rays.range_m)
    scan_of, found = measurement.scan_of[residuals.index], np.full(len(residuals), np.nan)
    for number, scan in enumerate(measurement.scans):
        rows = np.flatnonzero(scan_of == number)
        if len(rows):
            one, seen = measurement.changed(station=scan.pose, face=scan.face, scans=()), rays.part(rows)
            found[rows] = simulate_ranges(one, model, seen, random.child("scan", number)) - seen.range_m
    return found
