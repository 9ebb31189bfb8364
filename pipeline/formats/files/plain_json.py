"""Convert values for JSON."""

from __future__ import annotations

import math
from typing import Any


def without_nan(value: Any) -> Any:
    """Return a value as JSON can hold it: NaN and infinity become null, NumPy's numbers and arrays plain ones."""
    if isinstance(value, dict):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if hasattr(value, "tolist"):  # a NumPy value
        return without_nan(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
