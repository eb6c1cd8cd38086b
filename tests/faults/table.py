"""The faults: how each is planted, where it can occur, and what the report has to say of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from tests.faults.artefacts import Artefact, Onnx, Web


@dataclass(frozen=True)
class Fault:
    """A deliberate fault.

    ``tensors`` are the graph's tensors of which one must be named as the first that differs, with ``op`` as its op;
    empty where there is no number to look at, and ``words`` stand in the reason instead. ``kind`` is that of the
    comparison which must fail, ``cannot`` says in which formats there is no such fault, and why.
    """

    name: str
    fixture: str
    plant: Callable[[Artefact], object]
    output: str
    tensors: tuple[str, ...] = ()
    op: str = ""
    kind: str = "numbers"
    words: str = ""
    cannot: Mapping[str, str] = field(default_factory=dict)
    #: what a refusal must say, where a format with the fault is not even the bundle's any more
    refused: Mapping[str, str] = field(default_factory=dict)
    #: what must be named instead, where a format has the fault elsewhere
    elsewhere: Mapping[str, tuple[tuple[str, ...], str]] = field(default_factory=dict)


def _weight(name: str, index: tuple[int, ...], by: float) -> Callable[[Artefact], None]:
    def plant(artefact: Artefact) -> None:
        value = artefact.constant(name)
        value[index] += np.float32(by)
        artefact.set_constant(name, value)

    return plant


def _forbids(artefact: Artefact) -> None:
    one = artefact.add_constant("fault/one", np.array(1, np.float32))
    artefact.redirect("action_masks", artefact.insert("fault/inverted", "Sub", [one, "action_masks"]))


def _branches_turned(artefact: Artefact) -> None:
    order = artefact.add_constant("fault/order", np.array([5, 6, 7, 8, 3, 4, 0, 1, 2], np.int32))
    axis = artefact.add_constant("fault/axis", np.array(1, np.int32))
    dtypes = (np.float32, np.int32, np.int32)
    artefact.redirect(
        "action_masks", artefact.insert("fault/turned", "GatherV2", ["action_masks", order, axis], dtypes)
    )


def _one_bit(artefact: Artefact) -> None:
    # in ONNX the index and its column are one node
    index = f"deterministic_action/branch_2/{'column' if isinstance(artefact, Onnx) else 'argmax'}"
    dtype = np.int32 if isinstance(artefact, Web) else np.int64
    most = artefact.add_constant("fault/most", np.array(1, dtype))
    artefact.redirect(index, artefact.insert("fault/bit", "Minimum", [index, most], (dtype,)))


def _narrow(artefact: Artefact) -> None:
    for branch in range(3):
        column = f"deterministic_action/branch_{branch}/column"
        narrow = artefact.cast(f"fault/narrow_{branch}", column, np.int64, np.int32)
        artefact.redirect(column, narrow)
    artefact.retype_indices("deterministic_action", np.int32)


def _halves_swapped(artefact: Artefact) -> None:
    c, h, *axis = artefact.reads("recurrent_out")
    artefact.rewire("recurrent_out", [h, c, *axis])


def _relu(artefact: Artefact) -> None:
    artefact.become("main_graph_0/hidden_0/Mul", "Relu", ["main_graph_0/hidden_0/BiasAdd"])


def _shifted(artefact: Artefact) -> None:
    draw = "multinomial_1/Multinomial"
    source, *rest = artefact.reads(draw)
    by = artefact.add_constant("fault/by", np.array([[2.0, 0.0]], np.float32))
    artefact.rewire(draw, [artefact.insert("fault/shifted", "Add", [source, by]), *rest])


def _drop(name: str) -> Callable[[Artefact], None]:
    return lambda artefact: artefact.drop_output(name)


def _rename(old: str, new: str) -> Callable[[Artefact], None]:
    return lambda artefact: artefact.rename_output(old, new)


_FED = dict.fromkeys(("saved_model", "tfjs"), (("state",), "Placeholder"))
#: All branches are masked at once, whose logarithm is the first that these have of the source.
_MASKED = dict.fromkeys(("tfjs", "onnx"), (("Log",), "Log"))
_MASKS = ("strided_slice_3", "strided_slice_4", "strided_slice_5")

FAULTS = (
    Fault(
        "one weight off",
        "continuous",
        _weight("dense/kernel/read", (3, 1), 0.01),
        "action",
        ("dense/kernel/read",),
        "Const",
    ),
    Fault(
        "one weight of a convolution off",
        "visual",
        _weight("conv2d/kernel/read", (2, 1, 0, 3), 0.02),
        "value_estimate",
        ("conv2d/kernel/read",),
        "Const",
    ),
    Fault(
        "two inputs swapped",
        "two",
        lambda artefact: artefact.swap_inputs("state", "state_1"),
        "action",
        ("left/MatMul", "left"),
        "",
        elsewhere=_FED,
    ),
    Fault("a mask that forbids", "discrete", _forbids, "action", _MASKS, "StridedSlice", elsewhere=_MASKED),
    Fault(
        "a mask with its branches turned",
        "discrete",
        _branches_turned,
        "action",
        _MASKS,
        "StridedSlice",
        elsewhere=_MASKED,
    ),
    Fault(
        "an output dropped",
        "continuous",
        _drop("value_estimate"),
        "value_estimate",
        kind="failure",
        words="value_estimate",
    ),
    Fault(
        "an index cut to one bit",
        "discrete",
        _one_bit,
        "deterministic_action",
        ("deterministic_action/branch_2/column",),
        "Reshape",
        elsewhere={"onnx": (("deterministic_action",), "ConcatV2")},
    ),
    Fault(
        "an index narrowed to 32 bits",
        "discrete",
        _narrow,
        "deterministic_action",
        words="int32",
        cannot={"tfjs": "TensorFlow.js has no int64: its indices are int32, as they should be"},
        refused={"bytes": "has 'deterministic_action' as int32"},
    ),
    Fault(
        "a memory that is not fed back",
        "recurrent",
        lambda artefact: artefact.become("recurrent_out", "Identity", ["recurrent_in"]),
        "recurrent_out",
        ("recurrent_out",),
        "ConcatV2",
        "rollout",
    ),
    Fault(
        "[c|h] swapped",
        "recurrent",
        _halves_swapped,
        "recurrent_out",
        ("recurrent_out",),
        "ConcatV2",
    ),
    Fault("swish replaced by relu", "continuous", _relu, "action", ("main_graph_0/hidden_0/Mul",), "Mul"),
    Fault(
        "a sampler that prefers a class",
        "sampled",
        _shifted,
        "action",
        ("multinomial_1/Multinomial",),
        "Multinomial",
        words="that its classes are drawn from",
    ),
    Fault(
        "a sampler with a fixed seed",
        "sampled",
        lambda artefact: artefact.seed("multinomial_1/Multinomial", 7),
        "action",
        kind="draws",
        words="the same after every start",
    ),
    Fault("an output renamed", "continuous", _rename("action", "actions"), "action", kind="failure", words="action"),
)
