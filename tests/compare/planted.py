"""Sixty wrong pairs: a policy of the fixtures beside itself with one thing changed, and what that is called.

``python -m tests.compare.planted`` counts those that fail, and those that are called what they are.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from msgspec import Struct
from onnx import helper, numpy_helper

from export_model.converters.formats.onnx.exporters import repair_model
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.report import ParityReport
from tests.comparing import compare_artefacts

ROOT = Path(__file__).resolve().parents[2] / "fixtures"
Edit = Callable[[onnx.ModelProto], None]


def constant(model: onnx.ModelProto, value: np.ndarray) -> str:
    name = f"planted_{len(model.graph.initializer)}"
    model.graph.initializer.append(numpy_helper.from_array(value, name))
    return name


def before_input(op: str, *operands: np.ndarray, place: int = 0, **attributes: int) -> Edit:
    """An op between an input and the graph."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        name = graph.input[place].name
        made = f"planted_in_{len(graph.node)}"
        for node in graph.node:
            node.input[:] = [made if i == name else i for i in node.input]
        given = [constant(model, value) for value in operands]
        graph.node.insert(0, helper.make_node(op, [name, *given], [made], **attributes))

    return edit


def after_output(op: str, *operands: np.ndarray, name: str = "", **attributes: int) -> Edit:
    """An op between the graph and an output, the first unless one is named."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        output = name or graph.output[0].name
        before = f"planted_out_{len(graph.node)}"
        for node in graph.node:
            node.output[:] = [before if o == output else o for o in node.output]
            node.input[:] = [before if i == output else i for i in node.input]
        given = [constant(model, value) for value in operands]
        graph.node.append(helper.make_node(op, [before, *given], [output], **attributes))

    return edit


def other_weights(model: onnx.ModelProto) -> None:
    for weight in (t for t in model.graph.initializer if len(t.dims) == 2):
        values = np.random.default_rng(0).standard_normal(weight.dims).astype(np.float32)
        weight.CopyFrom(numpy_helper.from_array(values, weight.name))


def exchange_gates(model: onnx.ModelProto) -> None:
    """The gates of an LSTM in another framework's order."""
    node = next(n for n in model.graph.node if n.op_type == "LSTM")
    for weight in (t for t in model.graph.initializer if t.name in node.input[1:3]):
        i, o, f, c = np.split(numpy_helper.to_array(weight), 4, axis=1)
        weight.CopyFrom(numpy_helper.from_array(np.concatenate([i, f, c, o], axis=1), weight.name))


def leave_normaliser_out(place: int) -> Edit:
    """An input goes on in place of what Sub, Div and Clip make of it."""

    def edit(model: onnx.ModelProto) -> None:
        graph = model.graph
        made_by = {node.output[0]: node for node in graph.node}
        for clip in (n for n in graph.node if n.op_type == "Clip"):
            divided = made_by.get(clip.input[0])
            moved = divided and made_by.get(divided.input[0])
            if moved and moved.op_type == "Sub" and moved.input[0] == graph.input[place].name:
                for node in graph.node:
                    node.input[:] = [moved.input[0] if i == clip.output[0] else i for i in node.input]
                return
        raise AssertionError("it normalises no such input")

    return edit


def within(bound: float, plant: Callable[..., Edit], **place: Any) -> Edit:
    """Bounds from above and below; Clip takes them otherwise in older opsets."""

    def edit(model: onnx.ModelProto) -> None:
        for op, number in (("Min", bound), ("Max", -bound)):
            plant(op, np.float32(number), **place)(model)

    return edit


def order(size: int, *cycle: int) -> np.ndarray:
    """Places of which those of ``cycle`` are moved round."""
    places = np.arange(size)
    places[list(cycle)] = [*cycle[1:], cycle[0]]
    return places


def column(size: int, place: int, factor: float) -> np.ndarray:
    factors = np.ones(size, np.float32)
    factors[place] = factor
    return factors


class Base(Struct, frozen=True):
    """A file of the fixtures: the observation that is changed, its columns, and the action without chance."""

    file: str
    size: int
    place: int = 0
    action: str = ""

    @property
    def path(self) -> Path:
        return ROOT / self.file


class Wrong(Struct, frozen=True):
    """A wrong pair: what is changed, and the words of the sentence that names it; no words: it has no name."""

    base: Base
    edit: Edit
    words: str

    def write(self, folder: Path) -> Path:
        """Write the candidate."""
        model = onnx.load(self.base.path)
        self.edit(model)
        file = folder / "wrong.onnx"
        onnx.save(model, file)
        return file


ACTOR = Base("sb3/torch_actor_legacy.onnx", 8)
PENDULUM, INVERTED = Base("gym/Pendulum-v1.onnx", 3), Base("gym/InvertedPendulum-v5.onnx", 4)
PPO = Base("torch_checkpoint/ppo_1_1.onnx", 4, 1, "deterministic_continuous_actions")
SAC = Base("torch_checkpoint/sac_1_1.onnx", 5, 0, "deterministic_continuous_actions")
LSTM = Base("torch_checkpoint/ppo_1_1_hybrid_lstm.onnx", 5, 0, "deterministic_continuous_actions")
SAC_LSTM = Base("torch_checkpoint/sac_0_28_hybrid_lstm.onnx", 3, 1, "deterministic_continuous_actions")
GRU = Base("exporters/gru_reset.onnx", 6)
PLAIN = {"actor": ACTOR, "pendulum": PENDULUM, "inverted pendulum": INVERTED, "ppo": PPO, "sac": SAC}
NORMALISED = {"ppo, obs_0": (PPO, 0), "ppo, obs_1": (PPO, 1), "ppo with a memory": (LSTM, 0)}


