"""Show progress as a bar in a notebook."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Self

from pipeline.report.progress import Progress, shown_progress

_BAR = '<progress value="{share:.3f}" max="1" style="width: 20em"></progress> {percent} %, {time}: {stage}'


class NotebookProgress(Progress):
    """Show how much of a long computation is done as an HTML bar in a Jupyter notebook.

    The bar is redrawn when a stage begins or advances, and vanishes at the end.
    """

    def __init__(self, display: Any) -> None:
        """Make a bar. display: IPython's function, or one with the same arguments."""
        super().__init__()
        self._display, self._handle, self._shown = display, None, ""

    def __enter__(self) -> Self:
        self._handle = self._display({"text/html": "", "text/plain": ""}, raw=True, display_id=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._show("")

    def plan(self, weights: Mapping[str, float]) -> None:
        """Announce the stages of the computation, and draw the bar in the notebook.

        Parameters
        ----------
        weights : mapping of str to float
            Name of each stage, and the seconds that it is expected to take.
        """
        super().plan(weights)
        self._draw()

    @contextmanager
    def stage(self, name: str) -> Iterator[Self]:
        """Mark what is done inside the `with` block as a stage of the computation, and show its name beside the bar."""
        with super().stage(name):
            self._draw()
            yield self

    def advance(self, fraction: float) -> None:
        """Report which fraction of the current stage is done, 0 to 1, and redraw the bar in the notebook."""
        super().advance(fraction)
        self._draw()

    def _draw(self) -> None:
        self._show(_BAR.format(share=self.share, percent=int(100 * self.share), time=self.time, stage=self.current))

    def _show(self, html: str) -> None:
        if self._handle is not None and html != self._shown:
            self._handle.update({"text/html": html, "text/plain": ""}, raw=True)
            self._shown = html


def python_progress(show: bool | str = "auto") -> Progress:
    """Choose how a function that is called from Python shows its progress.

    Parameters
    ----------
    show : bool or "auto"
        True: a bar in a notebook or on a terminal, lines of text elsewhere. "auto": the same bars, but nothing elsewhere.
        False: nothing.

    Returns
    -------
    Progress
        Object that the function tells its stages; to be used in a `with` statement.
    """
    if show is False:
        return Progress()
    if in_notebook():
        from IPython.display import display

        return NotebookProgress(display)
    return shown_progress(quiet=show == "auto" and not sys.stderr.isatty())


def in_notebook() -> bool:
    """Return whether the code runs in a Jupyter notebook, where progress is shown as HTML."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")
