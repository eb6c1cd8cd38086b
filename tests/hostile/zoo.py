"""Model files that would do something else than be converted, each made in a folder of the test that runs it.

A case writes its files to ``folder``; where it gets what it wants, it writes the file ``marker`` (or reads what it must
not, or takes memory). It returns the source to give, and, where it is one, the bundle.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from converters import schema
from signatures.digest import sha256_hex
from tests.checkpoint.writing import bundle as write_checkpoint
from tests.checkpoint.writing import policy as training_policy
from tests.handmade import constant, continuous_policy, graph_bytes, graph_def, node, placeholder, sampled_policy

Maker = Callable[[Path, Path], Path]


@dataclass(frozen=True)
class Case:
    """One file: ``source`` is read as a source, ``candidate`` compared, ``bundle`` verified, served, snipped."""

    make: Maker
    kind: str = "source"


CASES: dict[str, Case] = {}


def case(name: str, kind: str = "source") -> Callable[[Maker], Maker]:
    """Register a maker."""

    def registered(make: Maker) -> Maker:
        assert name not in CASES, name
        CASES[name] = Case(make, kind)
        return make

    return registered


# ------------------------------------------------------------------ ops that act


def writer(marker: Path, name: str = "write_file", op: str = "WriteFile", prefix: str = "") -> list[Any]:
    """A node that writes the marker when it runs."""
    path, text = f"{prefix}{name}/path", f"{prefix}{name}/text"
    return [constant(path, str(marker).encode()), constant(text, b"x"), node(f"{prefix}{name}", op, path, text)]


def saving(marker: Path, name: str = "write_file") -> list[Any]:
    """SaveV2, which writes a checkpoint."""
    strings = [("prefix", [str(marker).encode()]), ("names", [b"w"]), ("slices", [b""])]
    nodes = [constant(f"{name}/{key}", value) for key, value in strings]
    nodes[0] = constant(f"{name}/prefix", str(marker).encode())
    save = node(name, "SaveV2", *(n.name for n in nodes), f"{name}/w", dtypes=(np.float32,))
    return [*nodes, constant(f"{name}/w", 1.0), save]


def printing(marker: Path, name: str = "write_file") -> list[Any]:
    """PrintV2 into a file."""
    text = constant(f"{name}/text", b"x")
    return [text, node(name, "PrintV2", text.name, output_stream=f"file://{marker}", end="\n")]


def python(marker: Path, name: str = "write_file") -> list[Any]:
    """A function of the loader's own process."""
    return [node(name, "PyFunc", token=f"open({str(marker)!r}, 'w')", Tin=(), Tout=())]


ACTING: dict[str, Callable[[Path], list[Any]]] = {
    "WriteFile": writer,
    "SaveV2": saving,
    "PrintV2": printing,
    "PyFunc": python,
}


def controlled(nodes: Sequence[Any], at: str, by: str = "write_file") -> list[Any]:
    """``by`` as a control input of the node ``at``."""
    next(n for n in nodes if n.name == at).input.append(f"^{by}")
    return list(nodes)


def frozen(folder: Path, nodes: Sequence[Any]) -> Path:
    path = folder / "policy.bytes"
    path.write_bytes(graph_bytes(nodes))
    return path


# ------------------------------------------------------------------ frozen graphs


def _control_cases() -> None:
    for op, acting in ACTING.items():
        for at in ("action", "mu", "mu/kernel", "vector_observation"):

            def make(folder: Path, marker: Path, acting: Any = acting, at: str = at) -> Path:
                return frozen(folder, controlled([*continuous_policy(), *acting(marker)], at))

            case(f"frozen graph, {op} behind a control input of {at}")(make)
            if at == "action":
                case(f"compare with a frozen graph, {op} behind a control input of {at}", "candidate")(make)


_control_cases()


@case("frozen graph, a writer behind a NoOp")
def _(folder: Path, marker: Path) -> Path:
    barrier = node("barrier", "NoOp", "^write_file")
    return frozen(folder, controlled([*continuous_policy(), *writer(marker), barrier], "action", "barrier"))


@case("frozen graph, a writer behind an assertion's text")
def _(folder: Path, marker: Path) -> Path:
    check = [constant("true", True), node("check", "Assert", "true", "true", "^write_file", T=(np.bool_,), summarize=3)]
    return frozen(folder, controlled([*continuous_policy(), *writer(marker), *check], "action", "check"))


