"""Measure training images per second and inference megapixels per second, compared with backbone and pyramid only.

    KERAS_BACKEND=tensorflow python benchmarks/detector.py [--config configs/detectors/fine.yaml] [--threads 1]

Target: half of the bare rate (forward and backward for training, forward for inference). Inference with mirrored views
(`head.mirrored: both`) is timed too. Processor times are taken in turns, so that other work on the machine hardly matters. Images
are noise with a dozen blocks in each 256 px square.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

ROUNDS = 7


def processor_seconds(*works: Callable[[], object]) -> list[float]:
    """Median processor time of each work, s, taken in turns after one round that traces and compiles."""
    for work in works:
        work()
    timed = []
    for _ in range(ROUNDS):
        row = []
        for work in works:
            start = time.process_time()
            work()
            row.append(time.process_time() - start)
        timed.append(row)
    return [statistics.median(column) for column in zip(*timed, strict=True)]


def examples(count: int, size: int, most_blocks: int, channels: int) -> dict[str, np.ndarray]:
    """Return a batch as `pipeline.detection.network.data.batches` makes it."""
    random = np.random.default_rng(1)
    image = random.normal(0, 0.3, (count, size, size, channels)).astype(np.float32)
    boxes, valid = np.zeros((count, most_blocks, 4), np.float32), np.zeros((count, most_blocks), np.float32)
    labels = np.zeros((count, size, size), np.int32)
    for number in range(count):
        for block in range(min(12 * (size // 256) ** 2, most_blocks)):
            height, width = random.integers(5, 25, 2)
            y, x = random.integers(0, size - 25, 2)
            labels[number, y : y + height, x : x + width] = block + 1
            image[number, y : y + height, x : x + width, 0] += 2
            boxes[number, block], valid[number, block] = (y, x, y + height, x + width), 1
    return {"image": image, "boxes": boxes, "valid": valid, "labels": labels}


def bare(pyramid: Any, image: np.ndarray, *, backward: bool) -> Callable[[], object]:
    """Return the backbone with its pyramid alone, compiled, to be timed."""
    import tensorflow as tf

    def work(values: Any) -> Any:
        if not backward:
            return pyramid(values, training=False)
        with tf.GradientTape() as tape:
            total = sum(tf.reduce_mean(tf.square(level)) for level in pyramid(values, training=True))
        return tape.gradient(total, pyramid.trainable_variables)

    values, compiled = tf.constant(image), tf.function(work)
    return lambda: compiled(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=Path(__file__).parents[1] / "configs" / "detectors" / "fine.yaml")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", str(arguments.threads))
    from pipeline.detection.network.keras_backend import computing_precision, import_keras

    import_keras()
    import keras
    import tensorflow as tf

    from pipeline.detection.inference.mirrored import build_network
    from pipeline.detection.inference.weights import with_head
    from pipeline.detection.network.config import load_train_config
    from pipeline.detection.network.model import MaskRCNN

    tf.config.threading.set_intra_op_parallelism_threads(arguments.threads)
    tf.config.threading.set_inter_op_parallelism_threads(1)
    config = load_train_config(arguments.config)
    crop, size, channels = config.training.crop_px, config.detector.image_px, config.detector.normalisation.channels
    batch = examples(config.training.batch, crop or size, config.detector.most_blocks, channels)

    learner = MaskRCNN(config.detector, crop)
    learner.compile(optimizer=keras.optimizers.AdamW(1e-4), jit_compile=False)

    def step(precision: Literal["float32", "bfloat16"]) -> None:
        with computing_precision(precision):
            learner.train_on_batch(batch)

    works = partial(step, "float32"), partial(step, "bfloat16"), bare(learner.pyramid, batch["image"], backward=True)
    whole, half, alone = processor_seconds(*works)
    count = config.training.batch
    print(
        f"training at {crop or size} px, {count} a step: {count / whole:.2f} images/s, bare {count / alone:.2f}, "
        f"ratio {alone / whole:.2f}; with training.precision=bfloat16 {count / half:.2f}, {whole / half:.2f} times as many"
    )
    finder, looker = MaskRCNN(config.detector), build_network(with_head(config.detector, mirrored="both"))
    image = examples(4, size, config.detector.most_blocks, channels)["image"]
    whole, mirrored, alone = processor_seconds(
        lambda: finder.predict_on_batch({"image": image}),
        lambda: looker.predict_on_batch({"image": image}),
        bare(finder.pyramid, image, backward=False),
    )
    megapixels = 4 * size**2 / 1e6
    print(
        f"inference at {size} px: {megapixels / whole:.2f} MP/s, bare {megapixels / alone:.2f}, ratio {alone / whole:.2f}; "
        f"with mirror images {megapixels / mirrored:.2f} MP/s, {mirrored / whole:.2f} times the time"
    )


if __name__ == "__main__":
    main()
