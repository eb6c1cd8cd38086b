"""Runtimes that are Python packages: numpy, TensorFlow and ONNX Runtime, in a child process of this interpreter."""

from __future__ import annotations

import importlib.util
from functools import partial

from converters.runtimes.base import Runtime, RuntimeInfo
from converters.runtimes.command import child_command

# One module, many distributions: these all provide ``tensorflow`` and ``onnxruntime``. First come, first taken.
_DISTRIBUTIONS = {
    "numpy": ("numpy",),
    "tensorflow": (
        "tensorflow",
        "tensorflow-cpu",
        "tensorflow-gpu",
        "tensorflow-intel",
        "tensorflow-macos",
        "tensorflow-rocm",
        "tensorflow-cpu-aws",
        "intel-tensorflow",
        "tf-nightly",
        "tf-nightly-cpu",
    ),
    "onnxruntime": (
        "onnxruntime",
        "onnxruntime-gpu",
        "onnxruntime-directml",
        "onnxruntime-openvino",
        "onnxruntime-qnn",
        "ort-nightly",
    ),
}


def module_origin(name: str) -> str | None:
    """The file of a top-level module, or None. A folder that merely has the name (a namespace) does not count."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module that something put into sys.modules without a spec
        return None
    return None if spec is None else spec.origin


def _find(module: str, how: str) -> RuntimeInfo:
    if module_origin(module) is None:
        return RuntimeInfo(module, False, None, how)
    return RuntimeInfo(module, True, _distribution_version(_DISTRIBUTIONS[module]), how)


def _distribution_version(names: tuple[str, ...]) -> str | None:
    import importlib.metadata  # here: an export without verification needs neither it nor what it imports

    for name in names:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return None


def _runtime(name: str, formats: tuple[str, ...], how: str, *, independent: bool = True) -> Runtime:
    command = partial(child_command, f"converters.runtimes.{name}.child")
    return Runtime(name, formats, partial(_find, name, how), command, independent=independent)


NUMPY = _runtime("numpy", ("bytes",), "pip install export-model", independent=False)
TENSORFLOW = _runtime("tensorflow", ("source", "bytes", "saved_model"), "pip install 'export-model[tensorflow]'")
ONNXRUNTIME = _runtime("onnxruntime", ("source", "onnx"), "pip install 'export-model[onnxruntime]'")
