"""``python -m tests.verify.mutants``: single-line breaks of what judges, each run against the tests that reach it.

A mutant has a number, the same in every run of the same code. ``--sample N --seed S`` draws N of all; ``--only FILE``
takes those of one file, ``--numbers`` those of some numbers. What survives is printed with its line, and the share
that was killed with its interval. By hand, or nightly: a mutant takes about a second (tests/verify/mutation.py).

Left out by rule, as no test of what is judged can tell them: text, annotations, ``raise`` and ``assert``, what a
function that returns one text says (unless its docstring says that the text may be empty, which decides something),
the seed of a generator, the sizes that an array is brought to by reshape, ``strict=`` of zip, ``copy=`` of arrays,
the state of numpy's warnings, options of a decorator or a base class, and what is there for the type checker.
"""

from __future__ import annotations

import argparse
import ast
import random
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("exporter/verify", "exporter/compare")
_COMPARED = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
}
_COMPUTED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr}
_NAMES = {"any": "all", "all": "any", "min": "max", "max": "min", "maximum": "minimum", "minimum": "maximum"}
_UNTOLD = ("default_rng", "reshape")
_KEYWORDS = ("strict", "copy", "divide", "invalid", "over", "stacklevel", "encoding")


@dataclass(frozen=True)
class Mutant:
    """One break: a file, the place of its node among all, and which of the node's breaks."""

    number: int
    file: str
    #: The function or method of a module that holds it, by its qualified name; empty for what runs at import.
    function: str
    node: int
    kind: int
    line: int
    what: str

    @property
    def module(self) -> str:
        return "export_model." + self.file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


def breaks(node: ast.AST) -> list[tuple[str, ast.AST]]:
    """What a node may become, with a word for each."""
    match node:
        case ast.Compare(left, [op], right) if type(op) in _COMPARED:
            other = _COMPARED[type(op)]()
            return [(type(other).__name__, ast.Compare(left, [other], right))]
        case ast.BoolOp(op, values):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            fewer = [(f"without term {i}", _joined(op, [*values[:i], *values[i + 1 :]])) for i in range(len(values))]
            return [(type(other).__name__, ast.BoolOp(other, values)), *fewer]
        case ast.UnaryOp(ast.Not(), operand):
            return [("without not", operand)]
        case ast.If(test, body, rest):
            return [("if not", ast.If(ast.UnaryOp(ast.Not(), test), body, rest))]
        case ast.IfExp(test, body, rest):
            return [("always the first", body), ("always the other", rest)]
        case ast.BinOp(left, op, right) if type(op) in _COMPUTED:
            other = _COMPUTED[type(op)]()
            return [(type(other).__name__, ast.BinOp(left, other, right)), ("the left alone", left)]
        case ast.Constant(value) if type(value) in (int, float):
            return [("ten times", ast.Constant(value * 10 if value else 1))]
        case ast.Constant(value) if type(value) is bool:
            return [(str(not value), ast.Constant(not value))]
        case ast.Call(ast.Name(name), args, words) if name in _NAMES:
            return [(_NAMES[name], ast.Call(ast.Name(_NAMES[name], ast.Load()), args, words))]
        case ast.Call(ast.Attribute(value, name), args, words) if name in _NAMES:
            return [(_NAMES[name], ast.Call(ast.Attribute(value, _NAMES[name], ast.Load()), args, words))]
        case ast.Continue():
            return [("break", ast.Break())]
        case ast.AugAssign() | ast.Expr(ast.Call()):
            return [("left out", ast.Pass())]
    return []


def _joined(op: ast.boolop, values: Sequence[ast.expr]) -> ast.expr:
    return values[0] if len(values) == 1 else ast.BoolOp(op, list(values))


def _is_text(node: ast.AST) -> bool:
    """Whether a function only words something."""
    if not isinstance(node, ast.FunctionDef) or node.returns is None or ast.unparse(node.returns) != "str":
        return False
    return "empty" not in (ast.get_docstring(node) or "")


