"""Values as JSON knows them."""

from __future__ import annotations

import math
from typing import Any


def without_nan(value: Any) -> Any:
    """The value with null in place of NaN and infinity, which JSON does not know; NumPy's numbers and arrays become plain."""
    if isinstance(value, dict):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if hasattr(value, "tolist"):  # NumPy's
        return without_nan(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
