"""A model that was read, against what its framework answered."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.formats.source import SourceModel
from export_model.converters.graph.run import run_graph


def assert_agrees(model: SourceModel, fed: Sequence[np.ndarray], wanted: Sequence[np.ndarray], where: str = "") -> None:
    """Inputs in the file's order, outputs in that of the model; |d| within 2e-6 + 2e-5·|x|."""
    inputs = [n for n in model.graph.nodes if n.op == "Placeholder"]
    feeds = {n.name: a.astype(n.attrs["dtype"]) for n, a in zip(inputs, fed, strict=True)}
    names = [*model.facts.outputs]
    got = run_graph(model.graph, feeds, names)
    for name, value in zip(names, wanted, strict=True):
        assert got[name].shape == value.shape, (where, name)
        np.testing.assert_allclose(got[name], value, rtol=2e-5, atol=2e-6, err_msg=f"{where}: {name}")
