"""A checkpoint as a source, by its prefix or any of its files; and a training graph, with the checkpoint beside it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.checkpoint import listing
from export_model.converters.formats.checkpoint.freeze import freeze, with_values
from export_model.converters.formats.checkpoint.listing import (
    STEPPED,
    Behavior,
    behaviors,
    best,
    graph_of,
    unread_folders,
)
from export_model.converters.formats.checkpoint.policy_nodes import policy_nodes
from export_model.converters.formats.checkpoint.table import MAGIC
from export_model.converters.formats.checkpoint.tensor_bundle import Checkpoint, of_objects, version_1
from export_model.converters.formats.checkpoint.training_graph import read_training_graph
from export_model.converters.formats.format import Member
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.errors import ExportModelError, SourceError, UsageError

_PARTS = re.compile(r"(?P<prefix>.+)\.(index|meta|data-\d{5}-of-\d{5})")


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The policy of one checkpoint.

    A prefix, ``.index``, ``.data`` or ``.meta`` names it; ``checkpoint`` and a graph (raw_graph_def.pb) stand for the
    newest in their folder, or the one of ``--step``.
    """
    path = given.path
    named = _prefix(path)
    if named is not None:
        step = listing.step_of(named.name)[1]
        if options.step is not None and options.step != step:
            raise UsageError(
                f"--step {options.step} goes with a folder, and {path.name} is the checkpoint of step {step}",
                fix=f"give the folder: {path.parent}",
            )
        stem = re.sub(r"\.(cptk|ckpt)$", "", named.name)
        return [read_checkpoint(named, name=stem)]
    name = path.parent.resolve().name if path.name in (listing.LIST, listing.RAW_GRAPH) else path.stem
    graph = None if path.name == listing.LIST else path
    found = listing.checkpoints(path.parent)
    if not found:
        _refuse_version_1(path.parent)
        if graph is not None and options.step is None:
            return [_graph_alone(graph, name)]
    kept = newest(found, options.step, path.parent)
    rest = [k.label for k in found if k is not kept]
    return [read_checkpoint(kept.prefix, graph, name, left_out(rest))]


def read_checkpoint(
    prefix: Path, graph: Path | None = None, name: str | None = None, notes: Sequence[str] = ()
) -> SourceModel:
    """The model of one checkpoint. ``graph`` is a file with its graph, by default the one that lies beside it."""
    checkpoint = Checkpoint(prefix)
    path = graph or listing.graph_of(prefix)
    if path is None and checkpoint.of_objects:
        raise of_objects(checkpoint)
    if path is None:
        raise SourceError(
            "the graph is missing beside the checkpoint",
            where=prefix.name,
            why="a checkpoint has values only; what is computed with them is in raw_graph_def.pb or in its .meta",
            fix=f"put the run's raw_graph_def.pb, or {prefix.name}.meta, beside it",
        )
    try:
        training = read_training_graph(path)
        frozen = freeze(training, checkpoint)
        policy, found = policy_nodes(frozen.graph)
    except ExportModelError as error:
        if error.where is None:
            raise error.at(path.name) from error.__cause__
        raise
    detached = Detached()
    return SourceModel(
        policy,
        (path, *checkpoint.files),
        SourceFacts(notes=(*found, *notes)),
        name,
        OriginalRun(
            "tensorflow", path, definition=with_values(training.definition, frozen.values, detached), detached=detached
        ),
    )


def newest(found: Sequence[listing.KeptStep], step: int | None, folder: Path) -> listing.KeptStep:
    """The checkpoint of ``step``, by default the newest. Raises UsageError with the steps there are, SourceError."""
    if not found:
        _refuse_version_1(folder)
        raise SourceError(
            "the folder holds no checkpoint",
            where=str(folder),
            why="a checkpoint is a file called <name>-<step>.cptk.index or .ckpt.index, with a .data file beside it",
            fix="give the folder that training wrote to, or the frozen graph",
        )
    if step is None:
        return found[-1]
    wanted = [k for k in found if k.step == step]
    if not wanted:
        raise no_such_step(step, [k.step for k in found if k.step is not None])
    return wanted[-1]


def no_such_step(step: int, steps: Sequence[int]) -> UsageError:
    """The error that lists the steps there are."""
    shown = ", ".join(map(str, sorted(set(steps)))) or "none"
    return UsageError(f"--step {step}: no checkpoint has that step", fix=f"the steps are {shown}")


def left_out(names: Sequence[str]) -> tuple[str, ...]:
    """The note that lists what lay beside the form that was read."""
    if not names:
        return ()
    shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    return (f"also here, not used: {shown}",)


def is_version_1(path: Path) -> bool:
    """Whether a file is a checkpoint of one file: a table that is not called ``.index``."""
    if not path.is_file() or path.suffix == ".index" or path.stat().st_size < len(MAGIC):
        return False
    with path.open("rb") as file:
        file.seek(-len(MAGIC), 2)
        return file.read() == MAGIC


def _refuse_version_1(folder: Path) -> None:
    first = next((p for p in sorted(folder.iterdir()) if is_version_1(p)), None)
    if first is not None:
        raise version_1(first.name)


def _prefix(path: Path) -> Path | None:
    """The checkpoint that a path names, None where it names a folder's."""
    match = _PARTS.fullmatch(path.name)
    if match is not None:
        return path.with_name(match["prefix"])
    if path.with_name(path.name + ".index").is_file():
        return path
    if is_version_1(path):
        raise version_1(path.name)
    return None


def _graph_alone(path: Path, name: str) -> SourceModel:
    """A graph that has variables, but not where the policy needs any."""
    training = read_training_graph(path)
    graph, notes = policy_nodes(freeze(training, None).graph)
    original = OriginalRun("tensorflow", path, definition=training.definition)
    return SourceModel(graph, (path,), SourceFacts(notes=notes), name, original)


def members(path: Path, options: ReadOptions) -> list[Member]:
    """What is read of a run folder, or of a behavior's.

    The final export goes before checkpoints, unless ``--step`` asks for one. Raises UsageError with the steps there
    are where no behavior has that step.
    """
    found = behaviors(path)
    if options.step is None:
        finals = [member for behavior in found for member in _finals(behavior)]
        unread = left_out([f"{folder.name}/ (give it by its path)" for folder in unread_folders(path)])
        return [*(replace(m, notes=(*m.notes, *unread)) for m in finals[:1]), *finals[1:]]
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
