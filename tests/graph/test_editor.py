"""What an editor knows of shapes while a graph is being made."""

from __future__ import annotations

import pytest

from export_model.converters.graph import editor as module
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Node
from tests.graph.making import graph, node, placeholder


def test_a_node_is_inferred_once_however_often_shapes_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of a stranger's thousand normalisations asks: a minute where all before it were inferred for each."""
    told: list[str] = []
    infer = module.add_types
    monkeypatch.setattr(module, "add_types", lambda types, n, *rest: (told.append(n.name), infer(types, n, *rest))[1])
    names = [f"t{i}" for i in range(200)]
    old = graph(placeholder("x", (None, 4)), *(node(n, "Tanh", p) for n, p in zip(names, ["x", *names], strict=False)))
    made = Editor(old)
    for each in old.nodes:
        made.keep(each)
        shape = made.shape_of(each.name)
        assert shape is not None and shape[1] == 4
    assert told == [n.name for n in old.nodes]


def test_what_is_not_made_yet_or_has_no_entry_is_not_known() -> None:
    old = graph(placeholder("x", (None, 4)), Node("odd", "Madeup", ("x",)), node("y", "Tanh", "odd"))
    made = Editor(old)
    assert made.shape_of("y") is None
    for each in old.nodes:
        made.keep(each)
    assert made.shape_of("y") is None
    assert made.shape_of("x") is not None
