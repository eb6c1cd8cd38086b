"""The program's own words: functions are named by verbs or results, and messages say what must be.

The numbers are ratchets: what is left of an older style. They go down with it, and never up.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("signatures", "converters", "exporter", "fixtures")
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
#: Words of an older English that readers stumbled over, in strings that are printed or written.
OLD = re.compile(r"\b(?:stands?|lies?|of (?:its|their|your) own|(?:is|are|was|were) told)\b")
#: Strings with one: source code that is written for C, C# and JavaScript has most of them.
OLD_WORDS = 19
#: Our own word for something → what a reader knows it by. ``self-consistent`` is a verdict, and is explained beside it.
PRIVATE = ("reading of the original", "unknown profile", "formats are self-consistent")


def trees() -> Iterator[ast.Module]:
    for room in ROOMS:
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


def messages(tree: ast.Module, pattern: str | re.Pattern[str]) -> list[str]:
    """The strings that are not docstrings in which the pattern is found."""
    bodies = (n.body for n in ast.walk(tree) if isinstance(n, ast.Module | ast.ClassDef | ast.FunctionDef))
    docs = {id(body[0].value) for body in bodies if body and isinstance(body[0], ast.Expr)}
    strings = (n for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str))
    return [s.value for s in strings if id(s) not in docs and re.search(pattern, s.value)]


def is_no(tree: ast.Module) -> list[str]:
    """The messages with "is no"."""
    return messages(tree, r"\bis no\b")


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


def test_messages_are_in_plain_english() -> None:
    found = [text for tree in trees() for text in messages(tree, OLD)]
    assert len(found) <= OLD_WORDS, f"is, is in, is at, its own, is given: {found}"
    private = [text for tree in trees() for text in messages(tree, "|".join(PRIVATE))]
    assert not private, private


def test_an_old_word_is_known() -> None:
    tree = ast.parse('"""It stands."""\nx = f"{x} lies in a file"\ny = "it has a memory of its own"\nz = "a stand-in"')
    assert sorted(messages(tree, OLD)) == [" lies in a file", "a stand-in", "it has a memory of its own"]


#: Another project's file, whose name one of ours had.
THEIRS = {("converters/formats/barracuda/format.py", "barracuda.py")}


def files_named(text: str) -> set[str]:
    """The modules that docstrings and comments of a module name, with as much of their path as stands there."""
    nodes = (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Module | ast.ClassDef | ast.FunctionDef))
    words = [ast.get_docstring(n) or "" for n in nodes]
    words += [t.string for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.COMMENT]
    return {name for word in words for name in re.findall(r"[\w/-]*\b\w+\.(?:py|mjs)\b", word)}


def test_a_file_is_found_where_it_is_named() -> None:
    assert files_named('"""As (a/b.py)."""\nx = "c.py"  # of d_e.mjs, f.pyc') == {"a/b.py", "d_e.mjs"}


def test_no_docstring_names_a_file_that_is_gone() -> None:
    """What it names is here, or another project's: never one that this repository had."""
    said = ["git", "log", "--no-renames", "--diff-filter=D", "--name-only", "--format=", "--", *ROOMS]
    done = subprocess.run(said, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    gone = set(done.stdout.split())
    if not gone:
        pytest.skip("no history here; a whole clone has it: git fetch --unshallow")
    paths = [p for room in ROOMS for p in (ROOT / room).rglob("*") if p.suffix in (".py", ".mjs")]
    here = {f"/{p.relative_to(ROOT).as_posix()}" for p in paths if "node_modules" not in p.parts}
    wrong = [
        (path, name)
        for path in sorted(here)
        if path.endswith(".py")
        for name in files_named((ROOT / path[1:]).read_text(encoding="utf-8"))
        if not any(other.endswith(f"/{name}") for other in here) and any(f"/{g}".endswith(f"/{name}") for g in gone)
    ]
    assert {(path[1:], name) for path, name in wrong} - THEIRS == set()
