"""ONNX's own tests of its operators, each as a policy: what is converted is right, the rest is refused.

The onnx package generates them (onnx.backend.test.case.node): a model of one node (or of its definition by others), its
inputs and expected outputs, of fixed shapes. Here one observation, without a batch axis, is cut into the inputs that
the compiler takes as computed ones, the others are constants, and all outputs are one action. So every export is of a
model for one agent, and is run with several.

``python -m tests.onnx_reader.node_tests`` runs all of them, numpy and onnxruntime, and writes its part of
docs/support-tables.md.
"""

from __future__ import annotations

import re
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError
from export_model.signatures.roles import Role
from tests.support_tables import write

TITLE = "Operators of ONNX"
ROWS = 3
#: dtype kinds that a policy computes in
_NUMBERS = "fiub"
Array = np.ndarray


@dataclass(frozen=True)
class NodeTest:
    """One of ONNX's tests and the first set of its data; ``subject`` is the operator that it is about."""

    name: str
    subject: str
    model: Any
    inputs: tuple[Any, ...]
    outputs: tuple[Any, ...]
    rtol: float
    atol: float


@dataclass(frozen=True)
class Outcome:
    """What became of a test, with the reason: ``right``, ``refused``, ``wrong``, ``no kernel`` (in onnxruntime) or
    ``no policy``.
    """

    state: str
    reason: str = ""


def collected(only: str | None = None) -> list[NodeTest]:
    """The tests that onnx generates, all or those of the operators' modules that are named so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from onnx.backend.test.case.node import collect_testcases

        cases = collect_testcases(only)
    kinds = {case.name: case.model.graph.node[-1].op_type for case in cases}
    found = []
    for case in cases:
        inputs, outputs = case.data_sets[0]
        whole = case.name.partition("_expanded")[0]  # the same operator, as ONNX defines it by others
        subject = kinds[case.name] if whole == case.name else f"{kinds.get(whole, whole)}, written out"
        found.append(NodeTest(case.name, subject, case.model, tuple(inputs), tuple(outputs), case.rtol, case.atol))
    return found


def outcome(test: NodeTest, folder: Path, pool: RuntimePool | None) -> Outcome:
    """Every way to feed it that the compiler takes must be right; refused where it takes none."""
    if not all(_is_tensor(a) for a in (*test.inputs, *test.outputs)):
        return Outcome("no policy", "its values are no tensors of numbers")
    if not test.inputs or not all(_array(a).size for a in test.inputs):
        return Outcome("no policy", "nothing is fed to it, or no elements")
    if any(n.op_type in _CHANCE for n in test.model.graph.node):
        return Outcome("no policy", "it draws")
    refusals = []
    taken = False
    for fed in _ways(test):
        try:
            policy = policy_of(test, fed, folder)
        except ExportModelError as error:
            refusals.append(_short(error))
            continue
        taken = True
        try:
            fault = _fault(test, fed, policy, folder, pool)
        except RunFailedError as error:
            return Outcome("no kernel", error.why or error.what)
        if fault:
            return Outcome("wrong", f"{fault} (fed: {fed})")
    if taken:
        return Outcome("right")
    return Outcome("refused", next((r for r in refusals if "while the graph runs" not in r), refusals[0]))


#: Operators whose results are draws; tests/onnx_reader/test_samplers.py holds their distributions.
_CHANCE = ("Bernoulli", "RandomUniformLike", "RandomNormalLike", "Multinomial")


def _is_tensor(value: Any) -> bool:
    if isinstance(value, TensorProto):
        return value.data_type not in (8, *range(17, 40)) and value.data_type != 16
    return isinstance(value, np.ndarray | np.generic) and np.asarray(value).dtype.kind in _NUMBERS


def _array(value: Any) -> Array:
    return numpy_helper.to_array(value) if isinstance(value, TensorProto) else np.asarray(value)


def _ways(test: NodeTest) -> Iterator[tuple[int, ...]]:
    """Which inputs are computed from the observation: all floats, else one of them, else one of any kind."""
    arrays = [_array(a) for a in test.inputs]
    floats = tuple(i for i, a in enumerate(arrays) if a.dtype.kind == "f" and a.size)
    yield from dict.fromkeys((floats,) if floats else ())
    yield from ((i,) for i in floats if floats != (i,))
    yield from ((i,) for i, a in enumerate(arrays) if a.dtype.kind != "f" and a.size)


def policy_of(test: NodeTest, fed: Sequence[int], folder: Path) -> Policy:
    """The test as a policy; raises ExportModelError."""
    path = folder / "test.onnx"
    path.write_bytes(wrapped(test, fed).SerializeToString())
    options = CompileOptions(outputs={"action": Role.ACTION})
    (policy,) = read_source(path).policies(options)
    return policy


def wrapped(test: NodeTest, fed: Sequence[int]) -> Any:
    """A model of one observation and one action, with the test's nodes between."""
    model = onnx.ModelProto()
    model.CopyFrom(test.model)
    graph = model.graph
    nodes: list[Any] = []
    values = [v.name for v in graph.input]
    arrays = [_array(a) for a in test.inputs]
    constants = [
        numpy_helper.from_array(a, n) for i, (n, a) in enumerate(zip(values, arrays, strict=True)) if i not in fed
    ]

    def constant(name: str, numbers: Sequence[int]) -> str:
        constants.append(numpy_helper.from_array(np.array(numbers, np.int64), name))
        return name

    start = 0
    for i in fed:
        name, array = values[i], arrays[i]
        bounds = [constant(f"{name}_{k}", [v]) for k, v in (("begin", start), ("end", start + array.size))]
        start += array.size
        nodes.append(helper.make_node("Slice", ["obs", *bounds], [f"{name}_part"]))
        nodes.append(
            helper.make_node("Reshape", [f"{name}_part", constant(f"{name}_shape", array.shape)], [f"{name}_wide"])
        )
        kind = test.model.graph.input[i].type.tensor_type.elem_type
        nodes.append(helper.make_node("Cast", [f"{name}_wide"], [name], to=kind))
    results = []
    for value in graph.output:
        flat = helper.make_node("Reshape", [value.name, constant(f"{value.name}_flat", [-1])], [f"{value.name}_row"])
        results.append(f"{value.name}_number")
        after = helper.make_node("Cast", [f"{value.name}_row"], [results[-1]], to=TensorProto.FLOAT)
        graph.node.extend([flat, after])
    graph.node.append(helper.make_node("Concat", results, ["action"], axis=0))
    nodes.extend(graph.node)
    opsets = {o.domain: o.version for o in model.opset_import}
    opsets[""] = max(opsets.get("", 0), 13)
    made = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [start])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, None)],
        [*graph.initializer, *constants],
    )
    imports = [helper.make_opsetid(d, v) for d, v in opsets.items()]
    return helper.make_model(made, opset_imports=imports, ir_version=10, functions=list(model.functions))


