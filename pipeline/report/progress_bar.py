"""Show progress as a bar on a terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Self, TextIO

from rich.console import Console, RenderableType
from rich.progress import BarColumn, TaskProgressColumn, TextColumn
from rich.progress import Progress as RichProgress

from pipeline.report.progress import Progress


class BarProgress(Progress):
    """Show how much of a long computation is done as a bar on a terminal.

    The bar is redrawn several times a second, and vanishes at the end. `stream` is the terminal.
    """

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._bar = _Bar(self, stream)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


class _Bar(RichProgress):
    """rich's progress bar, which asks `source` for the progress whenever it is drawn."""

    def __init__(self, source: Progress, stream: TextIO) -> None:
        self._source = source
        time, stage = TextColumn("{task.fields[time]}"), TextColumn("{task.description}")
        share = TaskProgressColumn("[progress.percentage]{task.percentage:>3.0f} %")
        super().__init__(BarColumn(), share, time, stage, console=Console(file=stream), transient=True)
        self.add_task("", total=1.0, time="")

    def get_renderables(self) -> Iterable[RenderableType]:
        """Update and return what rich draws."""
        source = self._source
        for task in self.task_ids:  # none when rich draws for the first time
            self.update(task, completed=source.share, description=source.current, time=source.time)
        yield from super().get_renderables()
