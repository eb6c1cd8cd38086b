"""What a release and the GitHub Action take from elsewhere is fixed to its bytes or its version."""

from __future__ import annotations

import json
import re
import subprocess
import sys

from export_model.exporter import __version__
from tests.commands import ROOT

WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))


def test_actions_are_pinned_by_commit() -> None:
    used = [line.split("uses:")[1].strip() for w in WORKFLOWS for line in w.read_text().splitlines() if "uses:" in line]
    assert used
    for action in used:
        assert action == "./" or re.fullmatch(r"[\w/-]+@[0-9a-f]{40} # v[\d.]+", action), action


def test_the_action_installs_this_version_without_tensorflow() -> None:
    (installed,) = re.findall(r'default: "(export-model.*)"', (ROOT / "action.yml").read_text())
    assert installed.endswith(f"=={__version__}")
    extras = installed.partition("[")[2].partition("]")[0].split(",")
    assert "tensorflow" not in extras and "all" not in extras


def test_a_release_is_built_by_wheels_with_hashes() -> None:
    release = (ROOT / ".github/workflows/release.yml").read_text()
    assert "--require-hashes --only-binary :all: -r .ci/build.txt" in release and "--no-isolation" in release
    for line in (ROOT / ".ci/build.txt").read_text().splitlines()[1:]:
        assert re.fullmatch(r"[\w.]+==[\w.]+ --hash=sha256:[0-9a-f]{64}", line)


def test_the_bill_of_materials_has_what_is_locked() -> None:
    done = subprocess.run([sys.executable, str(ROOT / ".ci/sbom.py")], capture_output=True, text=True, check=True)
    named = {(c["name"], c["version"]) for c in json.loads(done.stdout)["components"]}
    assert (
        "playwright-core",
        json.loads((ROOT / "converters/runtimes/javascript/js/package-lock.json").read_text())["packages"][
            "node_modules/playwright-core"
        ]["version"],
    ) in named
    pins = (line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    assert {(name, version) for name, version in pins} <= named
