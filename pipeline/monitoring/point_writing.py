"""Write the registered points of each epoch once, in whatever process still has them in memory, and draw its pictures.

Points carry the number of their event, and events are numbered over all epochs in order. So a process that compared an epoch
writes its points as soon as the results of all earlier epochs are stored. What no process wrote is written at the end.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.formats.files.atomic import write_text
from pipeline.monitoring.events import Catalogue
from pipeline.monitoring.options import MonitorOptions
from pipeline.monitoring.products import Followed, write_points
from pipeline.monitoring.reading import EpochData, EpochSource, read_epoch
from pipeline.monitoring.records import EpochRecord, points_note, stored
from pipeline.monitoring.site import ReferenceSite

_MOST_WAITING = 2
"""Epochs whose points stay in a process's memory until those before them have been compared."""


def write_points_once(
    epoch: Followed, data: EpochData | None, site: ReferenceSite, out: Path, fingerprint: str, options: MonitorOptions
) -> None:
    """Write an epoch's registered points with the event at each point, unless the folder of results has them already.

    They are written again if the epoch's files, the reference, the options or the numbers of its events have changed.

    Parameters
    ----------
    epoch : Followed
        Result of the epoch.
    data : EpochData or None
        The epoch's points; None: they are read from its files if they have to be written.
    site : ReferenceSite
        The reference epoch.
    out : Path
        Folder of the results, which has the epoch's maps already.
    fingerprint : str
        Checksum of the reference and the options.
    options : MonitorOptions
        Options of the call.
    """
    note, key = points_note(out, epoch.number), _key(epoch, fingerprint)
    if (out / f"epoch_{epoch.number:03d}.laz").is_file() and note.is_file() and note.read_text(encoding="utf-8") == key:
        return
    note.unlink(missing_ok=True)
    write_points(epoch, data or read_epoch(epoch.source, options), site, out)
    write_text(note, key)


def _key(epoch: Followed, fingerprint: str) -> str:
    """Checksum of all that an epoch's points and pictures depend on."""
    events = [(region.identity, region.view, region.row, region.column) for region in epoch.regions]
    return hashlib.sha256(json.dumps([fingerprint, dict(epoch.record.inputs), events]).encode()).hexdigest()


def _draw(epoch: Followed, site: ReferenceSite, out: Path) -> None:
    """Draw the epoch's pictures for the report, which needs them at the end."""
    from pipeline.monitoring.report import epoch_pictures  # Matplotlib takes long to import

    epoch_pictures(epoch, site.views, out)


@dataclass
class PointsInOrder:
    """Writes the points and pictures of the epochs that one process compares.

    Both have the numbers of the events, which depend on all earlier epochs, whose results must be stored before.

    Attributes
    ----------
    site : ReferenceSite
        The reference epoch.
    out : Path
        Folder of the results, into which other processes store their results, too.
    fingerprint : str
        Checksum of the reference and the options.
    options : MonitorOptions
        Options of the call.
    _catalogue, _next, _waiting
        State: events so far, number of the next epoch, and epochs whose points wait for it.
    """

    site: ReferenceSite
    out: Path
    fingerprint: str
    options: MonitorOptions
    _catalogue: Catalogue = field(default_factory=Catalogue)
    _next: int = 1
    _waiting: dict[int, tuple[EpochSource, EpochRecord, EpochData]] = field(default_factory=dict)

    def add(self, source: EpochSource, record: EpochRecord, data: EpochData) -> None:
        """Write points and pictures of a compared epoch now, or in a later call if results of earlier epochs are still missing.

        At most two epochs wait, and none with files too large for memory; the caller must write the points of the others later.

        source: the epoch's files. record: its result, which is stored in the folder already. data: its points.
        """
        self._waiting[record.number] = (source, record, data)
        while (known := stored(self.out, self._next, self.fingerprint)) is not None:
            regions = self._catalogue.identified(known.regions)
            if self._next in self._waiting:
                source, record, data = self._waiting.pop(self._next)
                epoch = Followed(source, record, regions)
                write_points_once(epoch, data, self.site, self.out, self.fingerprint, self.options)
                _draw(epoch, self.site, self.out)
            self._next += 1
        large = [number for number, (_, _, each) in self._waiting.items() if each.large is not None]
        for number in large or sorted(self._waiting)[_MOST_WAITING:]:
            del self._waiting[number]
