"""What was done with each threshold after the ablation, where that is not simply "kept"."""

from __future__ import annotations

DONE: dict[str, str] = {}
