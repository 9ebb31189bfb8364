"""Show pictures and tables in notebooks."""

from __future__ import annotations

import html
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.formats.files.atomic import write_bytes
from pipeline.report.page import picture_source
from scene.common.errors import InputError, nearest

_THUMBNAIL_PX = 640


@dataclass(frozen=True, repr=False)
class Picture:
    """A figure as in the reports, which a notebook displays.

    Attributes
    ----------
    png : bytes
        Content of the PNG file.
    """

    png: bytes

    def save(self, path: Path | str) -> Path:
        """Write the picture to a PNG file; return its path."""
        write_bytes(Path(path), self.png)
        return Path(path)

    def __repr__(self) -> str:
        return f"<Picture: PNG of {len(self.png):,} bytes>"

    def _repr_png_(self) -> bytes:
        return self.png

    def small(self) -> bytes:
        """Return the picture as a thumbnail, PNG bytes, small enough for a notebook's table."""
        from PIL import Image

        with Image.open(io.BytesIO(self.png)) as picture:
            picture.thumbnail((_THUMBNAIL_PX, _THUMBNAIL_PX))
            buffer = io.BytesIO()
            picture.convert("RGB").quantize(64).save(buffer, "PNG", optimize=True)
        return buffer.getvalue()


def pick(pictures: Mapping[str, Any], kind: str | None, where: str) -> Any:
    """Return the picture that a user asks for by name, called `kind`, or the first if `kind` is None.

    pictures: pictures by name. where: what errors should call the call or its result. Raises InputError, with the
    available names, if there is none.
    """
    if not pictures:
        raise InputError(
            "the result has no pictures to plot",
            where=where,
            remedy="run the command of this result again, in an environment that can draw its report",
        )
    if kind is None:
        return next(iter(pictures.values()))
    if kind not in pictures:
        raise InputError(
            f"there is no picture '{kind}'",
            where=where,
            allowed=", ".join(pictures),
            remedy=nearest(kind, pictures) or "choose one of these pictures",
        )
    return pictures[kind]


def html_table(title: str, rows: Mapping[str, Any], picture: Picture | None = None) -> str:
    """Return HTML that a notebook shows for a result (`_repr_html_`).

    title: heading. rows: a table of two columns, values by their label. picture: a figure that is shown small below it.
    """
    lines = "".join(
        f"<tr><th style='text-align:left'>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows.items()
    )
    shown = "" if picture is None else f'<img src="{picture_source(picture.small())}" alt="{_text(title)}">'
    return f"<div><strong>{_text(title)}</strong><table>{lines}</table>{shown}</div>"


def _text(value: Any) -> str:
    """Return a value as escaped HTML text."""
    return html.escape(str(value))
