"""Which runtimes are chosen, and the processes that they run in."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.children import process as processes
from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.runtimes import pool as pools
from export_model.converters.runtimes.javascript import node as javascript
from export_model.converters.runtimes.pool import RuntimePool, chosen_runtimes, unverified_error
from export_model.converters.runtimes.registry import RUNTIMES, RuntimeInfo
from export_model.signatures.errors import RuntimeUnavailableError, UsageError
from fixtures import path as fixture
from tests.commands import PLACES

NODE = {r.name: r for r in javascript.RUNTIMES}
NAMES = ("numpy", "tensorflow", "tf1.4", "onnxruntime", "tfjs-cpu", "tfjs-wasm")


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """The runtimes that are installed; a test takes some away."""
    installed = set(NAMES) - {"tf1.4"}
    monkeypatch.setattr(
        pools, "available_runtimes", lambda: tuple(RuntimeInfo(n, n in installed, "1", f"get {n}") for n in NAMES)
    )
    return installed


def names(wanted: str | list[str], *formats: str) -> tuple[str, ...]:
    return chosen_runtimes(wanted, [WRITTEN[f] for f in formats or DEFAULTS])[0]


def test_what_is_installed_for_the_formats_is_chosen_by_itself(here: set[str]) -> None:
    assert names("auto") == ("numpy", "tensorflow", "onnxruntime", "tfjs-cpu", "tfjs-wasm")
    assert names("auto", "onnx") == ("tensorflow", "onnxruntime")
    here -= {"tensorflow", "tfjs-cpu"}
    assert names("auto") == ("numpy", "onnxruntime", "tfjs-wasm")
    assert names("none") == ()


def test_full_is_everything_and_nothing_may_be_missing(here: set[str]) -> None:
    here |= {"tf1.4"}
    assert set(names("full")) == set(NAMES)
    here -= {"onnxruntime"}
    with pytest.raises(RuntimeUnavailableError, match="onnxruntime is not installed") as caught:
        names("full")
    assert caught.value.fix == "get onnxruntime"


def test_full_leaves_out_what_the_system_cannot_have(monkeypatch: pytest.MonkeyPatch) -> None:
    infos = [RuntimeInfo("numpy", True, "1", ""), RuntimeInfo("onnxruntime", True, "1", "")]
    infos.append(RuntimeInfo("tf1.4", False, None, "only for Linux", supported=False))
    monkeypatch.setattr(pools, "available_runtimes", lambda: tuple(infos))
    assert names("full") == ("numpy", "onnxruntime")
    with pytest.raises(RuntimeUnavailableError, match=r"tf1\.4 is not installed"):
        names("tf1.4")


def test_words_stand_for_several_and_may_be_combined(monkeypatch: pytest.MonkeyPatch) -> None:
    every = tuple(RuntimeInfo(r.name, True, "1", "") for r in RUNTIMES)
    monkeypatch.setattr(pools, "available_runtimes", lambda: every)
    browser = ("tfjs-webgl", "tfjs-cpu@chromium", "tfjs-wasm@chromium", "onnxruntime-web@chromium", "litert-web")
    assert set(names("browser")) == {"numpy", *browser}
    assert set(names("onnxruntime,browser")) == {"numpy", "onnxruntime", *browser}
    assert set(names("auto,browser")) == {*names("auto"), *browser}
    assert {"c", "csharp", "node", "litert", "litert-web", "openvino", "torch"}.isdisjoint(
        names("full")
    )  # they run none of these, or are asked by name alone
    assert {"c", "litert"} <= set(names("full", "c", "litert"))
    assert "openvino" in names("full,openvino")
    assert names("js") == names("node"), "the judge of --to js answers to its name"


@pytest.mark.parametrize("wanted", ["tfjs-wasm,onnxruntime", ["tfjs-wasm", "onnxruntime"], "tfjs-wasm,,onnxruntime,"])
def test_names_are_taken_in_their_order_and_numpy_is_always_there(here: set[str], wanted: str | list[str]) -> None:
    assert names(wanted) == ("numpy", "tfjs-wasm", "onnxruntime")


def test_names_that_are_none_or_not_installed_are_refused(here: set[str]) -> None:
    with pytest.raises(UsageError, match="unknown runtime 'torch'") as caught:
        names("torch")
    assert caught.value.fix == f"the runtimes are {', '.join(NAMES)}"
    with pytest.raises(RuntimeUnavailableError, match=r"tf1\.4 is not installed"):
        names("numpy,tf1.4")


def test_what_is_known_is_told_whatever_is_chosen(here: set[str]) -> None:
    for wanted in ("none", "auto", "numpy"):
        assert [info.name for info in chosen_runtimes(wanted, [WRITTEN["onnx"]])[1]] == list(NAMES)


def test_the_error_names_runtimes_that_are_here_but_were_not_asked(here: set[str]) -> None:
    """What is installed is never called missing, and a format that this error does not name gives no remedy."""

    def error(runtimes: str, *formats: str) -> RuntimeUnavailableError:
        forms = [WRITTEN[f] for f in formats]
        return unverified_error(forms, *chosen_runtimes(runtimes, forms))

    asked = error("numpy", "onnx")
    assert (asked.what, asked.fix) == (
        "no independent runtime was asked for, so nothing was compared",
        "--runtimes onnxruntime, or --allow-unverified",
    )
    assert "numpy alone took part; an ONNX model runs in onnxruntime" in (asked.why or "")
    assert "--runtimes tfjs-cpu, or" in (error("numpy", "tfjs").fix or "")
    here -= {"onnxruntime"}
    missing = error("auto", "onnx")
    assert (missing.what, missing.fix) == (
        "no independent runtime is installed, so nothing was compared",
        "get onnxruntime, or --allow-unverified",
    )
    assert "runtimes says how" in (error("auto", "nn").fix or "")


# ------------------------------------------------------------------ processes


def test_a_process_is_started_on_first_use_and_shared() -> None:
    with RuntimePool() as pool:
        assert pool.versions() == {}
        first = pool.process("numpy")
        assert pool.process("numpy") is first
        assert pool.versions() == {"numpy": np.__version__}
        model = first.load(str(fixture("continuous")))
        feeds = {"state:0": np.zeros((3, 8), np.float32), "epsilon:0": np.zeros((3, 2), np.float32)}
        assert model.run(feeds, ["action:0"])["action:0"].shape == (3, 2)
        model.unload()
    assert pool.versions() == {}


def test_many_runs_are_few_requests_and_what_they_share_is_sent_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, np.ndarray]] = []
    ask = RuntimeProcess.request

    def request(self: RuntimeProcess, header: Any, tensors: Any = None) -> Any:
        asked.append(tensors)
        return ask(self, header, tensors)

    inputs = [{"state:0": np.full((n, 8), n, np.float32), "epsilon:0": np.zeros((n, 2), np.float32)} for n in (1, 2, 5)]
    with RuntimePool() as pool:
        model = pool.process("numpy").load(str(fixture("continuous")))
        alone = [model.run(feeds, ["action:0"])["action:0"] for feeds in inputs]
        monkeypatch.setattr(RuntimeProcess, "request", request)
        together = model.run_all([*inputs, inputs[0]], ["action:0"])
        moved = model.run_all([inputs[0]] * 2, ["action:0"], [{}, {"jitter": [0, 1]}])
        monkeypatch.setattr(processes, "_REQUEST", 1)
        split = model.run_all(inputs, ["action:0"])
        with pytest.raises(RunFailedError, match="'state' is not fed"):
            model.run_all([inputs[0], {}], ["action:0"])
        assert model.run_all([], ["action:0"]) == []
    assert [len(tensors) for tensors in asked] == [6, 2, 2, 2, 2, 2, 0]
    for answers in (together, split):
        for expected, answer in zip(alone, answers, strict=False):
            np.testing.assert_array_equal(answer["action:0"], expected)
    assert (moved[0]["action:0"] == alone[0]).all()
    assert (moved[1]["action:0"] != alone[0]).any()


def test_a_process_that_died_is_started_again() -> None:
    with RuntimePool() as pool:
        process = pool.process("numpy")
        model = process.load(str(fixture("continuous")))
        assert process._process is not None
        process._process.kill()
        with pytest.raises(RunFailedError, match="ended while it was working"):
            model.run({}, ["action"])
        assert pool.versions() == {}
        again = pool.process("numpy").load(str(fixture("continuous")))
        with pytest.raises(RunFailedError, match="'state' is not fed"):
            again.run({}, ["action"])


def test_a_runtime_that_does_not_start_is_unavailable() -> None:
    commands = {"numpy": lambda: ["/nonexistent/python"]}
    with RuntimePool(commands) as pool, pytest.raises(RuntimeUnavailableError, match="numpy did not start"):
        pool.process("numpy")


def test_a_runtime_that_ends_at_once_is_unavailable() -> None:
    commands = {"numpy": lambda: [sys.executable, "-c", "raise SystemExit('no such module')"]}
    with RuntimePool(commands) as pool, pytest.raises(RuntimeUnavailableError, match="no such module"):
        pool.process("numpy")


#: A runtime that is ready once the file that it is given exists.
WAITS = """
import pathlib, sys, time
sys.path.insert(0, sys.argv[2])
from export_model.converters.files.children.child import claim_stdout, serve
out = claim_stdout()
while not pathlib.Path(sys.argv[1]).exists():
    time.sleep(0.01)
