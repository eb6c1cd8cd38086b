"""Print what a release may install, as CycloneDX JSON: the locked packages of Python and npm."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCK = ROOT / "converters/runtimes/javascript/js/package-lock.json"


def python_components() -> list[dict[str, object]]:
    """Those of constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = (line.split("==") for line in lines if "==" in line and not line.startswith("#"))
    return [_component(name.strip(), version.strip(), "pypi") for name, version in pins]


def npm_components() -> list[dict[str, object]]:
    """Those of the lock, with the sha512 that npm holds them against."""
    packages = json.loads(LOCK.read_text(encoding="utf-8"))["packages"]
    found = []
    for place, package in packages.items():
        if place:
            digest = base64.b64decode(package["integrity"].removeprefix("sha512-")).hex()
            component = _component(place.rpartition("node_modules/")[2], package["version"], "npm")
            found.append({**component, "hashes": [{"alg": "SHA-512", "content": digest}]})
    return found


def _component(name: str, version: str, kind: str) -> dict[str, object]:
    purl = f"pkg:{kind}/{name.replace('@', '%40')}@{version}"
    return {"type": "library", "name": name, "version": version, "purl": purl, "bom-ref": purl}


if __name__ == "__main__":
    components = [*python_components(), *npm_components()]
    bill = {"bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "components": components}
    sys.stdout.write(f"{json.dumps(bill, indent=1)}\n")
