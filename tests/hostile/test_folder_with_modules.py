"""A folder of models that also holds Python modules, in which the user stands: none of them is imported."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from fixtures import path as fixture
from tests.commands import PLACES
from tests.exporter.test_imports import MODULES, name_of, tree_of

#: Modules that Python, multiprocessing and the children import early.
NAMES = ("multiprocessing", "pickle", "runpy", "json", "struct", "numpy", "onnxruntime", "export_model")
#: What the console script does: the script's folder goes before all others, not the one that the user stands in.
SCRIPT = f"import sys; sys.path[0] = {str(PLACES[0])!r}; from export_model.exporter.cli.main import main\n"
SCRIPT += "if __name__ == '__main__': main()"


def test_modules_beside_models_are_not_imported(tmp_path: Path) -> None:
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(f"import os\nos.write(2, b'{name} was imported')\nos._exit(7)\n")
    script = tmp_path / "bin" / "export-model"
    script.parent.mkdir()
    script.write_text(SCRIPT)
    sources = [str(fixture(name)) for name in ("continuous", "sampled")]
    options = ("-o", "out", "--to", "onnx", "--verify", "onnxruntime", "--jobs", "2")
    command = [sys.executable, str(script), *sources, *options]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert "was imported" not in ran.stderr + ran.stdout
    assert ran.returncode == 0, ran.stderr


def test_every_python_that_is_started_leaves_that_folder_out() -> None:
    """``-c`` and ``-m`` would look there first."""
    found = []
    for module in MODULES:
        for display in ast.walk(tree_of(module)):
            if not isinstance(display, ast.List | ast.Tuple) or len(display.elts) < 2:
                continue
            first, second = display.elts[:2]
            if ast.unparse(first) == "sys.executable":
                found.append((name_of(module), ast.unparse(second)))
    assert found
    assert [name for name, option in found if option not in ("'-P'", "'-I'")] == []
