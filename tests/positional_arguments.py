"""``python -m tests.positional_arguments``: calls of the product whose arguments are told by their place alone.

From the seventh on nobody counts right: they take keywords. A function that takes any number of arguments (the children
of an element, the examples of a command) is known by its ``*``, and is left out.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("signatures", "converters", "exporter")
MOST_POSITIONAL = 6


def name_of(function: ast.expr) -> str:
    """What a called function is called where it is called."""
    return str(getattr(function, "attr", getattr(function, "id", "")))


def of_any_number(trees: Iterable[ast.Module]) -> set[str]:
    """The functions that take any number of arguments by place."""
    functions = (n for tree in trees for n in ast.walk(tree) if isinstance(n, ast.FunctionDef))
    return {f.name for f in functions if f.args.vararg is not None}


def long_calls(tree: ast.Module, variadic: set[str]) -> Iterator[ast.Call]:
    """The calls with more than MOST_POSITIONAL arguments by place."""
    for call in (n for n in ast.walk(tree) if isinstance(n, ast.Call)):
        if len(call.args) > MOST_POSITIONAL and name_of(call.func) not in variadic:
            yield call


def faults() -> Iterator[str]:
    """A line for each such call."""
    paths = [p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py"))]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}
    variadic = of_any_number(trees.values())
    for path, tree in trees.items():
        for call in long_calls(tree, variadic):
            yield f"{path.relative_to(ROOT)}:{call.lineno} {name_of(call.func)} has {len(call.args)} arguments by place"


def main() -> int:
    """1 where there is such a call."""
    found = list(faults())
    print(*found, sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
