"""The losses of Mask R-CNN, as means over samples; a weight is 1 for a sample and 0 for an empty place."""

from __future__ import annotations

from keras import ops

from pipeline.detection.network.boxes import Tensor


def binary_cross_entropy(logits: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """Compute the loss of yes-or-no predictions: the weighted mean of -[t ln s(x) + (1 - t) ln(1 - s(x))].

    logits: x, the predicted log odds; s(x), their logistic function, is the probability. targets: t, 0 to 1, of the same shape.
    weights: of each prediction; they may be broadcast. The result cannot overflow.
    """
    loss = ops.maximum(logits, 0.0) - logits * targets + ops.log1p(ops.exp(-ops.abs(logits)))
    return _mean(loss, weights)


def cross_entropy(logits: Tensor, classes: Tensor, weights: Tensor) -> Tensor:
    """Compute the loss of class predictions: the weighted mean of -ln softmax(x)_c.

    logits: x (..., k) of k classes. classes: true class c (...), an integer. weights: (...) of each prediction.
    """
    chosen = ops.sum(ops.one_hot(classes, logits.shape[-1]) * ops.log_softmax(logits, axis=-1), axis=-1)
    return _mean(-chosen, weights)


def smooth_l1(codes: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """Compute the smooth L1 loss of box codes: x^2 / 2 for |x| < 1 and |x| - 1/2 beyond, of x = code - target (Girshick 2015).

    codes, targets: (..., 4) the four numbers that code a box. weights: (...) of each box. Returns the weighted mean over boxes
    of the sum over the four numbers.
    """
    distance = ops.abs(codes - targets)
    loss = ops.where(distance < 1, 0.5 * ops.square(distance), distance - 0.5)
    return _mean(ops.sum(loss, axis=-1), weights)


def _mean(loss: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean."""
    weights = weights * ops.ones_like(loss)
    return ops.sum(loss * weights) / ops.maximum(ops.sum(weights), 1.0)