@case("frozen graph, a file read into the observation's scale")
def _(folder: Path, marker: Path) -> Path:
    nodes = continuous_policy()
    read = [
        constant("path", b"/etc/passwd"),
        node("text", "ReadFile", "path"),
        node("raw", "DecodeRaw", "text", out_type=np.uint8, little_endian=True),
        node("numbers", "Cast", "raw", SrcT=np.uint8, DstT=np.float32),
        node("sum", "Sum", "numbers", "zero", T=np.float32, Tidx=np.int32, keep_dims=False),
        constant("zero", 0),
        node("read", "Mul", "mu", "sum", T=np.float32),
    ]
    next(n for n in nodes if n.name == "action").input[0] = "read"
    return frozen(folder, [*nodes, *read])


@case("frozen graph, a writer that nothing hangs on")
def _(folder: Path, marker: Path) -> Path:
    return frozen(folder, [*continuous_policy(), *writer(marker)])


@case("frozen graph, a writer in a loop's body")
def _(folder: Path, marker: Path) -> Path:
    t = {"T": np.float32}
    loop = [
        node("enter", "Enter", "mu", frame_name="loop", is_constant=False, parallel_iterations=1, **t),
        node("count/start", "Enter", "zero", frame_name="loop", is_constant=False, parallel_iterations=1, T=np.int32),
        constant("zero", 0),
        node("merge", "Merge", "enter", "next", N=2, **t),
        node("count", "Merge", "count/start", "count/next", N=2, T=np.int32),
        constant("limit", 2),
        node("less", "Less", "count", "limit", T=np.int32),
        node("going", "LoopCond", "less"),
        node("switch", "Switch", "merge", "going", **t),
        node("count/switch", "Switch", "count", "going", T=np.int32),
        node("count/turn", "Identity", "count/switch:1", T=np.int32),
        constant("one", 1),
        node("count/add", "Add", "count/turn", "one", T=np.int32),
        node("count/next", "NextIteration", "count/add", T=np.int32),
        node("body", "Tanh", "switch:1", "^write_file", **t),
        node("next", "NextIteration", "body", **t),
        node("exit", "Exit", "switch", **t),
    ]
    nodes = continuous_policy()
    next(n for n in nodes if n.name == "action").input[0] = "exit"
    return frozen(folder, [*nodes, *loop, *writer(marker)])


@case("frozen graph, a writer in one of two brains")
def _(folder: Path, marker: Path) -> Path:
    nodes = [*continuous_policy("Goalie/"), *continuous_policy("Striker/"), *writer(marker)]
    return frozen(folder, controlled(nodes, "Striker/action"))


@case("frozen graph, a writer behind the sampler that is fed")
def _(folder: Path, marker: Path) -> Path:
    return frozen(folder, controlled([*sampled_policy(), *writer(marker)], "draw"))


@case("frozen graph, a default that is read from a file")
def _(folder: Path, marker: Path) -> Path:
    nodes = continuous_policy()
    nodes[0] = node("vector_observation", "PlaceholderWithDefault", "text", dtype=np.float32)
    nodes[0].attr["shape"].shape.unknown_rank = True
    return frozen(folder, [*nodes, *writer(marker), constant("path", b"/etc/passwd"), node("text", "ReadFile", "path")])


@case("frozen graph, a function that writes")
def _(folder: Path, marker: Path) -> Path:
    graph = graph_def([*continuous_policy(), node("write_file", "Evil", "mu")])
    graph.node[-2].input.append("^write_file")
    function(graph, "Evil", [("x", 1)], [("y", 1, "x")], [*writer(marker)], ["write_file"])
    path = folder / "policy.bytes"
    path.write_bytes(schema.serialise(graph))
    return path


@case("frozen graph, an op of a library that is not there")
def _(folder: Path, marker: Path) -> Path:
    return frozen(folder, controlled([*continuous_policy(), node("write_file", "LoadLibrary")], "action"))


@case("frozen graph on another device")
def _(folder: Path, marker: Path) -> Path:
    nodes = continuous_policy()
    for n in nodes:
        n.device = "/job:worker/replica:0/task:7/device:GPU:3"
    return frozen(folder, nodes)


# ------------------------------------------------------------------ run folders


