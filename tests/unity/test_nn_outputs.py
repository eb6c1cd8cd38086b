"""Our reading of a ``.nn`` computes what Barracuda computed: every file and batch of ../shared/unity/nn_outputs.

The graph that ``to_graph`` makes is run by our numpy kernels, fed as Barracuda was, its draws replaced by the recorded
noise. Every output that the file lists is compared, and the whole memory after the step.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.barracuda.format import NnModel, parse
from export_model.converters.formats.barracuda.graph import MEMORY_IN, MEMORY_OUT, to_graph
from export_model.converters.formats.barracuda.layer_builder import node_name
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError
from tests.unity.conftest import SHARED, lines

pytestmark = pytest.mark.corpus

ROWS = lines("nn_outputs/index.jsonl")
#: Files that Barracuda runs and we refuse, with the reason.
REFUSED = {
    "corpus/nn/zeroblitz36+ml-agents__BananaLearning.nn": "left out the slices that cut the action into branches",
    "genuine/0.10.1tf115-ppo-continuous/Brain.nn": "reads 3 tensors",
}
#: Of the largest number in an output: sums are rounded against their largest terms.
TOLERANCE = 1e-5
#: (file, output) → why Barracuda's is another; none of them is read by the action or the memory.
OTHERS = {
    (
        "genuine/0.10.1-ppo-continuous-recurrent/Brain.nn",
        "strided_slice_3",
    ): "of a slice that begins at 16 and ends at 0 "
    "(the end), Barracuda 3.0.0 takes one number; the trainer's graph takes 16",
}
#: File → how far Barracuda's own rounding carries; our result is held to float64 there.
ROUNDED = {
    "corpus/nn/AliBharwani+ml-agents__GridFoodCollector.nn": 3e-4,  # log-probabilities behind pictures of 40x40x6
}
PARAMETERS = [pytest.param(row, id=row["file"].replace("/", "__")[-60:]) for row in ROWS] or [
    pytest.param({}, id="shared-is-absent")
]


@pytest.mark.parametrize("row", PARAMETERS)
def test_outputs_are_those_of_barracuda(row: dict[str, Any], unity_data: Path) -> None:
    model = parse((SHARED / row["file"]).read_bytes())
    if row["file"] in REFUSED:
        with pytest.raises(DamagedFileError, match=REFUSED[row["file"]]):
            to_graph(model)
        return
    graph = to_graph(model).graph
    if row["status"] == "does not load":
        assert model.version == 15
        return
    with np.load(unity_data / "nn_outputs" / row["npz"]) as arrays:
        for batch in ("b1", "b3"):
            recorded = {name: arrays[name] for name in arrays.files if name.startswith(batch)}
            compared = compare(model, graph, recorded, batch, row["file"])
            assert "action" in compared, (batch, compared)


def compare(model: NnModel, graph: Graph, recorded: dict[str, np.ndarray], batch: str, file: str) -> list[str]:
    """The outputs that are compared, one assertion each."""
    count = 1 if batch == "b1" else 3
    feeds = fed(model, graph, recorded, batch, count)
    results = {name.rpartition("/out/")[2] if "/out/" in name else name: a for name, a in recorded.items()}
    memories = [results[m.output] for m in model.memories if m.output in results]
    outputs = {name: node_name(name) for name in model.outputs if name in results and name != MEMORY_OUT}
    expected = {name: results[name] for name in outputs}
    if memories:
        expected[MEMORY_OUT] = np.concatenate([m.reshape(count, -1) for m in memories], axis=1)
        outputs[MEMORY_OUT] = MEMORY_OUT
    nodes = {node.name for node in graph.nodes}
    fetch = {name: node for name, node in outputs.items() if node in nodes and (file, name) not in OTHERS}
    found = run_graph(graph, feeds, list(fetch.values()))
    if file in ROUNDED:
        exact = run_graph(graph, {k: v.astype(np.float64) for k, v in feeds.items()}, list(fetch.values()))
    for name, node in fetch.items():
        value, wanted = found[node], expected[name].reshape(-1)
        assert value.size == wanted.size, (name, value.shape, expected[name].shape)
        bound = TOLERANCE * max(1.0, float(np.abs(wanted[np.isfinite(wanted)]).max(initial=0)))
        if file in ROUNDED:
            np.testing.assert_allclose(value, exact[node], 0, bound, err_msg=f"{name} {batch} against float64")
            bound = ROUNDED[file]
        np.testing.assert_allclose(value.reshape(-1), wanted, 0, bound, err_msg=f"{name} {batch}")
    return list(fetch)


def fed(model: NnModel, graph: Graph, recorded: dict[str, np.ndarray], batch: str, count: int) -> dict[str, np.ndarray]:
    """What Barracuda was given, by the names and shapes of our graph."""
    feeds = {}
    for node in graph.nodes:
        if node.op == "Placeholder":
            feeds[node.name] = given(model, node, recorded, batch, count)
        elif node.op == "RandomStandardNormal":
            feeds[node.name] = recorded[f"{batch}/noise"].reshape(count, -1)
    return feeds


def given(model: NnModel, node: Node, recorded: dict[str, np.ndarray], batch: str, count: int) -> np.ndarray:
    if node.name == MEMORY_IN and model.memories:
        parts = [recorded[f"{batch}/in/{m.input}"].reshape(count, -1) for m in model.memories]
        return np.concatenate(parts, axis=1)
    name = next(i.name for i in model.inputs if node.name in (node_name(i.name), f"{node_name(i.name)}_1"))
    array = recorded[f"{batch}/in/{name}"]
    if array.shape[1:3] == (1, 1):
        array = array.reshape(count, -1)
    return array.astype(np.int32) if node.name == "prev_action" else array


def test_branches_that_were_cut_again_are_those_that_unity_draws_from(unity_data: Path) -> None:
    """Of an action without its slices Unity reads the first columns; a branch's draw depends on their ratios alone."""
    (file,) = (name for name in REFUSED if "BananaLearning" in name)
    (policy,) = read_source(SHARED / file).policies()
    assert policy.signature.branches == (3, 3, 3, 2)
    assert any("put back (3, 3, 3, 2)" in note for note in policy.signature.notes)
    row = next(r for r in ROWS if r["file"] == file)
    with np.load(unity_data / "nn_outputs" / row["npz"]) as arrays:
        inputs = {name: arrays[f"b3/in/{name}"].reshape(3, -1) for name in ("vector_observation", "action_masks")}
        columns = arrays["b3/out/action"].reshape(3, -1)[:, :11]
    feeds = {"state": inputs["vector_observation"], "action_masks": inputs["action_masks"]}
    got = run_graph(policy.graph, feeds, ["action"])["action"]
    for first, last in ((0, 3), (3, 6), (6, 9), (9, 11)):
        allowed = inputs["action_masks"][:, first:last]
        wanted = np.exp(columns[:, first:last]) / np.exp(columns[:, first:last]).sum(axis=1, keepdims=True)
        np.testing.assert_allclose(np.exp(got[:, first:last]) * allowed, wanted * allowed, atol=1e-6)


def test_every_recorded_file_is_there(unity_data: Path) -> None:
    assert len(ROWS) == 107
    assert sum(row["status"] == "runs" for row in ROWS) == 93
