"""A policy as loops, with what every language says around them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from msgspec import Struct

from export_model.converters.compiler.targets import PROGRAM, prepare
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.programs.comment import escape, interface_lines
from export_model.converters.formats.programs.members import Field, Header, header_of
from export_model.converters.formats.programs.weights import ProgramWeights, weights_name, weights_of
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.printer import Printer
from export_model.converters.graph.program import Program, program_of
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import numbers_made
from export_model.converters.graph.size_limits import MAX_COMPUTED
from export_model.converters.policy.policy import Policy
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.errors import GraphError, UnsupportedOpError, UsageError
from export_model.signatures.roles import Role

#: Golden rows of the self test, and how far float32 may be off.
ROWS = 3
#: What all languages say of numbers that are none.
NAN_SAID = "NaN is not looked for: numbers made of one are NaN, a class that is drawn by them is 0."
#: Numbers that the self test of a header compares; a policy has some hundreds, and the text of more says nothing.
MAX_GOLDEN = 1 << 16
CLOSE = "1e-4"


class Guarded(Struct, frozen=True):
    """An observation's mean in training, number by number, and how far from it is usual."""

    field: Field
    mean: tuple[float, ...]
    limit: tuple[float, ...]


class Plan(Struct, frozen=True):
    """The loops of a policy and its members.

    ``contract`` is the text of a comment. ``chosen`` is the output that classes are drawn by, ``sizes`` its branches.
    ``checked`` are the outputs that the self test compares, ``golden`` their numbers, row after row; NaN: any number.
    """

    header: Header
    program: Program
    contract: str
    chosen: Field | None
    sizes: tuple[int, ...]
    checked: tuple[Field, ...]
    golden: tuple[float, ...]
    weights: ProgramWeights
    code: CodeOptions
    guarded: tuple[Guarded, ...] = ()

    @property
    def masks(self) -> list[tuple[Field, tuple[int, ...]]]:
        """The members that say what is allowed, and how many actions of them each branch has."""
        fields = [f for f in self.header.inputs if f.spec.role is Role.MASKS]
        return [(f, self.sizes if sum(self.sizes) == f.size else (f.size,)) for f in fields]

    def chance(self, printer: Printer, noise: str) -> str:
        """What ``compute`` does with chance; ``noise`` says where it stands."""
        said = [f"with the noise that stands in {noise} (zeros: without chance)"] if self.header.noise else []
        said += ["drawing by the agent's stream"] if printer.draws else []
        return ", ".join(said) or "without chance"

    def draws(self, printer: Printer) -> bool:
        """Whether an agent draws numbers, once its loops are printed."""
        return printer.draws or bool(self.header.noise) or self.chosen is not None


def write_program(
    policy: Policy, options: WriteOptions, suffix: str, text: Callable[[str, Plan], str]
) -> dict[str, Pieces]:
    """Return the file of a policy's source code, and its weights where they lie beside it.

    ``text`` is given the policy's name and its plan. Raises UnsupportedOpError, UsageError.
    """
    plan = plan_of(policy, options)
    file = {} if plan.weights.file is None else {weights_name(policy.name): Pieces(plan.weights.file)}
    return {f"{policy.name}{suffix}": Pieces(text(policy.name, plan).encode("ascii")), **file}


def plan_of(policy: Policy, options: WriteOptions) -> Plan:
    """Plan a policy's program, once for the languages that are asked one after the other.

    Raises UnsupportedOpError, UsageError.
    """
    said = (policy.name, policy.feeds, policy.fetches, options.contract, options.weights, options.code)
    kept = policy.graph.cache.get(plan_of)
    if kept is None or kept[0] is not policy.signature or kept[1] != said:
        kept = policy.graph.cache[plan_of] = policy.signature, said, _plan(policy, options)
    plan: Plan = kept[2]
    return plan


