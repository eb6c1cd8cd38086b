"""The compiler's passes in their order: each finds what it requires, and leaves what it ensures."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation, Condition
from export_model.converters.compiler.compile import PASSES, compilations, compile_graph
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes import conditions as has
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.policy.facts import SourceFacts
from export_model.exporter.export.sources import read_source
from export_model.signatures.roles import Role
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.graph.harness import Runtimes, difference
from tests.graph.making import const, graph, node, placeholder
from tests.graph.running import values
from tests.graph.samples import floats

pytestmark = pytest.mark.xdist_group("graph-passes")
OPTIONS = {
    "as it is": CompileOptions(),
    "noise kept": CompileOptions(noise="keep"),
    "noise zero": CompileOptions(noise="zero"),
    "deterministic": CompileOptions(deterministic=True),
    "the trainer's names": CompileOptions(names="source"),
}


def contradictions(place: str, conditions: tuple[Condition, ...], c: Compilation) -> list[str]:
    found = ((condition.__name__, condition(c)) for condition in conditions)
    return [f"{place} {name}: {what}" for name, what in found if what is not None]


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("name", FIXTURES)
def test_every_pass_keeps_its_word(name: str, options: CompileOptions) -> None:
    for source in read_source(fixture(name)).models:
        for _, c in compilations(source.graph, options, source.facts):
            for step in PASSES:
                assert contradictions(f"before {step.name}:", step.requires, c) == []
                c = step.run(c)
                assert contradictions(f"after {step.name}:", step.ensures, c) == []


def test_what_a_pass_requires_an_earlier_one_ensures() -> None:
    ensured: set[Condition] = {has.pinned_outputs}
    for step in PASSES:
        assert set(step.requires) <= ensured, step.name
        ensured |= set(step.ensures)


def test_every_condition_can_be_contradicted() -> None:
    """A condition that always holds would hold nothing."""
    nodes = (
        placeholder("state", (None, 2)),
        Node("loop", "Enter", ("state",)),
        Node("new", "SelectV2"),
        const("one", np.ones(2, np.float32)),
        node("two", "Neg", "one"),
        node("same", "Identity", "state"),
        node("shape", "Shape", "state"),
        node("draw", "RandomStandardNormal", "shape", dtype=np.dtype("float32"), seed=3),
        node("action", "Add", "same", "draw"),
    )
    (c,) = (c for _, c in compilations(graph(*nodes[:1], *nodes[3:]), CompileOptions(), SourceFacts()))
    assert has.constants_folded(replace(c, graph=graph(*nodes[:1], *nodes[3:])))
    broken = replace(c, graph=Graph(nodes), fetches={"action": "action", "deterministic_action": "draw"})
    broken = replace(broken, roles={"state": Role.SEQUENCE_LENGTH}, feeds={"other": "state"})
    for name in (
        "settled_inputs", "one_spelling", "no_control_flow", "no_identities", "no_dead_nodes", "meanings",
        "noise_as_asked", "no_seeds", "actions_without_chance", "signature", "names_of_the_signature",
    ):  # fmt: skip
        assert getattr(has, name)(broken) is not None, name
    assert has.pinned_outputs(replace(c, fetches={"action": "gone"})) is not None


def test_brains_are_compiled_one_by_one() -> None:
    nodes = [
        made
        for scope in ("A/", "B/")
        for made in (
            placeholder(f"{scope}vector_observation", (None, 2)),
            node(f"{scope}action", "Tanh", f"{scope}vector_observation"),
        )
    ]
    assert [p.name for p in compile_graph(graph(*nodes), "p")] == ["p-A", "p-B"]
    assert [p.name for p in compile_graph(graph(*nodes), "p", CompileOptions(brain="B"))] == ["p-B"]


def test_all_passes_together_keep_what_tensorflow_computes(runtimes: Runtimes) -> None:
    """The visual fixture flattens by shape arithmetic, draws noise and has two heads."""
    source = read_graph(fixture("visual").read_bytes())
    (policy,) = compile_graph(source, "visual")
    feeds = {
        "observation_0": floats(3, 20, 20, 3, low=0, high=1),
        "state": floats(3, 4),
        "epsilon": floats(3, 2, seed=2),
    }
    mine = values(policy.graph, feeds, "action", "value_estimate")
    for expected, actual in zip(
        runtimes.tensorflow(policy.graph, feeds, ["action", "value_estimate"]), mine, strict=True
    ):
        assert difference(expected, actual) is None
    assert not {n.op for n in policy.graph.nodes} & {"Shape", "Prod", "Slice", "Pack", "StopGradient"}
