"""The learning rate, and the criterion for early stopping."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.detection.network.config import TrainingConfig

_LAST_SHARE = 0.01
"""Last learning rate of the cosine schedule over the first."""


def learning_rate(step: int, steps: int, config: TrainingConfig) -> float:
    """Return the learning rate of a step: a linear warm-up, then constant, or a half cosine down to a hundredth.

    Parameters
    ----------
    step : Number of the step, from 0.
    steps : Number of all steps.
    config : Settings of the training.
    """
    rise = min(1.0, (step + 1) / (config.warm_up_steps + 1))
    if config.schedule == "constant":
        return config.learning_rate * rise
    share = min(step / max(steps, 1), 1.0)
    return config.learning_rate * rise * (_LAST_SHARE + (1 - _LAST_SHARE) * 0.5 * (1 + float(np.cos(np.pi * share))))


def has_converged(losses: Sequence[float], config: TrainingConfig) -> bool:
    """Return whether a training should stop, because the validation loss hardly falls any more.

    losses: validation loss of each epoch so far. config: it stops if the loss fell by less than `stop_slope` per epoch, on
    average over the last `stop_window` epochs.
    """
    if config.stop_slope <= 0 or len(losses) <= config.stop_window:
        return False
    recent = losses[-config.stop_window - 1 :]
    return (recent[0] - recent[-1]) / config.stop_window < config.stop_slope
