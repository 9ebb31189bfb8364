"""Units of length that a user can name, in metres."""

from __future__ import annotations

US_FOOT_M = 1200 / 3937
"""The US survey foot, 2 millionths longer than the international foot: 1.2 m in a northing of 600 km."""
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "us-ft": US_FOOT_M}
"""By the name that commands and configs take."""
