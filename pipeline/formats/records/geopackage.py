"""Write polygons with a table as a GeoPackage (OGC 12-128r19) for GIS programs, with SQLite only."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.formats.files.atomic import writing
from scene.geometry.mesh import FloatArray

_APPLICATION, _VERSION = 0x47504B47, 10300
_LITTLE_ENDIAN, _POLYGON_Z, _MULTI_POLYGON_Z = 1, 1003, 1006
_OWN_SYSTEM, _UNDEFINED_CARTESIAN = 100_000, -1
_NEVER = "2000-01-01T00:00:00.000Z"
"""Time of the last change, fixed so that equal tables give equal bytes."""
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT,
  last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL, PRIMARY KEY (table_name, column_name));
INSERT INTO gpkg_spatial_ref_sys VALUES ('Undefined Cartesian SRS', -1, 'NONE', -1, 'undefined', NULL);
INSERT INTO gpkg_spatial_ref_sys VALUES ('Undefined geographic SRS', 0, 'NONE', 0, 'undefined', NULL);
"""

Rings = Sequence[FloatArray]
"""Outer rings (n, 3) of the parts of one outline, closed, in coordinates x, y, z."""


def write_geopackage(
    path: Path,
    table: str,
    columns: Mapping[str, type],
    rows: Sequence[Mapping[str, Any]],
    outlines: Sequence[Rings],
    wkt: str = "",
) -> None:
    """Write polygons with heights and their attributes as a GeoPackage of one table, for a GIS.

    Parameters
    ----------
    path : Path
        Written whole or not at all.
    table : str
        Name of the table.
    columns : mapping of str to type
        Names and types (int, float or str) of the table's columns.
    rows : sequence of mappings
        For each polygon, a value or None for each column.
    outlines : sequence of Rings
        The polygon of each row: a closed ring (n, 3), x, y and z, m, for each of its separate parts.
    wkt : str
        The coordinate system of the polygons; empty where there is none.
    """
    kinds = {int: "INTEGER", float: "DOUBLE", str: "TEXT"}
    system = _OWN_SYSTEM if wkt else _UNDEFINED_CARTESIAN
    declared = ", ".join(f'"{name}" {kinds[kind]}' for name, kind in columns.items())
    places = [point for rings in outlines for ring in rings for point in ring]
    box = [None] * 4 if not places else [*np.min(places, axis=0)[:2].tolist(), *np.max(places, axis=0)[:2].tolist()]
    with writing(path) as temporary:
        temporary.unlink(missing_ok=True)
        database = sqlite3.connect(temporary)
        try:
            database.execute(f"PRAGMA application_id = {_APPLICATION}")
            database.execute(f"PRAGMA user_version = {_VERSION}")
            database.executescript(_TABLES)
            if wkt:
                values = ("the survey's", system, "NONE", system, wkt)
                database.execute("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", values)
            database.execute(f'CREATE TABLE "{table}" (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom BLOB, {declared})')
            database.execute(
                "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)", (table, table, _NEVER, *box, system)
            )
            database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'MULTIPOLYGON', ?, 1, 0)", (table, system))
            names = ", ".join(f'"{name}"' for name in columns)
            marks = ", ".join("?" * (len(columns) + 1))
            for row, rings in zip(rows, outlines, strict=True):
                values = (_geometry(rings, system), *(row[name] for name in columns))
                database.execute(f'INSERT INTO "{table}" (geom, {names}) VALUES ({marks})', values)
            database.commit()
        finally:
            database.close()


def _geometry(rings: Rings, system: int) -> bytes:
    """Encode one outline in the standard's binary form: its header without an envelope, then well-known binary."""
    head = b"GP" + struct.pack("<BBi", 0, _LITTLE_ENDIAN, system)
    parts = [
        struct.pack("<BIII", _LITTLE_ENDIAN, _POLYGON_Z, 1, len(ring)) + np.asarray(ring, dtype="<f8").tobytes() for ring in rings
    ]
    return head + struct.pack("<BII", _LITTLE_ENDIAN, _MULTI_POLYGON_Z, len(parts)) + b"".join(parts)
