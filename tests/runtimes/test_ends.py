"""How the processes of runtimes end: with their parent, whatever they are doing, and never later than they are told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.signatures.errors import RuntimeUnavailableError
from tests.commands import PLACES, default_signals
from tests.runtimes.graph_models import info, node, placeholder, write_model
from tests.runtimes.pipe import NEEDS_NODE

#: A Python child that never ends a request.
BUSY = f"""
import os, sys
sys.path.insert(0, {str(PLACES[0])!r})
from export_model.converters.files.children.child import claim_stdout, serve
out = claim_stdout()
def load(header):
    open(header["path"], "w").write(str(os.getpid()))
    while True:
        pass
serve("busy", "1", load, (), out)
"""
#: A parent that waits for a child of it.
PARENT = f"""
import sys
sys.path.insert(0, {str(PLACES[0])!r})
from export_model.converters.files.children.process import RuntimeProcess
RuntimeProcess("busy", [sys.executable, "-c", {BUSY!r}], confined=False).load(sys.argv[1])
"""
#: A parent whose child multiplies matrices that take TensorFlow.js minutes.
MULTIPLYING = f"""
import sys, threading
import numpy as np
sys.path.insert(0, {str(PLACES[0])!r})
from export_model.converters.files.children.process import RuntimeProcess
from export_model.converters.runtimes.registry import RUNTIMES
def multiply():
    process = RuntimeProcess("tfjs-cpu", next(r for r in RUNTIMES if r.name == "tfjs-cpu").command())
    model = process.load(sys.argv[2])
    open(sys.argv[1], "w").write(str(process._process.pid))
    model.run({{"x": np.ones((4000, 4000), np.float32)}}, ["y"])
multiply() if sys.argv[3] == "main" else threading.Thread(target=multiply).start()
"""


def gone(pid: int) -> bool:
    """Waits for minutes. A child of a process that is gone is nobody's, so it leaves no zombie of ours."""
    for _ in range(1200):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.1)
    return False


def killed_while_busy(tmp_path: Path, program: str, *arguments: str) -> int:
    """The process id of a child whose parent was killed in the middle of a request."""
    place = tmp_path / "pid"
    parent = subprocess.Popen([sys.executable, "-c", program, str(place), *arguments])
    try:
        while not (place.exists() and place.read_text()):
            assert parent.poll() is None
            time.sleep(0.02)
        child = int(place.read_text())
        since = computed(child)
        while computed(child) < since + 0.3:
            time.sleep(0.02)
    finally:
        parent.kill()
        parent.wait()
    return child


def computed(pid: int) -> float:
    """Seconds of a processor that it has had."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_a_python_child_ends_with_its_parent_in_the_middle_of_a_request(tmp_path: Path) -> None:
    assert gone(killed_while_busy(tmp_path, PARENT))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@NEEDS_NODE[0]
@NEEDS_NODE[1]
@pytest.mark.parametrize("thread", ["main", "other"])
def test_a_node_child_ends_with_its_parent_in_the_middle_of_a_request(tmp_path: Path, thread: str) -> None:
    """The kernel kills it with the main thread's process; where another thread started it, it looks by itself."""
    nodes = [placeholder("x", "float32", [None, 4000]), node("y", "MatMul", "x", "x", T={"type": "DT_FLOAT"})]
    signature = ({"x": info("x:0", "float32", [None, 4000])}, {"y": info("y:0", "float32", [None, 4000])})
    model = write_model(tmp_path / "model", nodes, {}, *signature)
    assert gone(killed_while_busy(tmp_path, MULTIPLYING, str(model), thread))


def python(program: str) -> RuntimeProcess:
    return RuntimeProcess("strange", [sys.executable, "-c", program])


def test_one_that_closes_its_pipe_and_lives_on_is_ended() -> None:
    """Its end was waited for, and TimeoutExpired leaked."""
    process = python("import os, time; os.close(1); time.sleep(600)")
    process.launch()
    child = process._process
    assert child is not None
    with pytest.raises(RuntimeUnavailableError, match="strange did not start"):
        process.start()
    assert child.poll() is not None


NO_FRAMES = (b"hello, world", b"\x02\0\0\0[]", b'\x04\0\0\0{"a"', b'\x24\0\0\0{"tensors":[{"dtype":7,"shape":[]}]}')


@pytest.mark.parametrize("said", NO_FRAMES)
def test_one_that_speaks_no_frames_is_refused(said: bytes) -> None:
    with python(f"import os; os.write(1, {said!r})") as process:
        with pytest.raises(RuntimeUnavailableError, match="did not start"):
            process.start()
        with pytest.raises(RunFailedError, match="not running"):
            process.request({"cmd": "hello"})


INTERRUPTED = f"""
import pathlib, sys
sys.path.insert(0, {str(PLACES[0])!r})
from export_model.converters.runtimes.pool import RuntimePool
never = "import time; time.sleep(600)"
with RuntimePool({{"a": lambda: [sys.executable, "-c", never]}}) as pool:
    pool.start(["a"])
    pathlib.Path(sys.argv[1]).touch()
    pool.process("a")
"""


def test_an_interrupt_while_a_runtime_starts_is_not_waited_for(tmp_path: Path) -> None:
    """A job runner sends it to the command alone; the children are the command's to end."""
    command = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, str(tmp_path / "up")],
        stderr=subprocess.DEVNULL,
        preexec_fn=default_signals,
    )
    while not (tmp_path / "up").exists():
        assert command.poll() is None
        time.sleep(0.02)
    time.sleep(0.3)  # so that it waits, most times: before that, the same must come of it
    command.send_signal(signal.SIGINT)
    assert command.wait(300) != 0
