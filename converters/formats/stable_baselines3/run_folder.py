"""What Stable-Baselines3 and rl-baselines3-zoo put beside a saved model.

Sources: rl_zoo3/exp_manager.py (``<log>/<env>_<n>/<env>.zip``, its settings and ``vecnormalize.pkl`` in a folder
``<env>/`` beside it), callbacks.py (``best_model.zip``), push_to_hub.py (``<algo>-<env>.zip``, ``vec_normalize.pkl``,
``config.yml``, and the model unpacked to ``<algo>-<env>/``); stable_baselines3/common/callbacks.py
(``CheckpointCallback``: ``<prefix>_<n>_steps.zip``, ``<prefix>_vecnormalize_<n>_steps.pkl``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from export_model.converters.files.fetch import Fetched, open_regular_file, path_text, unreadable
from export_model.converters.formats.format import Member
from export_model.converters.formats.source import ReadOptions
from export_model.signatures.errors import SourceError

_STATISTICS = ("vecnormalize.pkl", "vec_normalize.pkl")
#: What people call them, too.
_LIKE = re.compile(r".*vec_?normali[sz]e.*\.pkl", re.IGNORECASE)
_PICKLES = (".pkl", ".pickle", "")
#: Bytes that the name of a pickle's own class stands in, in every protocol.
_HEAD = 128
_OF_A_STEP = re.compile(r"_\d+_steps$")
_SETTINGS = ("config.yml", "args.yml")
_UNPACKED = "policy.pth"
_OF_STEP = re.compile(r"(.+)_(\d{1,18})_steps")
#: Models of a run that its callbacks save; the run's folder of settings is theirs, too.
_OF_CALLBACKS = ("best_model", "final_model")
_LARGEST = 1 << 20
#: ``normalize: true``, or as PyYAML writes the pairs of an OrderedDict: ``- - normalize`` above ``  - true``.
_NORMALIZE = re.compile(r"^[ -]*normalize(?::|\n[ -]*-) *([^\n]{0,300})", re.MULTILINE)
_NOT_OBSERVATIONS = re.compile(r"norm_obs['\"]{0,3} {0,3}[:=] {0,3}false", re.IGNORECASE)


def statistics_beside(given: Fetched, *, wanted: bool = True) -> tuple[Path | None, list[Path]]:
    """Return the file that a model's observations were normalised by, and all others that were seen.

    A file of the model's own name is its; else the only one beside it that no other model has, under the library's
    name, or one folder up of a model that a callback saved (``EvalCallback`` has a folder of its own). Raises
    SourceError where others may be it, unless it is not ``wanted``.
    """
    model = given.path
    beside, above = (_statistics_in(folder) for folder in (model.parent, Path(os.path.normpath(model.parent / ".."))))
    seen = list(dict.fromkeys([*beside, *above]))
    own = _named_after(model)
    if own is not None:
        return own, [file for file in seen if file != own]
    free = [file for file in beside if not _is_anothers(file, model)]
    callback = model.stem in _OF_CALLBACKS or _OF_STEP.fullmatch(model.stem) is not None
    able = free or [file for file in above if not _is_anothers(file, model)]
    if able and able[0].name in _STATISTICS and (free or callback) and len({*map(given.bytes_of, able)}) == 1:
        return able[0], [file for file in seen if file != able[0]]
    if able and wanted:
        raise _ambiguity_error(able, "beside it" if free else "one folder up")
    return None, seen


def _named_after(model: Path) -> Path | None:
    """Return the statistics that a model's name, or a folder of that name, says are its; None where none are."""
    known = (folder / name for folder, names in _places(model) for name in names)
    own = next((file for file in known if file.is_file()), None)
    return None if own is None or (own.name in _STATISTICS and own.parent == model.parent) else own


def _ambiguity_error(files: Sequence[Path], place: str) -> SourceError:
    """The error for statistics at a place of which none is known to be the model's."""
    named = [(file.name, f"--normaliser {path_text(file)}") for file in files[:8]]
    return SourceError(
        f"its observations may have been normalised by {' or '.join(name for name, _ in named)}",
        why=f"statistics of VecNormalize are {place}, and their names do not say that they are of this model",
        fix=f"say which: {' or '.join(flag for _, flag in named)}; none: --set normaliser=none",
    )


