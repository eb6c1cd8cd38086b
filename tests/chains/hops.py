"""One export after the other, the artefact of each the source of the next."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.verify.difference import compare, floor_log_probs
from export_model.exporter.verify.tolerances import Tolerance, tolerance_for
from export_model.signatures.contract import safe_name
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from export_model.signatures.spec import PolicySignature
from tests.chains.starts import Start

#: What a hop gives to the next one: one format's artefact, or the bundle's folder.
FORMS = ("bytes", "saved_model", "tfjs", "onnx", "litert", "bundle")
_MAIN = {form: "" if form == "bundle" else WRITTEN[form].main for form in FORMS}
#: Nothing is computed anew on the way, so the kernels may only differ by how a constant was folded.
CLOSE = Tolerance(2e-6, 2e-6)


@dataclass(frozen=True)
class Hop:
    """An export: what of it is taken further, and how it was asked for."""

    form: str
    names: str = "canonical"
    opset: int = 15
    deterministic: bool = False

    def __repr__(self) -> str:
        said = [self.form, "names=source" * (self.names == "source"), "deterministic" * self.deterministic]
        return " ".join([s for s in said if s] + ([f"opset={self.opset}"] if self.opset != 15 else []))

    @property
    def targets(self) -> tuple[str, ...]:
        """The formats to write; a bundle is read from the first of them that it has."""
        return ("onnx", "tfjs") if self.form == "bundle" else (self.form,)


def exported(place: Path, out: Path, hop: Hop, options: CompileOptions) -> list[ExportResult]:
    """The policies of a source in the format of a hop."""
    how = replace(options, names=hop.names, deterministic=hop.deterministic)
    opset = hop.opset if "onnx" in hop.targets else None  # of other formats it says nothing, and is refused
    return list(export([place], ExportOptions(out, hop.targets, compile=how, opset=opset, verify="none")))


def walk(start: Start, chain: Sequence[Hop], folder: Path) -> list[tuple[ExportResult, ExportResult]]:
    """Per policy of the start: (the direct export, the end of the chain)."""
    (folder / "start").mkdir(parents=True)
    place = start.make(folder / "start")
    own = CompileOptions(inputs=start.inputs, outputs=start.outputs)
    # A name that a hop has changed is changed for good; so is an action without chance.
    names = "source" if all(h.names == "source" for h in chain) else "canonical"
    last = dataclasses.replace(chain[-1], names=names, deterministic=any(h.deterministic for h in chain))
    direct = exported(place, folder / "direct", last, own)
    found = []
    for number, wanted in enumerate(direct):
        brain = None if len(direct) == 1 else wanted.policy.name.removeprefix(f"{safe_name(place.stem)}-")
        options = replace(own, brain=brain)
        source = place
        for step, hop in enumerate(chain):
            (result,) = exported(source, folder / f"{number}-{step}", hop, options)
            source, options = result.folder / _MAIN[hop.form].format(name=result.policy.name), CompileOptions()
        found.append((wanted, result))
    return found


def told(policy: Policy) -> dict[str, Any]:
    """The contract, but for what is the artefact's own: its name and the source's names of the tensors."""
    content = policy.signature.to_dict()
    for entry in (*content["inputs"], *content["outputs"]):
        del entry["source"]
    return content


def _settled(answers: Mapping[str, np.ndarray], signature: PolicySignature) -> dict[str, np.ndarray]:
    """Answers as verification compares them: log-probabilities that say "never" are one value."""
    scores = {s.name for s in signature.outputs if s.role is Role.LOG_PROBS and s.dtype == "float32"}
    return {n: floor_log_probs(a, signature.branches) if n in scores else a for n, a in answers.items()}


def assert_runs_alike(wanted: ExportResult, got: ExportResult, form: str, pool: RuntimePool) -> None:
    """The numbers of the numpy kernels, and of a runtime that computes by itself, are those of the direct export."""
    signature = wanted.policy.signature
    random = {s.name for s in signature.outputs if s.role is Role.SAMPLED}
    names = [s.name for s in signature.outputs if s.name not in random]
    kind = "tfjs" if form == "bundle" else form
    runtime = next(r for r in WRITTEN[kind].runtimes if r != "numpy")
    loading = {"kind": kind if kind in ("saved_model", "litert") else "graph"}
    models = [
        pool.process(runtime).load(str(r.folder / _MAIN[kind].format(name=r.policy.name)), **loading)
        for r in (wanted, got)
    ]
    edges = ("clip", "1e3")  # inputs beyond what training saw: rounding alone may pass the tolerance there
    for case in draw_cases(signature, seed=3, samples=1):
        if any(word in case.name for word in edges):
            continue
        direct, ours = (_settled(run_graph(r.policy.graph, case.feeds, names), signature) for r in (wanted, got))
        reference, theirs = (_settled(m.run(case.feeds, names), signature) for m in models)
        for name in names:
            close = compare(direct[name], ours[name], CLOSE)
            assert close.passed, f"{case.name}: {name} by the numpy kernels: {close}"
            wide = tolerance_for(signature, name, Tolerance())
            away = compare(reference[name], theirs[name], wide, narrowed=kind == "tfjs")
            assert away.passed, f"{case.name}: {name} in {runtime}: {away}"
    for model in models:
        model.unload()
