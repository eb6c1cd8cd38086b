"""A saved model of Stable-Baselines3 as a source: ``data`` (JSON) and ``policy.pth`` (PyTorch's archive) of its ZIP.

Source: stable_baselines3/common/save_util.py. Values that JSON lacks stand in ``data`` as a pickle in base64, with
their attributes as text beside it: the text is read, and of SBX, which has no ``policy.pth``, the policy's pickle as
data. The archive is looked into and never unpacked to
disk; what its two entries may unfold to is bounded by the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.files.fetch import Fetched, path_text
from export_model.converters.files.file_probe import json_in
from export_model.converters.files.torch_archive import Archive
from export_model.converters.files.zip_archives import ZIP_ERRORS, entry_of, open_archive
from export_model.converters.formats.source import NO_NORMALISER, ReadOptions, SourceModel, run_of
from export_model.converters.formats.stable_baselines3.run_folder import settings_that_normalise, statistics_beside
from export_model.converters.trainers.pytorch.weights import ArraysByName
from export_model.converters.trainers.registry import rebuild
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import DamagedFileError

_DATA, _POLICY = "data", "policy.pth"
#: Stable-Baselines3 does not compress; a ZIP that was packed again shrinks JSON to a tenth, weights hardly.
_MOST, _MOST_ADDED = 64, 64 << 20
_COPY_AGAIN = "copy or download it again"
_NORMALISED = "feed observations that are normalised as in training"


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one policy of a saved model, or of the folder that it was unpacked to.

    Raises NotAPolicyError, SourceError for a network that is not built, DamagedFileError, UsageError.
    """
    if given.path.is_dir():
        files = tuple(given.path / name for name in (_DATA, _POLICY))
        found: tuple[bytes, bytes | None] = given.bytes_of(files[0]), given.bytes_of(files[1])
    else:
        files = (given.path,)
        found = _entries(given.data)
    data, policy = found
    try:
        content: Any = json_in(data)
    except (ValueError, RecursionError) as error:
        raise DamagedFileError("its data is not JSON", why=str(error)[:200], fix=_COPY_AGAIN) from error
    if not isinstance(content, dict):
        raise DamagedFileError("its data must be a JSON object", why="what was saved is one", fix=_COPY_AGAIN)
    statistics, notes = _statistics(given, options.normaliser)
    beside = None if statistics is None else (statistics.name, given.bytes_of(statistics))
    archive = ArraysByName({}) if policy is None else Archive(policy)
    made = rebuild(Saved(given, archive, content, activation=options.activation, statistics=beside))
    facts = replace(made.facts, notes=(*made.facts.notes, *notes))
    read_files = (*files, *([] if statistics is None else [statistics]))
    return [SourceModel(made.graph, read_files, facts, original=run_of(given.path, made.modules))]


def _statistics(given: Fetched, wanted: str | None) -> tuple[Path | None, tuple[str, ...]]:
    """Return the file with the statistics of the observations, and notes on what is missing or left out."""
    if wanted not in (None, NO_NORMALISER):
        return Path(wanted), ()
    found, others = statistics_beside(given, wanted=wanted != NO_NORMALISER)
    if wanted == NO_NORMALISER:
        seen = ", ".join(file.name for file in ([found] if found else others))
        return None, ((f"{seen} is left out (--set normaliser=none): {_NORMALISED}",) if seen else ())
    names = ", ".join(map(path_text, others[:4])) + (f" and {len(others) - 4} more" if len(others) > 4 else "")
    seen_too = (f"other statistics of VecNormalize were seen and not taken: {names} (--normaliser FILE takes one)",)
    settings = settings_that_normalise(given) if found is None else None
    if settings is None:
        return found, (seen_too if others else ())
    return None, (
        f"{settings.name} says that it was trained behind VecNormalize, and vecnormalize.pkl is missing beside it: "
        f"{_NORMALISED}, or give the file: --normaliser FILE",
    )


def _entries(data: bytes) -> tuple[bytes, bytes | None]:
    """``data`` and ``policy.pth`` of an archive; SBX writes no ``policy.pth``. Raises DamagedFileError."""
    try:
        with open_archive(data) as archive:
            most = min(_MOST * len(data), len(data) + _MOST_ADDED)
            policy = entry_of(archive, _POLICY, most) if _POLICY in archive.namelist() else None
            return entry_of(archive, _DATA, most), policy
    except ZIP_ERRORS as error:
        raise DamagedFileError(f"its archive cannot be read: {error}", why="it is damaged", fix=_COPY_AGAIN) from error
