"""OpenVINO: another reader of ONNX, on request: it takes 180 MB, and a fifth of a second to compile a model."""

from msgspec.structs import replace

from converters.runtimes.packages import package_runtime

DISTRIBUTIONS = ("openvino", "openvino-nightly")
RUNTIMES = (
    replace(
        package_runtime("openvino", "pip install 'export-model[openvino]'", DISTRIBUTIONS),
        taken_by="name",
        arithmetic="compiled",
    ),
)
