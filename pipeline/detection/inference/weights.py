"""A trained detector as a folder: detector.yaml says what it is, model.weights.h5 holds Keras's weights."""

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
_REMEDY = "train again, or copy the whole folder"
_HDF5 = b"\x89HDF\r\n\x1a\n"


def save(model: Any, folder: Path) -> None:
    """Write the detector `model`, a MaskRCNN, to the folder; each file is whole or absent."""
    write_text(folder / CONFIG, yaml.safe_dump(model.config.model_dump(mode="json"), sort_keys=False))
    save_weights(model, folder / WEIGHTS)


def save_weights(model: Any, path: Path) -> None:
    """Write Keras's weights to `path`, which ends in .weights.h5 as Keras demands, whole or not at all."""
    with writing(path) as temporary:
        own = temporary.with_name(f"{temporary.stem}.weights.h5")
        model.save_weights(own)
        own.replace(temporary)


def load_weights(model: Any, path: Path) -> None:
    """Load Keras's weights; numbers alone are taken from the file, and nothing in it is carried out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Keras tells each layer that does not fit, then raises
        model.load_weights(path)


def load_config(folder: Path) -> DetectorConfig:
    """What the detector in the folder is made of; raises InputError where that is not to be had."""
    if not (folder / CONFIG).is_file():
        remedy = "give a folder that `scarpsim train` made, or say `default` for the one that comes with scarpsim"
        raise InputError(f"holds no detector ({CONFIG} is missing)", where=str(folder), remedy=remedy)
    return parse(DetectorConfig, load_yaml(folder / CONFIG), where=str(folder / CONFIG))


def with_head(config: DetectorConfig, **values: Any) -> DetectorConfig:
    """A copy with other values in `head`."""
    return config.model_copy(update={"head": config.head.model_copy(update=values)})


def check_detector(folder: Path) -> None:
    """Raise InputError where a folder holds no detector, as far as it can be told without the network."""
    load_config(folder)
    with check_file(folder / WEIGHTS, remedy=_REMEDY).open("rb") as file:
        if file.read(len(_HDF5)) != _HDF5:
            raise InputError("is no HDF5 file", where=str(folder / WEIGHTS), remedy=_REMEDY)
    _check_contents(folder / WEIGHTS)


def _check_contents(path: Path) -> None:
    """Raise InputError for numbers that are not in the file itself: in another one, or as many as are claimed and never written.

    Without h5py there is no Keras either, which is said later.
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
        problem = f"is not a whole HDF5 file ({' '.join(str(error).split())[:200]})"
        raise InputError(problem, where=str(path), remedy=_REMEDY) from None
    if outside:
        raise InputError(f"names data outside of it ('{outside[0]:.80}')", where=str(path), remedy=_REMEDY)
    if claimed > size:
        raise InputError(f"claims {claimed:,} bytes of weights in {size:,} bytes", where=str(path), remedy=_REMEDY)


def load(folder: Path, *, image_px: int | None = None, unmirrored: bool = False) -> Any:
    """The detector in the folder, a MaskRCNN; raises InputError where the weights are absent, damaged or of another network.

    unmirrored: it looks at maps as they are alone, whatever `head.mirrored` says.
    """
    from pipeline.detection.inference.mirrored import network

    check_detector(folder)
    config = load_config(folder)
    if unmirrored:
        config = with_head(config, mirrored="none")
    model = network(config, image_px)
    take_weights(model, folder)
    return model


def take_weights(model: Any, folder: Path) -> None:
    """Give a MaskRCNN the weights of the detector in the folder; raises InputError where they are of another network."""
    path = folder / WEIGHTS
    try:
        load_weights(model, path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        problem = " ".join(str(error).split())[:200]
        remedy = f"use the {CONFIG} that was saved with the weights"
        raise InputError(f"does not fit the network ({problem})", where=str(path), remedy=remedy) from None
