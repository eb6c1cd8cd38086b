"""docs/figures.md is what ``python -m tests.figures`` wrote, and what other pages quote of it is there."""

from __future__ import annotations

import json

from export_model.converters.runtimes.pool import INDEPENDENT
from tests import figures
from tests.commands import ROOT
from tests.reports.made import comparison

CONTENT = json.loads(figures.FIGURES.read_text(encoding="utf-8"))
INDEX = (ROOT / "docs/index.md").read_text(encoding="utf-8")


def test_the_page_is_that_of_the_figures() -> None:
    text = figures.PAGE.read_text(encoding="utf-8")
    assert text[: text.index(figures.REST)] == figures.page(CONTENT)


def test_what_is_measured_is_what_the_page_reads() -> None:
    cell = figures.Cell()
    cell.add("3DBall", comparison("onnx", "onnxruntime"))
    assert set(CONTENT["cells"][0]) - {"kind", "format", "runtime"} == set(cell.to_dict())


def test_no_policy_acts_otherwise_under_a_profile() -> None:
    counted = CONTENT["unity"]
    assert not any(cell["wrong"] for cell in counted["profiles"])
    for cell in counted["profiles"]:
        assert cell["held"] + sum(cell["refused"].values()) == counted["policies"]


def test_what_the_front_page_quotes() -> None:
    cells = CONTENT["cells"]
    comparisons, _ = figures.counted(CONTENT)
    runtimes = sum(name in INDEPENDENT for name in CONTENT["runtimes"])
    assert f"{comparisons:,} comparisons in {runtimes} runtimes" in INDEX
    readme, index = (" ".join(text.split()) for text in ((ROOT / "README.md").read_text(encoding="utf-8"), INDEX))
    trained = f"{CONTENT['policies']['corpus']} trained policies from public repositories"
    written = f"and {CONTENT['policies']['genuine']} that the"
    claim = (
        f"0 of {comparisons:,} comparisons failed · {trained} {written} original trainers wrote · {runtimes} runtimes ·"
    )
    assert claim in readme
    assert f"{trained}, {written} trainers of ML-Agents 0.3 to 0.22 wrote" in index and "random weights" in index
    assert not CONTENT["failed"]
    assert sum(c["failures"] for c in cells) == 0
    elements = [(float(d), n) for c in cells for d, n in c["elements"].items() if c["runtime"] != "numpy"]
    below = sum(n for decade, n in elements if decade < 0.99e-5)
    assert below / sum(n for _, n in elements) > 0.998
