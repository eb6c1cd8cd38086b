"""TensorFlow.js and onnxruntime-web in Chromium: where a user's page runs them.

They need Node (which drives Chromium), the npm packages that ``js/package-lock.json`` here pins, and a Chromium
that is installed already: nothing here downloads a browser. WebGL draws with Chromium's own software renderer
(SwiftShader) on every machine, so that what is verified does not depend on a graphics card.
"""

from __future__ import annotations

import os
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from export_model.converters.runtimes.base import Runtime, RuntimeInfo
from export_model.converters.runtimes.javascript.node import (
    INSTALL_NODE,
    INSTALL_TFJS,
    SPEEDS,
    install_packages,
    js_home,
    node_executable,
    package_version,
    runner_command,
)
from export_model.signatures.errors import RuntimeUnavailableError

if TYPE_CHECKING:
    from export_model.converters.graph.ops.approximations import Arithmetic

CHROMIUM_VARIABLE = "EXPORT_MODEL_CHROMIUM"
"""The environment variable that names Chromium's program; it goes before every other place."""

INSTALL_CHROMIUM = "apt-get install chromium"
"""Of Debian and Ubuntu; elsewhere Google Chrome will do."""

_ON_PATH = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_USUAL_PLACES = {
    "darwin": (
        "/Applications/Chromium.app/Contents/MacOS/Chromium",
        "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    ),
    "win32": tuple(
        f"{root}/{program}"
        for root in (os.environ.get(v) for v in ("ProgramFiles", "ProgramFiles(x86)", "LocalAppData"))
        if root
        for program in ("Chromium/Application/chrome.exe", "Google/Chrome/Application/chrome.exe")
    ),
}

_TFJS = "@tensorflow/tfjs"
_TFJS_WASM = "@tensorflow/tfjs-backend-wasm"
_ORT = "onnxruntime-web"
_LITERT = "@litertjs/core"
_DRIVER = "playwright-core"


def chromium_executable() -> str | None:
    """Chromium's program: ``EXPORT_MODEL_CHROMIUM``, else on PATH, else where the system usually has it, else None.

    A file that the variable names and that is not there gives None: another browser would not be what was asked for.
    """
    named = os.environ.get(CHROMIUM_VARIABLE)
    if named:
        return shutil.which(str(Path(named).expanduser()))
    found = next(filter(None, map(shutil.which, _ON_PATH)), None)
    return found or next((place for place in _USUAL_PLACES.get(sys.platform, ()) if Path(place).is_file()), None)


def _find(name: str, packages: tuple[str, ...]) -> RuntimeInfo:
    """The version is that of the npm package; Chromium's own would take a third of a second to ask for."""
    home = js_home()
    versions = [package_version(home, package) for package in (*packages, _DRIVER)]
    steps = {
        INSTALL_CHROMIUM: chromium_executable() is None,
        INSTALL_NODE: node_executable() is None,
        INSTALL_TFJS: None in versions,
    }
    missing = [step for step, needed in steps.items() if needed]
    # With everything here, ``how`` is what a user of another machine has to do.
    how = " && ".join(missing or [INSTALL_CHROMIUM, INSTALL_TFJS])
    return RuntimeInfo(name, not missing, None if missing else versions[0], how)


def _command(name: str) -> list[str]:
    chromium = chromium_executable()
    if chromium is None and node_executable() is not None:
        raise RuntimeUnavailableError(
            "Chromium is not installed", fix=f"{INSTALL_CHROMIUM}, or let {CHROMIUM_VARIABLE} name it"
        )
    return runner_command("browser.mjs", name, "--chromium", str(chromium))


def _runtime(name: str, *packages: str, alike: bool = False, arithmetic: Arithmetic = "processor") -> Runtime:
    """``alike``: its sessions begin to draw alike, as those of onnxruntime do."""
    find, command = partial(_find, name, packages), partial(_command, name)
    return Runtime(
        *(name, find, command, install_packages),
        taken_by="full",
        browser=True,
        confined=False,
        arithmetic=arithmetic,
        sessions_alike=alike,
        products_per_second=SPEEDS.get(name.partition("@")[0], 3e8),
    )


RUNTIMES = (
    _runtime("tfjs-webgl", _TFJS, arithmetic="graphics"),
    _runtime("tfjs-cpu@chromium", _TFJS),
    _runtime("tfjs-wasm@chromium", _TFJS, _TFJS_WASM),
    _runtime("onnxruntime-web@chromium", _ORT, alike=True),
    # @litertjs/core 2.5: "Element type BOOL is not supported", INT64 neither
    replace(_runtime("litert-web", _LITERT), fixed=True, dtypes=frozenset(("float32", "int32", "uint8"))),
)