def _pairs() -> Iterator[tuple[str, Wrong]]:
    scalar = np.float32
    for name, b in PLAIN.items():
        at = {"place": b.place}
        last = b.size - 1
        yield f"{name}: columns", Wrong(b, before_input("Gather", order(b.size, 0, last), axis=1, **at), "exchanged")
        yield f"{name}: degrees", Wrong(b, before_input("Mul", scalar(180 / np.pi), **at), "degrees")
        sign = before_input("Mul", column(b.size, last, -1), **at)
        yield f"{name}: a sign", Wrong(b, sign, f"[{last}] scaled (the reference would be given -1 ×")
        turned = before_input("Gather", order(b.size, 0, 1, 2), axis=1, **at)
        yield f"{name}: axes", Wrong(b, turned, "in another order")
        yield f"{name}: tanh", Wrong(b, after_output("Tanh", name=b.action), "squashed otherwise")
        yield f"{name}: scale", Wrong(b, after_output("Mul", scalar(0.25), name=b.action), "0.25 ×")
        yield f"{name}: offset", Wrong(b, after_output("Add", scalar(0.3), name=b.action), "+ 0.3")
    for name, b in {k: PLAIN[k] for k in ("actor", "ppo", "sac")}.items():
        yield f"{name}: actions", Wrong(b, after_output("Gather", order(2, 0, 1), name=b.action, axis=1), "exchanged")
    for name, b in {k: PLAIN[k] for k in ("actor", "inverted pendulum", "ppo")}.items():
        yield f"{name}: actions clipped", Wrong(b, within(0.01, after_output, name=b.action), "clipped to ±0.01")
        yield f"{name}: observations clipped", Wrong(b, within(1, before_input, place=b.place), "clipped to ±1")
    for name, (b, place) in NORMALISED.items():
        yield f"{name}: no normaliser", Wrong(b, leave_normaliser_out(place), "normalised otherwise")
    for name, b in {"lstm": LSTM, "sac lstm": SAC_LSTM}.items():
        memory = next(i for i, v in enumerate(onnx.load(b.path).graph.input) if v.name == "recurrent_in")
        yield f"{name}: no memory", Wrong(b, before_input("Mul", scalar(0), place=memory), "was not fed back")
        swapped = before_input("Gather", order(b.size, 0, 1), place=b.place, axis=1)
        yield f"{name}: columns", Wrong(b, swapped, "exchanged")
        yield f"{name}: gates", Wrong(b, exchange_gates, "")
    frames = np.arange(8).reshape(2, 4)
    yield "actor: frames", Wrong(ACTOR, before_input("Gather", frames[::-1].reshape(-1), axis=1), "stacked frames")
    yield "actor: values", Wrong(ACTOR, before_input("Gather", frames.T.reshape(-1), axis=1), "value by value")
    for name in ("actor", "inverted pendulum", "ppo", "sac"):
        yield f"{name}: another training", Wrong(PLAIN[name], other_weights, "")
    yield "gru: reset", Wrong(GRU, lambda model: None, "fault of the exporter")


PAIRS = dict(_pairs())


def compared(pair: Wrong, folder: Path, pool: RuntimePool) -> tuple[ParityReport, list[str]]:
    """Compare the file of the fixtures with the wrong one; the report, and the sentences that name what differs.

    The file that an exporter wrote wrongly is the candidate, the one that was mended the reference.
    """
    wrong, reference = pair.write(folder), pair.base.path
    if pair.base is GRU:
        mended = onnx.load(reference)
        repair_model(mended, "gru-reset")
        reference = folder / "mended.onnx"
        onnx.save(mended, reference)
    report = compare_artefacts(reference, wrong, runtimes="onnxruntime", pool=pool)
    return report, [n for n in report.notes if " is the reference with " in n or " is the candidate with " in n] + [
        n for n in report.notes if "fault of the exporter" in n
    ]


def is_named(pair: Wrong, sentences: list[str]) -> bool:
    return bool(pair.words) and any(pair.words in sentence for sentence in sentences)


def main() -> None:
    failed = named = 0
    with RuntimePool() as pool, tempfile.TemporaryDirectory() as folder:
        for name, pair in PAIRS.items():
            report, sentences = compared(pair, Path(folder), pool)
            right = is_named(pair, sentences)
            failed += report.passed is False
            named += right
            print(f"{name}: {report.passed}, {'named' if right else 'NOT named'}: {sentences}", flush=True)
    print(f"{failed} of {len(PAIRS)} wrong pairs fail, {named} are called what they are")
    sys.exit(failed < len(PAIRS))


if __name__ == "__main__":
    main()
