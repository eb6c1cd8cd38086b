"""The commands that only tell: ``inspect`` of what a file is, ``runtimes`` of what is installed."""

from __future__ import annotations

import re
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.base import Progress
from export_model.converters.runtimes.javascript.node import install_packages
from export_model.converters.runtimes.registry import RUNTIMES, Runtime
from export_model.exporter.cli.terminal import next_text
from export_model.exporter.tables import command_text
from fixtures import path as fixture
from fixtures.trained import run_folder as trained_run
from tests.commands import ROOT, export_model, files_in, is_refused
from tests.handmade import NodeDef, constant, dense, graph_bytes, node, placeholder

BALL = fixture("continuous")


# ------------------------------------------------------------------ inspect


def test_inspection_says_what_to_feed_and_what_comes_out() -> None:
    ran = export_model("inspect", fixture("sampled"))
    assert (ran.status, ran.err) == (0, "")
    assert "branches [3, 2, 4]" in ran.out
    assert "1 = allowed, 0 = forbidden" in ran.out
    assert "action drawn inside the graph" in ran.out
    assert "can be written as: bytes, saved_model, tfjs, onnx" in ran.out
    assert ran.out.splitlines()[-1] == f"next: export-model {fixture('sampled')} -o exported"
    assert "memory 32 [c|h]" in export_model("inspect", fixture("recurrent")).out
    assert "divide bytes by 255" in export_model("inspect", fixture("visual")).out
    assert "2 policies" in export_model("inspect", fixture("twobrains")).out


def test_inspection_as_json_has_the_contract_of_each_policy() -> None:
    ran = export_model("inspect", fixture("recurrent"), "--json")
    assert (ran.status, ran.err) == (0, "")
    assert set(ran.json) == {"schema", "path", "kind", "sha256", "bytes", "nodes", "producer", "policies"}
    policy = ran.json["policies"][0]
    assert policy["memory"] == {"size": 32, "input": "recurrent_in", "output": "recurrent_out", "layout": ["c", "h"]}
    assert policy["branches"] == [3, 2]
    assert policy["targets"] == {t: {"ok": True, "reason": None} for t in WRITTEN}
    assert policy["ops"]["Placeholder"] == 4


def test_inspection_tells_the_layers_the_parameters_and_the_normaliser() -> None:
    ran = export_model("inspect", trained_run("3DBall"), ROOT / "fixtures/sb3/torch_actor.onnx")
    assert ran.status == 0
    assert "layers: 8 → normalise → 32 swish → 32 swish → 2\n" in ran.out
    assert "parameters: 2,809\n" in ran.out
    assert "state is normalised by: 0.00314 ± 0.0613, " in ran.out
    assert "; pytorch 2.13.0+cpu, opset 20\n" in ran.out
    assert ran.out.count("next: ") == 1
    policy = export_model("inspect", fixture("recurrent"), "--json").json["policies"][0]
    assert policy["layers"] == {"action": "6 → 32 swish → LSTM 16 → 2"}


def test_of_several_sources_one_that_is_refused_does_not_stop_the_others(tmp_path: Path) -> None:
    ran = export_model("inspect", "nothing.bytes", BALL)
    assert ran.status == 2
    assert "policy continuous" in ran.out
    assert "nothing.bytes: no such file\n  fix: " in ran.err  # its lines stay lines
    first, second = export_model("inspect", "nothing.bytes", BALL, "--json").json["sources"]
    assert (first["error"], second["policies"][0]["name"]) == ("SourceError", "continuous")
    is_refused(export_model("inspect", BALL, BALL, "--svg", tmp_path / "a.svg"), "for one source")


def test_inspection_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert export_model("inspect", BALL).status == 0
    assert files_in(tmp_path) == set()


def test_inspection_says_which_format_cannot_take_a_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(*_: object) -> None:
        raise TypeError("no")

    monkeypatch.setattr("export_model.converters.formats.tfjs.writer.write", refusing)
    found = export_model("inspect", BALL, "--json").json["policies"][0]["targets"]
    assert found["onnx"] == {"ok": True, "reason": None}
    assert found["tfjs"] == {"ok": False, "reason": "the graph cannot be understood"}
    assert "cannot be written as tfjs: " in export_model("inspect", BALL).out


