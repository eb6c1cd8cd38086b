"""``export-model snippets`` for pages and Node: what is printed runs as printed, and gives what numpy gives."""

from __future__ import annotations

import base64
import functools
import hashlib
import http.server
import json
import queue
import re
import shutil
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.javascript.node import js_home, node_executable
from export_model.exporter.snippets.packages import CDN, PACKAGES, TFJS, Package
from tests.acting.snippet_bundles import NAMES, code_of
from tests.commands import ROOT
from tests.exporting import load_policy

LOCKED = ROOT / "converters" / "runtimes" / "javascript" / "js"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

PAGES = ("policy-tfjs", "policy-ort", "tfjs", "onnxruntime-web")


def module_of(page: str, modules: Path, folder: Path) -> str:
    """The page's module, its imports resolved as its import map says."""
    (mapped,) = re.findall(r'<script type="importmap">\n(.*?)\n</script>', page, re.S)
    (code,) = re.findall(r'<script type="module">\n(.*?)\n</script>', page, re.S)
    return resolved(code, json.loads(mapped)["imports"], modules, folder)


def resolved(code: str, imports: dict[str, str], modules: Path, folder: Path) -> str:
    """A module's imports as files: packages by an import map, other modules from ``folder``."""
    for package, target in imports.items():
        file = modules / target
        assert file.is_file(), target
        if file.suffix == ".js":  # a module all the same; Node goes by the name
            named = folder / f"{file.stem}.mjs"
            shutil.copy(file, named)
            file = named
        code = code.replace(f'"{package}"', json.dumps(file.as_uri()))
    return re.sub(r'from "\./', f'from "{folder.as_uri()}/', code)


