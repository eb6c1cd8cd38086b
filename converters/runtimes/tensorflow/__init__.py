"""TensorFlow 2."""

from export_model.converters.runtimes.packages import package_runtime

#: First come, first taken: all of them provide the package.
DISTRIBUTIONS = (
    *("tensorflow", "tensorflow-cpu", "tensorflow-gpu", "tensorflow-intel", "tensorflow-macos"),
    *("tensorflow-rocm", "tensorflow-cpu-aws", "intel-tensorflow", "tf-nightly", "tf-nightly-cpu"),
)
RUNTIMES = (package_runtime("tensorflow", "pip install 'export-model[tensorflow]'", DISTRIBUTIONS, originals=True),)
