"""Noise that is drawn in the graph: an input, a zero, or kept."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.compiler.passes.noise import lift_noise, samplers, without_noise
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UnsupportedOpError
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.running import gaussian, mean, same_values, value
from tests.graph.samples import f32, floats

pytestmark = pytest.mark.xdist_group("graph-passes")


def test_lifted_noise_is_an_input_of_the_sampler_s_name() -> None:
    before = gaussian(in_graph=True)
    assert [n.name for n in samplers(before)] == ["epsilon"]
    made = lift_noise(before, "lift")
    assert samplers(made) == []
    assert made["epsilon"] == Node(
        "epsilon", "Placeholder", (), {"dtype": FLOAT32, "shape": TensorShape((None, 2))}, origin="epsilon:0"
    )
    feeds = {"x": floats(4, 3, seed=1), "epsilon": floats(4, 2, seed=2)}
    same_values(before, made, feeds, {"action": "action"})


def test_kept_noise_stays_in_the_graph() -> None:
    before = gaussian(in_graph=True)
    assert lift_noise(before, "keep") is before
    fed = gaussian(in_graph=False)
    assert lift_noise(fed, "lift") is fed


def test_zero_noise_leaves_the_mean_in_any_batch() -> None:
    made = lift_noise(gaussian(in_graph=True), "zero")
    assert made["epsilon"].op == "Const"
    for batch in (1, 4):
        x = floats(batch, 3)
        np.testing.assert_allclose(value(made, {"x": x}, "action"), mean(x), rtol=1e-6)


def test_noise_of_unknown_rank_is_not_lifted() -> None:
    made = graph(placeholder("shape", (None,), np.int32), node("draw", "RandomStandardNormal", "shape", dtype=FLOAT32))
    with pytest.raises(UnsupportedOpError, match="'draw'") as caught:
        lift_noise(made, "lift")
    assert caught.value.issues == (("draw", "RandomStandardNormal"),)


@pytest.mark.parametrize("in_graph", [True, False])
def test_an_action_without_noise_stands_beside_the_noisy_one(in_graph: bool) -> None:
    before = gaussian(in_graph=in_graph)
    made, (still,) = without_noise(before, ["action"], {"epsilon": (None, 2)}, "quiet")
    x, epsilon = floats(4, 3), floats(4, 2, seed=2)
    np.testing.assert_allclose(value(made, {"x": x}, still), mean(x), rtol=1e-6)
    same_values(before, made, {"x": x, "epsilon": epsilon}, {"action": "action"})
    # the mean itself: neither a product with zero nor a sum with it
    assert ops(made.prune([still])) == ["MatMul", "Tanh"]


def test_an_overflowing_deviation_does_not_reach_the_quiet_action() -> None:
    endless = node("sigma", "Exp", "far")
    before = graph(const("far", f32(1e4).reshape(())), *gaussian(in_graph=False, scale=endless).nodes)
    made, (still,) = without_noise(before, ["action"], {"epsilon": (None, 2)}, "quiet")
    assert np.isfinite(value(made, {"x": floats(4, 3)}, still)).all()


def test_noise_subtracted_or_added_to_a_row_is_taken_out() -> None:
    before = graph(
        placeholder("x", (None, 2)),
        placeholder("epsilon", (None, 2)),
        const("row", f32(3, 4)),
        node("less", "Sub", "x", "epsilon"),
        node("shifted", "Add", "row", "epsilon"),  # broadcast: the row alone has another shape
        node("y", "Add", "less", "shifted"),
    )
    made, (still,) = without_noise(before, ["y"], {"epsilon": (None, 2)}, "quiet")
    x = floats(3, 2)
    np.testing.assert_array_equal(value(made, {"x": x}, still), x + f32(3, 4))
    made, (still,) = without_noise(before, ["shifted"], {"epsilon": (None, 2)}, "quiet")
    np.testing.assert_array_equal(value(made, {"x": x}, still), f32(3, 4).reshape(1, 2), strict=True)


def test_without_noise_nothing_is_copied() -> None:
    made = graph(placeholder("x", (None, 2)), placeholder("epsilon", (None, 2)), node("action", "Tanh", "x"))
    assert without_noise(made, ["action"], {"epsilon": (None, 2)}, "quiet") == (made, ["action"])


def test_a_graph_is_walked_once_for_all_columns_that_are_made_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy of 1,000 action columns: once for each took 12 s."""
    count = 50
    columns = [node(f"column_{i}", "Add", "noisy", f"shift_{i}") for i in range(count)]
    before = graph(
        placeholder("x", (None, 2)),
        placeholder("epsilon", (None, 2)),
        node("noisy", "Add", "x", "epsilon"),
        *(const(f"shift_{i}", f32(i, -i)) for i in range(count)),
        *columns,
    )
    walks: list[object] = []
    descendants = Graph.descendants
    monkeypatch.setattr(Graph, "descendants", lambda self, names: walks.append(self) or descendants(self, names))
    made, still = without_noise(before, [c.name for c in columns], {"epsilon": (None, 2)}, "quiet")
    assert len(walks) == 1
    x = floats(3, 2)
    for i in (0, 7, count - 1):
        np.testing.assert_allclose(value(made, {"x": x}, still[i]), x + f32(i, -i), rtol=1e-6)
