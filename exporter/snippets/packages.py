"""The npm packages that pages and programs in JavaScript take their runtime from: beside them, or from a CDN.

A CDN's file is named with its version and its hash, so that a browser runs that file or none. Versions are those that
this project is tested with (converters/runtimes/javascript/js/package-lock.json); a test hashes the installed files.
"""

from __future__ import annotations

import json

from msgspec import Struct

#: Where the files of npm packages lie by version.
CDN = "https://cdn.jsdelivr.net/npm"


class Package(Struct, frozen=True):
    """An npm package: the ES module that a page imports, and its SHA-384 as base64."""

    name: str
    version: str
    module: str
    sha384: str

    @property
    def address(self) -> str:
        """Where the CDN has the module."""
        return f"{CDN}/{self.name}@{self.version}/{self.module}"

    def import_map(self, *, cdn: bool) -> str:
        """What a page's import map says: the module beside the page, or the CDN's with its hash."""
        if not cdn:
            return json.dumps({"imports": {self.name: f"./node_modules/{self.name}/{self.module}"}})
        held = {"imports": {self.name: self.address}, "integrity": {self.address: f"sha384-{self.sha384}"}}
        return json.dumps(held, indent=1)


TFJS = Package(
    "@tensorflow/tfjs",
    "4.22.0",
    "dist/tf.fesm.min.js",
    "sVlxznT2g8UX+LKW0MDllnfEuRVwUddI56wB4DDI438kCsTkdvYxJz657EqBDpmc",
)
#: It fetches its WebAssembly from beside itself.
ORT = Package(
    "onnxruntime-web",
    "1.30.0",
    "dist/ort.wasm.bundle.min.mjs",
    "PLWz+nHEVHpjwBsO0YVdvQj6n5814Iv8E3b8FG0Rp/uIAtjFMCKOpP66iPzedrIG",
)
PACKAGES = (TFJS, ORT)
