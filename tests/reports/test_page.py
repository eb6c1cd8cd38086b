"""The HTML page: parsed, self-contained, every name escaped."""

from __future__ import annotations

import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from export_model.exporter.reports import charts
from export_model.exporter.reports.entry import Entry, of_bundle, of_result
from export_model.exporter.reports.markdown import markdown_text
from export_model.exporter.reports.page import page
from export_model.exporter.reports.sections import first_values
from export_model.exporter.verify.findings import Rollout
from export_model.exporter.verify.options import VerifyOptions
from fixtures import path as fixture
from tests.exporter.rehearsal import ActingPool, export
from tests.reports.made import FAILING, PASSING, UNVERIFIED, entry

VOID = {"meta", "br", "hr", "wbr"}


class Page(HTMLParser):
    """Elements, attributes and text; fails where elements do not close in their order."""

    def __init__(self, source: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(source)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("style", "title"):
            self.words.append(data)

    def count(self, tag: str) -> int:
        return Counter(t for t, _ in self.elements)[tag]


def is_self_contained(source: str, parsed: Page) -> None:
    assert not {tag for tag, _ in parsed.elements} & {
        "script",
        "link",
        "img",
        "iframe",
        "object",
        "embed",
        "base",
        "form",
    }
    for _, attributes in parsed.elements:
        assert not any(name.startswith("on") or name in ("src", "srcset", "style", "action") for name in attributes)
        assert (attributes.get("href") or "#").startswith("#")
    assert not re.search(r"url\(|@import|@font-face", source)


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory: pytest.TempPathFactory) -> tuple[Entry, Path]:
    """A real bundle of a straight recurrent policy, played runtimes, and where it is."""
    folder = tmp_path_factory.mktemp("bundles")
    with pytest.MonkeyPatch.context() as patch:
        refusing = ActingPool(refused=frozenset({("source", "tensorflow")}))
        first = export(patch, fixture("recurrent"), folder / "first", refusing)[0]
        options = VerifyOptions(steps=3)

        def spoil(kind: str, runtime: str, answer: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            moved = {"recurrent_out"} if (kind, runtime) == ("onnx", "onnxruntime") else set()
            return {n: a + np.float32(1e-3) if n in moved else a for n, a in answer.items()}

        result = export(patch, first.folder / "recurrent.bytes", folder / "second", ActingPool(spoil), parity=options)[
            0
        ]
    made = of_result(result, 3)
    assert made is not None
    return made, result.folder


def test_a_page_shows_all_that_is_known_of_a_policy(recurrent: tuple[Entry, Path]) -> None:
    made, folder = recurrent
    source = page([made])
    parsed = Page(source)
    is_self_contained(source, parsed)
    for words in (
        *("What disagrees", "Agreement", "How differences are distributed", "Memory", "The policy", "Worst inputs"),
        *("Tolerances", "Runtimes", "Sizes", "LSTM 16", "dense 32, swish", "recurrent_out differs by 0.001"),
        *("First difference:", "Smallest tolerance that would pass", "onnx in onnxruntime", "discrete, 3 + 2"),
    ):
        assert words in parsed.text, words
    case = max((c for c in made.report.failures if c.output == "recurrent_out"), key=lambda c: c.max_abs_diff)
    assert first_values(made.feeds(str(case.worst_input))["state"]) in parsed.text
    assert [t for t, _ in parsed.elements].index("h1") < [t for t, _ in parsed.elements].index("h2")
    assert parsed.count("h1") == 1
    assert page([of_bundle(made.report, folder, None, 3)]).count("<rect") == source.count("<rect")


def test_it_can_be_read_without_eyes(recurrent: tuple[Entry, Path]) -> None:
    parsed = Page(page([recurrent[0], entry(PASSING)]))
    assert parsed.count("caption") == parsed.count("table") > 5
    assert all(a.get("scope") in ("row", "col") for t, a in parsed.elements if t == "th")
    assert all(a.get("role") == "img" and a.get("aria-label") for t, a in parsed.elements if t == "svg")
    scrolling = [a for _, a in parsed.elements if a.get("class") == "scroll"]
    assert all(a.get("tabindex") == "0" and a.get("aria-label") for a in scrolling)
    names = [a["id"] for _, a in parsed.elements if "id" in a]
    assert len(names) == len(set(names))
    links = [str(a["href"])[1:] for _, a in parsed.elements if "href" in a]
    assert links and set(links) <= set(names)
    assert ("html", {"lang": "en"}) in parsed.elements


def test_failed_policies_come_first() -> None:
    text = Page(page([entry(PASSING), entry(UNVERIFIED), entry(replace(FAILING, policy="broken"))])).text
    assert text.index("broken") < text.index("Not verified") < text.index("Passed")


def test_many_policies_begin_with_a_coloured_table_of_formats_and_runtimes() -> None:
    far = tuple(
        replace(c, share=0.7, rounding=1e-3) if c.output == "value_estimate" else c for c in PASSING.comparisons
    )
    policies = [PASSING, replace(PASSING, policy="far", comparisons=far), replace(FAILING, policy="broken")]
    source = page([entry(report) for report in policies])
    colours = [a["class"] for t, a in Page(source).elements if t == "td" and "heat" in str(a.get("class"))]
    assert set(colours) == {"heat low", "heat rounding", "heat over"}
    source = page([entry(PASSING), entry(replace(PASSING, comparisons=(replace(far[0], rounding=1e-3),)))])
    assert 'class="heat rounding"' in source
    assert "reference" in Page(source).text
    parts = [a for t, a in Page(page([entry(report) for report in policies])).elements if t == "details"]
    opened = [a for a in parts if a.get("class") == "policy" and "open" in a]
    assert len(opened) == 1 and sum(a.get("class") == "policy" for a in parts) == 3  # what failed is open


def test_the_tolerance_is_the_middle_of_its_axis() -> None:
    source = charts.histograms("action", [c for c in PASSING.comparisons if any(c.histogram)][:1])
    (bound,) = re.findall(r'class="bound" x1="([\d.]+)"', source)
    bars = [float(x) for x in re.findall(r'class="bar"[^>]* x="([\d.]+)"', source)]
    (line,) = re.findall(r'class="axis" x1="[\d.]+" x2="([\d.]+)"', source)
    begin = 2 + 17 + 18
    assert float(bound) == pytest.approx((begin + float(line)) / 2)
    assert all(x <= float(line) for x in bars)


def test_a_report_says_the_command_that_makes_it(recurrent: tuple[Entry, Path]) -> None:
    made, folder = recurrent
    assert f"To compare again: export-model verify {folder} --runtimes " in Page(page([made])).text
    fetched = of_bundle(made.report, folder, Path("https://example.org/recurrent"), 3)
    assert "again: export-model verify https://example.org/recurrent --runtimes " in Page(page([fetched])).text
    assert "To compare again" not in Page(page([entry(PASSING)])).text
    other = replace(entry(PASSING), command=("compare", "a b.onnx", "c.onnx"))
    assert "export-model compare 'a b.onnx' c.onnx --runtimes onnxruntime --seed 3" in Page(page([other])).text


def test_no_light_or_dark_text_is_too_faint() -> None:
    """WCAG AA, 4.5 : 1, for every pair of colours that text is set in."""
    css = (Path(__file__).parents[2] / "exporter" / "reports" / "page.css").read_text()
    for block in re.findall(r":root \{(.*?)\}", css, re.S):
        colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]+)", block))
        pairs = [(ink, "paper") for ink in ("ink", "soft", "good", "bad", "warn", "accent")]
        pairs += [(ink, f"{ink}-wash") for ink in ("good", "bad", "warn")] + [("ink", "wash"), ("ink", "good-wash")]
        for ink, paper in pairs:
            light, dark = sorted((luminance(colours[ink]), luminance(colours[paper])), reverse=True)
            assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, paper)


