"""A policy whose weights are rounded (``--dtype float16``, ``--quantize int8``): when it may be, how it is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from converters.format import Format
from converters.formats import WRITTEN
from converters.graph.passes.weights import Storage, rounded
from exporter.export.job import Job, artefacts_of
from exporter.export.options import ExportOptions
from signatures.errors import UsageError


def check_weights(options: ExportOptions, formats: Sequence[Format]) -> None:
    """Raise UsageError where rounded weights are asked for and what is written cannot hold them."""
    if options.weights == "float32":
        return
    flag = "--dtype float16" if options.weights == "float16" else "--quantize int8"
    if options.profile is not None:
        raise UsageError(
            f"{flag} does not go with --for {options.profile}",
            why="the importers of Unity and TensorFlowSharp were not shown to read weights in less than float32",
            fix="leave one of them out",
        )
    wide = [f.key for f in formats if not f.narrow]
    if wide:
        raise UsageError(
            f"{flag} does not go with --to {','.join(wide)}",
            why=f"weights in {options.weights} are written to {', '.join(f.key for f in WRITTEN.values() if f.narrow)}",
            fix="leave one of them out",
        )


def smaller(job: Job, weights: Storage) -> Job:
    """The policy with its weights rounded, which a note in its contract says."""
    whole = job.policy
    note = f"weights were rounded to {weights}; what is computed with them is float32"
    signature = replace(whole.signature, notes=(*whole.signature.notes, note))
    return replace(job, policy=replace(whole, graph=rounded(whole.graph, weights), signature=signature), whole=whole)


def sizes_unrounded(job: Job, formats: Sequence[Format], options: ExportOptions) -> dict[str, int]:
    """What the formats would take with weights in float32; nothing where that is how they are written."""
    if job.whole is None:
        return {}
    whole = replace(job, policy=job.whole, whole=None)
    _, artifacts, _ = artefacts_of(whole, formats, replace(options, weights="float32", verify="none"))
    return {a.format.key: a.size for a in artifacts}
