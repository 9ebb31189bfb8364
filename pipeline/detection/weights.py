"""A trained detector as a folder: detector.yaml says what it is, model.weights.h5 holds Keras's weights."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import yaml

from pipeline.detection.config import DetectorConfig
from pipeline.formats.atomic import write_text, writing
from scene.config import load_yaml, parse
from scene.errors import InputError
from scene.regular_file import check_file

CONFIG, WEIGHTS = "detector.yaml", "model.weights.h5"
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


def check_detector(folder: Path) -> None:
    """Raise InputError where a folder holds no detector, as far as it can be told without the network."""
    load_config(folder)
    remedy = "train again, or copy the whole folder"
    with check_file(folder / WEIGHTS, remedy=remedy).open("rb") as file:
        if file.read(len(_HDF5)) != _HDF5:
            raise InputError("is no HDF5 file", where=str(folder / WEIGHTS), remedy=remedy)


def load(folder: Path, *, image_px: int | None = None) -> Any:
    """The detector in the folder, a MaskRCNN; raises InputError where the weights are absent, damaged or of another network."""
    from pipeline.detection.model import MaskRCNN

    check_detector(folder)
    model = MaskRCNN(load_config(folder), image_px)
    path = folder / WEIGHTS
    try:
        load_weights(model, path)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        problem = " ".join(str(error).split())[:200]
        remedy = f"use the {CONFIG} that was saved with the weights"
        raise InputError(f"does not fit the network ({problem})", where=str(path), remedy=remedy) from None
    return model
