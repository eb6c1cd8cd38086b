"""ONNX ops into the TensorFlow vocabulary: an explicit table (``table.py``), a file per kind of op."""