def luminance(colour: str) -> float:
    digits = colour[1:] if len(colour) == 7 else "".join(2 * d for d in colour[1:])
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@given(
    st.sampled_from(["<script>alert(1)</script>", '"><img src=//x onerror=y>', "]]>", "&lt;", "\0\ud800"])
    | st.text(min_size=1)
)
def test_every_name_is_text(name: str) -> None:
    hostile = replace(FAILING.comparisons[-1], reason=name, output=name, format=name, runtime=name, worst_input=name)
    numbers = replace(FAILING.comparisons[4], output=name, format=name, runtime=name)
    rolled = replace(FAILING.comparisons[5], output=name, drift=(1e-3, 2e-3))
    report = replace(
        FAILING,
        policy=name,
        comparisons=(hostile, numbers, rolled),
        notes=(name,),
        sizes={name: 1},
        runtimes={name: {"version": name, "status": "not run", "reason": name}},
    )
    source = page([entry(report)])
    source.encode()
    parsed = Page(source)
    is_self_contained(source, parsed)
    plain = Page(page([entry(replace(report, policy="x"))]))
    assert [t for t, _ in parsed.elements] == [t for t, _ in plain.elements]


def test_a_report_of_one_policy_is_called_by_it_and_its_source(recurrent: tuple[Entry, Path]) -> None:
    assert "<title>recurrent from recurrent.bytes: parity report</title>" in page([recurrent[0]])
    assert f"<title>{PASSING.policy}: parity report</title>" in page([entry(PASSING)])  # no bundle says the source


def test_runtimes_that_nobody_asked_for_are_not_listed() -> None:
    states = {
        **PASSING.runtimes,
        "csharp": {"version": None, "status": "not run", "reason": "not installed; get mono"},  # of another format
        "tfjs-wasm": {"version": "4.22", "status": "not run", "reason": "not asked for"},
    }
    made = entry(replace(PASSING, runtimes=states))
    assert list(made.missing) == ["tfjs-cpu"]
    for text in (Page(page([made])).text, markdown_text([made])):
        assert "runtimes install tfjs" in text
        assert "get mono" not in text and "not asked for" not in text


def test_a_drift_is_drawn_only_where_it_takes_a_part_of_the_tolerance() -> None:
    def memory(*drift: float) -> str:
        moved = (replace(c, drift=drift) if isinstance(c, Rollout) else c for c in PASSING.comparisons)
        return page([entry(replace(PASSING, comparisons=tuple(moved)))]).partition("<h3>Memory</h3>")[2]

    assert "Fed back in each runtime, every step differs by at most 9e-07, less than a tenth" in memory(0.0, 9e-7)
    assert "every step is equal" in memory(0.0, 0.0)
    assert "Chart of action" in memory(0.0, 2e-6)


def test_a_long_list_of_what_was_forgiven_is_closed() -> None:
    rounded = [replace(c, rounding=1e-3) for c in PASSING.comparisons if c.histogram]
    few = Page(page([entry(replace(PASSING, comparisons=tuple(rounded)))]))
    many = Page(page([entry(replace(PASSING, comparisons=tuple(rounded * 9)))]))
    assert many.count("details") == few.count("details") + 1
    assert "Above the tolerance, but within what float32 rounding explains" in many.text
