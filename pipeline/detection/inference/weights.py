"""Save and load a trained detector as a folder: detector.yaml has its config, model.weights.h5 Keras's weights."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from typing import Any

import yaml

from pipeline.detection.network.config import DetectorConfig
from pipeline.formats.files.atomic import write_text, writing
from scene.common.config import load_yaml, parse
from scene.common.errors import InputError
from scene.common.regular_file import check_file

CONFIG, WEIGHTS = "detector.yaml", "model.weights.h5"
_REMEDY = "copy the detector's whole folder again from where it was trained, or train it again"
_HDF5 = b"\x89HDF\r\n\x1a\n"
"""First bytes of an HDF5 file."""


def save(model: Any, folder: Path) -> None:
    """Write a trained MaskRCNN to a folder, from which `load` reads it: its config and its weights.

    Each file is complete or absent.
    """
    write_text(folder / CONFIG, yaml.safe_dump(model.config.model_dump(mode="json"), sort_keys=False))
    save_weights(model, folder / WEIGHTS)


def save_weights(model: Any, path: Path) -> None:
    """Write the weights of a Keras network to the file `path`, which must end in .weights.h5, completely or not at all."""
    with writing(path) as temporary:
        own = temporary.with_name(f"{temporary.stem}.weights.h5")
        model.save_weights(own)
        own.replace(temporary)


def load_weights(model: Any, path: Path) -> None:
    """Load Keras's weights from a file into a network; only numbers are taken from the file, and no code in it is run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Keras warns of each layer that does not fit, then raises
        model.load_weights(path)


def load_config(folder: Path) -> DetectorConfig:
    """Read the config of the detector in the folder; raise InputError if there is none."""
    if not (folder / CONFIG).is_file():
        raise InputError(
            f"the folder holds no detector ({CONFIG} is missing)",
            where=str(folder),
            remedy="name a folder made by `scarpsim train`, or `default` for the one that comes with scarpsim",
        )
    return parse(DetectorConfig, load_yaml(folder / CONFIG), where=str(folder / CONFIG))


def with_head(config: DetectorConfig, **values: Any) -> DetectorConfig:
    """Return a copy of a detector's config with other values in its section `head`. values: new values by key."""
    return config.model_copy(update={"head": config.head.model_copy(update=values)})


def check_detector(folder: Path, *, mirrored: bool = False) -> None:
    """Raise InputError if a folder holds no valid detector, as far as can be checked without loading the network.

    mirrored: whether its config must also state mirrored views, for detection on mirror images of a map.
    """
    if load_config(folder).head.mirrored == "none" and mirrored:
        raise InputError(
            "the detector has no mirrored views (`head.mirrored: none`)",
            where=str(folder / CONFIG),
            remedy="set `head.mirrored: both` there, or search without mirrored views",
        )
    with check_file(folder / WEIGHTS, remedy=_REMEDY).open("rb") as file:
        if file.read(len(_HDF5)) != _HDF5:
            raise InputError("the file is not HDF5", where=str(folder / WEIGHTS), remedy=_REMEDY)
    _check_contents(folder / WEIGHTS)


def _check_contents(path: Path) -> None:
    """Raise InputError if weights refer to other files, or claim more bytes than the file has.

    Without h5py there is no Keras either, which is reported later.
    """
    if importlib.util.find_spec("h5py") is None:
        return
    import h5py  # type: ignore[import-untyped]

    links: list[tuple[str, Any]] = []
    size, claimed = path.stat().st_size, 0
    try:
        with h5py.File(path, "r") as file:
            file.visititems_links(lambda name, link: links.append((name, link)))
            outside = [name for name, link in links if not isinstance(link, h5py.HardLink)]
            for item in (file[name] for name, _ in links if name not in outside):
                if isinstance(item, h5py.Dataset):
                    claimed += item.nbytes
                    outside += [str(item.name)] if item.external else []
    except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the HDF5 file is incomplete ({' '.join(str(error).split())[:200]})", where=str(path), remedy=_REMEDY
        ) from None
    if outside:
        raise InputError(f"the file refers to data in other files ('{outside[0]:.80}')", where=str(path), remedy=_REMEDY)
    if claimed > size:
        raise InputError(f"the file claims {claimed:,} bytes of weights but has {size:,} bytes", where=str(path), remedy=_REMEDY)


def load(folder: Path, *, image_px: int | None = None, mirrored: bool = False) -> Any:
    """Load a detector.

    Parameters
    ----------
    folder : Folder of the detector.
    image_px : Side of the images, px; None: as in the config.
    mirrored : Whether to average over the mirrored views that `head.mirrored` states.

    Returns
    -------
    A MaskRCNN.

    Raises
    ------
    InputError
        If the weights are missing, damaged or of another network, or if there are no mirrored views to use.
    """
    from pipeline.detection.inference.mirrored import build_network

    check_detector(folder, mirrored=mirrored)
    config = load_config(folder)
    if not mirrored:
        config = with_head(config, mirrored="none")
    model = build_network(config, image_px)
    take_weights(model, folder)
    return model


def take_weights(model: Any, folder: Path) -> None:
    """Load the weights of a trained detector into a MaskRCNN.

    folder: of the detector. Raises InputError if the weights are of another network.
    """
    path = folder / WEIGHTS
    try:
        load_weights(model, path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        problem = " ".join(str(error).split())[:200]
        raise InputError(
            f"the weights do not fit the network ({problem})",
            where=str(path),
            remedy=f"use the {CONFIG} that was saved with the weights",
        ) from None
