"""Each file of docs/interface.md beside what inspect says of it, word for word."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import ROOT, export_model
from tests.docs.blocks import Block, blocks
from tests.interfaces.made import write_onnx


def pairs() -> Iterator[tuple[Block, Block]]:
    """The files of the page, each with the block of text behind it."""
    found = blocks(ROOT / "docs" / "interface.md")
    for block, behind in itertools.pairwise(found):
        if block.language in ("yaml", "json") and behind.language == "text":
            yield block, behind


PAIRS = list(pairs())


def said_of(block: Block, folder: Path) -> str:
    """What inspect says of a policy, 8 numbers to 2, beside which a block's file lies."""
    folder = folder / "walker"
    folder.mkdir()
    source = folder / "walker.bytes"
    shutil.copy(ROOT / "fixtures" / "continuous.bytes", source)
    if block.language == "yaml":
        name = block.text.splitlines()[0].removeprefix("# ")
        (folder / name).write_text(block.text)
    elif "interface" in json.loads(block.text):
        (folder / "labels.json").write_text(block.text)
        asked = ("--labels", folder / "labels.json", "--to", "onnx", "--verify", "none")
        assert export_model(source, "-o", folder / "out", *asked).status == 0
        source = folder / "out" / "walker"
    else:
        source = write_onnx(folder / "walker.onnx", 8, 2, json.loads(block.text))
    ran = export_model("inspect", source)
    assert ran.status == 0, ran.err
    return " ".join(ran.out.split())


@pytest.mark.parametrize("number", range(len(PAIRS)))
def test_inspect_says_what_the_page_shows(tmp_path: Path, number: int) -> None:
    block, shown = PAIRS[number]
    said = said_of(block, tmp_path)
    for line in shown.text.splitlines():
        assert " ".join(line.split()) in said, f"{shown.where}: {said}"


def test_the_page_has_every_kind() -> None:
    assert len(PAIRS) == 8
