"""The parts of the HTML page: each takes an entry and gives its section, or None where it has nothing to say."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from export_model.converters.interfaces.text import loop_lines, tables
from export_model.exporter.markup import Child, Markup, el
from export_model.exporter.reports import charts
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.layers import blocks_of
from export_model.exporter.tables import command_text, count_text, size_with_original
from export_model.exporter.verify.findings import Failure, Finding, Rollout
from export_model.exporter.verify.plays import CONFIDENCE
from export_model.signatures.spec import TensorSpec

_SHOWN_VALUES = 12
#: More boxes than this are no picture any more.
_MOST_BLOCKS = 90
_MOST_NODES = 3000
#: A drift that never takes this share of the tolerance is a sentence, not a chart.
_SEEN = 0.1
_MOST_FAILURES = 40
#: Rows of a table of what was forgiven that stays open.
_MOST_OPEN = 8


def section(title: str, *content: Child) -> Markup:
    """A heading and what is under it."""
    return el("section", el("h3", title), content)


def table(caption: str, head: Sequence[Child], rows: Iterable[Sequence[Child]], numbers: Sequence[int] = ()) -> Markup:
    """A table that scrolls in its own box; the first cell of a row is its heading. ``numbers`` are right-aligned."""
    kinds = ["number" if i in numbers else None for i in range(len(head))]
    heads = [el("th", h, scope="col", class_=k) for h, k in zip(head, kinds, strict=True)]
    body = []
    for row in rows:
        first, *rest = row
        cells: list[Child] = [el("th", first, scope="row")]
        for cell, kind in zip(rest, kinds[1:], strict=True):
            is_cell = isinstance(cell, Markup) and cell.startswith("<td")
            cells.append(cell if is_cell else el("td", cell, class_=kind))
        body.append(el("tr", cells))
    small = "small" if len(head) < 4 else None
    whole = el(
        "table", el("caption", el("span", caption)), el("thead", el("tr", heads)), el("tbody", body), class_=small
    )
    return el("div", whole, class_="scroll", tabindex=0, role="group", aria_label=caption)


def interface(entry: Entry) -> Markup | None:
    """What the source and the files beside it state of the policy's numbers."""
    signature = entry.signature
    if signature is None or signature.interface is None:
        return None
    shown = [table(f"Interface of {name}", head, rows) for name, head, rows in tables(signature)]
    lines = [el("li", line) for line in loop_lines(signature.interface)]
    return section("Interface", shown, el("ul", lines) if lines else None)


def _wide(*content: Child) -> Markup:
    return el("td", content, class_="wide")


def facts(entry: Entry) -> Markup:
    """What the policy is and how it was verified."""
    report, signature = entry.report, entry.signature
    found: list[tuple[str, Child]] = []
    if signature is not None:
        found.append(("Trained with", signature.family))
        branches = f", {' + '.join(map(str, signature.branches))}" if signature.branches else ""
        found.append(("Actions", signature.action_space + branches))
    if entry.contract is not None:
        found.append(("Source", el("code", entry.contract.origin.path)))
    found += [
        ("Reference", el("code", report.reference)),
        ("Comparisons", f"{len(report.comparisons)} ({len(report.failures)} disagree)"),
        ("Inputs", f"seed {report.seed}, {report.samples} typical per batch size"),
    ]
    return el("dl", [el("div", el("dt", k), el("dd", v)) for k, v in found], class_="facts")


def again(entry: Entry) -> Markup | None:
    """The command that makes the same comparison once more."""
    report = entry.report
    if not entry.command:
        return None
    ran = [name for name, state in report.runtimes.items() if state["status"] == "ran" and name != "numpy"]
    chosen = ["--runtimes", ",".join(ran)] if ran else ["--allow-unverified"]
    numbers = ["--seed", str(report.seed), "--samples", str(report.samples), "--steps", str(entry.steps)]
    line = command_text(*entry.command, *chosen, *numbers)
    command = el("div", el("code", line), class_="scroll", tabindex=0, role="group", aria_label="To compare again")
    return el("div", el("p", "To compare again:"), command, class_="soft again")


