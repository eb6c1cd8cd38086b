"""``python -m tests.runtimes.write_installed``: the sha256 of what is loaded of the npm packages in the lock.

After a change of ``package-lock.json``, in a checkout whose node_modules were just installed from it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from export_model.converters.runtimes.javascript.node import JS_SOURCE, js_home
from export_model.signatures.digest import sha256_hex

#: Package → its files that a runtime, a browser's page or the page of ``serve`` loads.
LOADED = {
    "@tensorflow/tfjs-core": ("dist/tf-core.node.js",),
    "@tensorflow/tfjs-converter": ("dist/tf-converter.node.js",),
    "@tensorflow/tfjs-backend-cpu": ("dist/tf-backend-cpu.node.js",),
    "@tensorflow/tfjs-backend-wasm": (
        *("dist/tf-backend-wasm.node.js", "dist/tf-backend-wasm.min.js", "dist/tf-backend-wasm.es2017.min.js"),
        "dist/*.wasm",
    ),
    "@tensorflow/tfjs-backend-webgpu": ("dist/tf-backend-webgpu.es2017.min.js",),
    "@tensorflow/tfjs": ("dist/tf.min.js", "dist/tf.es2017.min.js"),
    "onnxruntime-web": ("dist/ort.wasm.min.js", "dist/ort.wasm.min.mjs", "dist/ort-wasm-simd-threaded.*"),
    "@litertjs/core": ("dist/index.js", "wasm/litert_wasm_*"),
    "@litertjs/wasm-utils": ("dist/index.js",),
    "seedrandom": ("*.js", "lib/*.js"),
    "playwright-core": ("**/*.js", "**/*.mjs", "browsers.json"),
}


def installed(modules: Path) -> dict[str, str]:
    """File in ``node_modules`` → its sha256."""
    return {path.relative_to(modules).as_posix(): sha256_hex(path.read_bytes()) for path in _files(modules)}


def _files(modules: Path) -> Iterator[Path]:
    for package, patterns in LOADED.items():
        folder = modules / package
        found = {path for pattern in ("package.json", *patterns) for path in folder.glob(pattern) if path.is_file()}
        yield from sorted(path for path in found if path.suffix != ".map")


if __name__ == "__main__":
    text = json.dumps(installed(js_home() / "node_modules"), indent=1)
    (JS_SOURCE / "installed.json").write_text(f"{text}\n", encoding="utf-8")
