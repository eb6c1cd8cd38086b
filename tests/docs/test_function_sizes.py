"""What is measured of a function (tests/function_sizes.py), on functions whose measures can be counted by hand."""

from __future__ import annotations

import ast
import textwrap

import pytest

from tests.function_sizes import complexity, functions, is_table, own_lines
from tests.positional_arguments import long_calls, name_of, of_any_number

OUTER = """
def outer(x):
    '''A docstring
    of two lines.
    '''
    def inner(y):
        if y:
            return 1
        return 2
    return [inner(z) for z in x if z and z > 1]
"""


def test_a_function_is_measured_without_its_docstring_and_what_is_inside_of_it() -> None:
    outer, inner = functions(OUTER)
    assert (outer.name, own_lines(outer), complexity(outer)) == ("outer", 2, 4)  # a loop, its condition, an "and"
    assert (inner.name, own_lines(inner), complexity(inner)) == ("inner", 4, 2)


@pytest.mark.parametrize(
    ("body", "table"),
    [
        ("'''Rows.'''\nyield 1\nyield from (2, 3)", True),
        ("a = 1\nreturn {'a': a, 'b': 2}", True),
        ("if a:\n    return 1\nreturn 2", False),
        ("print(1)\nreturn 2", False),
        ("for a in b:\n    yield a", False),
    ],
)
def test_a_table_only_gives_and_names_values(body: str, table: bool) -> None:
    (function,) = functions(f"def rows():\n{textwrap.indent(body, '    ')}")
    assert is_table(function) is table


def test_arguments_by_place_are_counted_but_for_functions_of_any_number() -> None:
    tree = ast.parse(
        "def element(tag, *children): ...\n"
        "element(1, 2, 3, 4, 5, 6, 7)\n"
        "Layer(1, 2, 3, 4, 5, 6, 7)\n"
        "nn.lstm(1, 2, 3, 4, 5, 6, 7, gates=8)\n"
        "Layer(1, 2, 3, 4, 5, 6, axis=7)\n"
    )
    assert [name_of(call.func) for call in long_calls(tree, of_any_number([tree]))] == ["Layer", "lstm"]
