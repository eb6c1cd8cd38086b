"""``python -m tests.verify.mutants``: single-line breaks of what judges, each run against the judge's fast tests.

A mutant has a number, the same in every run of the same code. By hand, or nightly: a mutant takes seconds. What
survives is printed with its line. ``--sample N`` runs N of them, spread over all; ``--only FILE`` those of one file;
``--quick`` the tests of seconds alone.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.util
import os
import resource
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("exporter/verify", "exporter/compare")
#: What reads and words, and judges nothing; other rooms' tests are for these.
_WORDS = ("verdict", "findings", "report", "npy", "plays", "options", "session", "golden", "tolerance_file", "__init__")
#: Tests that start no runtime, the cheapest first.
TESTS = (
    *("tests/verify/test_bounds.py", "tests/exporter/test_comparison.py", "tests/verify"),
    *("tests/compare/test_ports.py", "tests/compare/test_budget.py", "tests/exporter/test_bisection.py"),
    *("tests/exporter/test_verification.py", "tests/exporter/test_what_is_compared.py"),
)
QUICK = (*TESTS[:3], "tests/compare/test_budget.py", "tests/exporter/test_bisection.py")
SECONDS = 240
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


@dataclass(frozen=True)
class Mutant:
    """One break: a file, the place of its node among all, and which of the node's breaks."""

    file: str
    node: int
    kind: int
    line: int
    what: str


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


class _Breaker(ast.NodeTransformer):
    """Counts the nodes that can be broken, and breaks one; annotations, slices' steps and texts stay."""

    def __init__(self, wanted: tuple[int, int] | None = None) -> None:
        self.wanted, self.count = wanted, -1
        self.found: list[tuple[int, int, int, str]] = []

    def visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            node.value = self.visit(node.value)  # type: ignore[assignment]
            return node
        if isinstance(node, ast.arg | ast.JoinedStr | ast.Raise | ast.Assert | ast.ImportFrom):
            return node
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            return node
        made = breaks(node)
        own = self.count = self.count + 1
        self.found += [(own, kind, getattr(node, "lineno", 0), what) for kind, (what, _) in enumerate(made)]
        if self.wanted is not None and own == self.wanted[0]:
            return ast.copy_location(made[self.wanted[1]][1], node)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            node.body = [self.visit(each) for each in node.body]  # type: ignore[misc]
            return node
        return self.generic_visit(node)


def mutants() -> list[Mutant]:
    """Every break of every file that judges, in order."""
    found = []
    for file in sorted(p for room in ROOMS for p in (ROOT / room).rglob("*.py") if p.stem not in _WORDS):
        breaker = _Breaker()
        breaker.visit(ast.parse(file.read_text()))
        found += [Mutant(file.relative_to(ROOT).as_posix(), *each) for each in breaker.found]
    return found


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module with its break."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant
        self.name = "export_model." + mutant.file.removesuffix(".py").replace("/", ".")

    def find_spec(self, name: str, path: object, target: object = None) -> object:  # type: ignore[override]
        file = ROOT / self.mutant.file
        return importlib.util.spec_from_file_location(name, file, loader=self) if name == self.name else None

    def create_module(self, spec: object) -> None:
        return None

    def exec_module(self, module: object) -> None:
        tree = _Breaker((self.mutant.node, self.mutant.kind)).visit(ast.parse((ROOT / self.mutant.file).read_text()))
        code = compile(ast.fix_missing_locations(tree), self.mutant.file, "exec")  # type: ignore[call-overload]
        exec(code, module.__dict__)


def survives(mutant: Mutant, tests: Sequence[str] = TESTS) -> bool:
    """Whether all tests pass with the break, in a process of its own."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] == 0
    status = 1
    try:
        import pytest

        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        sys.meta_path.insert(0, _Finder(mutant))
        status = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]))
    finally:
        os._exit(status)


def _preload() -> None:
    """Import what is not broken once, ahead of the forks."""
    modules = ("onnx", "export_model.converters.compiler.compile", "export_model.converters.runtimes.numpy.child")
    for name in ("pytest", *modules):
        importlib.import_module(name)


def survivors(chosen: Sequence[Mutant], tests: Sequence[str], workers: int = 2) -> Iterator[Mutant]:
    """Those that no test kills."""
    with ThreadPoolExecutor(workers) as threads:
        for mutant, alive in zip(chosen, threads.map(partial(survives, tests=tests), chosen), strict=True):
            if alive:
                yield mutant


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.verify.mutants", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=0, help="so many, spread over all")
    parser.add_argument("--only", default="", help="those of files whose path holds this")
    parser.add_argument("--quick", action="store_true", help="with the tests of seconds alone: more survive")
    options = parser.parse_args()
    numbered = [(i, m) for i, m in enumerate(mutants()) if options.only in m.file]
    numbered = numbered[:: max(1, len(numbered) // options.sample)] if options.sample else numbered
    numbers = {m: i for i, m in numbered}
    _preload()
    os.chdir(ROOT)
    tests = QUICK if options.quick else TESTS
    if not survives(Mutant("", 0, 0, 0, ""), tests):
        raise SystemExit("the tests fail without a break: run them by themselves")
    alive = Counter[str]()
    for mutant in survivors([m for _, m in numbered], tests):
        alive[mutant.file] += 1
        line = (ROOT / mutant.file).read_text().splitlines()[mutant.line - 1].strip()
        print(f"{numbers[mutant]}: {mutant.file}:{mutant.line}: {mutant.what}: {line}", flush=True)
    total = Counter(m.file for _, m in numbered)
    for file, count in sorted(total.items()):
        print(f"{file}: {count - alive[file]} of {count} killed")
    killed = sum(total.values()) - sum(alive.values())
    print(f"{killed} of {sum(total.values())} killed ({killed / max(1, sum(total.values())):.0%})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
