"""A folder with the files to try, and what runs the blocks of a page there."""

from __future__ import annotations

import functools
import http.server
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import tomllib
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from export_model.exporter.demo.files import write_files
from tests.commands import PLACES, ROOT
from tests.docs.blocks import Block
from tests.serve.browsing import needed, visit

#: First on PYTHONPATH, a module there makes ``auto`` stand for onnxruntime.
NARROW = ROOT / "tests/docs/narrow"
MODULES = ROOT / "converters/runtimes/javascript/js/node_modules"


def furnish(folder: Path) -> None:
    """What a reader has who typed ``export-model demo --files`` there, and installed npm's packages."""
    write_files(folder)
    if MODULES.is_dir():
        (folder / "node_modules").symlink_to(MODULES)


@contextmanager
def _serving(folder: Path) -> Iterator[str]:
    """What ``python -m http.server`` does there; gives the address."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


class Workshop:
    """Runs the blocks of one page, one after the other, in one folder."""

    def __init__(self, folder: Path, python: Path = Path(sys.executable)) -> None:
        self.folder, self.python = folder, python
        self.narrow = False
        self._programs = 0
        self._last = ""

    def run(self, block: Block) -> None:
        """Run a block, or look at it, as its language and the page say."""
        if block.verb == "skip":
            assert len(block.argument) > 10, f"{block.where}: skipped without a reason"
            return
        HOW[block.language](self, block)

    def shell(self, block: Block) -> None:
        command = ["bash", "-euo", "pipefail", "-c", block.text]
        if block.verb == "until":
            self._interrupted(command, block)
        else:
            self._finished(command, block)
            for target, name in re.findall(r"--for (\S+) > (\S+\.(?:html|mjs))", block.text):
                self._opened(self.folder / name, block, served="cdn" not in target)

    def _opened(self, file: Path, block: Block, *, served: bool) -> None:
        """Open a page or run a program that a block wrote, with npm's packages beside it; no CDN can be reached."""
        node = shutil.which("node")
        if node is None or not MODULES.is_dir() or (file.suffix == ".html" and needed() is not None):
            return
        if not (file.parent / "node_modules").exists():
            (file.parent / "node_modules").symlink_to(MODULES)
        if file.suffix == ".mjs":
            self._finished([node, file.name], block, file.parent)
            return
        answer = "document.getElementById('answer').textContent"
        with _serving(file.parent) as address:
            seen = visit(f"{address}/{file.name}", [["wait", f"{answer} !== ''"], ["eval", answer]])
        shown = str(seen.results[-1])
        wanted = "[" if served else "Error: a module was not loaded"
        assert shown.startswith(wanted), f"{block.where}: {file.name} shows {shown}"

    def python(self, block: Block) -> None:
        text = f"{self._last}\n\n{block.text}" if block.verb == "continues" else block.text
        self._last = text
        self._finished([str(self.python), self._program(text, "py")], block)

    def javascript(self, block: Block) -> None:
        node = shutil.which("node")
        if node is None or not MODULES.is_dir():
            pytest.skip("Node or its packages are not here; get them with: make install")
        check = ["--check"] if block.verb == "check" else []
        self._finished([node, *check, self._program(block.text, "mjs")], block)

    def yaml(self, block: Block) -> None:
        assert pytest.importorskip("yaml").safe_load(block.text), block.where

    def toml(self, block: Block) -> None:
        assert tomllib.loads(block.text), block.where

    def json(self, block: Block) -> None:
        assert json.loads(block.text), block.where

    def shown(self, block: Block) -> None:
        """Output, a picture, or a language of another machine: there must be no command in it."""
        first = block.text.split(" ")[0]
        assert first not in ("export-model", "python", "pip", "make"), f"{block.where}: a command in a block of text"

    # ---- processes

    def _program(self, text: str, suffix: str) -> str:
        self._programs += 1
        name = f"program{self._programs}.{suffix}"
        (self.folder / name).write_text(text, encoding="utf-8")
        return name

    def _environment(self) -> dict[str, str]:
        return {
            **os.environ,
            "PATH": f"{self.python.parent}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": os.pathsep.join(map(str, (NARROW, *PLACES) if self.narrow else PLACES)),
            "GITHUB_STEP_SUMMARY": str(self.folder / "summary.md"),
            "TF_CPP_MIN_LOG_LEVEL": "3",
            "CUDA_VISIBLE_DEVICES": "-1",
        }

    def _finished(self, command: list[str], block: Block, folder: Path | None = None) -> None:
        done = subprocess.run(
            command,
            cwd=folder or self.folder,
            env=self._environment(),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            check=False,
        )
        wanted = int(block.argument) if block.verb == "status" else 0
        said = f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
        assert done.returncode == wanted, f"{block.where}: status {done.returncode}\n{block.text}\n{said}"

    def _interrupted(self, command: list[str], block: Block) -> None:
        """Start it, read until it has said the text; where that is an address, open it; then Ctrl-C.

        The page's port may be taken on this machine, so a server gets a free one.
        """
        if block.text.startswith("export-model serve "):
            command = [*command[:-1], block.text.replace("export-model serve ", "export-model serve --port 0 ", 1)]
        process = subprocess.Popen(
            command,
            cwd=self.folder,
            env={**self._environment(), "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            start_new_session=True,
        )
        assert process.stdout is not None
        try:
            lines: list[str] = []
            for line in process.stdout:
                lines.append(line)
                if block.argument in line:
                    break
            assert lines and block.argument in lines[-1], f"{block.where}: {''.join(lines)}"
            address = next((word for word in lines[-1].split() if word.startswith("http://")), None)
            if address is not None:
                with urllib.request.urlopen(address, timeout=60) as answer:
                    assert answer.status == 200
        finally:
            os.killpg(process.pid, signal.SIGINT)
            process.stdout.close()
            try:
                process.wait(60)
            finally:
                process.kill()
                process.wait()


HOW = {
    "sh": Workshop.shell,
    "python": Workshop.python,
    "js": Workshop.javascript,
    "yaml": Workshop.yaml,
    "toml": Workshop.toml,
    "json": Workshop.json,
    "text": Workshop.shown,
    "csharp": Workshop.shown,
    "kotlin": Workshop.shown,
    "swift": Workshop.shown,
    "": Workshop.shown,
}