def run(folder: Path, change: Callable[[Any], None], *, meta: bool) -> Path:
    """A run's folder whose training graph was changed."""
    graph = training_policy()
    prefix = folder / "model-10.cptk"
    write_checkpoint(prefix, graph.variables)
    place = graph.write(folder / ("model-10.cptk.meta" if meta else "raw_graph_def.pb"), meta=meta)
    kind = schema.MetaGraphDef if meta else schema.GraphDef
    message = kind.FromString(place.read_bytes())
    change(message.graph_def if meta else message)
    place.write_bytes(schema.serialise(message))
    return folder


def _run_cases() -> None:
    for meta in (False, True):
        label = "its .meta" if meta else "its raw graph"

        def restoring(folder: Path, marker: Path, meta: bool = meta) -> Path:
            def change(graph: Any) -> None:
                graph.node.extend([*writer(marker), node("save/restore_all", "NoOp", "^write_file")])
                if not any(n.name == "save/Const" for n in graph.node):
                    graph.node.append(constant("save/Const", b"model"))

            return run(folder, change, meta=meta)

        def controlling(folder: Path, marker: Path, meta: bool = meta) -> Path:
            def change(graph: Any) -> None:
                graph.node.extend(writer(marker))
                next(n for n in graph.node if n.name == "action").input.append("^write_file")

            return run(folder, change, meta=meta)

        def initialising(folder: Path, marker: Path, meta: bool = meta) -> Path:
            def change(graph: Any) -> None:
                graph.node.extend([*writer(marker), node("init", "NoOp", "^write_file")])
                next(n for n in graph.node if n.op == "VariableV2").input.append("^init")

            return run(folder, change, meta=meta)

        case(f"run folder, {label} writes where the saver restores")(restoring)
        case(f"run folder, {label} writes behind a control input of action")(controlling)
        case(f"run folder, {label} writes behind a variable")(initialising)


_run_cases()


# ------------------------------------------------------------------ SavedModels


def function(
    graph: Any,
    name: str,
    takes: Sequence[tuple[str, int]],
    gives: Sequence[tuple[str, int, str]],
    nodes: Sequence[Any],
    effects: Sequence[str] = (),
) -> None:
    """A function in a graph's library: (argument, DataType), (result, DataType, the tensor that it is)."""
    made = graph.library.function.add()
    made.signature.name = name
    for argument, kind in takes:
        made.signature.input_arg.add(name=argument, type=kind)
    for result, kind, tensor in gives:
        made.signature.output_arg.add(name=result, type=kind)
        made.ret[result] = tensor
    made.node_def.extend(nodes)
    for effect in effects:
        made.control_ret[effect] = effect


def call(name: str, called: str, *inputs: str, results: int = 1) -> Any:
    made = node(name, "StatefulPartitionedCall", *inputs, Tin=(np.float32,) * len(inputs), Tout=(np.float32,) * results)
    made.attr["f"].func.name = called
    return made


def saved(folder: Path, graph: Any, output: str, extra: Callable[[Any], None] = lambda meta: None) -> Path:
    """A SavedModel of a graph, with ``serving_default``."""
    message = schema.SavedModel(saved_model_schema_version=1)
    meta = message.meta_graphs.add()
    meta.meta_info_def.tags.append("serve")
    meta.graph_def.CopyFrom(graph)
    entry = meta.signature_def["serving_default"]
    entry.method_name = "tensorflow/serving/predict"
    for side, key, tensor in (
        (entry.inputs, "vector_observation", "vector_observation:0"),
        (entry.outputs, "action", output),
    ):
        side[key].name, side[key].dtype = tensor, 1
        side[key].tensor_shape.dim.add(size=-1)
        side[key].tensor_shape.dim.add(size=3 if side is entry.inputs else 2)
    extra(meta)
    path = folder / "saved"
    path.mkdir()
    (path / "saved_model.pb").write_bytes(schema.serialise(message))
    return path


def calling(body: Sequence[Any], effects: Sequence[str] = ("write_file",), result: str = "y:y:0") -> Any:
    """A graph whose policy is a call of a function with this body beside a dense layer's head."""
    graph = graph_def([placeholder("vector_observation"), call("called", "policy", "vector_observation")])
    head = [
        constant("kernel", np.ones((3, 2), np.float32)),
        node("product", "MatMul", "x", "kernel:output:0", T=np.float32),
        node("y", "Tanh", "product:product:0", T=np.float32),
    ]
    function(graph, "policy", [("x", 1)], [("r", 1, result)], [*head, *body], effects)
    return graph


