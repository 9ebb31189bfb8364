"""Scans of more points than memory holds residuals of: a part of the pulses, drawn at random all over the scan.

Points are drawn, not lines or areas: lines may repeat what an effect does to them, and areas would not cover the wall. Of a known
pattern the pulses are drawn, so that a pulse that was lost is drawn as often as one that came back.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.measurements.measurement import Measurement, StereoMeasurement, SurfaceMeasurement
from pipeline.gap.decisions import decided
from pipeline.gap.residuals.tls_residuals import pulse_count, pulse_number, recorded_polar
from scene.common.keyed_random import KeyedRandom


def subsample(measurement: Measurement, random: KeyedRandom) -> tuple[Measurement, NDArray[np.int64]]:
    """At most about `points.most` of a scan's or a surface's points, with a note, and their rows; of a stereo pair all.

    Scan lines and times have to be known already (`with_order`): a part of the points does not tell them.
    """
    count, most = len(measurement.cloud.points), decided().points.most
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
        f"{len(rows):,} of {count:,} points, drawn at random, were looked at: the smallest change of the scene that can be found "
        f"is {1 / share:.1f} times as large; --set points.most=... takes more, with 1.5 kB of memory each"
    )
    part = measurement.part(rows).changed(notes=(*measurement.notes, note))
    return part if isinstance(part, SurfaceMeasurement) else part.changed(pulses=pulses), rows