def failures(entry: Entry) -> Markup | None:
    """Every comparison that failed, by format and runtime: by how much, the first tensor that differs, what passes."""
    failed = entry.report.failures
    if not failed:
        return None
    groups: dict[str, list[Child]] = {}
    for c in failed[:_MOST_FAILURES]:
        groups.setdefault(c.where, []).append(_failure(c))
    cards = [el("div", el("h4", where), content, class_="failure") for where, content in groups.items()]
    more = len(failed) - _MOST_FAILURES
    return section("What disagrees", cards, el("p", f"And {more} more: see parity.json.") if more > 0 else None)


def _failure(c: Finding) -> Markup:
    first, *rest = c.explanation()
    says = first.removeprefix(f"{c.where}: ")
    name = None if c.output == "*" else el("code", c.output)
    lines = [el("p", f"{line[:1].upper()}{line[1:]}.", class_="soft") for line in rest]
    return el("div", el("p", name, says.removeprefix(c.output)), lines, class_="detail")


def agreement(entry: Entry) -> Markup:
    """Format × runtime × output, the worst difference of each."""
    report, rows = entry.report, []
    for pair in report.pairs:
        verdict = el("td", f"{'✓' if pair.passed else '✗'} {pair.word}", class_="ok" if pair.passed else "fail")
        size = el("td", size_with_original(pair.format, report.sizes, report.whole_sizes), class_="number")
        worst = [_cell(pair.worst.get(output)) for output in report.outputs]
        rows.append([_breakable(pair.format), pair.runtime, verdict, size, *worst])
    head = ("format", "runtime", "verdict", "size", *report.outputs)
    caption = "Largest difference from the reference over all inputs, as a share of what is allowed, per output"
    return section("Agreement", table(caption, head, rows, range(3, len(head))))


def excuses(entry: Entry) -> Markup | None:
    """Which rules forgave a difference beyond the tolerance, of which elements."""
    rows = [
        (_breakable(c.format), c.runtime, c.output, f.excuse.title, f"{f.elements:,} of {c.elements:,}", _most(f.most))
        for c in entry.report.comparisons
        for f in c.forgiven
    ]
    head = ("format", "runtime", "output", "rule", "elements", "largest difference")
    caption = "Elements beyond the tolerance that a rule forgave: docs/agreement.md says what each may hide"
    return section("Forgiven", _closed_table(caption, head, rows, (4, 5))) if rows else None


def _closed_table(
    caption: str, head: Sequence[Child], rows: Sequence[Sequence[Child]], numbers: Sequence[int] = ()
) -> Markup:
    """A table that says one thing often: closed where it is long."""
    whole = table(caption, head, rows, numbers)
    return whole if len(rows) <= _MOST_OPEN else el("details", el("summary", f"{caption} ({len(rows)} rows)"), whole)


def _most(difference: float) -> str:
    return f"{difference:.2g}" if math.isfinite(difference) else ""


def _breakable(name: str) -> Child:
    head, colon, rest = name.partition(":")
    return [head, colon, el("wbr"), rest] if colon else name


def _cell(worst: Finding | None) -> Markup:
    if worst is None:
        return el("td", "–", class_="number soft")
    title = f"|Δ| {worst.max_abs_diff:.1e}" if worst.measured else None
    return el("td", el("span", worst.short(), title=title), class_="number" if worst.passed else "number fail")


def spread(entry: Entry) -> Markup | None:
    """Histograms of the differences."""
    counted = [c for c in entry.report.comparisons if any(c.histogram)]
    if not counted:
        return None
    figures, same = [], []
    for output in dict.fromkeys(c.output for c in counted):
        group = [c for c in counted if c.output == output]
        equal = [c for c in group if not any(c.histogram[1:])]
        if len(equal) == len(group):
            same.append(output)
            continue
        differing = [c for c in group if c not in equal]
        figures.append(_figure(output, charts.histograms(output, differing), _equal_text(equal)))
    text = (
        "How many elements differ by how much, over all inputs; each bar is a decade of |Δ|, its height the square "
        "root of the count. The dashed line is the absolute tolerance; the bar on the left counts equal elements."
    )
    return section(
        "How differences are distributed",
        el("p", text, class_="soft") if figures else None,
        el("div", figures, class_="figures") if figures else None,
        el("p", f"Equal to the last bit in all: {', '.join(same)}.", class_="soft") if same else None,
    )


def _equal_text(equal: Sequence[Finding]) -> str | None:
    """Who was exactly the reference: they would be drawn as a line on the floor."""
    return f"Equal to the last bit: {', '.join(dict.fromkeys(c.where for c in equal))}." if equal else None


