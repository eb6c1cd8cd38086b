"""The four formats as their files are, to be changed by hand: nothing of this project's writers is used.

Tensors go by the graph's names; an .onnx says itself what it calls them.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.tensors import from_array, to_array
from tests.handmade import constant, node

Array = npt.NDArray[Any]

FORMATS = ("bytes", "saved_model", "tfjs", "onnx")
#: What TensorFlow asks of the ops that are put in: attribute → the operand whose dtype it is.
_TYPES = {
    "Add": {"T": 0},
    "Mul": {"T": 0},
    "Sub": {"T": 0},
    "Minimum": {"T": 0},
    "GatherV2": {"Tparams": 0, "Tindices": 1, "Taxis": 2},
}


class Artefact(ABC):
    """One format of a bundle, opened."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.name = json.loads((folder / "policy.json").read_text())["name"]

    # ---- constants

    @abstractmethod
    def constant(self, name: str) -> Array:
        """A copy of a constant's value."""

    @abstractmethod
    def set_constant(self, name: str, value: Array) -> None:
        """Another value of the same shape and dtype."""

    @abstractmethod
    def add_constant(self, name: str, value: Array) -> str:
        """A new constant; gives its name."""

    # ---- nodes

    @abstractmethod
    def reads(self, name: str) -> list[str]:
        """What a node reads."""

    @abstractmethod
    def rewire(self, name: str, inputs: Sequence[str]) -> None:
        """Let a node read something else."""

    @abstractmethod
    def consumers(self, tensor: str) -> list[str]:
        """The nodes that read a tensor."""

    @abstractmethod
    def become(self, name: str, op: str, inputs: Sequence[str]) -> None:
        """Let a node compute a float function of ``inputs`` (Relu, Identity) instead."""

    @abstractmethod
    def insert(self, name: str, op: str, inputs: Sequence[str], dtypes: Sequence[Any] = (np.float32,)) -> str:
        """A new node before those that read its inputs; gives its name. ``dtypes`` are those of the inputs."""

    @abstractmethod
    def cast(self, name: str, tensor: str, source: Any, target: Any) -> str:
        """A new Cast; gives its name."""

    @abstractmethod
    def seed(self, name: str, value: int) -> None:
        """Give a sampler a seed of its own."""

    @abstractmethod
    def retype_indices(self, name: str, dtype: Any) -> None:
        """Declare another dtype for a Concat whose inputs have it now."""

    def redirect(self, tensor: str, other: str) -> None:
        """Let all that reads ``tensor`` read ``other``, which is made of it."""
        for reader in self.consumers(tensor):
            if reader != other:
                self.rewire(reader, [other if r == tensor else r for r in self.reads(reader)])

    # ---- the interface

    @abstractmethod
    def swap_inputs(self, a: str, b: str) -> None:
        """What is fed as ``a`` arrives as ``b``, and the other way round."""

    @abstractmethod
    def drop_output(self, name: str) -> None:
        """The output is not there any more."""

    @abstractmethod
    def rename_output(self, old: str, new: str) -> None:
        """The output has another name."""

    @abstractmethod
    def write(self) -> None:
        """Write the files; see ``save``."""

    def save(self, *, hashes: bool = True) -> None:
        """Write the files, and their hashes into policy.json."""
        self.write()
        if hashes:
            place = self.folder / "policy.json"
            content = json.loads(place.read_text())
            for path in content["files"]:
                data = (self.folder / path).read_bytes()
                content["files"][path] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
            place.write_text(json.dumps(content, indent=1) + "\n")


