"""What is decided by a format is asked of its ``Format``: outside of the rooms hardly any file names one by its key."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.registry import RUNTIMES
from tests.exporter.test_imports import MODULES, ROOT, name_of

#: Words of this project's own: others, such as ``c``, ``js`` and ``bytes``, are runtimes, units and languages, too.
KEYS = WRITTEN.keys() - {r.name for r in RUNTIMES} - {"bytes", "js"}
#: Files that may still name one: the protocol of TensorFlow's two children, the runtimes' names in a browser, and words
#: that stand for something else (a field of site.json and its readers, the name of a snippet, TensorFlow's own module,
#: what users of other tools type).
MOST = 9
#: Files beside Python that say something to a program: scripts, pages, templates of snippets and of compiled children.
CODE = {".mjs", ".js", ".html", ".tmpl", ".cs", ".c", ".h", ".sh"}


def literals(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def chosen_by_key(tree: ast.AST) -> Iterator[int]:
    """Lines that look a format up by a literal key, or compare one's key with a literal."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id == "WRITTEN":
            if isinstance(node.slice, ast.Constant):
                yield node.lineno
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            keyed = any(isinstance(s, ast.Attribute) and s.attr == "key" for s in sides)
            if keyed and any(isinstance(s, ast.Constant) and s.value in WRITTEN for s in sides):
                yield node.lineno


def outside() -> Iterator[tuple[str, ast.AST]]:
    for path in MODULES:
        if not name_of(path).startswith("converters/formats/"):
            yield name_of(path), ast.parse(path.read_text(encoding="utf-8"))


def named_in(text: str) -> set[str]:
    """The keys in code that is not Python, as a string or as a property; ``.onnx`` is the suffix of files."""
    strings = {m[2] for m in re.finditer(r"""(["'`])(\w+)\1""", text)}
    properties = set(re.findall(r"\w\.(\w+)", text)) - {"onnx"}
    return KEYS & (strings | properties)


def other_code() -> Iterator[Path]:
    for room in ("converters", "exporter", "signatures"):
        for path in sorted((ROOT / room).rglob("*")):
            name = path.relative_to(ROOT).as_posix()
            inside = name.startswith("converters/formats/") or "node_modules" in path.parts
            if path.suffix in CODE and path.is_file() and not inside:
                yield path


def test_hardly_a_file_outside_the_rooms_names_a_format() -> None:
    assert {"onnx", "tfjs", "nn", "saved_model"} <= KEYS
    files = [name for name, tree in outside() if KEYS.intersection(literals(tree))]
    scripts = list(other_code())
    assert len(scripts) > 60
    files += [p.name for p in scripts if named_in(p.read_text(encoding="utf-8"))]
    assert 0 < len(files) <= MOST, files


def test_a_key_in_a_script_would_be_found() -> None:
    assert named_in("if (kind === 'tfjs') x = site.nn; // a.onnx, \"files\"") == {"tfjs", "nn"}
    assert named_in('f["onnx"] + `saved_model`') == {"onnx", "saved_model"}
    assert named_in("find('.onnx'); tfjs.load()") == set()


def test_no_decision_hangs_on_a_key() -> None:
    assert [(name, line) for name, tree in outside() for line in chosen_by_key(tree)] == []


def test_a_decision_would_be_found() -> None:
    found = 'if f.key == "nn":\n    pass\nif "onnx" != f.key:\n    pass\nWRITTEN["tfjs"]\nWRITTEN[key]\nf.key == g.key'
    assert sorted(chosen_by_key(ast.parse(found))) == [1, 3, 5]
