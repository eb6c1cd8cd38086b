"""Files of TensorFlow Lite that are not read: quantised, damaged, of another version; each is refused by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.litert.flatbuffer import Table, decode, encode
from export_model.converters.formats.litert.schema import BUILTINS, TYPES
from export_model.exporter.export.sources import read_source
from export_model.exporter.inspect.inspection import inspect_source
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError, UnsupportedOpError
from fixtures import path
from tests.litert.operators import X, floats, graph_of, model_of
from tests.litert.sweep import written

pytestmark = pytest.mark.xdist_group("litert-reader")


def changed(change: Any, kind: str = "FULLY_CONNECTED") -> Table:
    """A model of one layer, changed."""
    model = model_of(kind, [X, floats(5, 4), floats(5)])
    change(model, model["subgraphs"][0])
    return model


QUANTISED = {"scale": [0.5], "zero_point": [0]}


def _as_integers(model: Table, subgraph: Table) -> None:
    subgraph["tensors"][1] |= {"type": TYPES[np.dtype(np.int8)][0], "quantization": QUANTISED}


UNREAD: Mapping[str, tuple[Any, str]] = {
    "quantised weights": (_as_integers, "quantised to int8"),
    "sparse weights": (lambda m, s: s["tensors"][1].update(sparsity={}), "sparse"),
    "a variable": (lambda m, s: s["tensors"][1].update(is_variable=1), "keeps its value"),
    "a custom operator": (lambda m, s: m["operator_codes"][0].update(builtin_code=32, custom_code="Mine"), "Mine"),
    "an LSTM": (lambda m, s: m["operator_codes"][0].update(builtin_code=44), "UNIDIRECTIONAL_SEQUENCE_LSTM"),
    "an operator of the future": (lambda m, s: m["operator_codes"][0].update(builtin_code=999), "operator 999"),
    "an activation of the future": (
        lambda m, s: s["operators"][0]["builtin_options"].update(activation=5),
        "activation 5",
    ),
    "shuffled weights": (lambda m, s: s["operators"][0]["builtin_options"].update(weights_format=1), "shuffled"),
    "no weights": (lambda m, s: s["operators"][0].update(inputs=[0, -1]), "operand 1 is missing"),
}


@pytest.mark.parametrize("title", UNREAD)
def test_what_is_not_read_is_refused_by_name(title: str) -> None:
    change, says = UNREAD[title]
    with pytest.raises(UnsupportedOpError) as caught:
        graph_of(changed(change))
    assert says in caught.value.message


def _repeat(model: Table, subgraph: Table) -> None:
    """A tensor that is made of what was made of itself."""
    subgraph["tensors"].append({"name": "between"})
    model["operator_codes"][0].update(builtin_code=BUILTINS["TANH"].code, deprecated_builtin_code=28)
    subgraph["operators"] = [{"inputs": [a], "outputs": [b]} for a, b in ((0, 3), (3, 4), (4, 3))]


def _shared(model: Table, subgraph: Table) -> None:
    """A megabyte of weights under a thousand shapes, each of them read."""
    model["buffers"][1] = {"data": np.zeros(1 << 20, np.uint8)}
    subgraph["tensors"] += [{"type": 0, "buffer": 1, "name": f"w{i}", "shape": [1 << 18] + [1] * i} for i in range(30)]
    count = len(subgraph["tensors"])
    subgraph["operators"] = [
        {"inputs": [0, *range(count - 30, count)], "outputs": [3]},
    ]
    model["operator_codes"][0].update(builtin_code=BUILTINS["ADD_N"].code, deprecated_builtin_code=106)


DAMAGED: Mapping[str, tuple[Any, str]] = {
    "an operand that is not there": (lambda m, s: s["operators"][0].update(inputs=[0, 9]), "tensors[9]"),
    "an operand below all": (lambda m, s: s["operators"][0].update(inputs=[0, -2]), "tensors[-2]"),
    "an operand that nothing makes": (
        lambda m, s: s["operators"][0].update(inputs=[0, 3, 2], outputs=[3]),
        "nothing makes",
    ),
    "an operator twice": (_repeat, "made before"),
    "an operator of no code": (lambda m, s: s["operators"][0].update(opcode_index=7), "operator_codes[7]"),
    "a buffer that is not there": (lambda m, s: s["tensors"][1].update(buffer=9), "buffers[9]"),
    "fewer bytes than its shape": (lambda m, s: s["tensors"][1].update(shape=[5, 5]), "not of the shape"),
    "a shape that no memory holds": (lambda m, s: s["tensors"][1].update(shape=[2**31 - 1] * 9), "not of the shape"),
    "lengths below 0": (lambda m, s: s["tensors"][1].update(shape=[-5, -4]), "below 0"),
    "an input twice": (lambda m, s: s.update(inputs=[0, 0]), "two inputs"),
    "a result that is no tensor": (lambda m, s: s.update(outputs=[77]), "tensors[77]"),
    "no function": (lambda m, s: m.update(subgraphs=[]), "subgraphs[0]"),
    "the same bytes again and again": (_shared, "name the same bytes"),
    "more results than it has": (
        lambda m, s: (s["tensors"].append({"name": "y"}), s["operators"][0].update(outputs=[3, 4])),
        "results",
    ),
}


@pytest.mark.parametrize("title", DAMAGED)
def test_a_damaged_file_is_refused(title: str) -> None:
    change, says = DAMAGED[title]
    with pytest.raises(DamagedFileError) as caught:
        graph_of(changed(change))
    assert says in caught.value.message


def test_what_nothing_needs_is_not_looked_at() -> None:
    """An operator that no output depends on may be any."""

    def change(model: Table, subgraph: Table) -> None:
        model["operator_codes"].append({"builtin_code": 999})
        subgraph["tensors"].append({"name": "unused"})
        subgraph["operators"].append({"opcode_index": 1, "inputs": [0], "outputs": [4]})

    assert "out0" in graph_of(changed(change))


def test_a_file_of_another_version_is_refused() -> None:
    with pytest.raises(NotAPolicyError, match="version 2"):
        graph_of(changed(lambda model, subgraph: model.update(version=2)))


@pytest.mark.parametrize("seed", range(20))
def test_changed_tables_give_a_graph_or_an_error_of_ours(seed: int, tmp_path: Path) -> None:
    """Numbers of the tables of a whole policy, changed; ``make fuzz`` tries thousands."""
    draw = np.random.default_rng(seed)
    (policy,) = read_source(path("discrete")).policies()
    model = decode(written(policy, ""))
    for _ in range(3):
        subgraph = model["subgraphs"][0]
        table = draw.choice([*subgraph["tensors"], *subgraph["operators"]])
        vectors = [k for k in ("shape", "inputs", "outputs") if k in table and len(table[k])]
        if vectors:
            numbers = [int(n) for n in table[vectors[0]]]
            numbers[int(draw.integers(len(numbers)))] = int(draw.choice([-1, 0, 1, 5, 77, 2**31 - 1]))
            table[vectors[0]] = numbers
    file = tmp_path / "policy.tflite"
    file.write_bytes(encode(model).to_bytes())
    try:
        inspect_source(file)
    except ExportModelError as error:
        assert error.exit_status == 2
