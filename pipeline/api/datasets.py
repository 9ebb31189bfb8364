"""Provide `make_dataset`, which makes labelled tiles of difference maps for training."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.api.configs import Show, keywords, plain
from pipeline.api.pictures import Picture, html_table, pick
from pipeline.api.tables import frame
from pipeline.config.bundled import config_path
from pipeline.dataset import run
from pipeline.dataset.config import DatasetConfig, dataset_config, load_dataset_config
from pipeline.dataset.loaders import Tiles
from pipeline.dataset.plan import SPLITS
from pipeline.dataset.records import read_dataset_file
from pipeline.formats.records.coco import read_coco
from pipeline.report.notebook_progress import python_progress

if TYPE_CHECKING:
    import pandas

DatasetLike = DatasetConfig | Mapping[str, Any] | str | os.PathLike[str]
"""The config of a data set, a mapping of its keys, a file, or a bundled name such as "small"."""


def make_dataset(
    config: DatasetLike,
    out: Path | str,
    *,
    workers: int = 0,
    scheduler: str = "",
    seed: int | None = None,
    progress: Show = "auto",
    **overrides: Any,
) -> DataSet:
    """Make a set of annotated tiles, or complete an unfinished one, as `scarpsim dataset` does.

    Parameters
    ----------
    config : DatasetConfig, mapping, path or name
        The config of the set. A wall in it may be a SimulationConfig.
    out : path
        Folder of the set.
    workers : int
        Number of local worker processes; 0: this process alone.
    scheduler : str
        Address of a Dask scheduler to use instead of local processes.
    seed : int, optional
        Seed of all random numbers. Default: the config's.
    progress : "auto" or bool
        Whether progress is shown; "auto": in notebooks and on terminals.
    **overrides
        Changed keys of the config; see `configure`.

    Returns
    -------
    DataSet
        The finished set.
    """
    changes = keywords(overrides)
    if isinstance(config, DatasetConfig | Mapping):
        resolved = dataset_config(plain(config), changes, seed, Path("config"))
    else:
        resolved = load_dataset_config(config_path("datasets", Path(config)), changes, seed)
    with python_progress(progress) as shown:
        made = run.make_dataset(resolved, Path(out), run.Workers(workers, scheduler), progress=shown)
    return DataSet(made.folder)


@dataclass(frozen=True, repr=False)
class DataSet:
    """A data set of annotated difference map tiles on disk, to train and test detectors with.

    Attributes
    ----------
    folder : Path
        Folder of the set.
    """

    folder: Path

    @property
    def splits(self) -> list[str]:
        """Names of the splits that the data set has, out of train, val and test."""
        return [name for name in SPLITS if (self.folder / name / "annotations.json").is_file()]

    @property
    def record(self) -> dict[str, Any]:
        """Content of dataset.json: configs, versions, and whether the set is complete."""
        return read_dataset_file(self.folder)

    def tiles(self, split: str = "train", **filters: str) -> Tiles:
        """Return the tiles of a split, to be read one by one as arrays, for example to train a detector.

        split: train, val or test. filters: what the tiles must have, by name. The names are sensor ("tls" or "stereo"), and
        wall, noise (noise level) and size_class (of the blocks), whose values the set's config names. Raises InputError for
        an unknown filter, or if no tile matches.
        """
        return Tiles(self.folder / pick({name: name for name in self.splits}, split, str(self.folder)), **filters)

    @property
    def table(self) -> pandas.DataFrame:
        """Description of all tiles, one row per tile, to count or select them.

        The columns include split (train, val or test), file_name, sensor, wall, noise (level) and size_class (of blocks) as
        the set's config names them, noise_sigma_m (standard deviation of the noise, m), and blocks (number of annotated
        blocks).
        """
        rows = []
        for split in self.splits:
            content = read_coco(self.folder / split / "annotations.json")
            counts: dict[Any, int] = {}
            for each in content.annotations:
                counts[each["image_id"]] = counts.get(each["image_id"], 0) + 1
            rows += [{"split": split, **image, "blocks": counts.get(image["id"], 0)} for image in content.images]
        return frame(rows)

    def plot(self, kind: str | None = None) -> Picture:
        """Return a figure of the set's README.md (its data card), such as its block sizes.

        kind: name of the figure; by default the first. Raises InputError, with the names, if there is no such figure.
        """
        drawn = {path.stem: path for path in sorted((self.folder / "card").glob("*.png"))}
        return Picture(pick(drawn, kind, str(self.folder)).read_bytes())

    def __repr__(self) -> str:
        return f"<DataSet {self.folder}: {', '.join(self.splits)}>"

    def _repr_html_(self) -> str:
        table = self.table
        rows = {
            name: f"{len(part):,} tiles with {part['blocks'].sum():,} blocks" for name, part in table.groupby("split", sort=False)
        }
        return html_table(f"Data set {self.folder}", {**rows, "card": self.folder / "README.md"})
