"""How the command line behaves: typos, the version, completion in a real shell."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest

from export_model import exporter
from export_model.exporter.cli.demo import _run_as_typed
from fixtures import path as fixture
from tests.commands import export_model, is_refused, python


@pytest.mark.parametrize(("typo", "meant"), [("verfiy", "verify"), ("inspct", "inspect"), ("runtime", "runtimes")])
def test_a_mistyped_command_is_told(typo: str, meant: str) -> None:
    is_refused(export_model(typo, fixture("continuous")), repr(typo), f"did you mean: export-model {meant}?")


def test_a_file_with_such_a_name_is_a_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(fixture("continuous"), "verifi")
    ran = export_model("verifi", "--verify", "none")
    assert ran.status == 0, ran.err
    assert (tmp_path / "exported" / "verifi" / "policy.json").is_file()


def test_what_is_like_no_command_is_a_source_that_is_missing() -> None:
    is_refused(export_model("banana.bytes"), "banana.bytes", "no such file")


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("verify", "x", "--runtime", "numpy"), "--runtimes"),
        ((fixture("continuous"), "--to", "onx"), "onnx"),
        ((fixture("continuous"), "--verify", "onnxruntim"), "did you mean onnxruntime?"),
    ],
)
def test_a_mistyped_option_or_name_is_told(arguments: tuple[object, ...], meant: str) -> None:
    ran = export_model(*arguments)
    assert ran.status == 2
    assert meant in ran.err


def test_the_version_tells_the_runtimes_that_are_here() -> None:
    ran = export_model("--version")
    assert ran.status == 0
    first, second = ran.out.splitlines()
    assert first == f"export-model, version {exporter.__version__}"
    assert second.startswith("runtimes: numpy ")


def completed(shell: str, words: str) -> list[str]:
    """What the program answers to a shell that completes the last of ``words``."""
    environment = {**os.environ, "_EXPORT_MODEL_COMPLETE": f"{shell}_complete", "COMP_WORDS": words}
    environment["COMP_CWORD"] = str(len(words.split(" ")) - 1) if shell == "bash" else words.split(" ")[-1]
    if shell == "zsh":
        environment["COMP_CWORD"] = str(len(words.split(" ")) - 1)
    done = subprocess.run(
        [sys.executable, "-m", "export_model"], env=environment, capture_output=True, encoding="utf-8", check=False
    )
    return done.stdout.splitlines()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("export-model ver", "plain,verify"),
        ("export-model pol", "file,pol"),
        ("export-model policy.bytes --no", "plain,--noise"),
        ("export-model policy.bytes --noise ", "plain,lift"),
        ("export-model verify --all", "plain,--allow-unverified"),
        ("export-model completion z", "plain,zsh"),
    ],
)
def test_the_program_answers_what_bash_asks(words: str, expected: str) -> None:
    assert expected in completed("bash", words)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_gets_its_script(shell: str) -> None:
    ran = export_model("completion", shell)
    assert ran.status == 0
    assert "_EXPORT_MODEL_COMPLETE" in ran.out
    refused = export_model("completion", "csh")
    assert refused.status == 2
    assert "'csh' is not one of 'bash', 'zsh', 'fish'" in refused.err


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not here")
def test_bash_takes_the_script(tmp_path: Path) -> None:
    file = tmp_path / "completion"
    file.write_text(export_model("completion", "bash").out)
    done = subprocess.run(
        ["bash", "-c", f"source {file} && complete -p export-model"], capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr
    assert "-F" in done.stdout


INTERRUPTED = """
import sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "click":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from export_model.exporter.cli.main import main
main(["--help"])
"""


def test_an_interrupt_while_the_program_itself_is_loaded_is_no_traceback() -> None:
    ran = python("-c", INTERRUPTED)
    assert (ran.status, ran.out, ran.err) == (130, "", "\nstopped\n")


#: Of what ``python -m export_model`` and the console script import, from the command line's first module on.
EARLY = """
import sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "export_model.exporter.cli.main":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
{start}
"""


@pytest.mark.parametrize(
    "start",
    [
        "from export_model.exporter.cli.main import main",
        "import runpy; runpy.run_module('export_model', run_name='__main__')",
    ],
)
def test_an_interrupt_before_the_program_has_begun_is_no_traceback(start: str) -> None:
    ran = python("-c", EARLY.format(start=start))
    assert ran.status != 0
    assert (ran.out, ran.err) == ("", "\nstopped\n")


def test_a_command_of_the_demo_is_run_as_it_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    """A folder may be called as a command is."""
    given: list[tuple[str, ...]] = []

    @click.command("export")
    @click.argument("words", nargs=-1)
    def command(words: tuple[str, ...]) -> None:
        given.append(words)

    _run_as_typed(command, "export ", "export", "a b")
    assert given == [("export", "a b")]
    assert capsys.readouterr().out == "$ export-model export export 'a b'\n"