def _statistics_in(folder: Path) -> list[Path]:
    """Return the files of a folder that are called like statistics of VecNormalize, or begin as its pickles do."""
    try:
        pickles = sorted(p for p in folder.iterdir() if p.suffix.lower() in _PICKLES and p.is_file())
    except OSError:  # a folder that may be entered and not listed
        return []
    return [p for p in pickles if _LIKE.fullmatch(p.name) or _begins_with_its_class(p)]


def _begins_with_its_class(file: Path) -> bool:
    """Whether a pickle is of a VecNormalize, whatever it is called (``vecnorm.pkl``, ``env_stats.pkl``)."""
    try:
        with open_regular_file(file) as opened:
            head = opened.read(_HEAD)
    except SourceError:  # a pipe, or one that may not be read: --normaliser would say so
        return False
    return b"vec_normalize" in head and b"VecNormalize" in head


def _is_anothers(file: Path, model: Path) -> bool:
    """Whether a file's name says of which other model it is: of a step, or of one that lies beside it."""
    stem, others = file.stem.lower(), {p.stem.lower() for p in file.parent.glob("*.zip")} - {model.stem.lower()}
    named = any(stem.startswith(f"{other}_") or stem.endswith(f"_{other}") for other in others)
    return named or _OF_A_STEP.search(stem) is not None


def settings_that_normalise(given: Fetched) -> Path | None:
    """Return the file beside a model that says it was trained behind VecNormalize; None where none says so."""
    for folder in dict.fromkeys(folder for folder, _ in _places(given.path)):
        for file in (folder / name for name in _SETTINGS):
            if file.is_file() and file.stat().st_size <= _LARGEST:
                text = given.bytes_of(file, empty=True).decode("utf-8", "replace")
                said = _NORMALIZE.search(text)
                value = said[1].strip("'\" ").lower() if said else "false"
                if value not in ("false", "null", "no", "off", "~", "") and not _NOT_OBSERVATIONS.search(text):
                    return file
    return None


def _places(model: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield folders, and what the statistics of a model are called there, the surest first."""
    stem = model.name if model.is_dir() else model.stem
    step = _OF_STEP.fullmatch(stem)
    if step is not None:
        yield model.parent, [f"{step[1]}_vecnormalize_{step[2]}_steps.pkl"]
    yield model if model.is_dir() else model.parent / stem, [*_STATISTICS]
    own = [called for name in _STATISTICS for called in (f"{stem}_{name}", f"{Path(name).stem}_{stem}.pkl")]
    yield model.parent, [*own, *_STATISTICS]
    if step is not None or stem in _OF_CALLBACKS:
        runs = _runs(model.parent)
        if len(runs) == 1:
            yield runs[0].with_suffix(""), [*_STATISTICS]


def _runs(folder: Path) -> list[Path]:
    """Return the models of a folder that have their settings, or themselves unpacked, in a folder of their name."""
    kept = (*_STATISTICS, *_SETTINGS, _UNPACKED)
    try:
        models = sorted(p for p in folder.iterdir() if p.suffix == ".zip" and p.is_file())
    except OSError as error:
        raise unreadable(folder, error) from error
    return [m for m in models if any((m.parent / m.stem / name).is_file() for name in kept)]


def is_run(folder: Path) -> bool:
    """Whether a folder is that of one run: one model, and what belongs to it."""
    return folder.is_dir() and len(_runs(folder)) == 1


def members(folder: Path, options: ReadOptions) -> list[Member]:
    """Return the one policy of a run: its last model, or the one of ``--step``. Raises SourceError."""
    (model,) = _runs(folder)
    others = sorted(p for p in folder.glob("*.zip") if p.is_file() and p != model)
    if options.step is not None:
        saved = {int(m[2]): p for p in others if (m := _OF_STEP.fullmatch(p.stem)) is not None}
        if options.step not in saved:
            known = ", ".join(map(str, sorted(saved))) or "none"
            raise SourceError(
                f"has no model of step {options.step}",
                where=str(folder),
                why=f"models of steps: {known}",
                fix=f"leave --step out for {model.name}",
            )
        return [Member(saved[options.step], model.stem)]
    names = ", ".join(p.name for p in others[:8]) + (f" and {len(others) - 8} more" if len(others) > 8 else "")
    notes = (f"also here, not used: {names} (give one by its path)",) if others else ()
    return [Member(model, model.stem, notes=notes)]
