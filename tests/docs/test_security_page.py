"""docs/security.md says of each sentence by which probe it is held, and the probes are there."""

from __future__ import annotations

import re

import pytest

from export_model.converters.compiler.options import MAX_PORTS
from export_model.converters.compiler.passes.unroll import MAX_POLICY_NODES
from export_model.converters.files.fetch import MAX_BYTES, MAX_WEIGHTS
from export_model.converters.files.message_limits import MAX_FIELDS
from export_model.converters.files.tensorflow_messages import MAX_GRAPHDEF_NODES
from export_model.signatures.bounded import MAX_VALUES
from tests.commands import ROOT
from tests.hostile import zoo
from tests.hostile.test_files_in_place_of_weights import CASES as SOURCES
from tests.hostile.test_files_in_place_of_weights import ODD
from tests.runtimes.test_confinement import ATTEMPTS

PAGE = (ROOT / "docs/security.md").read_text(encoding="utf-8")
BODY, *_ = PAGE.partition("## What is not defended")
NOTES = dict(re.findall(r"^\[\^(\w+)\]: (.+)$", PAGE, re.MULTILINE))
#: Sections whose rows name their probes themselves, in a column.
TRIED = "## What was tried"
#: Where a sentence ends: at a stop, with its marks, before the next begins.
END = re.compile(r"(?<=[.:])\**((?:\[\^\w+\])*)(?=\s+[A-Z`*]|\s*$)")


def sentences() -> list[str]:
    """All of the page that claims something: sentences, and the cells of tables."""
    text = re.sub(r"^```.*?^```$", "", BODY.partition(TRIED)[0], flags=re.MULTILINE | re.DOTALL)
    found = []
    for block in re.split(r"\n\n|\n(?=- )", text):
        if block.startswith("#") or not block.strip():
            continue
        if block.startswith("|"):
            rows = [row.strip("|").split(" | ") for row in block.splitlines()[2:]]
            found += [cell.strip() for row in rows for cell in row[1:]]
            continue
        joined, at = " ".join(block.split()), 0
        for end in END.finditer(joined):
            found.append(joined[at : end.end()])
            at = end.end()
        assert not joined[at:].strip(), f"no stop: {joined[at:]}"
    return found


@pytest.mark.parametrize("sentence", sentences(), ids=lambda text: text[:40])
def test_a_sentence_says_by_which_probe_it_is_held(sentence: str) -> None:
    marks = re.findall(r"\[\^(\w+)\]", sentence)
    assert marks, "its probe, or [^you]"
    assert set(marks) <= NOTES.keys()


@pytest.mark.parametrize("name", NOTES)
def test_a_probe_is_there_and_asked_for(name: str) -> None:
    assert f"[^{name}]" in BODY
    probes = re.findall(r"`([\w/.]+\.py)(?:::(\w+))?`", NOTES[name])
    assert probes or NOTES[name].startswith("No probe: ")
    for file, test in probes:
        assert f"def {test or 'test_'}" in (ROOT / file).read_text(encoding="utf-8")


def test_the_page_counts_the_attempts() -> None:
    assert f"| {len(ATTEMPTS)} attempts, by each kind of child |" in PAGE
    assert f"| {len(zoo.CASES)} cases |" in PAGE
    assert f"| {len(ODD)} kinds, {len(ODD) * len(SOURCES)} files |" in PAGE


def test_the_page_says_the_limits() -> None:
    text = " ".join(PAGE.split())
    assert f"a graph of {MAX_GRAPHDEF_NODES:,} nodes, a policy of {MAX_POLICY_NODES:,}, {MAX_PORTS:,} inputs or" in text
    assert (MAX_BYTES + 1, MAX_WEIGHTS) == (2 << 30, 16 << 30)
    assert "a file of 2 GiB, 16 GiB of external weights" in text
    assert (MAX_FIELDS, MAX_VALUES) == (3 << 20, 1 << 22)
    assert "protobuf files (3 << 20) and the values of JSON (1 << 22) are counted" in text


def test_what_was_tried_is_kept_somewhere() -> None:
    rows = BODY.partition(TRIED)[2].split("|---|---|---|---|\n")[1].strip().splitlines()
    for row in rows:
        kept = row.strip("| ").split(" | ")[-1]
        for place in re.findall(r"`([^`]+)`", kept):
            path = place.removeprefix("python -m ").replace(".", "/") if "python -m" in place else place
            if path.startswith("make "):
                continue
            assert (ROOT / path).exists() or (ROOT / f"{path}.py").exists() or (ROOT / "tests/hostile" / path).exists()