class _GraphDef(Artefact):
    """.bytes, and what a SavedModel shares with it."""

    graph: Any

    def _node(self, name: str) -> Any:
        return next(n for n in self.graph.node if n.name == name)

    def constant(self, name: str) -> Array:
        return np.array(to_array(self._node(name).attr["value"].tensor))

    def set_constant(self, name: str, value: Array) -> None:
        self._node(name).attr["value"].tensor.CopyFrom(from_array(value))

    def add_constant(self, name: str, value: Array) -> str:
        self.graph.node.add().CopyFrom(constant(name, value, value.dtype))
        return name

    def reads(self, name: str) -> list[str]:
        return list(self._node(name).input)

    def rewire(self, name: str, inputs: Sequence[str]) -> None:
        del self._node(name).input[:]
        self._node(name).input.extend(inputs)

    def consumers(self, tensor: str) -> list[str]:
        return [n.name for n in self.graph.node if tensor in n.input]

    def become(self, name: str, op: str, inputs: Sequence[str]) -> None:
        self._node(name).CopyFrom(node(name, op, *inputs, T=np.float32))

    def insert(self, name: str, op: str, inputs: Sequence[str], dtypes: Sequence[Any] = (np.float32,)) -> str:
        types = {key: dtypes[i] for key, i in _TYPES[op].items()}
        self.graph.node.add().CopyFrom(node(name, op, *inputs, **types))
        return name

    def cast(self, name: str, tensor: str, source: Any, target: Any) -> str:
        self.graph.node.add().CopyFrom(node(name, "Cast", tensor, SrcT=source, DstT=target))
        return name

    def seed(self, name: str, value: int) -> None:
        self._node(name).attr["seed"].i = self._node(name).attr["seed2"].i = value

    def retype_indices(self, name: str, dtype: Any) -> None:
        self._node(name).attr["T"].type = schema.dtype_number(np.dtype(dtype))


class Frozen(_GraphDef):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path = folder / f"{self.name}.bytes"
        self.graph = schema.GraphDef.FromString(self.path.read_bytes())

    def swap_inputs(self, a: str, b: str) -> None:
        # There is no signature: the placeholders exchange their names, so their readers read the other one.
        names = {a: b, b: a}
        for each in self.graph.node:
            inputs = [names.get(r, r) for r in each.input]
            del each.input[:]
            each.input.extend(inputs)

    def drop_output(self, name: str) -> None:
        self.graph.node.remove(self._node(name))

    def rename_output(self, old: str, new: str) -> None:
        self._node(old).name = new

    def write(self) -> None:
        self.path.write_bytes(self.graph.SerializeToString())


class Saved(_GraphDef):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.path = folder / "saved_model" / "saved_model.pb"
        self.message = schema.SavedModel.FromString(self.path.read_bytes())
        self.meta = self.message.meta_graphs[0]
        self.graph = self.meta.graph_def

    def swap_inputs(self, a: str, b: str) -> None:
        for definition in self.meta.signature_def.values():
            entries = definition.inputs
            entries[a].name, entries[b].name = entries[b].name, entries[a].name

    def drop_output(self, name: str) -> None:
        for definition in self.meta.signature_def.values():
            if name in definition.outputs:
                del definition.outputs[name]

    def rename_output(self, old: str, new: str) -> None:
        for definition in self.meta.signature_def.values():
            if old in definition.outputs:
                definition.outputs[new].CopyFrom(definition.outputs[old])
                del definition.outputs[old]

    def write(self) -> None:
        self.path.write_bytes(self.message.SerializeToString())


