"""A folder that training left as a source: one policy per behavior, each in the best form it was kept in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from converters.checkpoint.listing import STEPPED, Behavior, Kept, behaviors, best, graph_of
from converters.checkpoint.source import left_out, newest, no_such_step, read_checkpoint
from converters.recognise import not_readable, recognise_path
from converters.registry import reader
from converters.source import ReadOptions, SourceModel
from signatures.errors import ExportModelError


def read(path: Path, options: ReadOptions) -> list[SourceModel]:
    """The policies of a run folder, or of a behavior's.

    The final export goes before checkpoints, unless ``--step`` asks for one. Raises UsageError with the steps there
    are where no behavior has that step.
    """
    found = behaviors(path)
    if options.step is not None:
        kept = [b for b in found if options.step in b.steps]
        if not kept:
            raise no_such_step(options.step, sorted({s for b in found for s in b.steps}))
        without = tuple(f"{b.name} has no checkpoint of step {options.step}" for b in found if b not in kept)
        return [_with(m, None, without) for b in kept for m in _read(b, path, options)]
    return [model for behavior in found for model in _read(behavior, path, options)]


def _read(behavior: Behavior, folder: Path, options: ReadOptions) -> list[SourceModel]:
    """The models of a behavior: one; one per final export where a folder of 0.1-0.5 has several of the same kind."""
    step = options.step
    if step is None and behavior.finals:
        chosen = best(behavior.finals)
        notes = left_out([p.name for p in behavior.finals if p not in chosen] + [k.label for k in behavior.kept])
        models: list[SourceModel] = []
        for path in chosen:
            name = behavior.name if len(chosen) == 1 else path.stem
            models.extend(_with(m, name, notes) for m in _file(path, folder, options))
        return models
    kept = _newest(behavior, step)
    notes = left_out([p.name for p in behavior.finals] + [k.label for k in behavior.kept if k is not kept])
    if kept.suffix == ".index":
        return [read_checkpoint(kept.prefix, None, behavior.name, notes)]
    return [_with(m, behavior.name, notes) for m in _file(kept.path, folder, options)]


def _newest(behavior: Behavior, step: int | None) -> Kept:
    """What was kept at ``step``, or last; a checkpoint with its graph before exports, these before the rest."""
    last = step if step is not None else max(behavior.steps, default=None)
    at = [k for k in behavior.kept if k.step == last] or list(behavior.kept)
    usable = [k for k in at if k.suffix != ".index" or graph_of(k.prefix) is not None] or at
    if not usable:
        return newest([], None, behavior.folder)
    return min(usable, key=lambda k: STEPPED.index(k.suffix))


def _file(path: Path, folder: Path, options: ReadOptions) -> list[SourceModel]:
    """The models of one file, by the reader of what it is. Errors name it relative to the folder."""
    where = str(path.relative_to(folder))
    kind = recognise_path(path)
    read_file = reader(kind.key)
    if read_file is None:
        raise not_readable(kind, Path(where))
    try:
        return read_file(path, replace(options, step=None))
    except ExportModelError as error:
        raise error.at(where) from error.__cause__


def _with(model: SourceModel, name: str | None, notes: Sequence[str]) -> SourceModel:
    facts = replace(model.facts, notes=(*model.facts.notes, *notes))
    return replace(model, name=model.name if name is None else name, facts=facts)
