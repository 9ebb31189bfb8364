"""Subsample scans whose residuals would not fit into memory, by drawing pulses at random over the whole scan.

Points are drawn, not lines or areas: an effect may repeat along lines, and areas would not cover the wall. If the scan
pattern is known, its pulses are drawn, so that a lost pulse is as likely to be drawn as one that returned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement
from pipeline.gap.residuals.tls_residuals import pulse_count, pulse_number, recorded_polar
from pipeline.gap.thresholds import thresholds
from scene.common.keyed_random import KeyedRandom


def subsample_measurement(measurement: Measurement, random: KeyedRandom) -> tuple[Measurement, NDArray[np.int64]]:
    """Draw a random subsample of a laser scan or of a cloud without cameras that is too large for the memory.

    About two million points are kept (the threshold `points.most`). A stereo pair keeps all its points. Call `with_scan_order`
    before it: the scan line and time of each pulse cannot be recovered from a subsample.

    Parameters
    ----------
    measurement : The measurement.
    random : Source of the random numbers.

    Returns
    -------
    The subsampled measurement, with a note for the user if points were left out, and the (m,) row numbers of its points in the
    full one.
    """
    count, most = len(measurement.cloud.points), thresholds().points.most
    if isinstance(measurement, StereoMeasurement) or count <= most:
        return measurement, np.arange(count)
    share, generator, pulses = most / count, random.generator(), None
    if isinstance(measurement, SurfaceMeasurement) or measurement.pattern is None:
        drawn = generator.random(count, dtype=np.float32) < share
    else:
        pulses = generator.random(pulse_count(measurement.pattern), dtype=np.float32) < share
        azimuth, zenith, _ = recorded_polar(measurement)
        drawn = pulses[pulse_number(measurement.pattern, azimuth, zenith)]
    rows = np.flatnonzero(drawn)
    note = (
        f"a random subsample of {len(rows):,} of {count:,} points was used, so the smallest change of the scene that can be "
        f"detected is {1 / share:.1f} times as large; use --set points.most=... for more points (1.5 kB of memory each)"
    )
    part = measurement.part(rows).changed(notes=(*measurement.notes, note))
    return part if isinstance(part, SurfaceMeasurement) else part.changed(pulses=pulses), rows
