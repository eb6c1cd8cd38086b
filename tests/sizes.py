"""``python -m tests.sizes [REVISION]``: code lines of each room beside what it may have, and what was added.

A code line holds something besides a comment or a docstring. Without a revision the change is counted from the last
tag, where there is one. What a room may have stands in pyproject.toml (``[tool.sizes]``); status 1 where one has more.
"""

from __future__ import annotations

import ast
import io
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("signatures", "converters", "exporter", ".ci/src/export_model")
_NOT_CODE = frozenset(
    (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
)


def code_lines(text: str) -> int:
    """Return the lines of a module that hold code: no blank lines, comments or docstrings."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NOT_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if (
                isinstance(first, ast.Expr)
                and isinstance(first.value, ast.Constant)
                and isinstance(first.value.value, str)
            ):
                lines.difference_update(range(first.lineno, (first.end_lineno or first.lineno) + 1))
    return len(lines)


def room_of(path: str) -> str:
    """Return the room of a product file: its folder below the package, or the package for a file of its own."""
    parts = Path(path.removeprefix(".ci/src/")).parts
    return "/".join(parts[:2]) if len(parts) > 2 else parts[0]


def count_rooms(texts: Mapping[str, str]) -> Counter[str]:
    """Return code lines by room; ``texts``: path → text."""
    rooms: Counter[str] = Counter()
    for path, text in texts.items():
        rooms[room_of(path)] += code_lines(text)
    return +rooms  # a package's own __init__ has none


def here() -> dict[str, str]:
    """Return the product's modules as they are in the work tree."""
    files = (p for package in PACKAGES for p in sorted((ROOT / package).rglob("*.py")) if "node_modules" not in p.parts)
    return {str(p.relative_to(ROOT)): p.read_text(encoding="utf-8") for p in files}


def at(revision: str) -> dict[str, str]:
    """Return the product's modules as they were at a revision."""
    names = _git("ls-tree", "-r", "--name-only", revision, "--", *PACKAGES).splitlines()
    return {name: _git("show", f"{revision}:{name}") for name in names if name.endswith(".py")}


def allowed() -> dict[str, int]:
    """Return how many code lines each room may have."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        return dict(tomllib.load(file)["tool"]["sizes"])


def faults(rooms: Mapping[str, int], bounds: Mapping[str, int]) -> list[str]:
    """Return a sentence for each room that has more than it may, or of which nothing is said."""
    more = [
        f"{room} has {n} code lines and may have {bounds[room]}" for room, n in rooms.items() if n > bounds.get(room, n)
    ]
    return [
        *(f"{text}: take something out, or raise it in [tool.sizes] and say why in the commit" for text in more),
        *(f"{room} must have a number in [tool.sizes]" for room in rooms if room not in bounds),
        *(f"[tool.sizes] has {room}, which is no room" for room in bounds if room not in rooms),
    ]


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def _last_tag() -> str | None:
    tags = _git("tag", "--sort=-creatordate").split() if (ROOT / ".git").exists() else []
    return tags[0] if tags else None


def main() -> None:
    revision = sys.argv[1] if len(sys.argv) > 1 else _last_tag()
    rooms, bounds = count_rooms(here()), allowed()
    before = Counter[str]() if revision is None else count_rooms(at(revision))
    print(f"{'room':28}{'code':>8}{'may have':>10}" + ("" if revision is None else f"   since {revision}"))
    for room in sorted({*rooms, *before}):
        change = "" if revision is None else f"{rooms[room] - before[room]:>+10}"
        print(f"{room:28}{rooms[room]:>8}{bounds.get(room, 0):>10}{change}")
    total = "" if revision is None else f"{sum(rooms.values()) - sum(before.values()):>+10}"
    print(f"{'all':28}{sum(rooms.values()):>8}{sum(bounds.values()):>10}{total}")
    wrong = faults(rooms, bounds)
    print(*wrong, sep="\n", file=sys.stderr)
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