def inner_writer(marker: Path) -> list[Any]:
    """``writer`` as a function's nodes name one another."""
    nodes = writer(marker)
    nodes[-1].input[:] = [f"{i}:output:0" for i in nodes[-1].input]
    return nodes


def _saved_cases() -> None:
    def flat(folder: Path, marker: Path) -> Path:
        return saved(folder, graph_def(controlled([*continuous_policy(), *writer(marker)], "action")), "action:0")

    def effect(folder: Path, marker: Path) -> Path:
        return saved(folder, calling(inner_writer(marker)), "called:0")

    def control(folder: Path, marker: Path) -> Path:
        graph = calling(inner_writer(marker), ())
        next(n for n in graph.library.function[0].node_def if n.name == "y").input.append("^write_file")
        return saved(folder, graph, "called:0")

    def nested(folder: Path, marker: Path) -> Path:
        graph = calling([call("inner", "evil", "x")], ("inner",))
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def beside(folder: Path, marker: Path) -> Path:
        graph = calling([], ())
        graph.node.add().CopyFrom(call("write_file", "evil", "vector_observation"))
        graph.node[1].input.append("^write_file")
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def loop(folder: Path, marker: Path) -> Path:
        while_ = node("loop", "While", "y:y:0", T=(np.float32,))
        while_.attr["cond"].func.name, while_.attr["body"].func.name = "cond", "evil"
        graph = calling([while_], (), "loop:output:0")
        function(graph, "cond", [("x", 1)], [("r", 10, "no:output:0")], [constant("no", False)])
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def branch(folder: Path, marker: Path) -> Path:
        if_ = node("either", "If", "yes:output:0", "y:y:0", Tin=(np.float32,), Tout=(np.float32,), Tcond=np.bool_)
        if_.attr["then_branch"].func.name, if_.attr["else_branch"].func.name = "evil", "good"
        graph = calling([constant("yes", True), if_], (), "either:output:0")
        function(graph, "good", [("x", 1)], [("r", 1, "x")], [])
        function(graph, "evil", [("x", 1)], [("r", 1, "x")], inner_writer(marker), ("write_file",))
        return saved(folder, graph, "called:0")

    def endless(folder: Path, marker: Path) -> Path:
        graph = calling([call("again", "policy", "x")], ("again",))
        return saved(folder, graph, "called:0")

    def unfolding(folder: Path, marker: Path) -> Path:
        graph = calling([call("a", "f0", "y:y:0")], (), "a:output:0")
        for i in range(40):
            two = [call("a", f"f{i + 1}", "x"), call("b", f"f{i + 1}", "a:output:0")]
            function(graph, f"f{i}", [("x", 1)], [("r", 1, "b:output:0")], two)
        function(graph, "f40", [("x", 1)], [("r", 1, "x")], [])
        return saved(folder, graph, "called:0")

    def swelling(folder: Path, marker: Path) -> Path:
        graph = calling([call("a", "f0", "y:y:0")], (), "a:output:0")
        big = constant("big", np.ones((1 << 18,), np.float32))
        for i in range(14):
            two = [call("a", f"f{i + 1}", "x"), call("b", f"f{i + 1}", "a:output:0")]
            function(graph, f"f{i}", [("x", 1)], [("r", 1, "b:output:0")], two)
        body = [big, node("z", "Sum", "big:output:0", "axis:output:0", keep_dims=False), constant("axis", 0)]
        added = node("w", "Add", "x", "z:output:0")
        function(graph, "f14", [("x", 1)], [("r", 1, "w:z:0")], [*body, added])
        return saved(folder, graph, "called:0")

    def tree(depth: int, results: Sequence[str], body: Sequence[Any] = (), name: str = "a") -> Any:
        """A function that is called 2^depth times."""
        graph = calling([call(name, "f0", "y:y:0")], (), f"{name}:output:0")
        for i in range(depth):
            two = [call(name, f"f{i + 1}", "x"), call("b", f"f{i + 1}", f"{name}:output:0")]
            function(graph, f"f{i}", [("x", 1)], [("r", 1, "b:output:0")], two)
        function(graph, f"f{depth}", [("x", 1)], [(r, 1, "x") for r in results], body)
        return graph

    def passing(folder: Path, marker: Path) -> Path:
        return saved(folder, tree(13, [f"{i:x}" for i in range(3500)]), "called:0")

    def unread(folder: Path, marker: Path) -> Path:
        body = [node(f"{i:x}", "Abs", "x", T=np.float32) for i in range(3000)]
        return saved(folder, tree(14, ["r"], body), "called:0")

    def naming(folder: Path, marker: Path) -> Path:
        return saved(folder, tree(13, ["r"], name="a" * 100_000), "called:0")

    def missing(folder: Path, marker: Path) -> Path:
        graph = calling([call("inner", "nowhere", "x")], ("inner",))
        return saved(folder, graph, "called:0")

    def misfit(folder: Path, marker: Path) -> Path:
        graph = calling([call("inner", "policy", "x", "x")], ("inner",))
        return saved(folder, graph, "called:0")

    def main_op(folder: Path, marker: Path) -> Path:
        def extra(meta: Any) -> None:
            meta.signature_def["__saved_model_init_op"].outputs["__saved_model_init_op"].name = "write_file"

        return saved(folder, graph_def([*continuous_policy(), *writer(marker)]), "action:0", extra)

    def restoring(folder: Path, marker: Path) -> Path:
        def extra(meta: Any) -> None:
            meta.saver_def.restore_op_name = "write_file"

        path = saved(folder, graph_def([*continuous_policy(), *writer(marker)]), "action:0", extra)
        write_checkpoint(path / "variables" / "variables", {"w": np.ones(3, np.float32)})
        return path

    makers = {
        "a writer behind a control input": flat,
        "a function's effect": effect,
        "a function's control input": control,
        "an effect of a function that a function calls": nested,
        "a call that only a control input asks for": beside,
        "a loop's body": loop,
        "a branch that is not taken": branch,
        "a function that calls itself": endless,
        "functions that unfold to 2^40 calls": unfolding,
        "functions that unfold to 16 GiB": swelling,
        "3,500 results of 2^13 calls": passing,
        "3,000 nodes that none of 2^14 calls reads": unread,
        "calls whose names are 100 kB": naming,
        "a function that is not there": missing,
        "a call with too many tensors": misfit,
        "an init op": main_op,
        "a restore op": restoring,
    }
    for label, make in makers.items():
        case(f"SavedModel, {label}")(make)
        case(f"compare with a SavedModel, {label}", "candidate")(make)


