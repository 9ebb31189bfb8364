"""Write pictures as PNG files quickly.

Maps and diagrams have many equal pixels side by side. They become small without the filters that PNG offers for photographs, and
libdeflate compresses them several times faster than zlib.
"""

from __future__ import annotations

import struct
import zlib

import imagecodecs
import numpy as np
from numpy.typing import NDArray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {3: 2, 4: 6}
"""PNG's colour type by the number of channels."""
_BITS = 8
_LEVEL = 1
"""Compression level of PNG files: a higher one takes several times as long and makes them a tenth smaller."""
_INCH_M = 0.0254


def encode_png(pixels: NDArray[np.uint8], dpi: float) -> bytes:
    """Encode a picture as PNG; equal arguments give equal bytes.

    pixels: (h, w, 3) red, green, blue, or (h, w, 4) with opacity. dpi: resolution, pixels an inch.
    """
    height, width, channels = pixels.shape
    rows = np.zeros((height, 1 + width * channels), dtype=np.uint8)  # the first byte of a row says that it has no filter
    rows[:, 1:] = pixels.reshape(height, -1)
    per_metre = round(dpi / _INCH_M)
    header = struct.pack(">IIBBBBB", width, height, _BITS, _COLOUR_TYPES[channels], 0, 0, 0)
    parts = (
        (b"IHDR", header),
        (b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1)),
        (b"IDAT", bytes(imagecodecs.deflate_encode(rows.tobytes(), level=_LEVEL))),
        (b"IEND", b""),
    )
    return _SIGNATURE + b"".join(_chunk(name, content) for name, content in parts)


def _chunk(name: bytes, content: bytes) -> bytes:
    """Return a chunk of a PNG file: length, name, content and checksum."""
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
