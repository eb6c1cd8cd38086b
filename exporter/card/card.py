"""A bundle's card: YAML that a model hub reads, then Markdown. The same bundle gives the same bytes.

The fields are those of huggingface_hub's ModelCardData (1.0 on); what nobody stated, the licence first of all, is left
to whoever publishes it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.files.fetch import read_bytes
from export_model.converters.formats.bundle import bundle
from export_model.converters.formats.registry import FORMATS
from export_model.converters.interfaces.text import loop_lines, tables
from export_model.exporter.inspect.inspection import port_tables
from export_model.exporter.reports.markdown import code, markdown_table, play_table, text
from export_model.exporter.snippets.contract import read_bundle
from export_model.exporter.snippets.registry import snippets
from export_model.exporter.tables import size_text
from export_model.exporter.verify.plays import PlayRecord, read_plays
from export_model.signatures.contract import PARITY, POLICY, Contract, json_of
from export_model.signatures.errors import BundleError
from export_model.signatures.fields import Count, FieldError, Text, read

CARD = "README.md"
#: Snippets that a card shows, the first of which a bundle has the files for.
_LOADED_BY = ("onnxruntime", "load-policy", "saved-model", "inference-engine", "policy-tfjs")
_MOST_RECORD_BYTES = 16 << 20


class _Runtime(Struct, frozen=True):
    status: Text


class _Agreement(Struct, frozen=True):
    """What a card takes from parity.json."""

    sentence: Text
    seed: Count
    runtimes: Mapping[Text, _Runtime] = field(default_factory=dict)


def card_text(folder: Path) -> str:
    """Return the card of the bundle in ``folder``. Raises BundleError where its files are not those that it lists."""
    found = bundle.Bundle.open(folder)
    found.verify_hashes()
    played = read_plays(folder)
    sections = [
        _facts(found.contract),
        _section("What it sees and does", _ports(found.contract)),
        _section("Interface", _interface(found.contract)),
        *(_section(f"Returns in {text(record.environment)}", _returns(record)) for record in played),
        _section("Agreement of the files", _agreement(folder)),
        _section("How to load it", _loading(folder)),
        _section("Files", _files(found.contract)),
    ]
    body = "\n\n".join(part for part in sections if part)
    formats = [f.key for f in FORMATS if f.main and found.has(f)]
    metadata = _metadata(found.name, formats, played)
    return f"---\n{metadata}---\n\n# {text(found.name)}\n\n{body}\n"


def _section(title: str, lines: Sequence[str]) -> str:
    return "\n".join([f"## {title}", "", *lines]) if lines else ""


# ------------------------------------------------------------------ what a hub reads


def _metadata(name: str, formats: Sequence[str], played: Sequence[PlayRecord]) -> str:
    """The YAML; texts are in JSON's quotes, which YAML reads alike."""
    lines = ["pipeline_tag: reinforcement-learning", "tags:"]
    lines += [f"- {_json_text(tag)}" for tag in ("reinforcement-learning", "export-model", *formats)]
    if played:
        lines += ["model-index:", f"- name: {_json_text(name)}", "  results:"]
    for record in played:
        best = record.reference.returns
        value = f"{best.mean:.4g} +/- {(best.high - best.low) / 2:.4g}"
        lines += [
            "  - task:",
            "      type: reinforcement-learning",
            "      name: reinforcement-learning",
            "    dataset:",
            f"      name: {_json_text(record.environment)}",
            f"      type: {_json_text(record.environment)}",
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


def _returns(record: PlayRecord) -> list[str]:
    margin = f"Margin of the verdict: ± {record.margin:.4g} ({text(record.asked)}); seed {record.seed}."
    return [*play_table(record), "", margin]


def _agreement(folder: Path) -> list[str]:
    """What parity.json says; nothing where it is missing."""
    file = folder / PARITY
    if not file.is_file():
        return []
    try:
        found: _Agreement = read(json_of(read_bytes(file, most=_MOST_RECORD_BYTES)), _Agreement)
        ran = ", ".join(sorted(name for name, runtime in found.runtimes.items() if runtime.status == "ran"))
        return [text(found.sentence), "", f"Compared in {text(ran) or 'no runtime'}; seed {found.seed}."]
    except FieldError as error:
        raise BundleError(f"cannot be read: {error}", where=str(file), fix="verify the bundle again") from error


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


def write_card(folder: Path) -> Path:
    """Write README.md into the bundle. Raises BundleError."""
    content = card_text(folder)
    file = folder / CARD
    with bundle.writing(file):
        file.write_bytes(content.encode("utf-8"))
    return file
