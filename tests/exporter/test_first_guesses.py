"""What people type first who know another tool: each row of the table is answered by what to type here."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import click
import pytest

from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.cli.app import app
from export_model.exporter.cli.guesses import OPTIONS, WORDS
from fixtures import path as fixture
from tests.commands import export_model, files_in, is_refused

#: (whose command line it is, what is typed, what the answer names)
FIRST = [
    ("tf2onnx", "--saved-model run --output policy.onnx", "export-model FILE"),
    ("tf2onnx", "--graphdef p.bytes --inputs state:0 --outputs action:0", "export-model FILE"),
    ("tensorflowjs_converter", "p.bytes --output_format=tfjs_graph_model", "--to"),
    ("tensorflowjs_converter", "p.bytes --input_format=tf_frozen_model", "known by content"),
    ("onnx2tf", "-i p.bytes -o saved", "export-model FILE"),
    ("optimum-cli export onnx", "p.bytes --task reinforcement-learning", "the file says what it is"),
    ("optimum-cli", "-m p.bytes out", "export-model FILE"),
    ("rl-zoo3", "p.bytes --algo ppo", "the file says what it is"),
    ("ultralytics", "p.bytes --format onnx", "--to onnx"),
    ("ultralytics", "p.bytes --half", "--dtype float16"),
    ("python -m tf2onnx.convert", "convert p.bytes", "export-model FILE --to onnx"),
    ("polygraphy", "run p.bytes", "play BUNDLE"),
    ("onnx", "check p.bytes", "verify BUNDLE"),
    ("netron", "view p.bytes", "inspect FILE"),
    ("anybody", "p.bytes --check", "verify"),
    ("anybody", "p.bytes policy.onnx", "-o exported --name policy"),
    ("anybody", "p.bytes -o policy.onnx", "-o exported --name policy"),
    ("anybody", "p.bytes --output exported", "-o DIR"),
    ("anybody", "--input p.bytes", "needs no option"),
    ("anybody", "help", "--help"),
]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a policy; nothing may be written to it."""
    shutil.copy(fixture("continuous"), tmp_path / "p.bytes")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("tool", "typed", "answer"), FIRST, ids=[f"{t}: {w}" for t, w, _ in FIRST])
def test_a_first_guess_is_answered_by_the_right_line(tool: str, typed: str, answer: str, here: Path) -> None:
    is_refused(export_model(*shlex.split(typed)), answer, "fix: ")
    assert files_in(here) == {"p.bytes"}


@pytest.mark.parametrize("typed", [t for guess in OPTIONS for t in guess.typed])
def test_each_option_of_another_tool_is_answered(typed: str, here: Path) -> None:
    (fix,) = (guess.fix for guess in OPTIONS if typed in guess.typed)
    refused = export_model("p.bytes", typed, "x", "--json")
    assert (refused.status, refused.json["error"], refused.json["fix"]) == (2, "UsageError", fix)
    assert files_in(here) == {"p.bytes"}


@pytest.mark.parametrize("typed", [t for guess in WORDS for t in guess.typed])
def test_each_word_of_another_tool_is_answered_unless_a_file_is_called_so(typed: str, here: Path) -> None:
    (fix,) = (guess.fix for guess in WORDS if typed in guess.typed)
    assert export_model(typed, "p.bytes", "--json").json["fix"] == fix
    shutil.copy("p.bytes", typed)
    assert export_model(typed, "--verify", "none", "--to", "onnx").status == 0


def test_no_guess_is_an_option_or_a_command_and_every_answer_is() -> None:
    typed = [t for guess in (*OPTIONS, *WORDS) for t in guess.typed]
    assert len(typed) == len(set(typed))
    for guess in (*OPTIONS, *WORDS):
        assert guess.tools
    own = {name for p in app.commands["export"].params if isinstance(p, click.Option) for name in p.opts}
    assert own.isdisjoint(typed) and set(app.commands).isdisjoint(typed)
    known = {o for c in app.commands.values() for p in c.params if isinstance(p, click.Option) for o in p.opts}
    known |= {"--help", "--version"}
    for guess in (*OPTIONS, *WORDS):
        assert set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", guess.fix)) <= known, guess
        for word in re.findall("export-model ([a-z]+)", guess.fix):
            assert word in app.commands, guess


@pytest.mark.parametrize(("alias", "key"), [(a, f.key) for f in WRITTEN.values() for a in f.aliases])
def test_an_alias_writes_the_format(alias: str, key: str, here: Path) -> None:
    answer = export_model("p.bytes", "-o", "out", "--to", f"{alias},{key}", "--verify", "none", "--json").json
    assert list(answer["policies"][0]["sizes"]) == [key]


def test_the_aliases_that_were_asked_for_are_there() -> None:
    aliases = {a: f.key for f in WRITTEN.values() for a in f.aliases}
    assert {"tflite": "litert", "saved-model": "saved_model", "pb": "bytes"}.items() <= aliases.items()
    assert aliases.keys().isdisjoint(WRITTEN)
