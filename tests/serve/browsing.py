"""A site on a port of this machine, and Chromium on its page."""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.runtimes.javascript.browser import INSTALL_CHROMIUM, chromium_executable
from export_model.converters.runtimes.javascript.node import (
    INSTALL_NODE,
    INSTALL_TFJS,
    js_home,
    node_executable,
    package_version,
)
from export_model.exporter.serve.server import SiteServer, listening

SCRIPT = Path(__file__).with_name("visit.mjs")
#: The button comes with the page, and is free when the check is done.
CHECKED = "document.querySelector('[data-backend]') !== null && !document.querySelector('#check-body button').disabled"


@dataclass(frozen=True)
class Visit:
    """What was seen: an answer per step, warnings and errors of the console, addresses that were asked for."""

    results: list[Any]
    console: list[str]
    requests: list[str]


def needed() -> str | None:
    """How to install what is missing; None where nothing is."""
    if node_executable() is None:
        return INSTALL_NODE
    if any(package_version(js_home(), name) is None for name in ("playwright-core", "@tensorflow/tfjs")):
        return INSTALL_TFJS
    return INSTALL_CHROMIUM if chromium_executable() is None else None


def with_backends(site: Mapping[str, bytes], *names: str) -> dict[str, bytes]:
    """A site whose page has these backends alone: WebGL in software takes more than all the rest of a visit."""
    said = json.loads(site["site.json"])
    said["backends"] = [each for each in said["backends"] if each["name"] in names]
    assert len(said["backends"]) == len(names)
    return {**site, "site.json": json.dumps(said).encode()}


@contextmanager
def served(site: Mapping[str, bytes]) -> Iterator[SiteServer]:
    with listening(site, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join(30)


def visit(url: str, steps: Sequence[Sequence[Any]], **context: Any) -> Visit:
    """Skips where Chromium, Node or the packages are not here."""
    missing = needed()
    if missing is not None:
        pytest.skip(f"a browser is not to be had: {missing}")
    node, chromium = node_executable(), chromium_executable()
    assert node is not None
    assert chromium is not None
    seen = _browser(node, chromium).ask({"url": url, "context": context, "steps": steps})
    assert "failure" not in seen, seen
    return Visit(seen["results"], seen["console"], seen["requests"])


class _Browser:
    """Chromium, started once: it takes longer than most visits."""

    def __init__(self, node: str, chromium: str) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the process
        command = [node, str(SCRIPT), str(js_home()), chromium]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, encoding="utf-8"
        )
        atexit.register(self._process.communicate)

    def ask(self, request: Mapping[str, Any]) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            print(json.dumps(request), file=self._process.stdin, flush=True)
        try:
            answer = self._process.stdout.readline()
        except BaseException:  # the test was interrupted: this answer must not be the next one's
            _browser.cache_clear()
            self._process.kill()
            raise
        if not answer:
            _browser.cache_clear()  # the next visit has another
            self._process.wait()
            self._errors.seek(0)
            pytest.fail(f"no Chromium any more: {self._errors.read().decode(errors='replace')}")
        return json.loads(answer)


_browser = functools.cache(_Browser)
