"""A bundle's card: YAML that a model hub reads, then Markdown. The same bundle gives the same bytes.

The fields are those of huggingface_hub's ModelCardData (1.0 on); what nobody stated, the licence first of all, is left
to whoever publishes it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from converters.files.fetch import read_bytes
from converters.formats.bundle import bundle
from converters.formats.registry import FORMATS
from converters.interfaces.text import loop_lines, tables
from exporter.inspect.inspection import port_tables
from exporter.play.equivalence import CONFIDENCE
from exporter.play.student import t_quantile
from exporter.reports.markdown import code, markdown_table, text
from exporter.snippets.contract import read_bundle
from exporter.snippets.registry import snippets
from exporter.tables import size_text
from signatures.contract import PARITY, POLICY, Contract, json_of
from signatures.errors import BundleError, UsageError
from signatures.fields import Field, FieldError

CARD, PLAY = "README.md", "play.json"
#: Snippets that a card shows, the first of which a bundle has the files for.
_LOADED_BY = ("onnxruntime", "load-policy", "saved-model", "inference-engine", "policy-tfjs")
_MOST_RECORD_BYTES, _MOST_RETURNS = 16 << 20, 1_000_000


class Returns(Struct, frozen=True):
    """Mean return of what played, with its interval."""

    who: str
    mean: float
    low: float
    high: float
    episodes: int

    @property
    def words(self) -> str:
        """``9.31 (9.12 to 9.5)``."""
        return f"{self.mean:.4g} ({self.low:.4g} to {self.high:.4g})"


def card_text(folder: Path, play: Path | None = None) -> str:
    """Return the card of the bundle in ``folder``; ``play`` is what ``play --json`` said (default: its play.json).

    Raises BundleError where the bundle's files are not those that were written, UsageError for another ``play``.
    """
    found = bundle.Bundle.open(folder)
    found.verify_hashes()
    record = play if play is not None else folder / PLAY
    environment, returns = _read_returns(record, found.name) if play is not None or record.is_file() else ("", [])
    sections = [
        _facts(found.contract),
        _section("What it sees and does", _ports(found.contract)),
        _section("Interface", _interface(found.contract)),
        _section(f"Returns in {text(environment)}" if environment else "", _returns(returns)),
        _section("Agreement of the files", _agreement(folder)),
        _section("How to load it", _loading(folder)),
        _section("Files", _files(found.contract)),
    ]
    body = "\n\n".join(part for part in sections if part)
    formats = [f.key for f in FORMATS if f.main and found.has(f)]
    metadata = _metadata(found.name, formats, environment, returns)
    return f"---\n{metadata}---\n\n# {text(found.name)}\n\n{body}\n"


def _section(title: str, lines: Sequence[str]) -> str:
    return "\n".join([f"## {title}", "", *lines]) if lines else ""


# ------------------------------------------------------------------ what a hub reads


def _metadata(name: str, formats: Sequence[str], environment: str, returns: Sequence[Returns]) -> str:
    """The YAML; texts are in JSON's quotes, which YAML reads alike."""
    lines = ["pipeline_tag: reinforcement-learning", "tags:"]
    lines += [f"- {_json_text(tag)}" for tag in ("reinforcement-learning", "export-model", *formats)]
    if environment and returns:
        best = returns[0]
        value = f"{best.mean:.4g} +/- {(best.high - best.low) / 2:.4g}"
        lines += [
            "model-index:",
            f"- name: {_json_text(name)}",
            "  results:",
            "  - task:",
            "      type: reinforcement-learning",
            "      name: reinforcement-learning",
            "    dataset:",
            f"      name: {_json_text(environment)}",
            f"      type: {_json_text(environment)}",
            "    metrics:",
            "    - type: mean_reward",
            f"      value: {_json_text(value)}",
            "      name: mean_reward",
        ]
    return "\n".join(lines) + "\n"


def _json_text(value: str) -> str:
    return json.dumps(value, ensure_ascii=True)


# ------------------------------------------------------------------ what people read


def _facts(contract: Contract) -> str:
    signature, origin = contract.signature, contract.origin
    algorithm = f", {text(signature.algorithm)}" if signature.algorithm else ""
    memory = f", memory of {signature.memory.size} numbers" if signature.memory is not None else ""
    version = text(str(contract.tool.get("version", "")))
    lines = [
        f"A policy of {text(signature.family)}{algorithm}: {text(signature.flow)}, {signature.action_space} "
        f"actions{memory}.",
        "",
        f"Made by export-model {version} from {code(origin.path)} (sha256 {code(origin.sha256)}).",
        "",
        "Licence: not stated. Whoever publishes this policy adds it as `license:` above.",
    ]
    notes = [f"- {text(note)}" for note in signature.notes]
    return "\n".join([*lines, *(["", *notes] if notes else [])])


