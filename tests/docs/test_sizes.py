"""What a room may grow to: code lines are counted as pyproject.toml says, and one line too many is a fault."""

from __future__ import annotations

from tests import sizes

MODULE = '''"""A module.

Of two paragraphs."""

import os  # a comment

# another


def f() -> str:
    """One."""
    return """a
b"""
'''


def test_blank_lines_comments_and_docstrings_are_no_code() -> None:
    assert sizes.code_lines(MODULE) == 4
    assert sizes.code_lines("") == 0


def test_a_room_is_a_folder_of_a_package() -> None:
    texts = {"exporter/cli/main.py": "x = 1\n", "exporter/cli/a/b.py": "y = 1\n", "signatures/ids.py": "z = 1\n"}
    assert sizes.count_rooms(texts) == {"exporter/cli": 2, "signatures": 1}


def test_a_room_above_its_number_is_a_fault_and_so_is_one_without() -> None:
    assert sizes.faults({"a": 2}, {"a": 2}) == []
    (above,) = sizes.faults({"a": 3}, {"a": 2})
    assert above.startswith("a has 3 code lines and may have 2")
    assert len(sizes.faults({"a": 1}, {"b": 1})) == 2


def test_every_room_has_a_number() -> None:
    rooms = sizes.count_rooms(sizes.here())
    assert rooms.keys() == sizes.allowed().keys()
