"""Read a run's folder for export: its files, and the blocks that fell."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from pipeline.formats.records.result_records import RUN_FILE
from pipeline.formats.records.run_files import RunFiles
from pipeline.report.figures import SCALE_SIGMAS
from scene.common.errors import InputError


class ExportedRun(RunFiles):
    """A run of `simulate` that is exported to other formats, made of the run's folder; files are read when needed.

    Raises InputError if the folder contains no finished epoch.
    """

    @cached_property
    def record(self) -> dict[str, Any]:
        """Content of run.json, which describes the run."""
        found = super().record
        if len(found["epochs"]) < 2:
            raise InputError(
                "the run contains no finished epoch",
                where=str(self.folder),
                remedy="continue the run with scarpsim simulate --resume",
            )
        return found

    @property
    def last(self) -> int:
        """Number of the run's last epoch; the reference is 0."""
        return len(self.record["epochs"]) - 1

    def limit_m(self, number: int) -> float:
        """Return the difference at which the colour scale of an epoch's map ends, m, as in the run's report.

        number: of the epoch, from 1.
        """
        statistics = self.record["epochs"][number].get("statistics")
        if not statistics:
            raise InputError(
                f"the run has no statistics of epoch {number}",
                where=str(self.folder / RUN_FILE),
                remedy="continue the run with scarpsim simulate --resume",
            )
        return float(SCALE_SIGMAS * statistics["sigma_m"])

    def blocks(self, number: int) -> list[dict[str, Any]]:
        """Return the records of the blocks that fell in an epoch of the run, the largest first. number: of the epoch, from 1."""
        return sorted(self.record["epochs"][number]["blocks"], key=lambda block: -block["volume_m3"])
