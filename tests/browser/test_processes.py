"""No Chromium and no folder outlives the process that started it, however that ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.runtimes.javascript import RUNTIMES
from export_model.converters.runtimes.javascript.node import JS_SOURCE, js_home, node_executable
from export_model.signatures.errors import RuntimeUnavailableError
from tests.runtimes.graph_models import batch, twins, twins_by_numpy

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.xdist_group("browser"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc"),
    pytest.mark.usefixtures("chromium_is_here"),
]


CHROMIUM = next(r for r in RUNTIMES if r.name == "tfjs-cpu@chromium")


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A temporary folder of this test's own, which every process of its Chromium has in its environment."""
    with tempfile.TemporaryDirectory(prefix="b") as made:  # a short path, as users have
        monkeypatch.setenv("TMPDIR", made)
        monkeypatch.setattr(tempfile, "tempdir", None)
        yield Path(made)


@pytest.fixture
def process(room: Path) -> Iterator[RuntimeProcess]:
    with RuntimeProcess(CHROMIUM.name, CHROMIUM.command(), confined=False, browser=True) as started:
        started.start()
        yield started


def processes(room: Path, kind: str = "") -> list[int]:
    """The processes whose environment names the room, which Chromium's inherit, and with ``kind`` in the command."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            around, command = (place / "environ").read_bytes(), (place / "cmdline").read_bytes()
        except OSError:  # it ended, or it is another user's
            continue
        mine = f"TMPDIR={room}".encode() in around or str(room).encode() in command
        if mine and kind.encode() in command and int(place.name) != os.getpid():
            found.append(int(place.name))
    return found


def nothing_left(room: Path) -> bool:
    """Waits: a killed process ends when the kernel gets to it."""
    for _ in range(1200):
        if not processes(room):
            return True
        time.sleep(0.1)
    return False


def folders(room: Path) -> list[str]:
    return sorted(p.name for p in room.iterdir() if p.name.startswith("export-model-browser-"))


def test_close_leaves_no_process_and_no_folder(room: Path, process: RuntimeProcess) -> None:
    assert len(processes(room, "--type=renderer")) >= 1
    assert len(folders(room)) == 1
    process.close()
    assert nothing_left(room)
    assert folders(room) == []


def test_close_in_the_middle_of_the_start_leaves_no_process_and_no_folder(room: Path) -> None:
    """A run that fails elsewhere closes runtimes that were started ahead."""
    for delay in (0.3, 1.2):
        process = RuntimeProcess(CHROMIUM.name, CHROMIUM.command(), confined=False, browser=True)
        process.launch()
        time.sleep(delay)
        process.close()
        assert nothing_left(room)
        assert folders(room) == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_no_process_and_no_folder(room: Path, process: RuntimeProcess, number: int) -> None:
    (runner,) = processes(room, "browser.mjs")
    os.kill(runner, number)
    assert nothing_left(room)
    assert folders(room) == []


def test_a_kill_leaves_no_process_and_a_start_on_a_later_day_removes_the_folder(
    room: Path, process: RuntimeProcess
) -> None:
    (runner,) = processes(room, "browser.mjs")
    os.kill(runner, signal.SIGKILL)
    assert process._process is not None
    process._process.wait()
    assert nothing_left(room)
    (left,) = folders(room)
    young = "export-model-browser-young"
    for name, hours in ((left, 25), (young, 23)):
        (room / name).mkdir(exist_ok=True)
        when = time.time() - hours * 3600
        os.utime(room / name, (when, when))
    process.close()
    process.start()
    assert left not in folders(room)
    assert len(folders(room)) == 2
    process.close()
    assert folders(room) == [young]


def test_a_page_that_dies_is_an_answer_and_the_next_request_a_new_browser(
    tmp_path: Path, room: Path, process: RuntimeProcess
) -> None:
    model = process.load(str(twins(tmp_path / "twins")))
    for renderer in processes(room, "--type=renderer"):
        os.kill(renderer, signal.SIGKILL)
    with pytest.raises(RunFailedError, match="crashed"):
        model.predict(batch(2), ["value"])
    assert nothing_left(room)
    again = process.load(str(tmp_path / "twins"))
    np.testing.assert_allclose(again.predict(batch(2), ["value"])["value"], twins_by_numpy(**batch(2))["value"], 1e-5)


def test_a_browser_that_dies_is_an_answer(tmp_path: Path, room: Path, process: RuntimeProcess) -> None:
    mains = [p for p in processes(room, "--remote-debugging-pipe") if p not in processes(room, "--type=")]
    for main in mains:
        os.kill(main, signal.SIGKILL)
    with pytest.raises(RunFailedError, match=r"Chromium ended|crashed"):
        process.load(str(twins(tmp_path / "twins")))
    assert nothing_left(room)


def test_a_chromium_that_does_not_start_is_an_answer(room: Path) -> None:
    node = node_executable()
    assert node is not None
    script = [node, str(JS_SOURCE / "browser.mjs"), "--runtime", "tfjs-cpu@chromium", "--modules", str(js_home())]
    with (
        RuntimeProcess("none", [*script, "--chromium", "/bin/false"], confined=False, browser=True) as nowhere,
        pytest.raises(RuntimeUnavailableError, match="did not start"),
    ):
        nowhere.start()
    assert folders(room) == []


@pytest.mark.parametrize("arguments", [[], ["--runtime", "netscape"], ["--runtime", "tfjs-webgl"]])
def test_a_bad_command_line_is_status_2(arguments: list[str]) -> None:
    node = node_executable()
    assert node is not None
    ran = subprocess.run([node, str(JS_SOURCE / "browser.mjs"), *arguments], capture_output=True, text=True)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.startswith("browser.mjs: --")


def test_the_server_answers_its_own_page_only_and_only_from_the_packages() -> None:
    node = node_executable()
    assert node is not None
    program = """
        import http from "node:http";
        import { PageServer } from "./browser_server.mjs";
        const server = await PageServer.start(process.argv[1] + "/node_modules");
        const { port, pathname } = new URL(server.url);
        const status = (path) => new Promise((resolve) => {
          http.get({ host: "127.0.0.1", port, path }, (answer) => resolve(answer.statusCode));
        });
        const paths = [
          `${pathname}page`, `${pathname}modules/playwright-core/package.json`, `${pathname}scripts/tfjs.mjs`,
          "/", "/page", `/${"0".repeat(32)}/page`, `${pathname}other`, `${pathname}modules/../package.json`,
          `${pathname}modules/..%2fpackage.json`, `${pathname}scripts/..%2f__init__.py`, `${pathname}scripts/%`,
        ];
        const found = [];
        for (const path of paths) found.push(await status(path));
        console.log(JSON.stringify(found));
        server.close();
    """
    ran = subprocess.run(
        [node, "--input-type=module", "-e", program, str(js_home())], cwd=JS_SOURCE, capture_output=True, text=True
    )
    assert (ran.stdout.strip(), ran.stderr) == ("[200,200,200,404,404,404,404,404,404,404,404]", "")
