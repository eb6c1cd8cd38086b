"""A site on a port of this machine, and Chromium on its page."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from converters.runtimes.javascript.browser import INSTALL_CHROMIUM, chromium_executable
from converters.runtimes.javascript.node import INSTALL_NODE, INSTALL_TFJS, js_home, node_executable, package_version
from exporter.serve.server import SiteServer, listening

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
    request = json.dumps({"url": url, "context": context, "steps": steps})
    done = subprocess.run(
        [node, str(SCRIPT), str(js_home()), chromium], input=request, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert "failure" not in seen, seen
    return Visit(seen["results"], seen["console"], seen["requests"])
