"""A few mutants as our messages and Google's read them, and that a difference is seen."""

from __future__ import annotations

from tests.fuzz.differential import CODECS, compared, differences, run
from tests.fuzz.seeds import mutant


def test_onnx_reads_what_we_read() -> None:
    counts, differing = run("ONNX", 0, 60)
    assert not differing
    assert counts["agree"] > 20
    assert counts.total() >= 60


def test_a_field_that_is_read_otherwise_is_seen() -> None:
    """The same bytes as a message whose field 1 is another one."""
    theirs = CODECS["ONNX"][2]()
    data = next(iter(mutant("ONNX", 1).values()))
    assert compared("ONNX", data, theirs)[0] in ("agree", "both refuse")
    good = theirs(ir_version=8)
    good.graph.name = "g"
    what, found = compared("ONNX", good.SerializeToString(), theirs)
    assert (what, found) == ("agree", [])
    ours = CODECS["ONNX"][1].FromString(good.SerializeToString())
    good.graph.name = "other"
    assert differences(ours, good) == [("GraphProto", "name", ".graph.name")]
