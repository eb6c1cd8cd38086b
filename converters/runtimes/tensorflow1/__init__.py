"""TensorFlow 1.4 and 1.7: the C libraries that Unity's TensorFlowSharp drove."""
