"""What Stable-Baselines3 and rl-baselines3-zoo put beside a saved model.

Sources: rl_zoo3/exp_manager.py (``<log>/<env>_<n>/<env>.zip``, its settings and ``vecnormalize.pkl`` in a folder
``<env>/`` beside it), callbacks.py (``best_model.zip``), push_to_hub.py (``<algo>-<env>.zip``, ``vec_normalize.pkl``,
``config.yml``, and the model unpacked to ``<algo>-<env>/``); stable_baselines3/common/callbacks.py
(``CheckpointCallback``: ``<prefix>_<n>_steps.zip``, ``<prefix>_vecnormalize_<n>_steps.pkl``).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from converters.files.fetch import Fetched, unreadable
from converters.formats.format import Member
from converters.formats.source import ReadOptions
from signatures.errors import SourceError

_STATISTICS = ("vecnormalize.pkl", "vec_normalize.pkl")
_SETTINGS = ("config.yml", "args.yml")
_UNPACKED = "policy.pth"
_OF_STEP = re.compile(r"(.+)_(\d{1,18})_steps")
#: Models of a run that its callbacks save; the run's folder of settings is theirs, too.
_OF_CALLBACKS = ("best_model", "final_model")
_LARGEST = 1 << 20
#: ``normalize: true``, or as PyYAML writes the pairs of an OrderedDict: ``- - normalize`` above ``  - true``.
_NORMALIZE = re.compile(r"^[ -]*normalize(?::|\n[ -]*-) *([^\n]{0,300})", re.MULTILINE)
_NOT_OBSERVATIONS = re.compile(r"norm_obs['\"]{0,3} {0,3}[:=] {0,3}false", re.IGNORECASE)


def statistics_beside(model: Path) -> Path | None:
    """Return the file with the statistics that a model's observations were normalised by, where one lies beside it."""
    for folder, names in _places(model):
        for name in names:
            if (folder / name).is_file():
                return folder / name
    return None


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
    yield model.parent, [*(f"{stem}_{name}" for name in _STATISTICS), *_STATISTICS]
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
