"""What imports what: one direction between the packages, and nothing heavy before it is used."""

from __future__ import annotations

import ast
import functools
import importlib
import pydoc
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from export_model.converters.formats.registry import ROOMS
from export_model.exporter.cli.app import app
from tests.commands import PACKAGE, ROOT, python

#: package → the packages of this project that it may import
ALLOWED = {
    "signatures": {"signatures"},
    "converters": {"signatures", "converters"},
    "exporter": {"signatures", "converters", "exporter"},
    "export_model": {"signatures", "converters", "exporter"},
}
#: In the package's own folder the others are links, which are not followed.
MODULES = [
    path
    for place in (ROOT / "signatures", ROOT / "converters", ROOT / "exporter", PACKAGE)
    for path in sorted(place.rglob("*.py"))
    if "node_modules" not in str(path)
]
HEAVY = {"tensorflow", "onnxruntime", "tensorflowjs", "tf2onnx", "torch", "keras"}
RUNTIMES = {"tensorflow", "onnxruntime"}


def imported(tree: ast.AST) -> Iterator[str]:
    """Top-level names of all imports in a piece of code; of ours, the name below ``export_model``."""
    for found in ast.walk(tree):
        if isinstance(found, ast.Import):
            yield from (top_of(alias.name) for alias in found.names)
        elif isinstance(found, ast.ImportFrom):
            assert found.level == 0, "relative imports hide what is imported"
            assert found.module is not None
            yield from (top_of(f"{found.module}.{alias.name}") for alias in found.names)


def top_of(module: str) -> str:
    return module.removeprefix("export_model.").split(".")[0]


def at_module_level(tree: ast.Module | ast.ClassDef) -> Iterator[str]:
    """The same, for imports that run when the module is imported: not those of functions and methods."""
    for statement in tree.body:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(statement, ast.ClassDef):
            yield from at_module_level(statement)
            continue
        if isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING":
            continue
        yield from imported(statement)


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE.parent if path.is_relative_to(PACKAGE) else ROOT).as_posix()


