"""OpenVINO: another reader of ONNX, on request: it takes 180 MB, and a fifth of a second to compile a model."""

from msgspec.structs import replace

from export_model.converters.runtimes.packages import package_runtime

DISTRIBUTIONS = ("openvino", "openvino-nightly")
RUNTIMES = (
    replace(
        package_runtime("openvino", "pip install 'export-model[openvino]'", DISTRIBUTIONS),
        taken_by="name",
        arithmetic="compiled",
        # measured on 2026.4.1: of 16,384 numbers of RandomNormalLike none is below -1.21, their mean is 0.06
        poor_draws="its Multinomial draws the same classes in every call, and its RandomNormal takes one uniform number"
        " for both that a normal one is made of",
    ),
)
