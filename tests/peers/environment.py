"""The environment with the peers: made on first use, kept in the user's cache, found again by what it was made from.

``python -m tests.peers.environment`` makes it and prints where it is. What this Python has in the very version that is
required, TensorFlow first of all, is not installed a second time (half a minute, 1.6 GB) but found where it is.
EXPORT_MODEL_PEERS names a folder with an environment that is there already.

Imports the standard library only: the benchmark measures peak memory, and what a process holds before it starts another
counts as the other's.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

VARIABLE = "EXPORT_MODEL_PEERS"
HOW = "make the peers' environment: .venv/bin/python -m tests.peers.environment"
REQUIREMENTS = Path(__file__).with_name("requirements.txt")
SHIM = Path(__file__).with_name("shim.py")
_READY = ".ready"
_SHIM_MODULE = "export_model_peers_shim"
#: Of the Python that runs this.
_PACKAGES = sysconfig.get_paths()["purelib"]


class PeersUnavailableError(Exception):
    """The environment is not there and cannot be made here."""


@dataclass(frozen=True)
class Peers:
    """An environment with tensorflowjs, tf2onnx and TensorFlow."""

    home: Path

    @property
    def python(self) -> str:
        return str(self.home / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python"))

    def tensorflowjs_converter(self) -> list[str]:
        """The package's own console script."""
        return [str(Path(self.python).with_name("tensorflowjs_converter"))]

    def tf2onnx(self) -> list[str]:
        return [self.python, "-m", "tf2onnx.convert"]

    def run(self, command: Sequence[str]) -> subprocess.CompletedProcess[str]:
        """Run to the end; raises AssertionError with what it printed where it fails."""
        done = subprocess.run(command, env=environment(), capture_output=True, encoding="utf-8", errors="replace")
        text = "\n".join([*done.stdout.splitlines()[-15:], *done.stderr.splitlines()[-15:]])
        assert done.returncode == 0, f"{' '.join(command)}: status {done.returncode}\n{text}"
        return done


def environment() -> dict[str, str]:
    """What both sides are run with: this user's variables, but nothing that keeps Python from using its bytecode."""
    dropped = ("PYTHONDONTWRITEBYTECODE", "PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV")
    own = {key: value for key, value in os.environ.items() if key not in dropped}
    return {**own, "TF_CPP_MIN_LOG_LEVEL": "3", "CUDA_VISIBLE_DEVICES": "-1"}


def ensure_peers() -> Peers:
    """The environment, made if need be. Raises PeersUnavailableError."""
    named = os.environ.get(VARIABLE)
    if named:
        peers = Peers(Path(named).expanduser().absolute())
        if not Path(peers.python).exists():
            raise PeersUnavailableError(f"{VARIABLE} names {peers.home}, which has no {peers.python}")
        return peers
    if sys.platform == "win32":
        raise PeersUnavailableError("the peers' environment is made on Linux and macOS only")
    home = _place()
    home.parent.mkdir(parents=True, exist_ok=True)
    with _locked(home.parent / f"{home.name}.lock"):
        if not (home / _READY).exists():
            shutil.rmtree(home, ignore_errors=True)  # what a killed run has left
            _make(home)
            (home / _READY).touch()
    return Peers(home)


def _place() -> Path:
    """A folder of its own for each content of the requirements and the shim, and each version of Python."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    missing = " ".join([_PACKAGES, *_missing()])
    digest = hashlib.sha256(REQUIREMENTS.read_bytes() + SHIM.read_bytes() + (version + missing).encode()).hexdigest()
    # Imported here: converters/runtimes/registry.py is small, but the benchmark's process should stay smaller still.
    from export_model.converters.runtimes.installed import cache_folder

    return cache_folder() / f"peers-{digest[:12]}"


class _locked:  # noqa: N801  used as a function
    """Several test processes may want the environment at once: one makes it, the others wait."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> None:
        import fcntl

        self._file = self._path.open("w")
        fcntl.flock(self._file, fcntl.LOCK_EX)

    def __exit__(self, *exception: object) -> None:
        self._file.close()


def _missing() -> list[str]:
    """The requirements that this Python has not, or in another version."""
    lines = [line for line in REQUIREMENTS.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    here = {p.name.lower() for p in Path(_PACKAGES).glob("*.dist-info")}
    return [line for line in lines if f"{line.lower().replace('-', '_').replace('==', '-')}.dist-info" not in here]


def _make(home: Path) -> None:
    # Made without links to another virtual environment: the interpreter that this one stands on.
    base = getattr(sys, "_base_executable", sys.executable)
    _step([base, "-m", "venv", str(home)])
    python = Peers(home).python
    _step([python, "-m", "pip", "install", "--quiet", "--no-deps", *_missing()])
    find = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    packages = Path(_step([python, "-c", find]).strip())
    shutil.copyfile(SHIM, packages / f"{_SHIM_MODULE}.py")
    (packages / f"{_SHIM_MODULE}.pth").write_text(f"import {_SHIM_MODULE}\n{_PACKAGES}\n", encoding="utf-8")
    # pip compiles by itself unless it was told not to. Without bytecode the peers would start three times slower, and
    # the comparison would flatter us. Some packages ship files for other versions of Python; those fail, and may.
    subprocess.run([python, "-m", "compileall", "-q", "-j", "0", str(packages)], env=environment(), capture_output=True)


def _step(command: Sequence[str]) -> str:
    try:
        done = subprocess.run(command, env=environment(), capture_output=True, encoding="utf-8", errors="replace")
    except OSError as error:
        raise PeersUnavailableError(str(error)) from error
    if done.returncode:
        last = [line for line in done.stderr.splitlines() if line.strip()][-3:]
        raise PeersUnavailableError(f"{' '.join(command[1:4])} failed: {' '.join(last)}")
    return done.stdout


if __name__ == "__main__":
    try:
        print(ensure_peers().home)
    except PeersUnavailableError as error:
        sys.exit(str(error))
