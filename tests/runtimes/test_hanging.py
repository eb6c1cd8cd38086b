"""A runtime that does not answer is ended, and so is no other."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.files.children import process
from export_model.converters.files.children import time_limits as patience
from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.formats.keras import children
from export_model.converters.runtimes.pool import RuntimePool
from export_model.signatures.errors import DamagedFileError

_PROGRAM = """
import sys, time
from export_model.converters.files.children.frames import read_frame, write_frame
out = sys.stdout.buffer
while True:
    header, _ = read_frame(sys.stdin.buffer)
    if header["cmd"] == "hang":
        time.sleep(3600)
    end = time.process_time() + float(sys.argv[2])
    while header["cmd"] == sys.argv[1] and time.process_time() < end:
        pass
    write_frame(out, {"ok": True, "version": "1"})
"""


def test_one_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_LOOK", 0.1)
    with RuntimeProcess("slow", [sys.executable, "-c", _PROGRAM, "", "0"]) as slow:
        slow.start()
        monkeypatch.setattr(process, "TIMEOUT", 0.3)
        time.sleep(0.5)  # nobody asked: that is no hanging
        monkeypatch.setattr(process, "TIMEOUT", 300.0)  # an answer may take its time on a busy machine
        slow.request({"cmd": "hello"})
        monkeypatch.setattr(process, "TIMEOUT", 0.3)
        with pytest.raises(RunFailedError, match="ended while it was working"):
            slow.request({"cmd": "hang"})


@pytest.mark.skipif(sys.platform != "linux", reason="no other system says how long a child has computed")
@pytest.mark.parametrize("command", ["load", "run"])
def test_what_computes_for_ever_is_stopped_once_for_all_runtimes(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "_LOOK", 0.05)
    monkeypatch.setattr(patience, "FIRST", 0.2)
    model = tmp_path / "model"
    model.touch()
    pool = RuntimePool({name: lambda: [sys.executable, "-c", _PROGRAM, command, "inf"] for name in ("one", "other")})
    with pool, pytest.raises(RunFailedError, match="one was stopped: it did not come to an end"):
        pool.process("one").load(str(model)).run({}, [])
    with pool, pytest.raises(RunFailedError, match="not run in other"):
        pool.process("other").load(str(model))


def test_a_model_that_answered_before_may_take_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_LOOK", 0.05)
    monkeypatch.setattr(patience, "FIRST", 0.2)
    model = tmp_path / "model"
    model.touch()
    with RuntimePool({"slow": lambda: [sys.executable, "-c", _PROGRAM, "run", "1"]}) as pool:
        assert pool.process("slow").load(str(model), answered=True).run({}, []) == {}


@pytest.mark.skipif(sys.platform != "linux", reason="no other system says how long a child has computed")
@pytest.mark.parametrize("command", ["load", "run"])
def test_an_h5_that_keeps_its_library_busy_is_refused(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("h5py")
    monkeypatch.setattr(process, "_LOOK", 0.05)
    monkeypatch.setattr(patience, "FIRST", 0.2)
    program = [sys.executable, "-c", _PROGRAM, command, "inf"]
    monkeypatch.setattr(children, "child_command", lambda module: program)
    (tmp_path / "policy.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(DamagedFileError) as refused:
        children.stored_in(tmp_path / "policy.h5")
    assert "of computing are enough" in (refused.value.why or "")


def test_a_model_that_is_collected_in_the_middle_of_an_answer_is_freed_with_the_next_request(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A collector's run there read another model's answer as its own, and the process was taken for broken."""
    sent: list[str] = []
    model = tmp_path / "model"
    model.touch()
    read, write = process.read_frame, process.write_frame

    def collect(*given: Any) -> Any:
        if sent[-1] == "run":
            first.unload()
        return read(*given)

    def note(stream: Any, header: Any, *tensors: Any) -> None:
        sent.append(header["cmd"])
        write(stream, header, *tensors)

    with RuntimeProcess("quick", [sys.executable, "-c", _PROGRAM, "", "0"]) as quick:
        first, second = quick.load(str(model)), quick.load(str(model))
        monkeypatch.setattr(process, "read_frame", collect)
        monkeypatch.setattr(process, "write_frame", note)
        second.run({}, [])
        assert sent == ["run"]
        quick.request({"cmd": "hello"})
        assert sent == ["run", "unload", "hello"]
