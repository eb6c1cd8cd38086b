"""The command line's contract: which command is meant, what goes to stdout and stderr, the statuses, the JSON."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from export_model import exporter
from export_model.converters.formats.registry import DEFAULTS
from export_model.exporter.cli.app import app
from export_model.exporter.cli.console import Console
from export_model.exporter.cli.group import GROUPS, Command
from fixtures import path as fixture
from tests.commands import ROOT, export_model, files_in, is_refused, python
from tests.handmade import continuous_policy, graph_bytes, sampled_policy

BALL = fixture("continuous")
UNVERIFIED = ("--verify", "none")


# ------------------------------------------------------------------ which command is meant


def test_a_source_alone_is_exported_into_a_folder_of_the_current_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = export_model(BALL, *UNVERIFIED)
    assert (ran.status, ran.err) == (0, "")
    assert "exported/continuous/policy.json" in files_in(tmp_path)


def test_naming_the_command_makes_no_difference(tmp_path: Path) -> None:
    short = export_model(BALL, "-o", tmp_path / "a", *UNVERIFIED)
    long = export_model("export", BALL, "-o", tmp_path / "a", *UNVERIFIED)
    assert short == long


def test_options_may_come_before_the_source(tmp_path: Path) -> None:
    assert export_model("--verify", "none", "-o", tmp_path, BALL).status == 0
    assert export_model("--json", "-o", tmp_path, *UNVERIFIED, BALL).json["policies"][0]["name"] == "continuous"


def test_a_source_that_is_called_like_a_command_is_given_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("inspect").write_bytes(graph_bytes(continuous_policy()))
    assert export_model("./inspect", "-o", tmp_path / "out", *UNVERIFIED).status == 0
    assert export_model("export", "inspect", "-o", tmp_path / "out", *UNVERIFIED).status == 0


def test_help_lists_every_command() -> None:
    ran = export_model("-h")
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.startswith("Usage: export-model SOURCE... [-o DIR] [OPTIONS]\n       export-model COMMAND ...\n")
    assert export_model("--help") == ran
    for name in ("export", "inspect", "verify", "runtimes"):
        assert f"\n  {name} " in ran.out
        own = export_model(name, "-h")
        assert (own.status, own.err) == (0, "")
        assert own.out.startswith(f"Usage: export-model {name} ")


def test_every_option_has_a_short_help_and_a_group() -> None:
    grouped = {name for names in GROUPS.values() for name in names}
    for name, command in app.commands.items():
        assert 0 < len(command.short_help or "") <= 60, name
        for parameter in command.params:
            if isinstance(parameter, click.Option):
                assert 0 < len(parameter.help or "") <= 60, (name, parameter.name)
                assert parameter.name in grouped, (name, parameter.name)


@pytest.mark.parametrize("name", sorted(n for n, c in app.commands.items() if isinstance(c, Command)))
def test_the_examples_of_a_help_are_commands_that_there_are(name: str) -> None:
    command = app.commands[name]
    assert isinstance(command, Command)
    assert command.examples
    shown = export_model(name, "--help").out
    for typed, _ in command.examples:
        assert f"    {typed}" in shown
        program, *words = typed.split(" >")[0].split()
        assert program == "export-model"
        command.make_context(name, words[words[0] == name :])


def test_help_fits_a_terminal_of_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in ((), *((name,) for name in app.commands)):
        lines = export_model(*words, "--help").out.splitlines()
        assert max(map(len, lines)) <= 80, lines
        assert len(lines) <= 30, lines


def test_help_shows_twelve_options_and_help_all_every_one() -> None:
    short, long = (export_model("export", word).out for word in ("--help", "--help-all"))
    core = [
        "out",
        "to",
        "for",
        "verify",
        "name",
        "deterministic",
        "html",
        "json",
        "jobs",
        "trust-source",
        "verbose",
        "quiet",
    ]
    assert re.findall(r"^  (?:-., )?--([a-z-]+)", short, re.MULTILINE) == [*core, "help-all"]
    assert all(f"--{word} " in export_model("--help").out for word in core)
    for name, command in app.commands.items():
        flag = "--help-all" if isinstance(command, Command) and command.core else "--help"
        shown = export_model(name, flag).out
        assert [o for p in command.params if isinstance(p, click.Option) for o in p.opts if o not in shown] == []
    everything = export_model("--help-all").out
    assert [o for o in ("--noise", "--version", "\n  completion ", "\n  consumers ") if o not in everything] == []
    assert "--noise" in long and "--noise" not in short


@pytest.mark.parametrize("flag", ["--verify", "--runtimes"])
def test_where_files_are_run_is_said_the_same_way_in_every_command(flag: str, tmp_path: Path) -> None:
    assert export_model(BALL, "-o", tmp_path, flag, "numpy", "--to", "bytes,onnx").status == 0
    folder = tmp_path / "continuous"
    for words in (("verify", folder), ("compare", BALL, folder / "continuous.onnx")):
        ran = export_model(*words, flag, "none")
        assert (ran.status, ran.err) == (0, ""), ran
        assert ran.out.endswith("NOT VERIFIED: no independent runtime ran\n")
        is_refused(export_model(*words, flag, "numpy"), "--allow-unverified", status=3)
        is_refused(export_model(*words, flag, "nothing"), "unknown runtime")


def test_what_is_listed_fits_it_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in (("inspect", fixture("recurrent")), ("inspect", fixture("twobrains")), ("runtimes",)):
        lines = export_model(*words).out.splitlines()
        assert max(map(len, lines)) <= 80, lines


def test_no_argument_shows_the_usage_and_is_status_2() -> None:
    ran = export_model()
    assert (ran.status, ran.out) == (2, "")
    assert "Usage: export-model SOURCE..." in ran.err


def test_the_version_is_the_packages() -> None:
    ran = export_model("--version")
    assert (ran.status, ran.out.splitlines()[0].split()[-1], ran.err) == (0, exporter.__version__, "")


def test_the_module_is_the_command() -> None:
    ran = python("-m", "export_model", "inspect", BALL, "--json")
    assert (ran.status, ran.err) == (0, "")
    assert ran.out == export_model("inspect", BALL, "--json").out
    is_refused(python("-m", "export_model", "nothing.bytes"), "nothing.bytes: no such file")


# ------------------------------------------------------------------ export


def test_a_success_says_where_the_policy_is_and_what_to_do_next(tmp_path: Path) -> None:
    out = tmp_path / "a folder"
    ran = export_model(BALL, "-o", out, *UNVERIFIED)
    lines = ran.out.splitlines()
    assert ran.err == ""
    assert lines[0].startswith("continuous: ")
    assert lines[0].endswith(f" -> {out / 'continuous'}")
    assert lines[-1].startswith(f"next: export-model verify '{out / 'continuous'}'")
    assert "NOT VERIFIED: --verify none" in lines
    assert [line.split()[0] for line in lines[3:7]] == list(DEFAULTS)


@pytest.mark.parametrize("profile", ["unity6", "godot-rl"])
def test_of_several_policies_for_a_consumer_each_has_its_next_step(profile: str, tmp_path: Path) -> None:
    ran = export_model(fixture("twobrains"), fixture("continuous"), "-o", tmp_path, "--for", profile, *UNVERIFIED)
    place, *commands = [line.removeprefix("next: ") for line in ran.out.splitlines() if line.startswith("next: ")]
    written = sorted(path for path in tmp_path.glob("*/*.onnx"))
    assert len(written) == 3 and all(f"{path.name} of {path.parent}" in place for path in written)
    assert [shlex.split(c)[2] for c in commands] == sorted((str(p.parent) for p in written), key=ran.out.index)
    for command in commands:
        assert export_model(*shlex.split(command.split("    (")[0])[1:]).status == 0


@pytest.mark.parametrize("targets", ["bytes", "onnx"])
def test_of_several_policies_that_were_not_compared_each_is_in_a_command(targets: str, tmp_path: Path) -> None:
    sources = (fixture("twobrains"), fixture("continuous"))
    ran = export_model(*sources, "-o", tmp_path, "--to", targets, *UNVERIFIED)
    commands = [line.removeprefix("next: ") for line in ran.out.splitlines() if line.startswith("next: ")]
    calls = [shlex.split(command.split("    (")[0])[1:] for command in commands]
    folders = {str(path.parent) for path in tmp_path.glob("*/policy.json")}
    assert len(folders) == 3 and {word for call in calls for word in call} >= folders
    for call in calls:
        assert export_model(*call, "--runtimes", "onnxruntime,tensorflow").status == 0


def test_an_export_that_unity_does_not_take_says_how_to_make_one(tmp_path: Path) -> None:
    def says_so(*flags: str) -> bool:
        return (
            "note: Unity looks up other names: export with --for unity6"
            in export_model(BALL, "-o", tmp_path, *UNVERIFIED, *flags).out
        )

    assert says_so()
    assert says_so("--to", "onnx")
    assert says_so("--to", "bytes")
    assert not says_so("--to", "saved_model,tfjs")
    assert not says_so("--to", "nn")
    assert not says_so("--names", "source")
    assert not says_so("--for", "unity6")


def test_the_result_as_json_has_every_policy(tmp_path: Path) -> None:
    ran = export_model(BALL, fixture("twobrains"), "-o", tmp_path, *UNVERIFIED, "--json")
    assert (ran.status, ran.err) == (0, "")
    policies = ran.json["policies"]
    assert [p["name"] for p in policies] == ["continuous", "twobrains-StrikerBrain", "twobrains-Goalie-Brain-2"]
    for policy in policies:
        assert set(policy) == {"name", "folder", "passed", "sizes", "parity"}
        assert policy["folder"] == str(tmp_path / policy["name"])
        assert (policy["passed"], policy["parity"]) == (None, None)
        on_disk = sum(f.stat().st_size for f in (tmp_path / policy["name"]).rglob("*") if f.is_file())
        assert sum(policy["sizes"].values()) == on_disk - (tmp_path / policy["name"] / "policy.json").stat().st_size


@pytest.mark.parametrize(
    "targets", [["bytes"], ["onnx"], ["tfjs"], ["saved_model"], ["onnx", "bytes"], ["tfjs", "saved_model", "tfjs"]]
)
def test_only_the_formats_that_were_asked_for_are_written(targets: list[str], tmp_path: Path) -> None:
    ran = export_model(BALL, "-o", tmp_path, *UNVERIFIED, "--to", ",".join(targets), "--json")
    assert list(ran.json["policies"][0]["sizes"]) == list(dict.fromkeys(targets))
    heads = {"bytes": "continuous.bytes", "saved_model": "saved_model", "tfjs": "tfjs", "onnx": "continuous.onnx"}
    found = {p.name for p in (tmp_path / "continuous").iterdir()}
    assert found == {"policy.json", *(heads[t] for t in targets)}


def test_one_brain_of_several_can_be_chosen(tmp_path: Path) -> None:
    flags = ("-o", tmp_path, *UNVERIFIED, "--brain", "StrikerBrain", "--json")
    assert [p["name"] for p in export_model(fixture("twobrains"), *flags).json["policies"]] == [
        "twobrains-StrikerBrain"
    ]
    named = export_model(fixture("twobrains"), *flags, "--name", "Striker")
    assert [p["name"] for p in named.json["policies"]] == ["Striker"]


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ("3DBall", "3DBall"),
        ("Ball (hard) ü", "Ball--hard---"),
        ("../up", "..-up"),
        ("a/b", "a-b"),
        ("..", "policy"),
        (".", "policy"),
    ],
)
def test_a_name_is_made_safe_for_files(given: str, name: str, tmp_path: Path) -> None:
    ran = export_model(BALL, "-o", tmp_path / "out", *UNVERIFIED, "--name", given, "--json")
    assert ran.json["policies"][0]["name"] == name
    assert f"out/{name}/{name}.bytes" in files_in(tmp_path)


@pytest.mark.parametrize("name", ["frozen_graph_def.pb", "saved_model.pb"])
def test_a_file_whose_name_says_nothing_is_called_after_its_folder(name: str, tmp_path: Path) -> None:
    (tmp_path / "My Behavior").mkdir()
    (tmp_path / "My Behavior" / name).write_bytes(graph_bytes(continuous_policy()))
    ran = export_model(tmp_path / "My Behavior" / name, "-o", tmp_path / "out", *UNVERIFIED, "--json")
    assert ran.json["policies"][0]["name"] == "My-Behavior"


def test_the_trainers_names_are_kept_on_request(tmp_path: Path) -> None:
    (tmp_path / "a.bytes").write_bytes(graph_bytes(continuous_policy("BallBrain/")))
    ran = export_model(tmp_path / "a.bytes", "-o", tmp_path / "out", *UNVERIFIED, "--names", "source")
    assert ran.status == 0
    policy = json.loads((tmp_path / "out" / "a" / "policy.json").read_text())
    assert [t["name"] for t in policy["inputs"]] == ["BallBrain/vector_observation"]
    assert policy["outputs"][0]["name"] == "BallBrain/action"


def _tensors(folder: Path, *flags: str) -> tuple[list[str], list[str]]:
    (folder / "a.bytes").write_bytes(fixture("visual").read_bytes())
    ran = export_model(folder / "a.bytes", "-o", folder / "out", *UNVERIFIED, *flags)
    assert ran.status == 0, ran
    policy = json.loads((folder / "out" / "a" / "policy.json").read_text())
    return [t["name"] for t in policy["inputs"]], [t["name"] for t in policy["outputs"]]


def test_noise_is_lifted_kept_or_removed(tmp_path: Path) -> None:
    outputs = ["action", "deterministic_action", "value_estimate"]
    assert _tensors(tmp_path) == (["state", "observation_0", "epsilon"], outputs)
    assert _tensors(tmp_path, "--noise", "lift") == (["state", "observation_0", "epsilon"], outputs)
    for mode in ("keep", "zero"):
        inputs, _ = _tensors(tmp_path, "--noise", mode)
        assert inputs == ["state", "observation_0"]
    inputs, _ = _tensors(tmp_path, "--deterministic")
    assert inputs == ["state", "observation_0"]


def test_roles_and_values_can_be_given(tmp_path: Path) -> None:
    nodes = continuous_policy(observation="what_it_sees")
    (tmp_path / "a.bytes").write_bytes(graph_bytes(nodes))
    ran = export_model("inspect", tmp_path / "a.bytes", "--json", "--input", "what_it_sees=parameter")
    assert ran.status == 2
    ran = export_model("inspect", tmp_path / "a.bytes", "--json", "--input", "what_it_sees=state")
    assert [t["role"] for t in ran.json["policies"][0]["inputs"]] == ["vector_observation"]
    ran = export_model("inspect", BALL, "--json", "--set", "epsilon=0")
    assert [t["name"] for t in ran.json["policies"][0]["inputs"]] == ["state"]
    for word, same in (("true", "1"), ("False", "0")):
        assert export_model("inspect", BALL, "--json", "--set", f"epsilon={word}") == export_model(
            "inspect", BALL, "--json", "--set", f"epsilon={same}"
        )


# ------------------------------------------------------------------ terminals that cannot show everything


def test_a_console_without_greek_letters_shows_the_rest(tmp_path: Path) -> None:
    """The head of the long table has a Δ, which few 8-bit encodings of a pipe have."""
    ran = python(
        *("-m", "export_model", BALL, "-o", tmp_path, "--verify", "onnxruntime", "-v"),
        environment={"PYTHONIOENCODING": "iso8859-5"},
    )
    assert ran.status == 0
    assert "|?|" in ran.out


@pytest.mark.skipif(sys.platform == "win32", reason="names are text there")
def test_a_file_name_that_is_no_text_is_no_trouble(tmp_path: Path) -> None:
    name = tmp_path / os.fsdecode(b"b\xff.bytes")
    name.write_bytes(BALL.read_bytes())
    ran = python("-m", "export_model", name, "-o", tmp_path / "out", *UNVERIFIED)
    assert (ran.status, ran.err) == (0, "")
    assert "out/b-/policy.json" in files_in(tmp_path)
    assert json.loads((tmp_path / "out" / "b-" / "policy.json").read_text())["source"]["path"] == "b\ufffd.bytes"
    assert python("-m", "export_model", "inspect", name).status == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("command", [["inspect"], ["-o", "{out}", *UNVERIFIED], ["inspect", "--json"]])
def test_output_that_cannot_be_written_is_an_error(command: list[str], tmp_path: Path) -> None:
    arguments = [a.format(out=tmp_path) for a in command]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "export_model", *arguments, str(BALL)],
            cwd=ROOT,
            stdout=full,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr.startswith("error: [Errno 28]")
    assert "Traceback" not in done.stderr


# ------------------------------------------------------------------ ends that are neither success nor error


def test_an_interrupted_run_says_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("export_model.exporter.export.sources.compile_graph", interrupted)
    ran = export_model(BALL, "-o", tmp_path / "out", *UNVERIFIED)
    assert (ran.status, ran.out) == (130, "")
    assert ran.err.strip() == "stopped"
    assert files_in(tmp_path) == set()


class Terminal(io.StringIO):
    """A stderr that people look at."""

    def isatty(self) -> bool:
        return True


def test_progress_is_shown_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    Console().progress()("working")
    assert "working" in shown.getvalue()
    Console(as_json=True).progress()("hidden")
    assert "hidden" not in shown.getvalue()
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    Console().progress()("hidden")
    assert sys.stderr.getvalue() == ""


def test_a_terminal_is_cleared_of_progress_before_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setenv("TERM", "xterm")
    app.main([str(BALL), "-o", str(tmp_path), *UNVERIFIED], standalone_mode=False)
    assert shown.getvalue().startswith("\r\x1b[2K  reading ")
    assert shown.getvalue().endswith("\r\x1b[2K")
    assert capsys.readouterr().out.startswith("continuous: ")


def test_the_same_source_twice_is_written_once(tmp_path: Path) -> None:
    ran = export_model(BALL, BALL, "-o", tmp_path, *UNVERIFIED)
    assert ran.status == 0
    assert {p.name for p in tmp_path.iterdir()} == {"continuous"}


def test_a_drawn_action_is_described_in_both_forms(tmp_path: Path) -> None:
    (tmp_path / "a.bytes").write_bytes(graph_bytes(sampled_policy()))
    policy = export_model("inspect", tmp_path / "a.bytes", "--json").json["policies"][0]
    assert [(t["name"], t["role"], t["source"]) for t in policy["outputs"]] == [
        ("action", "sampled", "action:0"),
        ("deterministic_action", "deterministic", None),
        ("action_log_probs", "log_probs", None),
    ]


def test_inspect_says_normalised_only_where_the_policy_does_it() -> None:
    folder = Path(__file__).resolve().parents[2] / "fixtures" / "trained" / "3DBall"
    assert "(normalised inside the policy)" in export_model("inspect", folder).out
    assert "normalised" not in export_model("inspect", fixture("discrete")).out
