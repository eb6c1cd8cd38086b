"""What ML-Agents calls its constants stands in one table."""

from __future__ import annotations

import ast

from export_model.signatures.roles import CONSTANT_NAMES
from tests.exporter.test_format_keys import literals
from tests.exporter.test_imports import MODULES, name_of


def test_ml_agents_names_of_constants_stand_in_one_table() -> None:
    assert {"version_number", "memory_size"} <= set(CONSTANT_NAMES)
    trees = {name_of(path): ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}
    places = {name for name, tree in trees.items() if not {*CONSTANT_NAMES}.isdisjoint(literals(tree))}
    assert places == {"signatures/roles.py"}
