"""Find out when an epoch was measured: from the user, a file beside it, its header, or its name, in this order."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from scene.common.errors import InputError
from scene.common.regular_file import read_text

SIDECAR = ".time.txt"
"""`march.laz.time.txt` beside `march.laz` holds its time in ISO 8601."""
_IN_NAME = re.compile(
    r"(?<!\d)(?P<year>(?:19|20)\d{2})[-_.]?(?P<month>\d{2})[-_.]?(?P<day>\d{2})"
    r"(?:[-_ T.]?(?P<hour>\d{2})[-_.:h]?(?P<minute>\d{2})(?:[-_.:m]?(?P<second>\d{2}))?)?(?!\d)"
)
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_LEAP_SECONDS = 18
"""GPS time minus UTC since 2017."""
_ADJUSTED_S = 1e9
"""What LAS takes off GPS seconds (LAS 1.4, section 2.4, global encoding)."""
_ISO = "a time in ISO 8601, such as 2026-03-14T15:30:00Z"


@dataclass(frozen=True)
class EpochTime:
    """When an epoch was measured.

    Attributes
    ----------
    when : datetime or None
        The time in UTC; None if it is unknown.
    source : str
        In words where it is stated, such as "from its name".
    """

    when: datetime | None
    source: str

    @property
    def text(self) -> str:
        """Time of the epoch in ISO 8601; empty if it is unknown."""
        return "" if self.when is None else self.when.isoformat().replace("+00:00", "Z")


def time_of(path: Path, given: str | None = None, files: Sequence[Path] = ()) -> EpochTime:
    """Find out when an epoch was measured.

    The time comes from the user, a file NAME.time.txt beside the epoch's, the LAS header or a date in the name, in this order.

    path: file or folder of the epoch. given: the user's text, ISO 8601. files: the scans of a folder; their earliest header
    counts. Raises InputError if a text is no time.
    """
    if given is not None:
        return EpochTime(parsed_time(given, "--times"), "as given by --times")
    beside = path.with_name(path.name + SIDECAR)
    if beside.is_file():
        return EpochTime(parsed_time(read_text(beside).strip(), str(beside)), f"from {beside.name}")
    headers = [found for file in files or (path,) if (found := _from_header(file)) is not None]
    earliest = min(headers, key=lambda each: each.text, default=None)
    return earliest or _from_name(path.name) or EpochTime(None, "unknown: neither --times, header nor name says it")


def parsed_time(text: str, where: str) -> datetime:
    """Read a time in ISO 8601, such as 2026-03-14T15:30:00Z, and return it in UTC; without a zone it is UTC.

    where: option or file that states it, for errors. Raises InputError for any other text.
    """
    try:
        found = datetime.fromisoformat(text.upper())
    except ValueError:
        raise InputError(
            f"'{text[:60]}' is not a time that can be read", where=where, allowed=_ISO, remedy="write it in this form"
        ) from None
    return found.replace(tzinfo=UTC) if found.tzinfo is None else found.astimezone(UTC)


def check_order(times: Sequence[EpochTime], names: Sequence[str]) -> None:
    """Raise InputError if an epoch is earlier than the one that is listed before it, the reference first.

    names: the epochs' names, for errors.
    """
    known = [(time.when, name) for time, name in zip(times, names, strict=True) if time.when is not None]
    for (before, first), (after, second) in itertools.pairwise(known):
        if after < before:
            is_reference = first == names[0]
            raise InputError(
                f"{second} ({after:%Y-%m-%d %H:%M}) is earlier than {first} ({before:%Y-%m-%d %H:%M}), "
                + ("which is the reference" if is_reference else "which comes before it"),
                where="EPOCH",
                remedy="make the earliest epoch the reference (--reference, or the first one), or state the times with --times"
                if is_reference
                else "give the epochs in the order of their times, or state the times with --times",
            )


def _from_header(path: Path) -> EpochTime | None:
    """The time of the first point of a LAS file whose GPS times count from a date."""
    if path.suffix.lower() not in (".las", ".laz"):
        return None
    import laspy

    try:
        with laspy.open(path) as reader:
            header = reader.header
            standard = int(header.global_encoding.gps_time_type) == 1
            if not standard or "gps_time" not in header.point_format.dimension_names:
                return None
            times = np.asarray(next(iter(reader.chunk_iterator(1000))).gps_time, dtype=np.float64)
    except Exception:  # what is wrong in the file is said by its reader
        return None
    times = times[(times != 0) & np.isfinite(times)]
    if not len(times):
        return None
    seconds = float(times[0]) + _ADJUSTED_S - _LEAP_SECONDS
    return EpochTime((_GPS_EPOCH + timedelta(seconds=seconds)).replace(microsecond=0), "from the GPS time of its first point")


def _from_name(name: str) -> EpochTime | None:
    """The last date in a file's name: 20260314, 2026-03-14, 20260314_1530, 2026-03-14T15-30-05."""
    for found in reversed(list(_IN_NAME.finditer(name))):
        parts = {key: int(value or 0) for key, value in found.groupdict().items()}
        try:
            return EpochTime(datetime(**parts, tzinfo=UTC), "from its name")
        except ValueError:
            continue
    return None
