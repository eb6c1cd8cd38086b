"""A runtime that does not answer is ended, and so is no other."""

from __future__ import annotations

import sys
import time

import pytest

from converters.runtimes import process
from converters.runtimes.process import RunFailedError, RuntimeProcess

_PROGRAM = """
import sys, time
from converters.runtimes.wire import read_frame, write_frame
out = sys.stdout.buffer
while True:
    header, _ = read_frame(sys.stdin.buffer)
    if header["cmd"] == "hang":
        time.sleep(3600)
    write_frame(out, {"ok": True, "version": "1"})
"""


def test_one_that_takes_too_long_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_LOOK", 0.1)
    with RuntimeProcess("slow", [sys.executable, "-c", _PROGRAM]) as slow:
        slow.start()
        monkeypatch.setattr(process, "TIMEOUT", 0.3)
        time.sleep(0.5)  # nobody asked: that is no hanging
        monkeypatch.setattr(process, "TIMEOUT", 300.0)  # an answer may take its time on a busy machine
        slow.request({"cmd": "hello"})
        monkeypatch.setattr(process, "TIMEOUT", 0.3)
        with pytest.raises(RunFailedError, match="ended while it was working"):
            slow.request({"cmd": "hang"})
