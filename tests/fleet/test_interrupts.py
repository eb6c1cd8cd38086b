"""Ctrl-C of a terminal, which every process of it gets, while the workers of a fleet still start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fixtures import path as fixture
from tests.commands import ROOT, default_signals

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="children are found in /proc")


def workers_of(process: subprocess.Popen[str]) -> list[str]:
    """Return the pids of a process's children that were started as workers."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text(encoding="ascii").split()
    return [pid for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]


@pytest.mark.parametrize("after", [0.0, 0.05, 0.1, 0.2])
def test_an_interrupt_is_the_business_of_the_first_process(after: float, tmp_path: Path) -> None:
    """A worker that imports its modules would end in a traceback; those that get it alone go on with their work."""
    command = subprocess.Popen(
        [
            *(sys.executable, "-m", "export_model", "export", "--jobs", "2", "--verify", "none", "-o", tmp_path),
            *(fixture(name) for name in ("continuous", "discrete", "visual", "recurrent")),
        ],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        preexec_fn=default_signals,
    )
    while command.poll() is None and not workers_of(command):
        time.sleep(0.001)
    time.sleep(after)
    for worker in workers_of(command):
        os.kill(int(worker), signal.SIGINT)
    out, err = command.communicate()
    assert "Traceback" not in out + err
    assert command.returncode == 0, (out, err)
    assert "4 policies exported" in " ".join(out.split())
