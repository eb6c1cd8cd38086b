"""Where an option or its value cannot be, the error repeats the one or the other, whatever command it was given to."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from export_model.exporter.cli.app import app
from fixtures import path as fixture
from tests.commands import export_model

#: What each command needs beside its options; others need a bundle, or take long.
GIVEN = {
    "export": [str(fixture("continuous")), "--verify", "none", "--to", "onnx"],
    "compare": [str(fixture("continuous")), str(fixture("continuous")), "--verify", "numpy", "--allow-unverified"],
    "inspect": [str(fixture("continuous"))],
    "runtimes": [],
    "consumers": [],
}
#: Words and numbers that hardly any option takes.
TYPED = ("nonsens", "-7")


def options() -> Iterator[tuple[str, str]]:
    """(command, option) of all options that take a value."""
    for name, command in app.commands.items():
        for option in command.params:
            if isinstance(option, click.Option) and not option.is_flag and not option.count and name in GIVEN:
                yield name, option.opts[0]


@pytest.mark.parametrize(("command", "option"), sorted(options()))
def test_the_error_repeats_what_was_typed(
    command: str, option: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for typed in TYPED:
        out = [] if option in ("-o", "--out") or command not in ("export", "demo") else ["-o", str(tmp_path / "out")]
        ran = export_model(command, *GIVEN[command], *out, option, typed)
        assert ran.status == 0 or typed in ran.err or f"{option} " in ran.err, ran.err
