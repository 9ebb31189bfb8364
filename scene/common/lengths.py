"""Units of length that a user can name, in metres."""

from __future__ import annotations

US_FOOT_M = 1200 / 3937
"""The US survey foot. It is 2 parts in a million longer than the international foot, which is 1.2 m in a northing of 600 km."""
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "us-ft": US_FOOT_M}
"""Metres per unit, by the name that commands and configs use."""