def _figure(title: str, picture: Markup, caption: str | None) -> Markup:
    box = el("div", picture, class_="scroll", tabindex=0, role="group", aria_label=f"Chart of {title}")
    return el("figure", el("h4", el("code", title)), box, el("figcaption", caption) if caption else None)


def memory(entry: Entry) -> Markup | None:
    """Drift of the rollout, a chart per output."""
    rolled = [c for c in entry.report.comparisons if isinstance(c, Rollout) and c.drift]
    if not rolled:
        return None
    moving = [c for c in rolled if _is_seen(c)]
    if not moving:
        most = max((d for c in rolled for d in c.drift if math.isfinite(d)), default=0)
        said = f"differs by at most {most:.1g}, less than a tenth of the tolerance" if most else "is equal"
        return section("Memory", el("p", f"Fed back in each runtime, every step {said}.", class_="soft"))
    pairs = list(dict.fromkeys((c.format, c.runtime) for c in moving))
    figures = []
    for output in dict.fromkeys(c.output for c in moving):
        group = [c for c in rolled if c.output == output]
        picture = charts.drift(output, [c for c in group if c in moving], pairs)
        figures.append(_figure(output, picture, _equal_text([c for c in group if not any(c.drift)])))
    key = [
        el("li", el("i", class_=charts.colour_of(n)), f"{kind} · {runtime}") for n, (kind, runtime) in enumerate(pairs)
    ]
    bound = el("li", el("i", class_="dash"), "absolute tolerance")
    return section(
        "Memory",
        el("p", "The worst |Δ| of each step, the memory fed back in each runtime.", class_="soft"),
        el("ul", key, bound, class_="key"),
        el("div", figures, class_="figures"),
    )


def _is_seen(c: Rollout) -> bool:
    """Whether a drift takes a part of the tolerance that is worth a chart."""
    most = max((d for d in c.drift if math.isfinite(d)), default=0)
    return most > (_SEEN * c.tolerance.atol if c.passed else 0)


def policy_graph(entry: Entry) -> Markup | None:
    """The layers as a picture, and every node in a list that opens."""
    if entry.graph is None or entry.signature is None:
        return None
    outputs = [s.name for s in entry.signature.outputs]
    nodes = [n for n in entry.graph.nodes if n.value is None]
    content: list[Child] = []
    blocks = blocks_of(entry.graph, outputs) if len(nodes) <= _MOST_NODES else []
    if 0 < len(blocks) <= _MOST_BLOCKS:
        picture = el("div", charts.diagram(blocks), class_="scroll", tabindex=0, role="group", aria_label="Layers")
        content.append(el("figure", picture, class_="diagram"))
    else:
        content.append(el("p", f"{len(nodes)} nodes: too many for a picture.", class_="soft"))
    rows = [(el("code", n.name), n.op, _wide(el("code", ", ".join(n.inputs)))) for n in nodes[:_MOST_NODES]]
    listing = table("Nodes in the order they are computed, constants left out", ("node", "op", "inputs"), rows)
    content.append(el("details", el("summary", f"All {count_text(len(nodes), 'node')}"), listing))
    return section("The policy", content)


def tensors(entry: Entry) -> Markup | None:
    """Inputs and outputs, by name, role, dtype and shape."""
    if entry.signature is None:
        return None

    def rows(specs: Iterable[TensorSpec]) -> list[Sequence[Child]]:
        found: list[Sequence[Child]] = []
        for s in specs:
            shape = " × ".join(
                "batch" if n is None and i == 0 else "any" if n is None else str(n) for i, n in enumerate(s.shape)
            )
            source = ", ".join(s.source) if isinstance(s.source, tuple) else s.source or "made here"
            found.append(
                (el("code", s.name), s.role.value.replace("_", " "), s.dtype, shape or "scalar", _wide(source))
            )
        return found

    head = ("name", "role", "dtype", "shape", "in the source")
    return section(
        "Inputs and outputs",
        table("What the policy is fed", head, rows(entry.signature.inputs)),
        table("What it returns", head, rows(entry.signature.outputs)),
    )