class _Breaker(ast.NodeTransformer):
    """Counts the nodes that can be broken, and breaks one."""

    def __init__(self, wanted: tuple[int, int] | None = None) -> None:
        self.wanted, self.count = wanted, -1
        self.found: list[tuple[str, int, int, int, str]] = []
        self.scope: list[ast.FunctionDef | ast.ClassDef] = []

    def visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            node.value = self.visit(node.value)  # type: ignore[assignment]
            return node
        if isinstance(node, ast.arg | ast.JoinedStr | ast.Raise | ast.Assert | ast.ImportFrom) or _is_text(node):
            return node
        if isinstance(node, ast.keyword) and node.arg in _KEYWORDS:
            return node
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _UNTOLD:
            node.func = self.visit(node.func)  # type: ignore[assignment]
            return node
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            return node
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if isinstance(node, ast.FunctionDef):
                node.args = self.visit(node.args)  # type: ignore[assignment]
            self.scope.append(node)
            node.body = [self.visit(each) for each in node.body]  # type: ignore[misc]
            self.scope.pop()
            return node
        made = breaks(node)
        own = self.count = self.count + 1
        self.found += [(self._function(), own, i, getattr(node, "lineno", 0), w) for i, (w, _) in enumerate(made)]
        if self.wanted is not None and own == self.wanted[0]:
            return ast.copy_location(made[self.wanted[1]][1], node)
        return self.generic_visit(node)

    def _function(self) -> str:
        """The outermost function; of a class, its method."""
        names = []
        for each in self.scope:
            names.append(each.name)
            if isinstance(each, ast.FunctionDef):
                return ".".join(names)
        return ""


def broken(mutant: Mutant) -> ast.Module:
    """The module with its break."""
    tree = _Breaker((mutant.node, mutant.kind)).visit(ast.parse((ROOT / mutant.file).read_text()))
    assert isinstance(tree, ast.Module)
    return ast.fix_missing_locations(tree)


def mutants() -> list[Mutant]:
    """Every break of both rooms, in order."""
    found: list[Mutant] = []
    for file in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        breaker = _Breaker()
        breaker.visit(ast.parse(file.read_text()))
        name = file.relative_to(ROOT).as_posix()
        found += [Mutant(len(found) + i, name, *each) for i, each in enumerate(breaker.found)]
    return found


def interval(killed: int, count: int) -> tuple[float, float]:
    """Wilson's interval of a share, 95 %."""
    z, share = 1.96, killed / count
    middle, scale = share + z * z / (2 * count), 1 + z * z / count
    width = z * sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return (middle - width) / scale, (middle + width) / scale


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.verify.mutants", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=0, help="so many of all")
    parser.add_argument("--seed", type=int, default=0, help="which")
    parser.add_argument("--only", default="", help="those of files whose path holds this")
    parser.add_argument("--numbers", default="", help="those of these numbers, joined by commas")
    parser.add_argument("--tests", nargs="+", default=[], help="those of these files alone: more survive")
    parser.add_argument("--quick", action="store_true", help="the tests of seconds alone: more survive")
    options = parser.parse_args()
    every = mutants()
    numbers = {int(n) for n in options.numbers.split(",") if n} or set(range(len(every)))
    chosen = [m for m in every if options.only in m.file and m.number in numbers]
    if options.sample:
        chosen = sorted(random.Random(options.seed).sample(chosen, options.sample), key=lambda m: m.number)
    if not chosen:
        parser.error("there are no such mutants")

    from tests.verify.mutation import QUICK, TESTS, survivors

    alive = Counter[str]()
    for mutant, reason in survivors(chosen, options.tests or (QUICK if options.quick else TESTS)):
        alive[mutant.file] += 1
        line = (ROOT / mutant.file).read_text().splitlines()[mutant.line - 1].strip()
        print(f"{mutant.number}: {mutant.file}:{mutant.line}: {mutant.what}: {line} ({reason})", flush=True)
    total = Counter(m.file for m in chosen)
    for file, count in sorted(total.items()):
        print(f"{file}: {count - alive[file]} of {count} killed")
    killed = len(chosen) - sum(alive.values())
    low, high = interval(killed, len(chosen))
    print(
        f"{killed} of {len(chosen)} killed: {killed / len(chosen):.1%} ({low:.1%} to {high:.1%}), seed {options.seed}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
