"""TensorFlow: 2 by its C interface and by its Python, and the C libraries of 1.4 and 1.7 that TensorFlowSharp drove.

One child (child.py) speaks to all of them by their C API. TensorFlow 2's Python is what users call, and costs five
times as much: ``tensorflow-python`` runs where it is asked for.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.files.children.python import child_command, module_origin
from export_model.converters.runtimes.base import Progress, Runtime, RuntimeInfo
from export_model.converters.runtimes.installed import check
from export_model.converters.runtimes.packages import package_runtime
from export_model.converters.runtimes.tensorflow.release import (
    API_LIBRARY,
    RELEASES,
    Release,
    how,
    is_whole,
    library_folder,
    unsupported_reason,
)
from export_model.signatures.errors import RuntimeUnavailableError

#: First come, first taken: all of them provide the package.
DISTRIBUTIONS = (
    *("tensorflow", "tensorflow-cpu", "tensorflow-gpu", "tensorflow-intel", "tensorflow-macos"),
    *("tensorflow-rocm", "tensorflow-cpu-aws", "intel-tensorflow", "tf-nightly", "tf-nightly-cpu"),
)
_CHILD, _PYTHON = (f"export_model.converters.runtimes.tensorflow.{module}" for module in ("child", "python"))
#: Beside the package's ``__init__``, in the wheels for Linux; its interface is that of tensorflow/c/c_api.h.
_LIBRARY = "libtensorflow_cc.so.2"


def _find(release: Release) -> RuntimeInfo:
    reason = unsupported_reason()
    if reason is not None:
        return RuntimeInfo(release.runtime, False, None, reason, supported=False)
    here = is_whole(library_folder(release))
    return RuntimeInfo(release.runtime, here, release.version if here else None, how(release))


def _command(release: Release) -> list[str]:
    folder = library_folder(release)
    if not is_whole(folder):
        raise RuntimeUnavailableError(f"the runtime {release.runtime} is not installed", fix=how(release))
    check(folder, release.libraries, how(release))
    return child_command(_CHILD, release.runtime, str(folder / API_LIBRARY))


def _install(release: Release, progress: Progress) -> Path:
    from export_model.converters.runtimes.tensorflow.install import (
        install,  # what unpacks is imported where that is done
    )

    return install(release, progress)


def _command_of_package() -> list[str]:
    return child_command(_CHILD, "tensorflow", str(Path(module_origin("tensorflow") or "").with_name(_LIBRARY)))


_package = partial(
    package_runtime,
    how="pip install 'export-model[tensorflow]'",
    distributions=DISTRIBUTIONS,
    package="tensorflow",
    originals=True,
)

RUNTIMES = (
    replace(_package("tensorflow"), command=_command_of_package),
    replace(_package("tensorflow-python"), command=partial(child_command, _PYTHON), originals=False, taken_by="full"),
    # A library of an old TensorFlow reads frozen graphs; SavedModels would need the wheel's Python code.
    *(Runtime(r.runtime, partial(_find, r), partial(_command, r), partial(_install, r)) for r in RELEASES),
)
