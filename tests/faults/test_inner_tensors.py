"""What each format has of the graph's tensors is found under the graph's names, with the graph's axes and values."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.targets import FEWER_OPS, prepare
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.saved_model.artifact import graph
from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.again import verify_folder
from export_model.exporter.verify.difference import compare
from export_model.exporter.verify.inner_tensors import inner_tensors, outputs_read
from export_model.exporter.verify.participants import PolicyUnderTest, participants_of
from export_model.exporter.verify.reference import Reference
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.sampling import draw_cases
from tests.faults.conftest import Bundle

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("runtimes"), pytest.mark.usefixtures("runtimes")]

#: What of a graph in fewer ops the formats may hide: products that were fused with their bias, numbers that became
#: attributes, a Minimum below a Maximum, and in ONNX the index below its column and an Elu that comes behind its pool.
HIDDEN = {"MatMul", "BiasAdd", "Conv2D", "Const", "Minimum", "ArgMax", "Elu"}


def policy_under_test(folder: object, monkeypatch: pytest.MonkeyPatch) -> PolicyUnderTest:
    """What a verification of the bundle is about."""
    caught: list[PolicyUnderTest] = []

    class CaughtError(Exception):
        pass

    def catch(tested: PolicyUnderTest, *rest: object, **more: object) -> None:
        caught.append(replace(tested, artefacts=tested.files))  # the copies of a verification are gone after it
        raise CaughtError

    monkeypatch.setattr("export_model.exporter.export.again.verify", catch)
    with pytest.raises(CaughtError):
        verify_folder(folder)  # type: ignore[arg-type]
    return caught[0]


@pytest.mark.parametrize("name", ["continuous", "discrete", "recurrent", "visual", "two"])
def test_every_tensor_that_a_format_has_is_the_graphs(
    name: str, bundle: Bundle, pool: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested = policy_under_test(bundle(name).folder, monkeypatch)
    graph = runnable(tested.graph)
    case = draw_cases(tested.signature, seed=3, samples=1)[1]
    read = outputs_read([n.name for n in graph.nodes], [r for n in graph.nodes for r in n.inputs])
    tensors = [t for n in graph.nodes for t in read[n.name]]
    expected = run_graph(graph, case.feeds, tensors)
    names = {s.name: s.name for s in tested.signature.outputs}
    shorter = prepare(Policy(name, graph, tested.signature, {}, names), FEWER_OPS)
    installed = [
        r.name for r in available_runtimes() if r.installed and "chromium" not in r.name and "webgl" not in r.name
    ]
    reference = Reference(tested, ["numpy"], pool, 0)
    tried = set()
    for participant in participants_of(tested, installed, pool, reference, lambda *failure: pytest.fail(str(failure))):
        assert participant.path is not None
        with inner_tensors(participant, participant.path, pool) as within:
            upstream = graph.ancestors(list(participant.outputs))
            has_fewer = participant.format in ("tfjs", "onnx")
            kept = shorter.ancestors(list(participant.outputs)) if has_fewer else upstream
            got = within.fetch(case.feeds, [t for t in tensors if graph.producer(t).name in upstream])
        wanted = [t for t in tensors if node_of(t) in upstream & kept]
        missing = {graph.producer(t).op for t in wanted if t not in got}
        hidden = HIDDEN if has_fewer else {"Const"} if "saved_model" in participant.format else set()
        assert missing <= hidden, (participant.name, missing)
        assert len(got) > len(wanted) / 2
        for tensor, value in got.items():
            exact = graph.producer(tensor).op == "Const"
            wide = value.astype(expected[tensor].dtype)
            found = compare(expected[tensor], wide, Tolerance(0, 0) if exact else Tolerance())
            assert found.passed, (participant.name, participant.runtime, tensor, found)
        tried.add(participant.format)
    assert tried >= {"bytes", "saved_model", "tfjs", "onnx"}


def test_a_saved_model_has_the_same_graph_as_the_bytes(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no converter misreads it (converters/compiler/targets.py, ``SAVED_MODEL``)."""
    tested = policy_under_test(bundle("discrete").folder, monkeypatch)
    ours, other = runnable(tested.graph), runnable(graph(tested.artefacts["saved_model"]))
    assert [(n.name, n.op, n.inputs) for n in ours.nodes] == [(n.name, n.op, n.inputs) for n in other.nodes]
    assert all(
        np.array_equal(a.value, b.value) for a, b in zip(ours.nodes, other.nodes, strict=True) if a.op == "Const"
    )
