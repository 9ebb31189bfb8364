"""Dr.Jit before TensorFlow: the other way round Dr.Jit takes LLVM symbols of TensorFlow's and crashes."""

import os

from scene.backend import dr, mi

dr.eval(dr.arange(mi.Float, 4) * 2)
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
