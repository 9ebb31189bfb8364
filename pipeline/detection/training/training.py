"""Training: epochs of steps, validation, checkpoints, an early stop; it goes on after a kill as if nothing had been."""

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
from pipeline.detection.network.keras_backend import computing_in
from pipeline.detection.network.model import LOSSES, MaskRCNN, total_loss
from pipeline.detection.products.figures import write_loss_figure
from pipeline.detection.products.run import detector_folder
from pipeline.detection.training.schedule import has_settled, learning_rate
from pipeline.formats.files.atomic import write_json, writing
from pipeline.formats.files.inside import inside
from pipeline.report.progress import Progress
from scene.common.config import Config, parse
from scene.common.errors import InputError
from scene.common.regular_file import read_json

_STATE, _OPTIMIZER = "state.json", "optimizer.npz"


_NO_CHECKPOINT = "train anew, with another --out"


class _TrainingState(Config):
    """state.json of a checkpoint: the names of its files, and the losses of the epochs before it."""

    weights: str
    optimizer: str
    config: dict[str, Any]
    training: list[dict[str, float]]
    validation: list[dict[str, float]]


@dataclass
class History:
    """Mean losses per epoch, by name; `loss` is their weighted sum."""

    training: list[dict[str, float]] = field(default_factory=list)
    validation: list[dict[str, float]] = field(default_factory=list)

    @property
    def total(self) -> list[float]:
        """The validation loss of each epoch."""
        return [losses["loss"] for losses in self.validation]