_saved_cases()


# ------------------------------------------------------------------ bundles


def rehashed(bundle: Path) -> Path:
    """The bundle with the hashes of what now lies in it."""
    content = json.loads((bundle / "policy.json").read_bytes())
    for name in content["files"]:
        data = (bundle / name).read_bytes()
        content["files"][name] = {"sha256": sha256_hex(data), "bytes": len(data)}
    (bundle / "policy.json").write_text(json.dumps(content))
    return bundle


def _bundle_cases() -> None:
    def bytes_(folder: Path, marker: Path) -> Path:
        (path,) = folder.glob("*.bytes")
        graph = schema.GraphDef.FromString(path.read_bytes())
        graph.node.extend(writer(marker))
        next(n for n in graph.node if n.name == "action").input.append("^write_file")
        path.write_bytes(schema.serialise(graph))
        return rehashed(folder)

    def saved_model(folder: Path, marker: Path) -> Path:
        path = folder / "saved_model/saved_model.pb"
        message = schema.SavedModel.FromString(path.read_bytes())
        graph = message.meta_graphs[0].graph_def
        graph.node.extend(writer(marker))
        next(n for n in graph.node if n.name == "action").input.append("^write_file")
        path.write_bytes(schema.serialise(message))
        return rehashed(folder)

    def init(folder: Path, marker: Path) -> Path:
        path = folder / "saved_model/saved_model.pb"
        message = schema.SavedModel.FromString(path.read_bytes())
        meta = message.meta_graphs[0]
        meta.graph_def.node.extend(writer(marker))
        meta.signature_def["__saved_model_init_op"].outputs["__saved_model_init_op"].name = "write_file"
        path.write_bytes(schema.serialise(message))
        return rehashed(folder)

    def tfjs_elsewhere(folder: Path, marker: Path) -> Path:
        path = folder / "tfjs/model.json"
        model = json.loads(path.read_bytes())
        model["weightsManifest"][0]["paths"] = ["../../../../../../etc/passwd"]
        path.write_text(json.dumps(model))
        return rehashed(folder)

    def tfjs_many(folder: Path, marker: Path) -> Path:
        path = folder / "tfjs/model.json"
        model = json.loads(path.read_bytes())
        model["weightsManifest"][0]["paths"] *= 100_000
        path.write_text(json.dumps(model))
        return rehashed(folder)

    def tfjs_op(folder: Path, marker: Path) -> Path:
        path = folder / "tfjs/model.json"
        model = json.loads(path.read_bytes())
        next(n for n in model["modelTopology"]["node"] if n["name"] == "action")["op"] = "WriteFile"
        path.write_text(json.dumps(model))
        return rehashed(folder)

    def onnx_elsewhere(folder: Path, marker: Path) -> Path:
        (path,) = folder.glob("*.onnx")
        path.write_bytes(_elsewhere(path.read_bytes(), "../../../../../../../../etc/passwd"))
        return rehashed(folder)

    makers = {
        "a writer in the .bytes": bytes_,
        "a writer in the SavedModel": saved_model,
        "an init op in the SavedModel": init,
        "weights of the TensorFlow.js model elsewhere": tfjs_elsewhere,
        "weights of the TensorFlow.js model named 100,000 times": tfjs_many,
        "an op that writes in the TensorFlow.js model": tfjs_op,
        "weights of the ONNX elsewhere": onnx_elsewhere,
    }
    for label, make in makers.items():
        case(f"bundle, {label}", "bundle")(make)


