"""What is in a source: generation, brains, inputs with what to feed, outputs with what they mean, targets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.consumers.named_files import artifact_of
from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.formats.registry import LITERT, WRITTEN
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.nodes import Graph
from export_model.converters.interfaces.text import kept_text, loop_lines, tables
from export_model.converters.policy.policy import Policy
from export_model.converters.policy.rules import RoleDecision
from export_model.exporter.export.sources import read_source
from export_model.exporter.layout.ports import robots_that_fit
from export_model.exporter.meanings import OUTPUT_MEANINGS, feed_text
from export_model.exporter.reports.layers import blocks_of, chain
from export_model.exporter.tables import count_text, paragraph, size_text, table
from export_model.signatures.contract import safe_name
from export_model.signatures.errors import ExportModelError, naming
from export_model.signatures.fields import printable
from export_model.signatures.spec import PolicySignature, TensorSpec

if TYPE_CHECKING:
    from export_model.converters.formats.litert.microcontrollers import Fit
if not TYPE_CHECKING:  # what asks a record for its signature looks these names up
    Fit = Any

#: More nodes than this are no chain of layers that anybody would read.
_MOST_NODES = 600
#: Robots that are named.
_MOST_ROBOTS = 4
#: Numbers of an observation whose statistics are shown.
_MOST_STATISTICS = 12


class PolicyInspection(Struct, frozen=True):
    """One policy of a source."""

    policy: Policy
    ops: Mapping[str, int]
    #: target → None where it can be written, else why not
    targets: Mapping[str, str | None]
    #: numbers that it holds: weights, and the statistics of its normaliser
    parameters: int = 0
    #: action → the layers from an observation to it, in words
    layers: Mapping[str, str] = field(default_factory=dict)
    #: why inputs and outputs have their roles, where it was asked
    decisions: Sequence[RoleDecision] = ()
    #: how its .tflite for one agent fits LiteRT for Microcontrollers; None where it has none
    board: Fit | None = None

    def __repr__(self) -> str:
        able = [target for target, reason in self.targets.items() if reason is None]
        return f"<{self.policy.name!r}: {self.policy.signature.flow}; can be written as {', '.join(able) or 'nothing'}>"

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "name": self.policy.name,
            **self.policy.signature.to_dict(),
            "parameters": self.parameters,
            "layers": dict(self.layers),
            "ops": dict(self.ops),
            "targets": {t: {"ok": reason is None, "reason": reason} for t, reason in self.targets.items()},
            **({} if self.board is None else {"board": {"lacks": list(self.board.lacks), "arena": self.board.arena}}),
            **({"why": [_reason(d) for d in self.decisions]} if self.decisions else {}),
        }


class Inspection(Struct, frozen=True):
    """A source and its policies."""

    path: Path
    kind: str
    sha256: str
    size: int
    nodes: int
    policies: Sequence[PolicyInspection]
    #: (name, graph) of every model in it, as it was read
    graphs: Sequence[tuple[str, Graph]] = ()
    #: what the file says of the tool that wrote it
    producer: str = ""

    def __repr__(self) -> str:
        names = ", ".join(repr(p.policy.name) for p in self.policies[:4])
        more = f" and {len(self.policies) - 4} more" if len(self.policies) > 4 else ""
        return f"<Inspection of {str(self.path)!r}: {self.kind}, {names}{more}>"

    def _repr_html_(self) -> str:
        from export_model.exporter.markup import notebook

        tables = [t for p in self.policies for t in port_tables(p.policy.signature)]
        return notebook(f"{self.path}: {self.kind}, {size_text(self.size)}", *tables)

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "schema": 1,
            "path": str(self.path),
            "kind": self.kind,
            "sha256": self.sha256,
            "bytes": self.size,
            "nodes": self.nodes,
            "producer": self.producer,
            "policies": [p.to_dict() for p in self.policies],
        }


def inspect_source(
    path: Path | str,
    options: CompileOptions | None = None,
    read: ReadOptions | None = None,
    refused: list[ExportModelError] | None = None,
    *,
    why: bool = False,
) -> Inspection:
    """Read and understand a source without writing anything. Raises what the export would raise.

    With ``refused``, which gets the errors, a file of a folder that is refused does not refuse the others. ``why``: the
    rule that decided on each tensor is found, too.
    """
    source = read_source(path, read, refused)
    compiled = source.compile_models(options) if refused is None else source.compiled_or_refused(options, refused)
    found = []
    decided: dict[str, tuple[RoleDecision, ...]] = {}
    for model, policy in compiled:
        if why and policy.name not in decided:
            decided |= source.explain(model, options)
        ops = dict(sorted(Counter(n.op for n in policy.graph.nodes).items()))
        targets = {key: _refusal(source.path, policy, f) for key, f in WRITTEN.items()}
        with naming(source.path):
            layers = _layers(policy)
        parameters = sum(v.size for v in policy.graph.values() if v.ndim and v.dtype.kind == "f")
        decisions = decided.get(policy.name, ())
        board = None if targets[LITERT.key] is not None else _board(source.path, policy)
        found.append(
            PolicyInspection(
                policy=policy,
                ops=ops,
                targets=targets,
                parameters=parameters,
                layers=layers,
                decisions=decisions,
                board=board,
            )
        )
    return Inspection(
        path=source.path,
        kind=source.format.label,
        sha256=source.sha256,
        size=source.size,
        nodes=sum(len(m.graph.nodes) for m in source.models),
        policies=found,
        graphs=[(safe_name(source.stem(m)), m.graph) for m in source.models],
        producer="; ".join(dict.fromkeys(m.producer for m in source.models if m.producer)),
    )


def _layers(policy: Policy) -> dict[str, str]:
    """Action → ``8 → normalise → 32 swish → 2``; nothing of a graph that is too large to be drawn."""
    signature, graph = policy.signature, policy.graph
    if sum(n.value is None for n in graph.nodes) > _MOST_NODES:
        return {}
    sizes = {s.name: "×".join("?" if n is None else str(n) for n in s.shape[1:]) or "1" for s in signature.inputs}
    blocks = blocks_of(graph, [head.name for head in signature.heads])
    ways = {head.name: chain(blocks, head.name) for head in signature.heads}
    return {name: " → ".join(sizes.get(word, word) for word in way) for name, way in ways.items()}


def _refusal(path: Path, policy: Policy, target: Format) -> str | None:
    """Why a target cannot take the policy, None if it can: the writer is asked, nothing is kept."""
    try:
        with naming(path):
            artifact_of(target, policy, WriteOptions("{}"))
    except ExportModelError as error:
        return error.what
    return None


def _board(path: Path, policy: Policy) -> Fit | None:
    """How the file for one agent would run on a board; None where it is for any number alone."""
    from export_model.converters.formats.litert.microcontrollers import fit

    try:
        with naming(path):
            (file,) = LITERT.artifact(policy, WriteOptions("{}", batch=1)).files.values()
            return fit(file.to_bytes())
    except ExportModelError:
        return None


def _board_line(fit: Fit) -> str:
    if fit.lacks:
        return paragraph(", ".join(fit.lacks), "LiteRT for Microcontrollers lacks: ", "  ")
    return f"LiteRT for Microcontrollers: an arena of about {size_text(fit.arena)} (--to litert --batch 1)"


def inspection_text(inspection: Inspection) -> str:
    """For the terminal."""
    head = (
        f"{inspection.path}: {inspection.kind}, {size_text(inspection.size)}, {count_text(inspection.nodes, 'node')}, "
        f"{count_text(len(inspection.policies), 'policy', 'policies')}"
        + (f"; {inspection.producer}" if inspection.producer else "")
    )
    return "\n\n".join([paragraph(head, "", "  "), *(_policy_text(p, inspection.path) for p in inspection.policies)])


def _policy_text(inspected: PolicyInspection, path: Path) -> str:
    signature = inspected.policy.signature
    facts = [signature.family, f"{signature.action_space} actions"]
    if signature.algorithm:
        facts.append(signature.algorithm)
    if signature.branches:
        facts.append(f"branches {list(signature.branches)}")
    if signature.memory is not None:
        layout = f" [{'|'.join(signature.memory.layout)}]" if signature.memory.layout else ""
        facts.append(f"memory {signature.memory.size}{layout}")
    head = f"policy {safe_name(inspected.policy.name)}: {', '.join(facts)}"
    lines = [paragraph(head, "", "  "), "", "\n\n".join(table(head, rows) for head, rows in port_tables(signature))]
    lines += _reason_lines(inspected.decisions)
    lines += ["", f"parameters: {inspected.parameters:,}"]
    for name, way in inspected.layers.items():
        lines.append(paragraph(way, "layers: " if len(inspected.layers) == 1 else f"layers to {name}: ", "  "))
    lines += [paragraph(text, f"{name} is normalised by: ", "  ") for name, text in _normaliser_texts(signature)]
    lines += _label_lines(signature.labels)
    lines += [*_interface_lines(signature), *_layout_lines(signature, path)]
    if signature.constants:
        lines += ["", paragraph(", ".join(f"{k}={v}" for k, v in signature.constants.items()), "constants: ", "  ")]
    lines += [paragraph(note, "note: ", "  ") for note in signature.notes]
    lines.append(paragraph(", ".join(f"{op} {n}" for op, n in inspected.ops.items()), "ops: ", "  "))
    able = [t for t, reason in inspected.targets.items() if reason is None]
    lines.append(f"can be written as: {', '.join(able) or 'nothing'}")
    lines += [] if inspected.board is None else [_board_line(inspected.board)]
    refused = {t: reason for t, reason in inspected.targets.items() if reason is not None}
    lines += [paragraph(reason, f"cannot be written as {t}: ", "  ") for t, reason in refused.items()]
    return "\n".join(lines)


def _reason(decision: RoleDecision) -> dict[str, Any]:
    return {
        "tensor": decision.tensor,
        "role": decision.role,
        "because": decision.says,
        "against": list(decision.against),
    }


def _reason_lines(decisions: Sequence[RoleDecision]) -> list[str]:
    """A tensor's role and the rule that decided, and what spoke against it."""
    lines = []
    for decision in decisions:
        head = printable(f"{decision.tensor}: {decision.role or 'left out'}, because ")
        lines.append(paragraph(decision.says, head, "  "))
        lines += [paragraph(text, "  but ", "      ") for text in decision.against]
    return ["", *lines] if lines else []