def module_of(path: Path) -> str:
    """The one name that a module is imported by."""
    name = name_of(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    return name if path.is_relative_to(PACKAGE) else f"export_model.{name}"


def test_the_modules_are_found() -> None:
    names = {name_of(m) for m in MODULES}
    assert {"signatures/roles.py", "converters/formats/registry.py", "exporter/cli/main.py"} <= names


@functools.cache
def tree_of(module: Path) -> ast.Module:
    return ast.parse(module.read_text(encoding="utf-8"))


def importing(modules: Iterable[Path], wrong: Callable[[Path], set[str]]) -> dict[str, set[str]]:
    """The modules that import what they may not, and what that is."""
    return {name_of(m): found for m in modules if (found := wrong(m))}


def test_imports_go_one_way() -> None:
    def wrong(module: Path) -> set[str]:
        own = set(imported(tree_of(module))) & set(ALLOWED)
        return own - ALLOWED[name_of(module).split("/")[0]]

    assert importing(MODULES, wrong) == {}


def test_signatures_know_numpy_msgspec_and_the_standard_library_only() -> None:
    known = {*sys.stdlib_module_names, "msgspec", "numpy", "signatures"}
    modules = [m for m in MODULES if m.is_relative_to(ROOT / "signatures")]
    assert importing(modules, lambda m: set(imported(tree_of(m))) - known) == {}


def test_records_are_structs() -> None:
    """A class of ``dataclasses`` compiles its methods, 0.5 ms each, when its module is imported."""
    assert importing(MODULES, lambda m: set(imported(tree_of(m))) & {"dataclasses"}) == {}


def test_no_runtime_is_imported_with_a_module() -> None:
    assert importing(MODULES, lambda m: set(at_module_level(tree_of(m))) & HEAVY) == {}


def test_only_the_children_and_what_acts_import_a_runtime() -> None:
    theirs = [ROOT / room for room in ("converters/runtimes", "converters/formats/live", "exporter/acting")]
    modules = [m for m in MODULES if not any(m.is_relative_to(room) for room in theirs)]
    assert importing(modules, lambda m: set(imported(tree_of(m))) & RUNTIMES) == {}


def own_imports(path: Path, names: set[str]) -> set[str]:
    """The modules of this project that a module imports, lazily too; those for type checking alone do not count.

    A block for type checking with an ``else`` names what is deferred (``export_model.converters.formats.format``).
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for found in ast.walk(tree):
        if isinstance(found, ast.If) and ast.unparse(found.test) == "TYPE_CHECKING" and not found.orelse:
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
    paths = {module_of(p): p for p in MODULES}
    left = circles({name: own_imports(path, set(paths)) for name, path in paths.items()})
    assert not left, f"these modules import each other: {left}"


def circles(imports: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """What is left of names and what each imports, without those that import nothing that is left."""
    left = {name: others - {name} for name, others in imports.items()}
    while free := {name for name, others in left.items() if not others}:
        left = {name: others - free for name, others in left.items() if name not in free}
    return left


#: The rooms of ``converters/``, the lowest first: each may import those before it, lazily too.
ROOMS_FROM_BELOW = (
    "files",
    "interfaces",
    "layouts",
    "graph",
    "policy",
    "compiler",
    "trainers",
    "formats",
    "consumers",
    "runtimes",
)


def room_of(module: str) -> str | None:
    """The room of ``converters`` that a module lies in; None elsewhere."""
    _, package, room, *_ = *module.split("."), "", ""
    return room if package == "converters" and room else None


def test_rooms_import_only_those_below_them() -> None:
    """Every import counts, those inside of functions too: an arrow upward is a cycle waiting for its other half."""
    names = {module_of(p) for p in MODULES}
    level = {room: number for number, room in enumerate(ROOMS_FROM_BELOW)}
    upward = [
        f"{module} -> {other}"
        for path in MODULES
        for module in [module_of(path)]
        for other in sorted(own_imports(path, names))
        if (own := room_of(module)) and (asked := room_of(other)) and level[own] < level[asked]
    ]
    assert not upward


#: The one room whose inner rooms import each other: ops are made of layers, layers of the builder, and it of the table.
ONE_WITHIN = "export_model.converters.graph."


def inner_room(module: str) -> str:
    """The room of a room that a module lies in, or it itself: ``converters.formats.onnx``, ``exporter.verify``."""
    depth = 4 if module.startswith("export_model.converters.") and not module.startswith(ONE_WITHIN) else 3
    return ".".join(module.split(".")[:depth])


def test_no_room_of_a_room_imports_itself_round_a_corner() -> None:
    """One level into formats, consumers, trainers, exporter and the others; lazy imports count."""
    paths = {module_of(p): p for p in MODULES}
    rooms: dict[str, set[str]] = {inner_room(name): set() for name in paths}
    for name, path in paths.items():
        rooms[inner_room(name)] |= {inner_room(other) for other in own_imports(path, set(paths))}
    assert len(rooms) > 150
    left = circles(rooms)
    assert not left, f"these rooms import each other: {left}"


def test_a_class_has_a_name_of_its_own() -> None:
    """A reader of one room takes its words for those of another; a few pairs are users' words, or two rooms' own."""
    homes: dict[str, list[str]] = {}
    for path in MODULES:
        for found in tree_of(path).body:
            if isinstance(found, ast.ClassDef):
                homes.setdefault(found.name, []).append(name_of(path))
    shared = {name: files for name, files in homes.items() if len(files) > 1}
    assert len(homes) > 500
    assert len(shared) <= 10, shared


def test_readers_name_no_trainer() -> None:
    """A trainer is a room and a line of the registry: no reader asks one by its name."""
    from export_model.converters.trainers.registry import ROOMS

    names = {module_of(p) for p in MODULES}
    theirs = {n for n in names for room in ROOMS if f"{n}.".startswith(f"export_model.converters.trainers.{room}.")}
    outside = [p for p in MODULES if not p.is_relative_to(ROOT / "converters/trainers")]
    assert importing(outside, lambda m: own_imports(m, names) & theirs) == {}


def test_every_module_of_converters_lies_in_a_room() -> None:
    rooms = {path.relative_to(ROOT).parts[1] for path in MODULES if path.is_relative_to(ROOT / "converters")}
    assert rooms == {"__init__.py", *ROOMS_FROM_BELOW}


def test_nothing_below_the_command_line_asks_it() -> None:
    modules = [m for m in MODULES if not m.is_relative_to(ROOT / "exporter/cli") and m.name != "__main__.py"]
    asking = [name_of(m) for m in modules if "export_model.exporter.cli" in m.read_text(encoding="utf-8")]
    assert asking == []


def loaded_by(*arguments: object) -> set[str]:
    """Top-level modules that a command imports; of ours, the name below ``export_model``."""
    ran = python("-X", "importtime", *arguments)
    assert ran.status == 0, ran.err
    return {top_of(line.rpartition("|")[2].strip()) for line in ran.err.splitlines() if line.startswith("import time:")}


def test_help_starts_without_anything_heavy() -> None:
    loaded = loaded_by("-m", "export_model", "--help")
    assert "click" in loaded
    assert not loaded & {"tensorflow", "onnxruntime", "onnx", "rich", "numpy", "google", "converters"}


#: What a plain export to the usual formats has no use for, and what it takes instead.
NOT_LOADED = (
    *HEAVY,
    # the package: messages are written with converters/formats/onnx/messages.py, and its checker is verification's
    *("onnx", "ml_dtypes"),
    # how messages are described in Python: converters/files/protobuf_messages.py describes them in bytes
    *("google.protobuf.descriptor_pb2", "google.protobuf.json_format"),
    *("rich", "email", "http", "ssl", "socket", "asyncio", "multiprocessing", "subprocess", "tarfile"),
    *("numpy.ma", "numpy.random", "numpy.testing", "numpy.fft", "numpy.polynomial", "numpy.f2py", "numpy.ctypeslib"),
    *(
        "export_model.converters.formats.barracuda.writer",
        "export_model.converters.formats.barracuda.reader",
        "export_model.converters.consumers",
        "export_model.converters.formats.live",
    ),
    *(
        "export_model.converters.formats.torch_checkpoint.source",
        "export_model.converters.formats.keras.source",
        "export_model.converters.formats.stable_baselines3.source",
    ),
    *(
        "export_model.converters.runtimes",
        "export_model.converters.formats.onnx.reader",
        "export_model.converters.formats.onnx.importer",
        "export_model.converters.formats.tensorboard",
    ),
    *(
        "export_model.exporter.verify.verification",
        "export_model.exporter.verify.findings",
        "export_model.exporter.verify.report",
        "export_model.exporter.verify.trial",
    ),
    *(
        "export_model.exporter.reports",
        "export_model.exporter.serve",
        "export_model.exporter.acting",
        "export_model.exporter.compare",
        "export_model.exporter.inspect",
        "export_model.exporter.demo",
    ),
    # other commands, and what only a page of links or completion asks for
    *(
        "export_model.exporter.cli.compare",
        "export_model.exporter.cli.inspect",
        "export_model.exporter.cli.verify",
        "export_model.exporter.cli.serve",
        "export_model.exporter.cli.demo",
    ),
    *(
        "export_model.exporter.cli.snippets",
        "export_model.exporter.cli.runtimes",
        "export_model.exporter.cli.completion",
    ),
    *("html", "click.shell_completion"),
    *(
        "export_model.exporter.snippets",
        "export_model.exporter.fleet.fleet",
        "export_model.exporter.fleet.worker",
        "export_model.exporter.export.again",
    ),
)


def test_a_plain_export_imports_what_it_uses(tmp_path: Path) -> None:
    script = (
        "import sys\nfrom export_model.exporter.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules)"
    )
    ran = python("-c", script, ROOT / "fixtures" / "continuous.bytes", "-o", tmp_path, "--verify", "none")
    loaded = set(ran.out.splitlines()[-1].split())
    assert "export_model.converters.formats.onnx.writer" in loaded
    assert {m for m in loaded for name in NOT_LOADED if m == name or m.startswith(f"{name}.")} == set()


def test_a_verified_bundle_is_vetted_without_what_costs_most(tmp_path: Path) -> None:
    """A quarter of a second for the package ``onnx``, 25 ms for a version."""
    python("-m", "export_model", ROOT / "fixtures" / "continuous.bytes", "-o", tmp_path, "--verify", "none")
    script = (
        "import sys\nfrom export_model.exporter.cli.main import main\n"
        "try:\n    main(['verify', sys.argv[1], '--runtimes', 'onnxruntime'])\nexcept SystemExit:\n    pass\n"
        "print(*sys.modules)"
    )
    *said, last = python("-c", script, tmp_path / "continuous").out.splitlines()
    loaded = set(last.split())
    assert said[-1].startswith("PASSED")
    assert "export_model.converters.formats.onnx.vetted" in loaded
    assert {"onnx", "importlib.metadata", "email", "export_model.converters.formats.onnx.reader"}.isdisjoint(loaded)


def test_the_package_loads_its_functions_when_they_are_asked_for() -> None:
    code = "import sys, export_model; print('numpy' in sys.modules); export_model.export; print('numpy' in sys.modules)"
    assert python("-c", code).out.split() == ["False", "True"]
    assert "has no attribute 'nothing'" in python("-c", "import export_model; export_model.nothing").err


def test_help_of_every_documented_class_is_shown() -> None:
    """The signature of a Struct evaluates its annotations, in which names for type checking alone are missing."""
    page = (ROOT / "docs/python-guide.md").read_text(encoding="utf-8")
    documented = re.findall(r"autoclass:: ([\w.]+)\.(\w+)", page)
    assert ("export_model.exporter.export.pipeline", "ExportResult") in documented
    for module, name in documented:
        assert f"{name}(" in pydoc.plain(pydoc.render_doc(getattr(importlib.import_module(module), name))), name


def test_every_name_that_is_resolved_later_is_there() -> None:
    """Commands by their modules, functions of the package, and what a format names of a module not yet imported."""
    for name, command in app.commands.items():
        assert command.name == name
    rooms = {
        p.stem for p in MODULES if p.parent == ROOT / "exporter/cli" and f"\ndef {p.stem}_command(" in p.read_text()
    }
    assert rooms == {*app.commands}
    rooms_of_formats = [ROOT / "converters/formats" / room / "__init__.py" for room in (*ROOMS, "programs")]
    named = [ask for room in rooms_of_formats for ask in asked_later(room)]
    assert len(named) > 30
    missing = [ask for ask in named if not callable(getattr(importlib.import_module(ask[0]), ask[1], None))]
    assert missing == []


def asked_later(room: Path) -> Iterator[tuple[str, str]]:
    """(module, function) of all that a room's ``__init__`` asks of what ``defer_imports`` gives."""
    tree, package = tree_of(room), module_of(room)
    modules: dict[str, str] = {}
    for found in ast.walk(tree):
        if isinstance(found, ast.Assign) and ast.unparse(found.value).startswith("defer_imports("):
            assert isinstance(found.value, ast.Call) and isinstance(found.targets[0], ast.Tuple)
            of, *words = found.value.args  # __name__, or the package of modules that rooms share
            home = package if isinstance(of, ast.Name) else ast.literal_eval(of)
            named = [f"{home}.{ast.literal_eval(word)}" for word in words]
            modules.update(zip(map(ast.unparse, found.targets[0].elts), named, strict=True))
    for found in ast.walk(tree):
        if isinstance(found, ast.Attribute) and isinstance(found.value, ast.Name) and found.value.id in modules:
            yield modules[found.value.id], found.attr