def _fault(test: NodeTest, fed: Sequence[int], policy: Policy, folder: Path, pool: RuntimePool | None) -> str:
    """What is wrong with the numbers, empty where nothing is."""
    row = np.concatenate([_array(test.inputs[i]).astype(np.float32).reshape(-1) for i in fed])
    expected = np.concatenate([_array(a).astype(np.float32).reshape(-1) for a in test.outputs])
    feeds = {policy.signature.inputs[0].name: np.repeat(row[None], ROWS, axis=0)}
    results = {"numpy": run_graph(policy.graph, feeds, ["action"])["action"]}
    if pool is not None:
        artifact = WRITTEN["onnx"].artifact(policy, WriteOptions("{}"))
        path = folder / "written.onnx"
        artifact.files[artifact.main].write(path)
        loaded = pool.process("onnxruntime").load(str(path))
        results["onnxruntime"] = loaded.run(feeds, ["action"])["action"]
        loaded.unload()
    exact = all(_array(a).dtype != np.float16 for a in (*test.inputs, *test.outputs))
    rtol, atol = max(test.rtol, 1e-4), max(test.atol, 1e-5) if exact else 5e-3
    for runtime, got in results.items():
        if got.shape != (ROWS, expected.size):
            return f"{runtime}: shape {got.shape}, not {(ROWS, expected.size)}"
        for value in got:
            if not np.allclose(value, expected, rtol, atol, equal_nan=True):
                worst = int(np.argmax(~np.isclose(value, expected, rtol, atol, equal_nan=True)))
                return f"{runtime}: {value[worst]:.6g} in place of {expected[worst]:.6g}"
    return ""


def _short(error: ExportModelError) -> str:
    """The reason without the names of a test's nodes."""
    text = error.what.split(" (also: ")[0]
    reason = re.sub(r" \(node '[^']*'\)", "", text.partition("): ")[2] or text)
    return reason if "no entry of the table" not in reason else "not in the table"


# ------------------------------------------------------------------ the page


def page(outcomes: Sequence[tuple[NodeTest, Outcome]]) -> str:
    """The part of the page: counts, and what is refused, with the reason. Expansions of an operator count with it."""
    states = Counter(o.state for _, o in outcomes)
    refused: dict[str, dict[str, int]] = {}
    right = {t.subject.partition(",")[0] for t, o in outcomes if o.state == "right"}
    for test, found in outcomes:
        if found.state == "refused":
            reasons = refused.setdefault(test.subject.partition(",")[0], {})
            reasons[found.reason] = reasons.get(found.reason, 0) + 1
    lines = [
        f"## {TITLE}",
        "",
        f"ONNX's own tests of its operators (onnx {onnx.__version__}, {len(outcomes)} tests), each made into a policy:",
        "one observation without a batch axis is cut into the test's inputs, its outputs are the action. The export is",
        f"run for three agents in numpy and onnxruntime. {states['right']} give the expected numbers,",
        f"{states['wrong']} give others, {states['refused']} are refused, {states['no kernel']} use a type that",
        f"onnxruntime has no kernel for, and {states['no policy']} are not policies (strings, sequences, draws).",
        "",
        f"Converted in at least one form: {', '.join(sorted(right))}.",
        "",
        "What is refused, with the number of tests:",
        "",
    ]
    by_reason: dict[str, Counter[str]] = {}
    for kind, reasons in refused.items():
        for reason, count in reasons.items():
            by_reason.setdefault(reason, Counter())[kind] += count
    rows = sorted(by_reason.items(), key=lambda item: (-item[1].total(), item[0]))
    lines += (f"- {reason} ({kinds.total()}): {', '.join(sorted(kinds))}" for reason, kinds in rows)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run all, print what is wrong, write the page."""
    found = []
    with RuntimePool() as pool, tempfile.TemporaryDirectory() as folder:
        for test in collected():
            found.append((test, outcome(test, Path(folder), pool)))
            if found[-1][1].state == "wrong":
                print(test.name, found[-1][1].reason, flush=True)
    write(TITLE, page(found))
    print(Counter(o.state for _, o in found))


if __name__ == "__main__":
    main()