serve("waits", "7", lambda header: 1 / 0, (), out)
"""


def waits(file: Path) -> Callable[[], list[str]]:
    return lambda: [sys.executable, "-c", WAITS, str(file), str(PLACES[0])]


def test_processes_start_side_by_side(tmp_path: Path) -> None:
    """Neither would be ready if each were waited for: the file comes after both were started."""
    with RuntimePool({"a": waits(tmp_path / "go"), "b": waits(tmp_path / "go")}) as pool:
        pool.start(["a", "b"])
        pool.start(["b"])
        assert pool.versions() == {}
        (tmp_path / "go").touch()
        assert pool.process("b") is pool.process("b")
        assert pool.versions() == {"b": "7"}
        assert pool.process("a").version == "7"


def test_what_is_not_ready_is_not_waited_for_at_the_end(tmp_path: Path) -> None:
    with RuntimePool({"a": waits(tmp_path / "never")}) as pool:
        pool.start(["a"])
        child = pool._processes["a"]._process
        assert child is not None
    assert child.returncode != 0


def test_one_that_cannot_be_started_leaves_the_others() -> None:
    commands = {"numpy": RUNTIMES[0].command, "gone": lambda: ["/nonexistent/python"]}
    with RuntimePool(commands) as pool:
        with pytest.raises(RuntimeUnavailableError, match="gone did not start"):
            pool.start(["numpy", "gone"])
        assert pool.process("numpy").version == np.__version__


def test_one_that_refused_to_start_is_tried_again(tmp_path: Path) -> None:
    """It answers "hello" with an error and lives on; asked nothing again, it would be waited for in vain."""
    command = NODE["tfjs-cpu"].command()
    empty = [*command[: command.index("--modules") + 1], str(tmp_path)]
    with RuntimePool({"tfjs-cpu": lambda: empty}) as pool:
        for _ in range(2):
            with pytest.raises(RuntimeUnavailableError, match="Cannot find module"):
                pool.process("tfjs-cpu")


def test_without_node_tensorflow_js_is_unavailable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(javascript, "node_executable", lambda: None)
    with RuntimePool() as pool, pytest.raises(RuntimeUnavailableError, match="Node is not installed"):
        pool.process("tfjs-cpu")


def test_tensorflow_js_runs_in_node_with_its_backend(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "node"
    program.write_bytes(b"\x7fELF")  # no shim, which would be looked through
    monkeypatch.setattr(javascript, "node_executable", lambda: str(program))
    monkeypatch.setenv("EXPORT_MODEL_JS", "/packages")
    command = NODE["tfjs-wasm"].command()
    assert command[0] == str(program)
    assert command[1].endswith("runner.mjs")
    assert command[2:] == ["--runtime", "tfjs-wasm", "--modules", "/packages"]
