"""The command ``skill``: a page for coding agents, made from this program."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import click

from export_model.exporter import __version__
from export_model.exporter.cli.group import PROGRAM, Command, command
from export_model.exporter.cli.terminal import say_lines
from export_model.signatures.errors import ExportModelError, ParityError, RuntimeUnavailableError

#: What is typed → what it is for; tests/exporter/test_skill.py runs them in order, on the files of ``demo --files``.
RECIPES = (
    ("See what a file is: numbers, names and roles; nothing is run.", "inspect 3DBall.onnx --json"),
    ("Export to every format and compare each with the original: status 0 is the proof.", "3DBall.onnx -o out --json"),
    ("Are these two files the same policy?", "compare 3DBall.bytes 3DBall.onnx --json"),
    ("Check a bundle in CI: hashes first, then the formats that must be checked.", "verify out --require onnx --json"),
    ("Get code that calls it, with this policy's names and sizes.", "snippets out/3DBall --for onnxruntime"),
)
STATUSES = (
    (0, "done; where formats were compared, all that ran agree"),
    (ParityError.exit_status, "something disagrees: the report names the first tensor that differs"),
    (ExportModelError.exit_status, "the file or the command line is wrong, or the policy cannot be converted exactly"),
    (RuntimeUnavailableError.exit_status, "a runtime is missing, or a format was not checked: nothing is proven"),
)
#: Command → the schema of what its --json prints, below exporter/.
SCHEMAS = {
    "SOURCE, verify, compare": (
        "reports/parity.schema.json",
        "policies[].parity of an export, reports[] of the others, parity.json in a bundle",
    ),
    "verify --log": ("reports/log.schema.json", "the top level"),
    "play": ("reports/play.schema.json", "the top level"),
}
_RULES = (
    "Believe the exit status, not words of the output; `--json` prints errors as JSON, too.",
    "An error says what, where, why and `fix`: type the fix. Never widen --atol, --rtol or --tolerances to pass.",
    "--trust-source runs code of the file: only when the user says that the file is trusted.",
    "NOT VERIFIED and status 3 mean that nothing was proven: install a runtime (`runtimes`), then `verify`.",
)


@command(
    "skill",
    "Print a page for coding agents: commands, statuses, JSON.",
    ("export-model skill > SKILL.md", "of the version that is installed"),
)
def skill_command() -> None:
    """Print SKILL.md: what a coding agent needs to call this program, at most 150 lines."""
    group = click.get_current_context().find_root().command
    assert isinstance(group, click.Group)
    say_lines("\n".join(_page(group)))


def _page(group: click.Group) -> Iterator[str]:
    yield from ("---", f"name: {PROGRAM}")
    yield (
        "description: Convert trained policies (Unity ML-Agents, Stable-Baselines3, rsl_rl, TorchScript, ONNX, Keras)"
        " to ONNX, TensorFlow.js, SavedModel, LiteRT, C, C#, JavaScript, and prove that files act the same."
    )
    yield from ("---", "", f"# {PROGRAM} {__version__}", "", *(f"- {rule}" for rule in _RULES), "", "## Recipes", "")
    for what, typed in RECIPES:
        yield from (what, f"    {PROGRAM} {typed}", "")
    yield from ("## Exit status", "", *(f"- {n}: {what}" for n, what in STATUSES), "", "## Commands", "")
    for name in group.list_commands(click.get_current_context()):
        yield from _describe(group.commands[name])
    yield from ("", "## JSON", "")
    for typed, (file, where) in SCHEMAS.items():
        yield f"- `{typed}`: {where}: {', '.join(_fields(file))}"


def _describe(made: click.Command) -> Iterator[str]:
    """Its usage and help in a line, then its core options, or all where they are few."""
    context = click.Context(made, parent=click.get_current_context().find_root(), info_name=made.name)
    usage = " ".join(made.collect_usage_pieces(context)).replace("[OPTIONS] ", "")
    yield f"- `{made.name} {usage}`: {made.get_short_help_str(200)}".replace(" [OPTIONS]`", "`")
    core = made.core_options(context)[:-1] if isinstance(made, Command) and made.core else ()
    for names, text in core:
        yield f"  - `{names}` {text}"


def _fields(file: str) -> list[str]:
    """Return the fields that the schema requires, with the values of those that have few."""
    schema = json.loads((Path(__file__).parents[1] / file).read_text(encoding="utf-8"))
    values = {n: schema["properties"][n].get("enum") for n in schema["required"]}
    return [f"{n} ({' | '.join(map(str, v))})" if v else n for n, v in values.items()]
