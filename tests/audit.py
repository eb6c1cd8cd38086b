"""``python -m tests.audit``: the locked dependencies are what is installed, what is known against them, and that no
function has grown too large (tests/function_sizes.py) or is called with too many arguments by place
(tests/positional_arguments.py).

Held without a network: what is installed of constraints.txt has the version of it, and every npm package of
package-lock.json has a hash. Known vulnerabilities are pip-audit's and npm's to say, which ask
their services: what could not be asked is said in so many words, and is no failure.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path

from tests import function_sizes, positional_arguments

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ROOT / "converters/runtimes/javascript/js"


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def locked() -> dict[str, str]:
    """Distribution → version, of constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pairs = (line.split(";")[0].strip().partition("==") for line in lines if "==" in line and not line.startswith("#"))
    return {_normal(name): version for name, _, version in pairs}


def faults() -> Iterator[str]:
    """What is not locked, or not as it is locked."""
    known = locked()
    for found in distributions():
        name = _normal(found.metadata["Name"])
        if known.get(name, found.version) != found.version:
            yield f"{name} {found.version} is installed, and constraints.txt has {known[name]}"
    lock = json.loads((PACKAGES / "package-lock.json").read_text())
    for path, entry in lock["packages"].items():
        if path and not entry.get("integrity", "").startswith("sha512-"):
            yield f"{path} has no hash in package-lock.json"


def asked() -> Iterator[str]:
    """What the services that know vulnerabilities say, a line each."""
    command = shutil.which("pip-audit", path=str(Path(sys.executable).parent)) or shutil.which("pip-audit")
    if command is None:
        yield "vulnerabilities of Python packages: NOT ASKED, pip-audit is not installed (pip install pip-audit)"
        return
    arguments = [command, "--requirement", "constraints.txt", "--no-deps", "--disable-pip", "--progress-spinner", "off"]
    done = subprocess.run(arguments, cwd=ROOT, capture_output=True, encoding="utf-8", timeout=120, check=False)
    said = (done.stdout + done.stderr).strip()
    if done.returncode and "Connection" in said:
        yield "vulnerabilities of Python packages: NOT ASKED, the service cannot be reached from here"
    elif done.returncode:
        raise SystemExit(said)
    else:
        yield "vulnerabilities of Python packages: none known to pip-audit"


def main() -> int:
    """1 where something is not locked, a function has become too large, or arguments are told by place alone."""
    found, large = list(faults()), [*function_sizes.faults(), *positional_arguments.faults()]
    for line in (*found, *asked(), *large):
        print(line)
    print(f"{len(locked())} Python packages and their npm packages are " + ("NOT as locked" if found else "as locked"))
    return 1 if found or large else 0


if __name__ == "__main__":
    sys.exit(main())