_bundle_cases()


# ------------------------------------------------------------------ ONNX


def _elsewhere(data: bytes, location: str) -> bytes:
    """An ONNX model whose first weights are said to lie in another file."""
    import onnx

    model = onnx.ModelProto.FromString(data)
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.ClearField("float_data")
    tensor.data_location = 1
    for key, value in (("location", location), ("offset", "0"), ("length", "4")):
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    result: bytes = model.SerializeToString()
    return result


def onnx_policy(nodes: Sequence[Any] | None = None, weights: Sequence[Any] = (), domains: Sequence[str] = ()) -> bytes:
    from onnx import helper, numpy_helper

    kernel = numpy_helper.from_array(np.ones((3, 2), np.float32), "kernel")
    graph = helper.make_graph(
        list(nodes) if nodes is not None else [helper.make_node("MatMul", ["obs_0", "kernel"], ["continuous_actions"])],
        "policy",
        [helper.make_tensor_value_info("obs_0", 1, ["batch", 3])],
        [helper.make_tensor_value_info("continuous_actions", 1, ["batch", 2])],
        [kernel, *weights],
    )
    imports = [helper.make_opsetid("", 13), *(helper.make_opsetid(d, 1) for d in domains)]
    result: bytes = helper.make_model(graph, opset_imports=imports, ir_version=8).SerializeToString()
    return result


def _onnx_cases() -> None:
    def written(folder: Path, data: bytes) -> Path:
        path = folder / "policy.onnx"
        path.write_bytes(data)
        return path

    def outside(location: str) -> Maker:
        return lambda folder, marker: written(folder, _elsewhere(onnx_policy(), location))

    def link(folder: Path, marker: Path) -> Path:
        (folder / "weights.bin").symlink_to("/etc/passwd")
        return written(folder, _elsewhere(onnx_policy(), "weights.bin"))

    def pipe(folder: Path, marker: Path) -> Path:
        import os

        os.mkfifo(folder / "weights.bin")
        return written(folder, _elsewhere(onnx_policy(), "weights.bin"))

    def custom(folder: Path, marker: Path) -> Path:
        from onnx import helper

        nodes = [
            helper.make_node("MatMul", ["obs_0", "kernel"], ["continuous_actions"]),
            helper.make_node("WriteFile", ["obs_0"], ["unused"], domain="evil.ops"),
        ]
        return written(folder, onnx_policy(nodes, domains=["evil.ops"]))

    def context(folder: Path, marker: Path) -> Path:
        from onnx import helper

        made = helper.make_node(
            "EPContext", ["obs_0"], ["continuous_actions"], domain="com.microsoft", ep_cache_context="/etc/passwd"
        )
        return written(folder, onnx_policy([made], domains=["com.microsoft"]))

    def in_function(folder: Path, marker: Path) -> Path:
        import onnx
        from onnx import helper

        model = onnx.ModelProto.FromString(
            onnx_policy([helper.make_node("F", ["obs_0"], ["continuous_actions"], domain="own")])
        )
        model.opset_import.add(domain="own", version=1)
        outer = onnx.ModelProto.FromString(_elsewhere(onnx_policy(), "../../../../../../../../etc/passwd"))
        constant_ = helper.make_node("Constant", [], ["k"], value=outer.graph.initializer[0])
        nodes = [constant_, helper.make_node("MatMul", ["x", "k"], ["y"])]
        model.functions.append(helper.make_function("own", "F", ["x"], ["y"], nodes, [helper.make_opsetid("", 13)]))
        return written(folder, model.SerializeToString())

    makers: dict[str, Maker] = {
        "weights above its folder": outside("../../../../../../../../etc/passwd"),
        "weights at an absolute path": outside("/etc/passwd"),
        "weights behind a link": link,
        "weights in a pipe": pipe,
        "weights that are its folder": outside("."),
        "weights with a NUL in the path": outside("a\0/etc/passwd"),
        "a custom operator": custom,
        "a context of a device": context,
        "weights elsewhere in a function": in_function,
    }
    for label, make in makers.items():
        case(f"ONNX, {label}")(make)
        case(f"compare with an ONNX, {label}", "candidate")(make)


