"""``python -m tests.function_sizes``: functions of the product that are too long or too branched to be read at once.

- Length: a function's own lines. Its docstring is left out, and so are functions and classes inside of it, which are
  measured by themselves. A table is left out: a function of which each statement gives or names a value.
- Complexity: McCabe's, counted as radon counts it (conditions, loops, comprehensions and their conditions, handlers,
  operands of ``and`` and ``or``, assertions, lambdas), without what stands in functions and lambdas inside of it.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("signatures", "converters", "exporter")
MOST_LINES, MOST_COMPLEX = 60, 25
Function = ast.FunctionDef | ast.AsyncFunctionDef
_INNER = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda)
_BRANCHES = (ast.If, ast.IfExp, ast.For, ast.AsyncFor, ast.While, ast.ExceptHandler, ast.Assert, ast.Lambda)


def own_lines(function: Function) -> int:
    """How many lines a function has without its docstring and what is defined inside of it."""
    begin = min([function.lineno, *(d.lineno for d in function.decorator_list)])
    lines = (function.end_lineno or begin) - function.lineno + 1
    inside = [n for n in _within(function) if isinstance(n, _INNER) and not isinstance(n, ast.Lambda)]
    first = function.body[0]
    if ast.get_docstring(function) is not None:
        inside.append(first)
    return lines - sum((n.end_lineno or n.lineno) - n.lineno + 1 for n in inside)


def _within(node: ast.AST) -> Iterator[ast.AST]:
    """What stands in a function, but for what stands in a function or class inside of it."""
    for child in ast.iter_child_nodes(node):
        yield child
        if not isinstance(child, _INNER):
            yield from _within(child)


def is_table(function: Function) -> bool:
    """Whether each statement of a function gives a value, or names a part of one, or is its docstring."""
    return all(
        isinstance(s, ast.Return | ast.Assign | ast.AnnAssign)
        or (isinstance(s, ast.Expr) and isinstance(s.value, ast.Yield | ast.YieldFrom | ast.Constant))
        for s in function.body
    )


def complexity(function: Function) -> int:
    """The number of ways through a function, without those through functions inside of it."""
    count = 1
    for part in _within(function):
        count += isinstance(part, (*_BRANCHES, ast.match_case))
        if isinstance(part, ast.comprehension):
            count += 1 + len(part.ifs)
        elif isinstance(part, ast.BoolOp):
            count += len(part.values) - 1
        elif isinstance(part, ast.For | ast.AsyncFor | ast.While | ast.Try):
            count += bool(part.orelse)
    return count


def functions(source: str) -> Iterator[Function]:
    """Every function of a module, those inside of others too."""
    return (node for node in ast.walk(ast.parse(source)) if isinstance(node, Function))


def faults() -> Iterator[str]:
    """A line for each function that is too long or too complex."""
    for path in (p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py"))):
        for function in functions(path.read_text(encoding="utf-8")):
            place = f"{path.relative_to(ROOT)}:{function.lineno} {function.name}"
            if own_lines(function) > MOST_LINES and not is_table(function):
                yield f"{place} has {own_lines(function)} lines of its own, and {MOST_LINES} are allowed"
            if complexity(function) > MOST_COMPLEX:
                yield f"{place} has a complexity of {complexity(function)}, and {MOST_COMPLEX} is allowed"


def main() -> int:
    """1 where a function is too large."""
    found = list(faults())
    print(*found, sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
