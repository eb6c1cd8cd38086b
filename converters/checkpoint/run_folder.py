"""A folder that training left as a source: one policy per behavior, each in the best form it was kept in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from converters.checkpoint.listing import STEPPED, Behavior, behaviors, best, graph_of
from converters.checkpoint.source import left_out, newest, no_such_step
from converters.format import Member
from converters.source import ReadOptions


def members(path: Path, options: ReadOptions) -> list[Member]:
    """What is read of a run folder, or of a behavior's.

    The final export goes before checkpoints, unless ``--step`` asks for one. Raises UsageError with the steps there
    are where no behavior has that step.
    """
    found = behaviors(path)
    if options.step is None:
        return [member for behavior in found for member in _finals(behavior)]
    kept = [b for b in found if options.step in b.steps]
    if not kept:
        raise no_such_step(options.step, sorted({s for b in found for s in b.steps}))
    without = tuple(f"{b.name} has no checkpoint of step {options.step}" for b in found if b not in kept)
    return [_newest(behavior, options.step, without) for behavior in kept]


def _finals(behavior: Behavior) -> list[Member]:
    """The final export (a folder of 0.1-0.5 may have several of a kind); without any, what was kept last."""
    if not behavior.finals:
        return [_newest(behavior, None)]
    chosen = best(behavior.finals)
    notes = left_out([p.name for p in behavior.finals if p not in chosen] + [k.label for k in behavior.kept])
    return [Member(path, behavior.name if len(chosen) == 1 else path.stem, notes) for path in chosen]


def _newest(behavior: Behavior, step: int | None, notes: Sequence[str] = ()) -> Member:
    """What was kept at ``step``, or last; a checkpoint with its graph before exports, these before the rest."""
    last = step if step is not None else max(behavior.steps, default=None)
    at = [k for k in behavior.kept if k.step == last] or list(behavior.kept)
    usable = [k for k in at if k.suffix != ".index" or graph_of(k.prefix) is not None] or at
    kept = min(usable, key=lambda k: STEPPED.index(k.suffix)) if usable else newest([], None, behavior.folder)
    rest = left_out([p.name for p in behavior.finals] + [k.label for k in behavior.kept if k is not kept])
    return Member(kept.prefix if kept.suffix == ".index" else kept.path, behavior.name, (*rest, *notes))