_onnx_cases()


# ------------------------------------------------------------------ more memory or time than the file has bytes


def fixed_batch(rows: int) -> bytes:
    """A model that was exported for so many rows."""
    import onnx

    model = onnx.ModelProto.FromString(onnx_policy())
    for value in (*model.graph.input, *model.graph.output):
        dim = value.type.tensor_type.shape.dim[0]
        dim.Clear()
        dim.dim_value = rows
    data: bytes = model.SerializeToString()
    return data


def _large_onnx() -> None:
    from onnx import helper, numpy_helper

    make = helper.make_node

    def numbers(name: str, value: Any) -> Any:
        return numpy_helper.from_array(np.asarray(value), name)

    def added(nodes: Sequence[Any], *weights: Any, axes: Sequence[int] = (0,)) -> bytes:
        """``big`` summed up and added to the action."""
        ends = [
            make("ReduceSum", ["big", "axes"], ["sum"], keepdims=int(axes != (0,))),
            make("MatMul", ["obs_0", "kernel"], ["product"]),
            make("Add", ["product", "sum"], ["continuous_actions"]),
        ]
        return onnx_policy([*nodes, *ends], [*weights, numbers("axes", np.array(axes, np.int64))])

    one, wide = numbers("one", np.ones(2, np.float32)), np.array([2**31], np.int64)

    def doubled(first: str, axis: int) -> list[Any]:
        names = [first, *(f"twice_{i}" for i in range(31)), "big"]
        return [make("Concat", [a, a], [b], axis=axis) for a, b in itertools.pairwise(names)]

    hot = [make("Cast", ["obs_0"], ["index"], to=7), make("OneHot", ["index", "depth", "values"], ["hot"])]
    hot.append(make("ReduceSum", ["hot", "last"], ["big"], keepdims=0))
    values = [numbers("depth", np.int64(2**31)), numbers("values", np.array([0, 1], np.float32))]
    files = {
        "a fixed batch of 2^31-1": fixed_batch(2**31 - 1),
        "a fixed batch of 2^24": fixed_batch(2**24),
        "a fixed batch of 2^62": fixed_batch(2**62),
        "an Expand to 2^31": added([make("Expand", ["one", "shape"], ["big"])], one, numbers("shape", [2**31, 2])),
        "a Tile to 2^32": added([make("Tile", ["one", "shape"], ["big"])], one, numbers("shape", wide)),
        "a ConstantOfShape of 2^32": added(
            [make("ConstantOfShape", ["shape"], ["big"])], numbers("shape", np.array([2**32], np.int64))
        ),
        "a Pad of 2^31": added(
            [make("Pad", ["obs_0", "pads"], ["big"])], numbers("pads", np.array([0, 0, 0, 2**31], np.int64)), axes=(1,)
        ),
        "a OneHot of depth 2^31": added(hot, *values, numbers("last", np.array([2], np.int64)), axes=(1,)),
        "thirty doublings of the observation": added(doubled("obs_0", 1), axes=(1,)),
        "thirty doublings of a constant": added(doubled("one", 0), one),
    }
    for label, data in files.items():

        def make_file(folder: Path, marker: Path, data: bytes = data) -> Path:
            path = folder / "policy.onnx"
            path.write_bytes(data)
            return path

        case(f"ONNX, {label}")(make_file)


_large_onnx()


