"""ONNX Runtime."""

from export_model.converters.runtimes.packages import package_runtime

#: First come, first taken: all of them provide the package.
DISTRIBUTIONS = (
    *("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml", "onnxruntime-openvino", "onnxruntime-qnn"),
    "ort-nightly",
)
RUNTIMES = (package_runtime("onnxruntime", "pip install 'export-model[onnxruntime]'", DISTRIBUTIONS, originals=True),)