def port_tables(signature: PolicySignature) -> list[tuple[tuple[str, ...], list[list[str]]]]:
    """Inputs with what to feed, and outputs with what they mean: head and rows of each."""
    fed = [_row(s, feed_text(s, signature)) for s in signature.inputs]
    meant = [_row(s, OUTPUT_MEANINGS.get(s.role, s.role.value)) for s in signature.outputs]
    middle = ("dtype", "shape", "in the source")
    return [(("input", *middle, "what to feed"), fed), (("output", *middle, "meaning"), meant)]


def _normaliser_texts(signature: PolicySignature) -> list[tuple[str, str]]:
    """Observation → the mean and the deviation that the policy normalises its numbers with."""
    found = []
    for spec in signature.observations:
        known = spec.distribution or {}
        if "std" in known:
            pairs = zip(np.atleast_1d(known["mean"]), np.atleast_1d(known["std"]), strict=True)
            shown = [f"{mean:.3g} ± {std:.3g}" for mean, std in list(pairs)[:_MOST_STATISTICS]]
            more = np.size(known["std"]) - len(shown)
            found.append((spec.name, ", ".join(shown) + (f", and {more} more (--json has all)" if more > 0 else "")))
    return found


def _label_lines(labels: Mapping[str, Any]) -> list[str]:
    """What the numbers are called, where somebody said it."""
    named = [(name, texts) for name, texts in labels.get("observations", {}).items()]
    named += [("continuous actions", labels["actions"])] if "actions" in labels else []
    named += [(f"branch {i}", texts) for i, texts in enumerate(labels.get("branches", []))]
    numbered = [(name, ", ".join(f"{i} {text}" for i, text in enumerate(texts))) for name, texts in named]
    lines = [paragraph(text, printable(f"labels of {name}: "), "  ") for name, text in numbered]
    return ["", *lines] if lines else []


def _interface_lines(signature: PolicySignature) -> list[str]:
    """What the source and the files beside it state of the numbers, and the keys that are not understood."""
    lines = []
    for name, head, rows in tables(signature):
        lines += ["", printable(f"interface of {name}:"), table(head, rows)]
    stated = [paragraph(text, "stated: ", "  ") for text in loop_lines(signature.interface)]
    kept = kept_text(signature.interface)
    return [*lines, *([""] if stated else []), *stated, *([paragraph(kept, "kept as text: ", "  ")] if kept else [])]


def _layout_lines(signature: PolicySignature, path: Path) -> list[str]:
    """The command that tells which number is which, where the widths are those of a known robot."""
    robots = robots_that_fit(signature)
    more = ", ..." if len(robots) > _MOST_ROBOTS else ""
    text = f"export-model layout {path} (these are widths of {', '.join(robots[:_MOST_ROBOTS])}{more})"
    return [paragraph(printable(text), "which number is which: ", "  ")] if robots else []


def _row(spec: TensorSpec, text: str) -> list[str]:
    source = ", ".join(spec.source) if isinstance(spec.source, tuple) else spec.source or "(made here)"
    return [spec.name, spec.dtype, spec.shape_text, source, text]