@case("ONNX, one file of weights named 3,000 times")
def _(folder: Path, marker: Path) -> Path:
    import onnx

    model = onnx.ModelProto.FromString(onnx_policy())
    (folder / "weights.bin").write_bytes(bytes(4 << 20))
    for i in range(3000):
        tensor = model.graph.initializer.add(name=f"t{i}", data_type=1, dims=[1 << 20], data_location=1)
        for key, value in (("location", "weights.bin"), ("offset", "0"), ("length", str(4 << 20))):
            entry = tensor.external_data.add()
            entry.key, entry.value = key, value
    path = folder / "policy.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def _large_graphs() -> None:
    f32, i32 = {"T": np.float32}, np.int32

    def summed(nodes: Sequence[Any], axes: Any = 0, *, keep: bool = False) -> list[Any]:
        """``big`` summed up and added to the action."""
        policy = continuous_policy()
        next(n for n in policy if n.name == "action").input[0] = "added"
        ends = [
            constant("axes", axes),
            node("sum", "Sum", "big", "axes", keep_dims=keep, Tidx=i32, **f32),
            node("added", "Add", "mu", "sum", **f32),
        ]
        return [*policy, *nodes, *ends]

    def chain(count: int, op: str) -> list[Any]:
        policy = continuous_policy()
        links = [node(f"link_{i}", op, f"link_{i - 1}" if i else "mu") for i in range(count)]
        return [*policy[:-1], *links, node("action", "Tanh", f"link_{count - 1}")]

    count = [constant("a", 0), constant("b", 2**31 - 1), constant("d", 1)]
    hot = [constant("i", [1]), constant("depth", 2**31 - 1), constant("on", 1.0), constant("off", 0.0)]
    graphs: dict[str, Callable[[], list[Any]]] = {
        "a Fill of 2^31-1": lambda: summed(
            [constant("dims", [2**31 - 1]), constant("v", 1.0), node("big", "Fill", "dims", "v", **f32)]
        ),
        "a Tile of the observation": lambda: summed(
            [constant("times", [1, 2**30]), node("big", "Tile", "vector_observation", "times", Tmultiples=i32, **f32)],
            1,
            keep=True,
        ),
        "a Range to 2^31-1": lambda: summed(
            [*count, node("r", "Range", "a", "b", "d", Tidx=i32), node("big", "Cast", "r", SrcT=i32, DstT=np.float32)]
        ),
        "a OneHot of depth 2^31-1": lambda: summed(
            [*hot, node("big", "OneHot", "i", "depth", "on", "off", TI=i32, axis=-1, **f32)], [0, 1]
        ),
        "an observation of 2^31-1": lambda: [
            placeholder("vector_observation", (None, 2**31 - 1)),
            *continuous_policy()[1:],
        ],
        "a chain of 30,000 nodes": lambda: chain(30_000, "Tanh"),
        "a chain of 300,000 nodes": lambda: chain(300_000, "Identity"),
    }
    for label, nodes in graphs.items():

        def make_graph(folder: Path, marker: Path, nodes: Callable[[], list[Any]] = nodes) -> Path:
            return frozen(folder, nodes())

        case(f"frozen graph, {label}")(make_graph)


_large_graphs()


# ------------------------------------------------------------------ pickles


def _pickles() -> None:
    import zipfile

    def archive(data: bytes) -> Maker:
        def make(folder: Path, marker: Path) -> Path:
            path = folder / "policy.pt"
            with zipfile.ZipFile(path, "w") as made:
                made.writestr("archive/data.pkl", data.replace(b"MARKER", str(marker).encode()))
                made.writestr("archive/version", "3\n")
            return path

        return make

    start, copies = b"\x80\x02", b"0(" + b"h\x00h\x01\x85R" * 20_000 + b"l."
    pickles = {
        "a command": start + b"cposix\nsystem\n(Vtouch MARKER\ntR.",
        "a command by its other name": start + b"cos\nsystem\n(Vtouch MARKER\ntR.",
        "an instance of a builtin": start + b"(Vopen('MARKER','w')\ni__builtin__\nexec\n.",
        "20,000 copies of a Size": start + b"ctorch\nSize\nq\x00(" + b"K\x01" * 50_000 + b"tq\x01" + copies,
        "20,000 copies of an OrderedDict": (
            start + b"ccollections\nOrderedDict\nq\x00(" + b"(K\x01K\x02l" * 50_000 + b"lq\x01" + copies
        ),
    }
    for label, data in pickles.items():
        case(f"PyTorch checkpoint, {label}")(archive(data))


_pickles()
