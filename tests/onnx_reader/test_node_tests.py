"""A part of ONNX's own tests of its operators, and the page on all of them (docs/support-tables.md)."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.onnx_reader.node_tests import TITLE, collected, outcome
from tests.support_tables import section

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning"),  # what onnx pads with is NaN, cast to integers
]


def test_what_is_converted_is_right_and_what_is_refused_stands_on_the_page(tmp_path: Path) -> None:
    page = section(TITLE)
    assert "\n0 give others," in page
    for test in collected()[7::25]:
        found = outcome(test, tmp_path, None)
        assert found.state != "wrong", (test.name, found.reason)
        if found.state == "refused":
            rows = [line for line in page.splitlines() if line.startswith(f"- {found.reason} (")]
            operator = test.subject.partition(",")[0]
            assert any(operator in row.rpartition("): ")[2].split(", ") for row in rows), test.name
