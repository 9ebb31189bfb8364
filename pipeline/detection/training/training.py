"""Train the detector: epochs, validation, checkpoints and early stopping.

An interrupted training can be resumed with the same result.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import keras
import numpy as np

from pipeline.detection.inference import weights
from pipeline.detection.inference.operating_point import set_operating_point
from pipeline.detection.network.config import BEST, CHECKPOINT, CURVES, EVENTS, STAGE, TrainConfig
from pipeline.detection.network.data import CocoFolder, batches
from pipeline.detection.network.keras_backend import computing_precision
from pipeline.detection.network.model import LOSSES, MaskRCNN, total_loss
from pipeline.detection.products.figures import write_loss_figure
from pipeline.detection.products.run import detector_folder
from pipeline.detection.training.schedule import has_converged, learning_rate
from pipeline.formats.files.atomic import write_json, writing
from pipeline.formats.files.inside import inside
from pipeline.report.progress import Progress
from scene.common.config import Config, parse
from scene.common.errors import InputError
from scene.common.regular_file import read_json

_STATE, _OPTIMIZER = "state.json", "optimizer.npz"
"""Names of files in a checkpoint."""


_NO_CHECKPOINT = "start a new training with another --out"


class _TrainingState(Config):
    """state.json of a checkpoint: the names of its files, the config, and the losses of all epochs so far."""

    weights: str
    optimizer: str
    config: dict[str, Any]
    training: list[dict[str, float]]
    validation: list[dict[str, float]]


@dataclass
class History:
    """Losses of a training so far: for each epoch the mean losses by name, on training and on validation images.

    The loss called `loss` is the weighted sum of the others.
    """

    training: list[dict[str, float]] = field(default_factory=list)
    validation: list[dict[str, float]] = field(default_factory=list)

    @property
    def total(self) -> list[float]:
        """Total validation loss (weighted sum) of each epoch of the training."""
        return [losses["loss"] for losses in self.validation]


def train(data_set: Path, config: TrainConfig, out: Path, *, resume: bool = False, progress: Progress | None = None) -> History:
    """Train a detector of fallen blocks on a data set of difference map tiles.

    The best detector and the last one are written to out/best and out/checkpoint. At the end, the scores of the best one, and
    of those that `keep_epochs` keeps, are calibrated by `set_operating_point`.

    Parameters
    ----------
    data_set : Folder of a data set, with the folders train and val.
    config : Settings of detector and training.
    out : Folder to write.
    resume : Whether to continue after the last complete epoch in `out`, with the same losses as without the interruption.
    progress : Receives the progress; None: nothing is shown.

    Returns
    -------
    The losses of all epochs.

    Raises
    ------
    InputError
        If the data set has no train or val, `out` holds another training, or resident data is used without JAX or with tiles
        that are not squares of one size.
    """
    progress = progress or Progress()
    folders = CocoFolder(data_set / "train"), CocoFolder(data_set / "val")
    training = config.training
    with progress.stage("network"):
        model = MaskRCNN(config.detector, training.crop_px, training.seed, training.loss_weights)
        model.compile(optimizer=_optimizer(config), jit_compile=False)
        model.optimizer.build(model.trainable_variables)
        history = _restore_or_start(out, config, model, resume=resume)
    with progress.stage("data"):
        learner = _learner(model, folders, config, progress)
    logged = _EventLog(out / EVENTS)
    epochs = {f"epoch {number + 1}": 1.0 for number in range(len(history.training), training.epochs)}
    progress.plan({**epochs, "scores": 0.3})
    steps = -(-len(folders[0]) // training.batch)
    for epoch in range(len(history.training), training.epochs):
        if has_converged(history.total, training):
            break
        rates = [learning_rate(epoch * steps + step, training.epochs * steps, training) for step in range(steps)]
        with progress.stage(f"epoch {epoch + 1}"), computing_precision(training.precision):
            history.training.append(_mean(learner.learn(epoch, rates), config))
            history.validation.append(_mean(learner.validate(), config))
            logged.add(epoch, history)
            _save(out, config, model, history)
            write_loss_figure(history.training, history.validation, out / CURVES)
    with progress.stage("scores"):
        for folder in (out / BEST, *sorted(out.glob(f"{STAGE}_*"))):
            set_operating_point(folder, folders[1])
    return history


class _Learner(Protocol):
    """Trains and validates one epoch; both methods return losses by name, for each step or batch."""

    def learn(self, epoch: int, rates: Sequence[float]) -> list[dict[str, float]]:
        """Make one step for each learning rate."""
        ...

    def validate(self) -> list[dict[str, float]]:
        """Return the losses on the validation data."""
        ...


@dataclass
class _Streamed:
    """Trains on batches from the disk, which are read while the network works on the previous ones."""

    model: MaskRCNN
    folders: tuple[CocoFolder, CocoFolder]
    config: TrainConfig
    progress: Progress

    def learn(self, epoch: int, rates: Sequence[float]) -> list[dict[str, float]]:
        """Make one step for each learning rate."""
        found = []
        coming = batches(self.folders[0], self.config.detector, self.config.training, epoch, learning=True)
        for step, (batch, rate) in enumerate(zip(coming, rates, strict=True)):
            self.model.optimizer.learning_rate = rate
            found.append(self.model.train_on_batch(batch, return_dict=True))
            self.progress.advance((step + 1) / (len(rates) + 1))
        return found

    def validate(self) -> list[dict[str, float]]:
        """Return the losses on the validation data."""
        found = []
        for batch in batches(self.folders[1], self.config.detector, self.config.training, 0, learning=False):
            self.model.reset_metrics()  # test_on_batch does not do this, unlike train_on_batch
            found.append(self.model.test_on_batch(batch, return_dict=True))
        return found


def _learner(model: MaskRCNN, folders: tuple[CocoFolder, CocoFolder], config: TrainConfig, progress: Progress) -> _Learner:
    """Return the learner that `training.data` asks for; raise InputError if the Keras backend does not support it."""
    if config.training.data == "streamed":
        return _Streamed(model, folders, config, progress)
    backend = keras.backend.backend()
    if backend != "jax":
        raise InputError(
            f"the value resident needs jax, not KERAS_BACKEND={backend}",
            where="training.data",
            allowed="resident on jax, streamed on every backend",
            remedy="set KERAS_BACKEND=jax, or training.data=streamed",
        )
    from pipeline.detection.training.resident import ResidentLearner, load_resident_set

    sets = [load_resident_set(folder, config.detector, model.size) for folder in folders]
    return ResidentLearner(model, sets[0], sets[1], config.training)


def _mean(batch_losses: list[dict[str, Any]], config: TrainConfig) -> dict[str, float]:
    """Return the mean of each loss and their weighted sum."""
    found: dict[str, float] = {name: float(np.mean([losses[name] for losses in batch_losses])) for name in LOSSES}
    return {"loss": total_loss(found, config.training.loss_weights), **found}


def _optimizer(config: TrainConfig) -> keras.optimizers.Optimizer:
    """Build the optimizer."""
    training = config.training
    common = {
        "learning_rate": training.learning_rate,
        "weight_decay": training.weight_decay,
        "global_clipnorm": training.clip_norm,
    }
    if training.optimizer == "sgd":
        return keras.optimizers.SGD(momentum=0.9, **common)
    return keras.optimizers.AdamW(**common)


def _restore_or_start(out: Path, config: TrainConfig, model: MaskRCNN, *, resume: bool) -> History:
    """Restore model, optimizer and history from `out`; for a new training, load the initial weights that its config names."""
    path = out / CHECKPOINT / _STATE
    if not os.path.lexists(path):
        if config.training.start is not None:
            weights.take_weights(model, detector_folder(config.training.start))
        return History()
    if not resume:
        raise InputError(
            "the folder already holds a training", where=str(out), remedy="add --resume to continue it, or choose another --out"
        )
    state = parse(_TrainingState, read_json(path, remedy=_NO_CHECKPOINT), str(path))
    if state.config != config.model_dump(mode="json"):
        raise InputError(
            "the training in this folder was started with another config",
            where=str(out),
            remedy="give the config that the training was started with, or choose another --out",
        )
    try:
        weights.load_weights(model, inside(path.parent, state.weights, path))
        with np.load(inside(path.parent, state.optimizer, path), allow_pickle=False) as values:
            for number, variable in enumerate(_state_besides_weights(model)):
                variable.assign(values[str(number)])
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(
            f"the checkpoint is damaged ({' '.join(str(error).split())[:200]})", where=str(out), remedy=_NO_CHECKPOINT
        ) from None
    return History(state.training, state.validation)


def _save(out: Path, config: TrainConfig, model: MaskRCNN, history: History) -> None:
    """Write a checkpoint.

    The state names the files of its epoch and is written last, so that the previous checkpoint stays complete if the process is
    killed.
    """
    folder, epoch = out / CHECKPOINT, len(history.training)
    names = {"weights": f"epoch_{epoch:04d}.weights.h5", "optimizer": f"epoch_{epoch:04d}.{_OPTIMIZER}"}
    weights.save_weights(model, folder / names["weights"])
    with writing(folder / names["optimizer"]) as temporary:
        values: dict[str, Any] = {str(n): np.asarray(variable) for n, variable in enumerate(_state_besides_weights(model))}
        np.savez(temporary, **values)
    if history.total[-1] == min(history.total):
        weights.save(model, out / BEST)
    if config.training.keep_epochs and epoch % config.training.keep_epochs == 0:
        weights.save(model, out / f"{STAGE}_{epoch:04d}")
    state = {**names, "config": config.model_dump(mode="json"), "training": history.training, "validation": history.validation}
    write_json(folder / _STATE, state)
    for old in folder.glob("epoch_*"):
        if old.name not in names.values():
            old.unlink()


def _state_besides_weights(model: MaskRCNN) -> list[Any]:
    """Return what resuming needs besides the weights: the optimizer's variables, and the state of the random samples."""
    return [*model.optimizer.variables, model.samples.state]


class _EventLog:
    """Writes the losses for TensorBoard if TensorFlow is the backend."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writers: dict[str, Any] = {}

    def add(self, epoch: int, history: History) -> None:
        """Add the last epoch's losses; files are created with the first, so that a training that fails before leaves none."""
        if keras.backend.backend() != "tensorflow":
            return
        import tensorflow as tf

        if not self._writers:
            names = ("training", "validation")
            self._writers = {name: tf.summary.create_file_writer(str(self._folder / name)) for name in names}
        for name, writer in self._writers.items():
            with writer.as_default():
                for loss, value in getattr(history, name)[-1].items():
                    tf.summary.scalar(loss, value, step=epoch)
            writer.flush()
