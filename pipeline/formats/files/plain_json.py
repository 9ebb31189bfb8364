"""Convert values for JSON."""

from __future__ import annotations

import math
from typing import Any


def without_nan(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not have, by null, and NumPy's numbers and arrays by plain ones."""
    if isinstance(value, dict):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if hasattr(value, "tolist"):  # a NumPy value
        return without_nan(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