def train(data_set: Path, config: TrainConfig, out: Path, *, resume: bool = False, progress: Progress | None = None) -> History:
    """Train a detector on DATA_SET/train, validate on DATA_SET/val; the best and the last go to out/best and out/checkpoint.

    At the end the scores of the best one, and of those that `keep_epochs` keeps, are shifted as `set_operating_point` says.

    With `resume` it goes on after the last whole epoch in `out`, to the same losses as without the interruption. Raises
    InputError for a data set without these folders, for an `out` that holds another training, and for resident data on another
    backend than JAX or of tiles that are not squares of one size.
    """
    progress = progress or Progress()
    folders = CocoFolder(data_set / "train"), CocoFolder(data_set / "val")
    training = config.training
    with progress.stage("network"):
        model = MaskRCNN(config.detector, training.crop_px, training.seed, training.loss_weights)
        model.compile(optimizer=_optimizer(config), jit_compile=False)
        model.optimizer.build(model.trainable_variables)
        history = _begun(out, config, model, resume=resume)
    with progress.stage("data"):
        learner = _learner(model, folders, config, progress)
    logged = _EventLog(out / EVENTS)
    epochs = {f"epoch {number + 1}": 1.0 for number in range(len(history.training), training.epochs)}
    progress.plan({**epochs, "scores": 0.3})
    steps = -(-len(folders[0]) // training.batch)
    for epoch in range(len(history.training), training.epochs):
        if has_settled(history.total, training):
            break
        rates = [learning_rate(epoch * steps + step, training.epochs * steps, training) for step in range(steps)]
        with progress.stage(f"epoch {epoch + 1}"), computing_in(training.precision):
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
    """What an epoch is made of: both return losses by name, of steps or of batches."""

    def learn(self, epoch: int, rates: Sequence[float]) -> list[dict[str, float]]:
        """One step for each learning rate."""
        ...

    def validate(self) -> list[dict[str, float]]:
        """Of what the training does not learn from."""
        ...


@dataclass
class _Streamed:
    """Batches from the disk, read while the network works on those before."""

    model: MaskRCNN
    folders: tuple[CocoFolder, CocoFolder]
    config: TrainConfig
    progress: Progress

    def learn(self, epoch: int, rates: Sequence[float]) -> list[dict[str, float]]:
        found = []
        coming = batches(self.folders[0], self.config.detector, self.config.training, epoch, learning=True)
        for step, (batch, rate) in enumerate(zip(coming, rates, strict=True)):
            self.model.optimizer.learning_rate = rate
            found.append(self.model.train_on_batch(batch, return_dict=True))
            self.progress.advance((step + 1) / (len(rates) + 1))
        return found

    def validate(self) -> list[dict[str, float]]:
        found = []
        for batch in batches(self.folders[1], self.config.detector, self.config.training, 0, learning=False):
            self.model.reset_metrics()  # train_on_batch does so itself, test_on_batch does not
            found.append(self.model.test_on_batch(batch, return_dict=True))
        return found


def _learner(model: MaskRCNN, folders: tuple[CocoFolder, CocoFolder], config: TrainConfig, progress: Progress) -> _Learner:
    """As `training.data` says; raises InputError where that is not for the Keras backend in use."""
    if config.training.data == "streamed":
        return _Streamed(model, folders, config, progress)
    backend = keras.backend.backend()
    if backend != "jax":
        where, remedy = "training.data", "set KERAS_BACKEND=jax, or training.data=streamed"
        raise InputError(f"is resident with KERAS_BACKEND={backend}", where=where, allowed="resident on jax", remedy=remedy)
    from pipeline.detection.training.resident import ResidentLearner, resident

    sets = [resident(folder, config.detector, model.size) for folder in folders]
    return ResidentLearner(model, sets[0], sets[1], config.training)


def _mean(batch_losses: list[dict[str, Any]], config: TrainConfig) -> dict[str, float]:
    found: dict[str, float] = {name: float(np.mean([losses[name] for losses in batch_losses])) for name in LOSSES}
    return {"loss": total_loss(found, config.training.loss_weights), **found}


def _optimizer(config: TrainConfig) -> keras.optimizers.Optimizer:
    training = config.training
    common = {
        "learning_rate": training.learning_rate,
        "weight_decay": training.weight_decay,
        "global_clipnorm": training.clip_norm,
    }
    if training.optimizer == "sgd":
        return keras.optimizers.SGD(momentum=0.9, **common)
    return keras.optimizers.AdamW(**common)


def _begun(out: Path, config: TrainConfig, model: MaskRCNN, *, resume: bool) -> History:
    """The history in `out`, with model and optimizer as they were then; an empty one for a new training, which takes up the
    weights that its config names."""
    path = out / CHECKPOINT / _STATE
    if not os.path.lexists(path):
        if config.training.start is not None:
            weights.take_weights(model, detector_folder(config.training.start))
        return History()
    if not resume:
        raise InputError(
            "holds a training already", where=str(out), remedy="add --resume to go on with it, or choose another --out"
        )
    state = parse(_TrainingState, read_json(path, remedy=_NO_CHECKPOINT), str(path))
    if state.config != config.model_dump(mode="json"):
        raise InputError("holds a training with another config", where=str(out), remedy="use its config, or choose another --out")
    try:
        weights.load_weights(model, inside(path.parent, state.weights, path))
        with np.load(inside(path.parent, state.optimizer, path), allow_pickle=False) as values:
            for number, variable in enumerate(_further_state(model)):
                variable.assign(values[str(number)])
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        problem = f"its checkpoint is damaged ({' '.join(str(error).split())[:200]})"
        raise InputError(problem, where=str(out), remedy=_NO_CHECKPOINT) from None
    return History(state.training, state.validation)


def _save(out: Path, config: TrainConfig, model: MaskRCNN, history: History) -> None:
    """The state names the files of its epoch and is written last, so that a kill leaves the one before whole."""
    folder, epoch = out / CHECKPOINT, len(history.training)
    names = {"weights": f"epoch_{epoch:04d}.weights.h5", "optimizer": f"epoch_{epoch:04d}.{_OPTIMIZER}"}
    weights.save_weights(model, folder / names["weights"])
    with writing(folder / names["optimizer"]) as temporary:
        values: dict[str, Any] = {str(n): np.asarray(variable) for n, variable in enumerate(_further_state(model))}
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


def _further_state(model: MaskRCNN) -> list[Any]:
    """What a training needs beside the weights to go on: the optimizer's variables and the place in the stream of samples."""
    return [*model.optimizer.variables, model.samples.state]


class _EventLog:
    """The losses for TensorBoard, where TensorFlow is the backend."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._writers: dict[str, Any] = {}

    def add(self, epoch: int, history: History) -> None:
        """The last epoch's losses; the files are begun with the first, so that a training that fails before it leaves none."""
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