def _plan(policy: Policy, options: WriteOptions) -> Plan:
    code = options.code
    header = header_of(policy.name, policy.signature, code)
    fetches = {f.spec.name: policy.fetches[f.spec.name] for f in header.answered}
    program = program_of(prepare(policy, PROGRAM), policy.feeds, fetches)
    for f in header.answered:
        if program.outputs[f.spec.name].place.size != f.size:
            raise UnsupportedOpError(
                f"{f.spec.name!r} ({f.spec.role}) cannot be written as source code: one agent gets "
                f"{program.outputs[f.spec.name].place.size} numbers of it",
                why=f"its shape {list(f.spec.shape)} says {f.size}",
                fix="mend the shapes that the source declares, or export to onnx, saved_model, tfjs or bytes",
            )
    contract = escape(options.contract)
    sizes = tuple(policy.signature.branches)
    checked, golden = _golden(policy, header)
    weights = weights_of(program, options.weights, in_file=code.weights == "file")
    guarded = () if code.guard is None else _guarded(policy.name, header, code.guard)
    text = f"{interface_lines(policy.signature)}   {EMBEDDED}: {contract}\n*/"
    return Plan(
        header=header,
        program=program,
        contract=text,
        chosen=header.choice_field(sizes),
        sizes=sizes,
        checked=checked,
        golden=golden,
        weights=weights,
        code=code,
        guarded=guarded,
    )


def _guarded(name: str, header: Header, most: float) -> tuple[Guarded, ...]:
    """The observations that the policy normalises, and how far they may lie. Raises UsageError."""
    found = []
    for f in header.inputs:
        said = f.spec.distribution or {}
        if said.get("kind") == "normal" and f.spec.dtype == "float32":
            mean, std = (np.resize(np.asarray(said[key], np.float32), f.size).tolist() for key in ("mean", "std"))
            limit = [float(np.float32(most * s)) for s in std]
            found.append(Guarded(f, tuple(mean), tuple(limit)))
    if not found:
        raise UsageError(
            f"--guard {most:g}: {name} has no normaliser",
            why="its running mean and deviation say what training saw",
            fix="leave --guard out",
        )
    return tuple(found)


def formula(field: Field, floats: str) -> str:
    """What the self test feeds to element ``i`` of a member in ``row``; ``floats`` is the language's formula."""
    if field.spec.role is Role.MASKS:
        return "1"
    return floats if field.spec.dtype == "float32" else "0"


def _sample_values(field: Field, row: int) -> np.ndarray:
    i = np.arange(field.size)
    if field.spec.role is Role.MASKS:
        return np.ones(field.size)
    return ((i * 7 + row * 5) % 17 - 8) / 8 if field.spec.dtype == "float32" else np.zeros(field.size)


def _golden(policy: Policy, header: Header) -> tuple[tuple[Field, ...], tuple[float, ...]]:
    """What the kernels make of inputs by a formula, as far as nothing is drawn; nothing of a graph too large."""
    graph = policy.graph
    drawn = graph.descendants(n.name for n in graph.nodes if traits(n).sampler)
    checked = [f for f in header.outputs if f.spec.dtype == "float32"]
    checked = [f for f in checked if policy.fetches[f.spec.name].partition(":")[0] not in drawn]
    golden = list[float]()
    few = ROWS * sum(f.size for f in checked) <= MAX_GOLDEN and numbers_made(graph, ROWS) <= MAX_COMPUTED
    for row in range(ROWS if checked and few else 0):
        feeds = {}
        for f in header.fed:
            value = _sample_values(f, row) if f in header.inputs else np.zeros(f.size)
            shape = [1 if n is None else n for n in f.spec.shape]
            feeds[policy.feeds[f.spec.name]] = value.astype(f.spec.dtype).reshape(shape)
        try:
            found = run_graph(graph, feeds, [policy.fetches[f.spec.name] for f in checked])
        except GraphError:  # zeros are no places in order
            return (), ()
        golden += [float(x) for f in checked for x in found[policy.fetches[f.spec.name]].reshape(-1)]
    return tuple(checked if golden else ()), tuple(float(f"{x:.6g}") if np.isfinite(x) else np.nan for x in golden)