class Web(Artefact):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.model = json.loads((folder / "tfjs" / "model.json").read_text())
        self.nodes: list[dict[str, Any]] = self.model["modelTopology"]["node"]
        (self.group,) = self.model["weightsManifest"]
        self.data = bytearray(b"".join((folder / "tfjs" / p).read_bytes() for p in self.group["paths"]))

    def _node(self, name: str) -> dict[str, Any]:
        return next(n for n in self.nodes if n["name"] == name)

    def _place(self, name: str) -> tuple[int, dict[str, Any]]:
        start = 0
        for entry in self.group["weights"]:
            if entry["name"] == name:
                return start, entry
            start += int(np.prod(entry["shape"])) * np.dtype(entry["dtype"]).itemsize
        raise KeyError(name)

    def constant(self, name: str) -> Array:
        start, entry = self._place(name)
        count = int(np.prod(entry["shape"]))
        return np.frombuffer(bytes(self.data), entry["dtype"], count, start).reshape(entry["shape"]).copy()

    def set_constant(self, name: str, value: Array) -> None:
        start, entry = self._place(name)
        assert (value.dtype.name, list(value.shape)) == (entry["dtype"], entry["shape"])
        self.data[start : start + value.nbytes] = value.tobytes()

    def add_constant(self, name: str, value: Array) -> str:
        kind = {"float32": "DT_FLOAT", "int32": "DT_INT32"}[value.dtype.name]
        shape = {"dim": [{"size": str(n)} for n in value.shape]}
        attributes = {"dtype": {"type": kind}, "value": {"tensor": {"dtype": kind, "tensorShape": shape}}}
        self.nodes.append({"name": name, "op": "Const", "attr": attributes})
        self.group["weights"].append({"name": name, "shape": list(value.shape), "dtype": value.dtype.name})
        self.data += value.tobytes()
        return name

    def reads(self, name: str) -> list[str]:
        return list(self._node(name).get("input", []))

    def rewire(self, name: str, inputs: Sequence[str]) -> None:
        self._node(name)["input"] = list(inputs)

    def consumers(self, tensor: str) -> list[str]:
        return [n["name"] for n in self.nodes if tensor in n.get("input", [])]

    def become(self, name: str, op: str, inputs: Sequence[str]) -> None:
        self._node(name).update(op=op, input=list(inputs), attr={"T": {"type": "DT_FLOAT"}})

    def insert(self, name: str, op: str, inputs: Sequence[str], dtypes: Sequence[Any] = (np.float32,)) -> str:
        types = {key: {"type": _web_type(dtypes[i])} for key, i in _TYPES[op].items()}
        self.nodes.append({"name": name, "op": op, "input": list(inputs), "attr": types})
        return name

    def cast(self, name: str, tensor: str, source: Any, target: Any) -> str:
        types = {"SrcT": {"type": _web_type(source)}, "DstT": {"type": _web_type(target)}}
        self.nodes.append({"name": name, "op": "Cast", "input": [tensor], "attr": types})
        return name

    def seed(self, name: str, value: int) -> None:
        self._node(name)["attr"].update(seed={"i": str(value)}, seed2={"i": str(value)})

    def retype_indices(self, name: str, dtype: Any) -> None:
        self._node(name)["attr"]["T"]["type"] = _web_type(dtype)

    def swap_inputs(self, a: str, b: str) -> None:
        entries = self.model["signature"]["inputs"]
        entries[a], entries[b] = entries[b], entries[a]

    def drop_output(self, name: str) -> None:
        del self.model["signature"]["outputs"][name]
        self.model["userDefinedMetadata"]["structuredOutputKeys"].remove(name)

    def rename_output(self, old: str, new: str) -> None:
        outputs = self.model["signature"]["outputs"]
        self.model["signature"]["outputs"] = {new if k == old else k: v for k, v in outputs.items()}
        keys = self.model["userDefinedMetadata"]["structuredOutputKeys"]
        keys[keys.index(old)] = new

    def write(self) -> None:
        (path,) = self.group["paths"]
        (self.folder / "tfjs" / path).write_bytes(bytes(self.data))
        (self.folder / "tfjs" / "model.json").write_text(json.dumps(self.model))


def _web_type(dtype: Any) -> str:
    return {"float32": "DT_FLOAT", "int32": "DT_INT32", "int64": "DT_INT32", "bool": "DT_BOOL"}[np.dtype(dtype).name]