def _ports(contract: Contract) -> list[str]:
    lines: list[str] = []
    for head, rows in port_tables(contract.signature):
        shown = [[code(name), dtype, shape, text(says)] for name, dtype, shape, _, says in rows]
        lines += [*markdown_table((head[0], head[1], head[2], head[4]), shown), ""]
    return lines[:-1]


def _interface(contract: Contract) -> list[str]:
    lines: list[str] = []
    for name, head, rows in tables(contract.signature):
        lines += [f"{code(name)}:", "", *markdown_table(head, [[text(c) for c in row] for row in rows]), ""]
    lines += [f"- {text(line)}" for line in loop_lines(contract.signature.interface)]
    return lines if lines and lines[-1] else lines[:-1]


def _returns(returns: Sequence[Returns]) -> list[str]:
    rows = [[text(r.who), r.words, str(r.episodes)] for r in returns]
    head = ("played by", f"mean return ({CONFIDENCE:.0%} interval)", "episodes")
    return markdown_table(head, rows) if rows else []


def _agreement(folder: Path) -> list[str]:
    """What parity.json says; nothing where it is missing."""
    file = folder / PARITY
    if not file.is_file():
        return []
    whole = _record(file)
    try:
        runtimes = {name: entry["status"].text() for name, entry in whole["runtimes"].members().items()}
        ran = ", ".join(sorted(name for name, status in runtimes.items() if status == "ran"))
        return [text(whole["sentence"].text()), "", f"Compared in {text(ran) or 'no runtime'}; seed {_number(whole)}."]
    except FieldError as error:
        raise BundleError(f"cannot be read: {error}", where=str(file), fix="verify the bundle again") from error


def _number(whole: Field) -> int:
    return whole["seed"].integer(0)


def _loading(folder: Path) -> list[str]:
    found = replace(read_bundle(folder), folder=Path())
    for name in _LOADED_BY:
        try:
            (made, *_), _ = snippets(found, name)
        except (BundleError, ValueError):
            continue
        fence = "`" * max(3, *(len(m) + 1 for m in re.findall("`+", made.code)), 0)
        return [f"{made.target.title}:", "", f"{fence}{made.target.language}", *made.code.splitlines(), fence]
    return []


def _files(contract: Contract) -> list[str]:
    rows = [[code(p), size_text(entry.size), code(entry.sha256)] for p, entry in sorted(contract.files.items())]
    said = f"{code(POLICY)} has the whole contract; `export-model verify` checks these hashes."
    return [*markdown_table(("file", "size", "sha256"), rows), "", said]


# ------------------------------------------------------------------ returns


def _read_returns(file: Path, name: str) -> tuple[str, list[Returns]]:
    """The environment and the mean returns in what ``play --json`` said of the policy ``name``."""
    try:
        whole = _record(file)
        environment, policy = whole["environment"].text(), whole["policy"].text()
        if policy != name:
            raise whole["policy"].error(f"is {policy[:60]!r}, and the bundle is of {name!r}")
        reference = whole["reference"]
        others = whole["played"].items()
        named = [f"{entry['format'].text()} in {entry['runtime'].text()}" for entry in others]
        found = [_mean(reference["name"].text(), reference["returns"])]
        found += [_mean(who, entry["returns"]) for who, entry in zip(named, others, strict=True)]
    except FieldError as error:
        raise UsageError(
            f"{file.name} must be what 'export-model play BUNDLE --env ENV --json' prints", why=str(error)[:300]
        ) from error
    return environment, found


def _mean(who: str, returns: Field) -> Returns:
    values = np.array([r.number() for r in returns.items(_MOST_RETURNS)], np.float64)
    if not values.size:
        raise returns.error("is empty")
    error = float(values.std(ddof=1)) / values.size**0.5 if values.size > 1 else 0.0
    near = t_quantile((1 - CONFIDENCE) / 2, values.size - 1) * error if values.size > 1 else 0.0
    mean = float(values.mean())
    return Returns(who, mean, mean - near, mean + near, int(values.size))


def _record(file: Path) -> Field:
    return Field(json_of(read_bytes(file, most=_MOST_RECORD_BYTES)))


def write_card(folder: Path, play: Path | None = None) -> Path:
    """Write README.md into the bundle. Raises BundleError, UsageError."""
    content = card_text(folder, play)
    file = folder / CARD
    with bundle.writing(file):
        file.write_bytes(content.encode("utf-8"))
    return file