@pytest.fixture(scope="module")
def logs(out: Path) -> Callable[[str, str], list[Any]]:
    """(target, policy) → what the page logged, call by call."""

    @functools.cache
    def ran() -> dict[tuple[str, str], Any]:
        node, home = node_executable(), js_home()
        if node is None or not (home / "node_modules/@tensorflow/tfjs").is_dir():
            pytest.skip("Node.js with @tensorflow/tfjs and onnxruntime-web is not here: make install")
        files = {}
        for target in PAGES:
            for name in NAMES:
                file = out / f"{target}-{name}.mjs"
                file.write_text(module_of(code_of(out, name, target), home, out), encoding="utf-8")
                files[target, name] = str(file)
        done = subprocess.run(
            [node, str(Path(__file__).with_name("run_pages.mjs"))],
            input=json.dumps(list(files.values())),
            capture_output=True,
            text=True,
            cwd=out,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        return dict(zip(files, json.loads(done.stdout), strict=True))

    return lambda target, name: ran()[target, name]


@pytest.mark.slow
@pytest.mark.parametrize("target", PAGES)
@pytest.mark.parametrize("name", NAMES)
def test_what_a_page_is_told_gives_what_numpy_gives(
    name: str, target: str, out: Path, logs: Callable[[str, str], list[Any]]
) -> None:
    policy = load_policy(out / name, runtime="numpy")
    agents = policy.agent(deterministic=True)
    zeros = {s.name: np.zeros([n or 1 for n in s.shape], s.dtype) for s in policy.signature.observations}
    lines = logs(target, name)
    assert len(lines) == (3 if name == "recurrent" else 1)
    for (values,) in lines:
        expected = agents.decide(zeros).action
        np.testing.assert_allclose(np.array(values).reshape(expected.shape), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("target", [*PAGES, *(f"{page}-cdn" for page in PAGES)])
def test_a_page_runs_in_a_browser(target: str, out: Path, tmp_path: Path) -> None:
    """With a CDN that is this machine: the browser holds its file to the hash all the same."""
    page = code_of(out, "recurrent", target).replace(f"{CDN}/", "./cdn/")
    *logged, shown = answers_of(page, out, tmp_path, 4)
    for (values,) in logged:
        assert np.size(values) == 2, logged
    # The page posts them side by side, so they may arrive in another order.
    assert sorted(json.loads(line) for line in shown.splitlines()) == sorted(values for (values,) in logged)


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_a_browser_runs_no_other_file_of_a_cdn(out: Path, tmp_path: Path) -> None:
    page = code_of(out, "recurrent", "tfjs-cdn").replace(f"{CDN}/", "./cdn/")
    (said,) = answers_of(page.replace(TFJS.sha384, TFJS.sha384[::-1]), out, tmp_path, 1)
    assert said == "not loaded"


@pytest.mark.parametrize("package", PACKAGES, ids=lambda p: p.name)
def test_a_package_of_a_cdn_is_the_one_that_is_tested_with(package: Package) -> None:
    installed = js_home() / "node_modules" / package.name
    if not installed.is_dir():
        pytest.skip(f"{package.name} is not here: make install")
    lock = json.loads((LOCKED / "package-lock.json").read_text())
    assert lock["packages"][f"node_modules/{package.name}"]["version"] == package.version
    digest = hashlib.sha384((installed / package.module).read_bytes()).digest()
    assert base64.b64encode(digest).decode() == package.sha384


def answers_of(page: str, out: Path, tmp_path: Path, count: int) -> list[Any]:
    """What a page prints, and last what it shows, in Chromium; packages lie in node_modules and as a CDN has them."""
    home = js_home()
    if not (home / "node_modules/@tensorflow/tfjs").is_dir():
        pytest.skip("@tensorflow/tfjs is not here: make install")
    (tmp_path / "node_modules").symlink_to((home / "node_modules").resolve())
    for package in PACKAGES:
        place = tmp_path / "cdn" / f"{package.name}@{package.version}"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to((home / "node_modules" / package.name).resolve())
    (tmp_path / "recurrent").symlink_to(out / "recurrent")
    tell = "(what) => navigator.sendBeacon('/told', JSON.stringify(what))"
    told = f"<script>const tell = {tell}; let logs = 0; onerror = (m) => tell('error: ' + m);"
    told += "const shown = () => tell(document.getElementById('answer').textContent);"
    told += "console.log = (...v) => { tell(v); if (++logs === 3) setTimeout(shown, 500); };"
    told += "onunhandledrejection = (e) => tell('error: ' + e.reason);</script>"
    page = page.replace('<script type="module">', '<script type="module" onerror="tell(\'not loaded\')">')
    (tmp_path / "index.html").write_text(page.replace('<meta charset="utf-8">', f'<meta charset="utf-8">{told}'))
    answers: queue.Queue[Any] = queue.Queue()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

        def do_POST(self) -> None:
            answers.put(json.loads(self.rfile.read(int(self.headers["content-length"]))))
            self.send_response(204)
            self.end_headers()

    handler = functools.partial(Handler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        assert CHROMIUM is not None
        command = [CHROMIUM, "--headless", "--no-sandbox", f"--user-data-dir={tmp_path / 'profile'}"]
        browser = subprocess.Popen(
            [*command, f"http://127.0.0.1:{server.server_port}/"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            return [answers.get(timeout=600) for _ in range(count)]
        finally:
            browser.kill()
            browser.wait()
            server.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("target", ["policy-node", "policy-ort-node", "tfjs-node", "onnxruntime-web-node"])
@pytest.mark.parametrize("name", ["recurrent", "continuous"])
def test_node_runs_what_is_printed_for_it(name: str, target: str, out: Path, tmp_path: Path) -> None:
    """As it is printed, with paths: nothing is fetched."""
    node, home = node_executable(), js_home()
    if node is None or not (home / "node_modules/@tensorflow/tfjs").is_dir():
        pytest.skip("Node or @tensorflow/tfjs is not here: make install")
    (tmp_path / "node_modules").symlink_to((home / "node_modules").resolve())
    shutil.copytree(out / name, tmp_path / name)
    (tmp_path / "play.mjs").write_text(code_of(out, name, target), encoding="utf-8")
    done = subprocess.run([node, "play.mjs"], cwd=tmp_path, capture_output=True, encoding="utf-8", timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    agents = load_policy(out / name, runtime="numpy").agent(deterministic=True)
    zeros = {s.name: np.zeros([n or 1 for n in s.shape], s.dtype) for s in agents.policy.signature.observations}
    lines = [line for line in done.stdout.splitlines() if line.startswith("[")]
    assert len(lines) == (3 if name == "recurrent" else 1)
    for line in lines:
        expected = agents.decide(zeros).action
        np.testing.assert_allclose(np.reshape(json.loads(line), expected.shape), expected, atol=1e-5, rtol=1e-5)
