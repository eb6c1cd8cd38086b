"""TensorFlow 1.4 and 1.7, the C libraries that Unity's TensorFlowSharp drove: are they here, started, installed."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from export_model.converters.files.children.python import child_command
from export_model.converters.runtimes.base import Progress, Runtime, RuntimeInfo
from export_model.converters.runtimes.installed import check
from export_model.converters.runtimes.tensorflow1.release import (
    API_LIBRARY,
    RELEASES,
    Release,
    how,
    is_whole,
    library_folder,
    unsupported_reason,
)
from export_model.signatures.errors import RuntimeUnavailableError


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
    return child_command(
        "export_model.converters.runtimes.tensorflow1.child", release.runtime, str(folder / API_LIBRARY)
    )


def _install(release: Release, progress: Progress) -> Path:
    from export_model.converters.runtimes.tensorflow1.install import (
        install,  # what unpacks is imported where that is done
    )

    return install(release, progress)


#: A library of an old TensorFlow reads frozen graphs; SavedModels would need the wheel's Python code.
RUNTIMES = tuple(Runtime(r.runtime, partial(_find, r), partial(_command, r), partial(_install, r)) for r in RELEASES)
