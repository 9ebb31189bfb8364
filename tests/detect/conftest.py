"""Import Dr.Jit before TensorFlow: in the other order Dr.Jit takes TensorFlow's LLVM symbols and crashes."""

import os

import pytest

from scene.common.backend import dr, mi

dr.eval(dr.arange(mi.Float, 4) * 2)
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("TF_ENABLE_ONEDNN_OPTS", "1")  # as `import_keras` has it


@pytest.fixture
def eager():
    """Run TensorFlow eagerly: building a graph takes 20 s, too long for a few steps."""
    import tensorflow as tf

    tf.config.run_functions_eagerly(True)
    yield
    tf.config.run_functions_eagerly(False)