class Onnx(Artefact):
    def __init__(self, folder: Path) -> None:
        import onnx
        import onnx.numpy_helper

        super().__init__(folder)
        self.onnx = onnx
        self.path = folder / f"{self.name}.onnx"
        self.model = onnx.load(str(self.path))
        self.graph = self.model.graph
        notes = {p.key: p.value for p in self.model.metadata_props}
        self.names = json.loads(notes.get("export_model_tensors", "{}")).get("values", {})

    def _node(self, name: str) -> Any:
        return next(n for n in self.graph.node if name in n.output)

    def _initializer(self, name: str) -> tuple[Any, list[int] | None]:
        entry = self.names.get(name, name)
        value, axes = entry if isinstance(entry, list) else (entry, None)
        return next(t for t in self.graph.initializer if t.name == value), axes

    def constant(self, name: str) -> Array:
        tensor, axes = self._initializer(name)
        value = self.onnx.numpy_helper.to_array(tensor)
        return np.array(value if axes is None else value.transpose(np.argsort(axes)))

    def set_constant(self, name: str, value: Array) -> None:
        tensor, axes = self._initializer(name)
        value = np.ascontiguousarray(value if axes is None else value.transpose(axes))
        tensor.CopyFrom(self.onnx.numpy_helper.from_array(value, tensor.name))

    def add_constant(self, name: str, value: Array) -> str:
        self.graph.initializer.append(self.onnx.numpy_helper.from_array(value, name))
        return name

    def reads(self, name: str) -> list[str]:
        return list(self._node(name).input)

    def rewire(self, name: str, inputs: Sequence[str]) -> None:
        del self._node(name).input[:]
        self._node(name).input.extend(inputs)

    def consumers(self, tensor: str) -> list[str]:
        return [n.output[0] for n in self.graph.node if tensor in n.input]

    def become(self, name: str, op: str, inputs: Sequence[str]) -> None:
        self._node(name).CopyFrom(self.onnx.helper.make_node(op, list(inputs), [name]))

    def insert(self, name: str, op: str, inputs: Sequence[str], dtypes: Sequence[Any] = (np.float32,)) -> str:
        if op == "GatherV2":
            made = self.onnx.helper.make_node("Gather", list(inputs[:2]), [name], axis=1)
        else:
            made = self.onnx.helper.make_node({"Minimum": "Min"}.get(op, op), list(inputs), [name])
        return self._placed(made, name)

    def cast(self, name: str, tensor: str, source: Any, target: Any) -> str:
        kind = self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(target))
        return self._placed(self.onnx.helper.make_node("Cast", [tensor], [name], to=kind), name)

    def seed(self, name: str, value: int) -> None:
        self._node(name).attribute.append(self.onnx.helper.make_attribute("seed", float(value)))

    def retype_indices(self, name: str, dtype: Any) -> None:
        kind = self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
        next(o for o in self.graph.output if o.name == name).type.tensor_type.elem_type = kind

    def _placed(self, made: Any, name: str) -> str:
        """ONNX wants a node behind what it reads, and before what reads it."""
        behind = [i for i, n in enumerate(self.graph.node) if set(n.output) & set(made.input)]
        self.graph.node.insert(max(behind, default=-1) + 1, made)
        return name

    def swap_inputs(self, a: str, b: str) -> None:
        names = {a: b, b: a}
        for each in self.graph.node:
            inputs = [names.get(r, r) for r in each.input]
            del each.input[:]
            each.input.extend(inputs)

    def drop_output(self, name: str) -> None:
        self.graph.output.remove(next(o for o in self.graph.output if o.name == name))

    def rename_output(self, old: str, new: str) -> None:
        next(o for o in self.graph.output if o.name == old).name = new
        for each in self.graph.node:
            for names in (each.input, each.output):
                for i, name in enumerate(names):
                    if name == old:
                        names[i] = new

    def write(self) -> None:
        self.path.write_bytes(self.model.SerializeToString())


def opened(kind: str, folder: Path) -> Artefact:
    """One format of a bundle."""
    return {"bytes": Frozen, "saved_model": Saved, "tfjs": Web, "onnx": Onnx}[kind](folder)
