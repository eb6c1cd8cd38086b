"""The code of a TorchScript archive: parsed as Python's syntax, never compiled or run.

``code/__torch__/a/b.py`` has the classes and functions ``__torch__.a.b.*``; those of the main module are in
``code/__torch__.py``. The printer (torch/csrc/jit/serialization/python_print.cpp) writes one assignment a line.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Mapping

from export_model.signatures.errors import DamagedFileError, SourceError

_DAMAGED = "copy or download it again"


class ArchiveCode:
    """The classes and functions of an archive, by their dotted names."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self._files = files
        self._parsed: dict[str, dict[str, ast.stmt]] = {}

    def method(self, type_name: str, name: str) -> ast.FunctionDef:
        """Return a method of a class. Raises SourceError where there is none."""
        found = self._definition(type_name)
        if isinstance(found, ast.ClassDef):
            for statement in found.body:
                if isinstance(statement, ast.FunctionDef) and statement.name == name:
                    return statement
        raise SourceError(
            f"its class {_short(type_name)} has no method {name[:60]} in the file",
            why="what it computes is not known",
            fix="save it again with torch.jit.script, or export it with torch.onnx.export",
        )

    def function(self, name: str) -> ast.FunctionDef | ast.ClassDef:
        """Return a function, or a class that is made by its name (NamedTuple). Raises DamagedFileError."""
        found = self._definition(name)
        if isinstance(found, ast.FunctionDef | ast.ClassDef):
            return found
        raise DamagedFileError(f"its code has no {name[:100]}", why="its code calls it", fix=_DAMAGED)

    def _definition(self, dotted: str) -> ast.stmt | None:
        place, _, name = dotted.rpartition(".")
        path = place.replace(".", "/") + ".py"
        if path not in self._parsed:
            self._parsed[path] = self._parse(path)
        return self._parsed[path].get(name)

    def _parse(self, path: str) -> dict[str, ast.stmt]:
        text = self._files.get(path)
        if text is None:
            return {}
        try:
            with warnings.catch_warnings():  # of escapes in a damaged text
                warnings.simplefilter("ignore")
                tree = ast.parse(text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            said = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
            raise DamagedFileError(f"its code/{path[:100]} cannot be parsed: {said}", fix=_DAMAGED) from error
        return {s.name: s for s in tree.body if isinstance(s, ast.FunctionDef | ast.ClassDef)}


def _short(type_name: str) -> str:
    return type_name.removeprefix("__torch__.")[-80:]
