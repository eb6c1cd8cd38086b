"""What imports what: one direction between the packages, and nothing heavy before it is used."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import fixtures
from tests.commands import ROOT, python

#: package → the packages of this project that it may import
ALLOWED = {
    "signatures": {"signatures"},
    "converters": {"signatures", "converters"},
    "exporter": {"signatures", "converters", "exporter"},
}
MODULES = [
    path for package in ALLOWED for path in sorted((ROOT / package).rglob("*.py")) if "node_modules" not in str(path)
]
HEAVY = {"tensorflow", "onnxruntime", "tensorflowjs", "tf2onnx", "torch", "keras"}
RUNTIMES = {"tensorflow", "onnxruntime"}


def imported(tree: ast.AST) -> Iterator[str]:
    """Top-level names of all imports in a piece of code."""
    for found in ast.walk(tree):
        if isinstance(found, ast.Import):
            yield from (alias.name.split(".")[0] for alias in found.names)
        elif isinstance(found, ast.ImportFrom):
            assert found.level == 0, "relative imports hide what is imported"
            assert found.module is not None
            yield found.module.split(".")[0]


def at_module_level(tree: ast.Module) -> Iterator[str]:
    """The same, for imports that run when the module is imported."""
    for statement in tree.body:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING":
            continue
        yield from imported(statement)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_the_modules_are_found() -> None:
    names = {name_of(m) for m in MODULES}
    assert {"signatures/roles.py", "converters/formats.py", "exporter/cli/main.py"} <= names


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_imports_go_one_way(module: Path) -> None:
    package = module.relative_to(ROOT).parts[0]
    own = set(imported(ast.parse(module.read_text(encoding="utf-8")))) & set(ALLOWED)
    assert own <= ALLOWED[package]


@pytest.mark.parametrize("module", [m for m in MODULES if m.is_relative_to(ROOT / "signatures")], ids=name_of)
def test_signatures_know_numpy_and_the_standard_library_only(module: Path) -> None:
    assert set(imported(ast.parse(module.read_text(encoding="utf-8")))) <= {
        *sys.stdlib_module_names,
        "numpy",
        "signatures",
    }


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_no_runtime_is_imported_with_a_module(module: Path) -> None:
    assert not set(at_module_level(ast.parse(module.read_text(encoding="utf-8")))) & HEAVY


@pytest.mark.parametrize("module", MODULES, ids=name_of)
def test_only_the_children_and_what_acts_import_a_runtime(module: Path) -> None:
    if not any(module.is_relative_to(ROOT / room) for room in ("converters/runtimes", "exporter/acting")):
        assert not set(imported(ast.parse(module.read_text(encoding="utf-8")))) & RUNTIMES


def own_imports(path: Path, names: set[str]) -> set[str]:
    """The modules of this project that a module imports, lazily too; those for type checking alone do not count."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for found in ast.walk(tree):
        if isinstance(found, ast.If) and ast.unparse(found.test) == "TYPE_CHECKING":
            found.body = []
    wanted: list[str] = []
    for found in ast.walk(tree):
        if isinstance(found, ast.Import):
            wanted += [alias.name for alias in found.names]
        elif isinstance(found, ast.ImportFrom):
            module = found.module or ""
            wanted += [n if (n := f"{module}.{alias.name}") in names else module for alias in found.names]
    return names & set(wanted)


def test_no_module_imports_itself_round_a_corner() -> None:
    """Lazy imports count: a cycle that is only broken by waiting is a cycle."""
    paths = {name_of(p).removesuffix(".py").removesuffix("/__init__").replace("/", "."): p for p in MODULES}
    left = {name: own_imports(path, set(paths)) - {name} for name, path in paths.items()}
    while free := {name for name, others in left.items() if not others}:
        left = {name: others - free for name, others in left.items() if name not in free}
    assert not left, f"these modules import each other: {left}"


def test_nothing_below_the_command_line_asks_it() -> None:
    modules = [m for m in MODULES if not m.is_relative_to(ROOT / "exporter/cli") and m.name != "__main__.py"]
    asking = [name_of(m) for m in modules if "exporter.cli" in m.read_text(encoding="utf-8")]
    assert asking == []


def loaded_by(*arguments: object) -> set[str]:
    """Top-level modules that a command imports."""
    ran = python("-X", "importtime", *arguments)
    assert ran.status == 0, ran.err
    return {
        line.rpartition("|")[2].strip().split(".")[0]
        for line in ran.err.splitlines()
        if line.startswith("import time:")
    }


def test_help_starts_without_anything_heavy() -> None:
    loaded = loaded_by("-m", "exporter", "--help")
    assert "click" in loaded
    assert not loaded & {"tensorflow", "onnxruntime", "onnx", "rich", "numpy", "google", "converters"}


def test_an_export_without_verification_loads_no_runtime(tmp_path: Path) -> None:
    source = ROOT / "fixtures" / "continuous.bytes"
    loaded = loaded_by("-m", "exporter", source, "-o", tmp_path, "--verify", "none", "--to", "bytes,saved_model,tfjs")
    assert not loaded & {"tensorflow", "onnxruntime", "onnx", "rich"}
    assert "onnx" in loaded_by("-m", "exporter", source, "-o", tmp_path, "--verify", "none", "--to", "onnx")


def test_an_export_reads_no_room_that_it_has_no_use_for(tmp_path: Path) -> None:
    """The ``.nn`` and the consumers of ``--for`` are a fifth of all modules."""
    script = (
        "import sys\nfrom exporter.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "rooms = ('converters.barracuda.', 'converters.targets', 'converters.torch_checkpoint.', 'converters.keras.')\n"
        "print([m for m in sys.modules if m.startswith(rooms)])"
    )
    ran = python("-c", script, ROOT / "fixtures" / "continuous.bytes", "-o", tmp_path, "--verify", "none")
    assert ran.out.splitlines()[-1] == "[]"


def test_the_package_loads_its_functions_when_they_are_asked_for() -> None:
    code = "import sys, exporter; print('numpy' in sys.modules); exporter.export_model; print('numpy' in sys.modules)"
    assert python("-c", code).out.split() == ["False", "True"]
    assert "has no attribute 'nothing'" in python("-c", "import exporter; exporter.nothing").err


def test_an_export_loads_neither_openssl_nor_numpy_random(tmp_path: Path) -> None:
    """Each costs megabytes, and a cold export without verification needs none of them."""
    script = (
        "import sys\n"
        "from exporter.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "print([m for m in ('_hashlib', 'numpy.random', 'tensorflow', 'onnxruntime') if m in sys.modules])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script, str(fixtures.path("continuous")), "-o", str(tmp_path), "--verify", "none"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stdout.splitlines()[-1] == "[]"
