"""TensorFlow 1.4 and 1.7: the C libraries that Unity's TensorFlowSharp drove."""

from converters.runtimes.tensorflow1.found import RUNTIMES

__all__ = ["RUNTIMES"]
