"""The program's own words: functions are named by verbs or results, and messages say what must be.

The numbers are ratchets: what is left of an older style. They go down with it, and never up.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
#: Participles that do not end in -ed.
IRREGULAR = re.compile(
    "begun|bent|bought|bound|broken|brought|built|caught|chosen|cut|dealt|drawn|driven|fallen|fed|felt|forgotten|"
    "found|given|gone|grown|heard|held|hidden|hung|kept|known|laid|led|left|lost|made|meant|met|paid|proven|read|"
    "rebuilt|remade|rewritten|said|seen|sent|set|shown|sought|spelt|spent|split|spoken|spun|stolen|stood|struck|"
    "taken|taught|thought|told|torn|understood|undone|unknown|unread|unseen|won|woven|written|wrung"
)
#: What is a participle and a verb, or only ends like one.
VERBS = re.compile("cut|embed|exceed|feed|led|need|proceed|read|reseed|seed|set|speed|split|succeed")
#: Functions named by a lone participle. What is left are answers of yes or no that users know from JSON (``passed``,
#: ``accepted``, ``proven``), and methods of the writers of LiteRT and of source code.
PARTICIPLES = 36
#: Strings with "is no".
IS_NO = 0


def trees() -> Iterator[ast.Module]:
    for room in ("signatures", "converters", "exporter", "fixtures"):
        for path in sorted((ROOT / room).rglob("*.py")):
            if "node_modules" not in path.parts:
                yield ast.parse(path.read_text(encoding="utf-8"))


def is_participle(name: str) -> bool:
    word = name.strip("_")
    participle = IRREGULAR.fullmatch(word) or re.fullmatch("[a-z]+ed", word)
    return participle is not None and VERBS.fullmatch(word) is None


def participles(tree: ast.Module) -> list[str]:
    functions = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef))
    return [f.name for f in functions if is_participle(f.name)]


def is_no(tree: ast.Module) -> list[str]:
    """The strings with "is no" that are not docstrings."""
    bodies = (n.body for n in ast.walk(tree) if isinstance(n, ast.Module | ast.ClassDef | ast.FunctionDef))
    docs = {id(body[0].value) for body in bodies if body and isinstance(body[0], ast.Expr)}
    strings = (n for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str))
    return [s.value for s in strings if id(s) not in docs and re.search(r"\bis no\b", s.value)]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("def told(): ...", ["told"]),
        ("def _joined(): ...", ["_joined"]),
        ("def read(): ...\ndef join_memory(): ...", []),
    ],
)
def test_a_participle_is_known(text: str, names: list[str]) -> None:
    assert participles(ast.parse(text)) == names


def test_a_docstring_may_say_is_no() -> None:
    assert is_no(ast.parse('"""A is no B."""\nx = "a is no b"\ny = f"{x} is no c"\nz = "is not d"')) == [
        "a is no b",
        " is no c",
    ]


def test_functions_are_verbs_or_what_they_return() -> None:
    found = [name for tree in trees() for name in participles(tree)]
    assert len(found) <= PARTICIPLES, f"name new ones by a verb or by what they return: {sorted(found)}"


def test_messages_say_what_must_be() -> None:
    found = [text for tree in trees() for text in is_no(tree)]
    assert len(found) <= IS_NO, f"say what must be, what is missing or unknown: {found}"
