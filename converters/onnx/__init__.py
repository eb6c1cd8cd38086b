"""ONNX: opset 15 and IR 8 by default, which onnxruntime, onnxruntime-web and Unity's Inference Engine take."""