def test_an_integer_state_is_shown_with_its_range(tmp_path: Path) -> None:
    nodes: list[NodeDef] = [
        placeholder("state", (None, 1), np.int32),
        *(constant(n, v) for n, v in (("depth", 5), ("on", 1.0), ("off", 0.0), ("shape", [-1, 5]))),
        node("hot", "OneHot", "state", "depth", "on", "off", axis=-1),
        node("flat", "Reshape", "hot", "shape"),
        *dense("mu", "flat", 5, 2),
        node("action", "Tanh", "mu"),
    ]
    (tmp_path / "a.bytes").write_bytes(graph_bytes(nodes))
    ran = export_model("inspect", tmp_path / "a.bytes")
    assert "the discrete state, an integer from 0 to 4" in ran.out


# ------------------------------------------------------------------ runtimes


def test_the_runtimes_are_listed_whether_they_are_here_or_not() -> None:
    ran = export_model("runtimes")
    assert (ran.status, ran.err) == (0, "")
    table, said = ran.out.split("\n\n")
    assert said.startswith("a runtime's process ")
    names = [line.split()[0] for line in table.splitlines()[2:]]
    assert names == [r["name"] for r in export_model("runtimes", "--json").json["runtimes"]]
    assert names == [r.name for r in RUNTIMES]


def test_the_runtimes_as_json_say_how_to_install_each() -> None:
    for runtime in export_model("runtimes", "--json").json["runtimes"]:
        assert set(runtime) == {"name", "installed", "version", "install"}
        assert runtime["install"]


def test_what_pip_installs_is_not_installed_by_the_command() -> None:
    is_refused(export_model("runtimes", "install", "onnxruntime"), "does not install it", "pip install")
    is_refused(export_model("runtimes", "install", "numpy"), "does not install it", "pip install")
    is_refused(export_model("runtimes", "install", "nothing"), "unknown runtime", "export-model runtimes")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("tfjs", ["js"]),
        ("tfjs-cpu", ["js"]),
        ("onnxruntime-web", ["js"]),
        ("tf1.4", ["tf1.4"]),
        ("tf1.7", ["tf1.7"]),
        ("tf1", ["tf1.4", "tf1.7"]),
    ],
)
def test_installing_reports_its_steps(monkeypatch: pytest.MonkeyPatch, name: str, said: list[str]) -> None:
    """Every runtime of a family once; what fetches is replaced, for these tests need no network."""

    def stand_in(runtime: Runtime) -> Runtime:
        if runtime.install is None:
            return runtime
        return replace(runtime, install=js if runtime.install is install_packages else steps[runtime.name])

    def js(progress: Progress) -> None:
        progress("js")

    steps = {n: partial(lambda text, progress: progress(text), n) for n in ("tf1.4", "tf1.7")}
    monkeypatch.setattr("export_model.converters.runtimes.registry.RUNTIMES", tuple(stand_in(r) for r in RUNTIMES))
    ran = export_model("runtimes", "install", name)
    assert (ran.status, ran.out.splitlines(), ran.err) == (0, said, "")


def test_the_help_of_runtimes_names_all_that_it_installs() -> None:
    help_text = " ".join(export_model("runtimes", "--help").out.split())
    names = re.findall(r"[\w-]+", help_text.partition("Install ")[2].partition(".")[0].replace(" or ", ", "))
    able = {r.name for r in RUNTIMES if r.install is not None}
    assert able == {r for r in able if any(r == n or r.startswith((f"{n}-", f"{n}.", f"{n}@")) for n in names)}
    assert all(any(r.startswith(n) for r in able) for n in names)
    assert "runtimes [OPTIONS] [install NAME]" in help_text and "Examples:" in help_text


@pytest.mark.parametrize(("release", "profile"), [("all", "unity6"), ("R20", "barracuda-3"), ("R20,R22", "unity6")])
def test_what_unity_does_not_read_is_to_be_exported_for_the_last_that_was_asked(release: str, profile: str) -> None:
    answer = export_model("inspect", BALL, "--unity", release, "--json").json
    assert answer["error"] == "SourceError"
    assert f"--for {profile}" in answer["fix"]


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_what_to_do_next_fits_the_terminal_and_can_be_pasted(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    words = ["verify", *(f"exported/policy {i}" for i in range(9)), "it's one", "--source", "a.onnx"]
    command = command_text(*words)
    said = next_text(command)
    assert all(len(line) <= width for line in said.splitlines())
    run = said.removeprefix("next: ").replace("export-model", "printf '%s\\n'", 1)
    typed = subprocess.run(["sh", "-c", run], capture_output=True, text=True, check=True).stdout.splitlines()
    assert typed == words
    prose = next_text("put the files into a project of Unity, open it there, and see what the Inspector says of them")
    assert all(len(line) <= width for line in prose.splitlines()) and "\\" not in prose
    monkeypatch.delenv("COLUMNS")
    assert next_text(command) == f"next: {command}"  # nobody looks: a line stays whole