def worst_inputs(entry: Entry) -> Markup | None:
    """For each output the input that it differs most on, with the values that were fed."""
    compared = [c for c in entry.report.comparisons if c.worst_input and c.measured]
    worst: dict[str, Finding] = {}
    for c in compared:
        if c.max_abs_diff > 0:
            worst[c.output] = max(worst.get(c.output, c), c, key=lambda c: (not c.passed, c.max_abs_diff))
    if not worst:
        return None
    rows = []
    for c in worst.values():
        fed = [el("div", el("code", n), f" {first_values(a)}") for n, a in entry.feeds(c.worst_input or "").items()]
        rows.append((el("code", c.output), c.where, f"{c.max_abs_diff:.3g}", c.worst_input, _wide(fed or "–")))
    head = ("output", "where", "|Δ|", "input", "values of its first row")
    return section("Worst inputs", table("The input on which each output differs most", head, rows))


def first_values(array: np.ndarray) -> str:
    """The first values of the first row."""
    row = np.asarray(array)[:1].reshape(-1)
    values = [f"{float(v):.4g}" for v in row[:_SHOWN_VALUES]]
    rest = f", … {row.size - _SHOWN_VALUES} more" if row.size > _SHOWN_VALUES else ""
    return f"[{', '.join(values)}{rest}]"


def tolerances(entry: Entry) -> Markup:
    """The default, what differs from it with its reason, and where rounding explains more."""
    comparisons = entry.report.comparisons
    plain = list(
        dict.fromkeys(c.bound_text for c in comparisons if not c.tolerance.reason and not isinstance(c, Failure))
    )
    content: list[Child] = []
    if plain:
        rounding = ", or what float32 rounding was measured to explain there, where that is more"
        content.append(el("p", "|Δ| ≤ ", el("code", " or ".join(plain)), f" for every element{rounding}."))
    special = [
        (el("code", c.output), c.where, el("code", c.bound_text), _wide(c.tolerance.reason))
        for c in comparisons
        if c.tolerance.reason
    ]
    if special:
        bounds = ("output", "where", "bound", "reason")
        content.append(table("Tolerances other than the default, with their reasons", bounds, dict.fromkeys(special)))
    rounded = [
        (el("code", c.output), c.where, f"{c.max_abs_diff:.3g}", f"{c.rounding:.3g}", c.worst_input)
        for c in comparisons
        if c.rounding and c.passed
    ]
    if rounded:
        head = ("output", "where", "|Δ|", "rounding explains", "input")
        content.append(_closed_table("Above the tolerance, but within what float32 rounding explains", head, rounded))
    return section("Tolerances", content)


def runtimes(entry: Entry) -> Markup:
    """Which ran, in which version; why others did not."""
    missing = entry.missing
    rows = [
        (name, state["version"] or "–", _wide(f"did not run: {missing[name]}" if name in missing else "ran"))
        for name, state in entry.report.runtimes.items()
        if name in missing or state["status"] == "ran"
    ]
    return section("Runtimes", table("Runtimes and their versions", ("runtime", "version", "state"), rows))


def files(entry: Entry) -> Markup | None:
    """Sizes of the formats."""
    if not entry.report.sizes:
        return None
    rows = [
        (kind, size_with_original(kind, entry.report.sizes, entry.report.whole_sizes)) for kind in entry.report.sizes
    ]
    return section("Sizes", table("Bytes of each format", ("format", "size"), rows, [1]))


def returns(entry: Entry) -> Markup | None:
    """What the files earned in environments, where no further section shows it with pictures."""
    if entry.more:
        return None
    shown: list[Child] = []
    head = ("played by", "mean return", f"{CONFIDENCE:.0%} interval", "difference", "episodes", "verdict")
    for record in entry.report.played:
        rows = [
            (
                p.name,
                f"{p.returns.mean:.4g}",
                f"{p.returns.low:.4g} to {p.returns.high:.4g}",
                p.difference_words,
                str(p.episodes),
                p.verdict or "reference",
            )
            for p in record.rows
        ]
        shown += [el("p", f"{record.sentence}."), table(f"Returns in {record.environment}", head, rows, range(1, 5))]
    return section("Returns", shown) if shown else None


def notes(entry: Entry) -> Markup | None:
    """What reading and verification found worth saying."""
    if not entry.report.notes:
        return None
    return section("Notes", el("ul", [el("li", note) for note in entry.report.notes], class_="plain"))
