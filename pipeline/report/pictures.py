"""Convert the pictures of a diagnosis to PNG."""

from __future__ import annotations

import io

from matplotlib.figure import Figure

from pipeline.report.plain_text import plain_text


def png(figure: Figure, dpi: int = 110) -> bytes:
    """Convert a Matplotlib figure to PNG with `dpi` dots per inch. Equal figures give equal bytes."""
    buffer = io.BytesIO()
    with plain_text(figure):
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()
