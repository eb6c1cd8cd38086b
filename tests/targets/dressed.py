"""A policy under a profile, run beside the policy itself: the same inputs under mapped names, layouts and dtypes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.consumers.importable import importable
from export_model.converters.consumers.playable import playable
from export_model.converters.consumers.profile import Profile
from export_model.converters.consumers.unity.checker import UnityVerdict, check_file
from export_model.converters.consumers.unity.consumers import Engine, consumer
from export_model.converters.consumers.unity.settings import Brain, sensors_of
from export_model.converters.formats.barracuda.format import NnModel, parse
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.onnx import messages
from export_model.converters.formats.onnx.edit import lift_draws
from export_model.converters.formats.registry import format_for_writing
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.roles import OBSERVATIONS, Role
from export_model.signatures.spec import TensorSpec
from tests.barracuda.nn_safety import assert_safe
from tests.barracuda.reference import evaluate

Feeds = dict[str, np.ndarray]
#: (feeds, fetches) → what was fetched, by name
Runner = Callable[[Mapping[str, np.ndarray], Sequence[str]], Mapping[str, np.ndarray]]
ATOL = RTOL = 1e-5
CONTRACT = '{"tool": {"version": "test"}}'


def as_written(entities: np.ndarray) -> np.ndarray:
    """[N, E, F] as a model of Barracuda sees it, which ML-Agents fills number by number: it lies there as [N, F, E]."""
    rows, count, width = entities.shape
    return entities.reshape(rows, width, count).transpose(0, 2, 1)


def compiled(path: Path, options: CompileOptions | None = None) -> list[Policy]:
    """The policies of a source, as every export has them."""
    return [policy for _, policy in read_source(path, ReadOptions()).compile_models(options)]


class Plain:
    """A policy as it is, in onnxruntime: made once, and held against what each profile makes of it."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    @cached_property
    def run(self) -> Callable[[Mapping[str, Any]], Feeds]:
        plain = format_for_writing("onnx").artifact(self.policy, WriteOptions(CONTRACT))
        return runner_of(onnx.ModelProto.FromString(plain.files[plain.main].to_bytes()))


@dataclass
class Pair:
    """A policy and what a profile makes of it, both as ONNX."""

    policy: Policy
    profile: Profile
    dressed: Policy
    plain: Plain
    #: the ModelProto, an empty one where the format is not ONNX
    made: onnx.ModelProto
    data: bytes
    form: str

    @classmethod
    def of(cls, policy: Policy, profile: Profile, plain: Plain | None = None, form: str | None = None) -> Pair:
        """In the profile's usual format, or in ``form``.

        Raises ProfileError where the profile cannot hold the policy, UnsupportedOpError where that format cannot.
        """
        dressed = profile.dress(policy)
        form = form or profile.formats[0]
        artifact = format_for_writing(form).artifact(dressed, profile.write_options(CONTRACT))
        if profile.importers:
            importable(profile, artifact.files, policy.name)
            playable(profile, artifact.files, policy.name)
        data = artifact.files[artifact.main].to_bytes()
        made = onnx.ModelProto.FromString(data if form == "onnx" else b"")
        return cls(policy, profile, dressed, plain or Plain(policy), made, data, form)

    def brain(self) -> Brain:
        """Behavior Parameters of an agent that the dressed policy is for."""
        signature = self.dressed.signature
        inputs = sorted(signature.observations, key=lambda s: int("0" + re.sub(r"\D", "", s.name)))
        shapes = [tuple(int(d or 1) for d in s.shape[1:]) for s in inputs]
        drawn = [s for s in signature.outputs if s.role in (Role.CONTINUOUS, Role.DETERMINISTIC)]
        width = next((int(s.shape[-1] or 0) for s in drawn if s.dtype == "float32"), 0)
        vector = next((int(s.shape[-1] or 0) for s in inputs if s.name == "vector_observation"), 0)
        return Brain(width, signature.branches, vector, sensors=sensors_of(shapes))

    def verdicts(self, folder: Path) -> dict[str, UnityVerdict]:
        """What our checker says for each release of the profile."""
        path = folder / f"policy.{self.form}"
        path.write_bytes(self.data)
        return {name: check_file(path, consumer(name), self.brain()) for name in self.profile.checkers}

    def made_constant(self, name: str) -> np.ndarray:
        """An output that is the same in every run."""
        return self.dressed.constants[name]

    # ------------------------------------------------------------------ running both

    def difference(self, rows: int, seed: int, runner: Runner | None = None, atol: float = ATOL) -> str | None:
        """What the dressed policy does otherwise than the policy, None for nothing.

        ``runner`` runs a .bytes: it is fed the draws in the place of its samplers. The default is numpy.
        """
        rng = np.random.default_rng(seed)
        own = {s.name: _sample(s, self.policy, rows, rng) for s in self.policy.signature.inputs}
        masks = self._masks(rows, rng)
        if masks is not None and self.policy.signature.has_input("action_masks"):
            own["action_masks"] = masks.astype(self.policy.signature.input("action_masks").dtype)
        theirs = {s.name: self._mapped(s, own, masks) for s in self.dressed.signature.inputs}
        if self.form == "bytes":
            expected = run_graph(self.policy.graph, own, [s.name for s in self.policy.signature.outputs])
            noise = [own[s.name] for s in self.policy.signature.noise]
            return self._frozen_difference(expected, theirs, noise, runner, atol)
        expected = self.plain.run(own)
        draws, scores = self._draws, self._scores
        noise = {s.name: own[s.name] for s in self.policy.signature.noise}
        if self.form == "nn":
            return self._nn_difference(expected, theirs, list(noise.values()), atol)
        if len(draws) == 1 and len(noise) == 1:
            theirs[draws[0]] = next(iter(noise.values()))
        actual = self._run_made(theirs)
        return self._compared(expected, actual, scores, drawn=len(draws) != len(noise) or len(draws) > 1)

    @cached_property
    def _draws(self) -> list[str]:
        return [n.output[0] for n in self.made.graph.node if n.op_type == "RandomNormalLike"]

    @cached_property
    def _scores(self) -> list[str]:
        return [n.input[0] for n in self.made.graph.node if n.op_type == "Multinomial"]

    @cached_property
    def _run_made(self) -> Callable[[Mapping[str, Any]], Feeds]:
        """What was made, with its one draw as an input where the policy has noise, and with what is drawn from."""
        fed = len(self._draws) == 1 and len(self.policy.signature.noise) == 1
        model = _copied(self.made)
        if fed:
            own = lift_draws(messages.ModelProto.FromString(model.SerializeToString()), self._draws)
            model = onnx.ModelProto.FromString(own.SerializeToString())
        known = {o.name for o in model.graph.output}
        inner = (n for n in dict.fromkeys(self._scores) if n not in known)
        model.graph.output.extend(onnx.ValueInfoProto(name=n) for n in inner)
        return runner_of(model)

    def _nn_difference(self, expected: Feeds, theirs: Feeds, noise: list[np.ndarray], atol: float) -> str | None:
        model = parse(self.data)
        assert_safe(model)
        values = self.nn_values(model, theirs, noise)
        given = {s.name: values[s.name].astype(s.dtype) for s in self.dressed.signature.outputs}
        for spec in self.dressed.signature.outputs:
            want = (1, spec.shape[-1], 1) if spec.role is Role.MEMORY_OUT else (1, 1, spec.shape[-1])
            if given[spec.name].shape[1:] != want:
                return f"{spec.name} is {given[spec.name].shape} in the file"
            given[spec.name] = given[spec.name].reshape([-1, *(d or 1 for d in spec.shape[1:])])
        given |= {name: values[name].reshape(value.shape) for name, value in self.dressed.constants.items()}
        scores = [layer.inputs[0] for layer in model.layers if layer.type == LayerType.MULTINOMIAL]
        given |= {name: values[name].reshape(len(values[name]), -1) for name in scores}
        draws = sum(layer.type == LayerType.RANDOM_NORMAL for layer in model.layers)
        return self._compared(expected, given, scores, drawn=draws != len(noise) or draws > 1, atol=atol)

    def values(self, model: NnModel, own: Feeds) -> dict[str, np.ndarray]:
        """Every tensor of the .nn, for what the policy itself is fed."""
        masks = own.get(
            "action_masks", np.ones((self.policy.signature.rows(own), sum(self.dressed.signature.branches)))
        )
        theirs = {s.name: self._mapped(s, own, masks) for s in self.dressed.signature.inputs}
        return self.nn_values(model, theirs, [own[s.name] for s in self.policy.signature.noise])

    def nn_values(self, model: NnModel, theirs: Feeds, noise: list[np.ndarray]) -> dict[str, np.ndarray]:
        """Every tensor of the .nn by the format's layer rules, fed as Unity feeds it; classes are not drawn."""
        feeds: dict[str, np.ndarray] = {}
        rows = self.dressed.signature.rows(theirs)
        for spec in self.dressed.signature.inputs:
            value = theirs[spec.name]
            if spec.role is Role.VISUAL:
                feeds[spec.name] = value.transpose(0, 2, 3, 1)
            elif spec.role is Role.MEMORY_IN:
                feeds[spec.name] = value.reshape(rows, 1, -1, 1)
            elif spec.is_sequence:
                feeds[spec.name] = value.transpose(0, 2, 1)[:, None]
            else:
                feeds[spec.name] = value.reshape(rows, 1, 1, -1)
        drawn = iter(noise)
        for layer in model.layers:
            if layer.type == LayerType.MULTINOMIAL:
                feeds[layer.name] = np.zeros((rows, 1, 1, 1))
            elif layer.type == LayerType.RANDOM_NORMAL:
                feeds[layer.name] = next(drawn).reshape(rows, 1, 1, -1)
        return evaluate(model, feeds)

    def _frozen_difference(
        self, expected: Feeds, theirs: Feeds, noise: list[np.ndarray], runner: Runner | None, atol: float
    ) -> str | None:
        nodes = self.dressed.graph.nodes
        draws = [n.name for n in nodes if n.op == "RandomStandardNormal"]
        scores = [n.inputs[0] for n in nodes if n.op == "Multinomial"]
        if len(draws) == len(noise) == 1:
            theirs[draws[0]] = noise[0]
        if "sequence_length" in self.dressed.graph:
            theirs["sequence_length"] = np.array(1, np.int32)
        constants = [n.name for n in nodes if n.op == "Const" and n.name in self.dressed.signature.constants]
        wanted = [*(s.name for s in self.dressed.signature.outputs), *scores, *constants]
        if runner is None:
            known = {n.name for n in nodes}
            fed = {k: v for k, v in theirs.items() if k in known}
            actual = run_graph(self.dressed.graph, fed, wanted)
        else:
            actual = dict(runner(theirs, wanted))
        for name in constants:
            if actual[name].dtype != np.int32 or actual[name].shape != ():
                return f"constant {name} is {actual[name]!r}"
        drawn = len(draws) != len(noise) or len(draws) > 1
        return self._compared(expected, actual, scores, drawn=drawn, atol=atol)

    def _masks(self, rows: int, rng: np.random.Generator) -> np.ndarray | None:
        """Masks that leave one action of each branch allowed, and forbid others now and then."""
        sizes = self.dressed.signature.branches
        if not sizes:
            return None
        parts = []
        for size in sizes:
            part = (rng.random((rows, size)) > 0.3).astype(np.float32)
            part[np.arange(rows), rng.integers(0, size, rows)] = 1
            parts.append(part)
        both = all(p.signature.has_input("action_masks") for p in (self.policy, self.dressed))
        return np.concatenate(parts, 1) if both else np.ones((rows, sum(sizes)), np.float32)

    def _mapped(self, spec: TensorSpec, own: Feeds, masks: np.ndarray | None) -> np.ndarray:
        if spec.role is Role.MASKS:
            assert masks is not None
            return masks
        if isinstance(spec.source, tuple) and spec.role is Role.VECTOR:
            parts = [s for s in self.policy.signature.inputs if s.role is Role.VECTOR]
            return np.concatenate([own[s.name].astype(np.float32) for s in parts], 1)
        role = spec.role
        if role is Role.MEMORY_IN and self.policy.signature.memory is None:
            role = Role.PREV_ACTION  # a memory that holds the last action alone
        source = [
            s
            for s in self.policy.signature.inputs
            if s.role is role and (s.source == spec.source or role is not spec.role)
        ]
        assert len(source) == 1, spec
        value = own[source[0].name]
        if spec.role is Role.VISUAL:
            done = self.policy.signature.preprocess[source[0].name]
            given = self.dressed.signature.preprocess[spec.name]["layout"]
            turn = {("NHWC", "NCHW"): (0, 3, 1, 2), ("NCHW", "NHWC"): (0, 2, 3, 1)}.get((done["layout"], given))
            value = value.transpose(turn) if turn is not None else value
            value = value / np.float32(done["range"][1])
        if role is Role.MEMORY_IN and self.keeps_action:
            last = next(own[s.name] for s in self.policy.signature.inputs if s.role is Role.PREV_ACTION)
            value = np.concatenate([value.reshape(len(value), -1), last.reshape(len(value), -1)], 1)
        value = value.astype(spec.dtype).reshape([len(value), *(d or -1 for d in spec.shape[1:])])
        return as_written(value) if value.ndim == 3 and self._transposes_buffers(spec) else value

    def _transposes_buffers(self, spec: TensorSpec) -> bool:
        released = {consumer(name).engine for name in self.profile.players}
        return spec.role in OBSERVATIONS and released == {Engine.BARRACUDA}

    def _compared(
        self, expected: Feeds, actual: Feeds, scores: list[str], *, drawn: bool, atol: float = ATOL
    ) -> str | None:
        for spec in self.dressed.signature.outputs:
            if spec.role is Role.SAMPLED or (drawn and spec.role is Role.CONTINUOUS):
                continue
            if spec.role is Role.LOG_PROBS:
                found = self._branches_compared(expected, [actual[spec.name][:, a:b] for a, b in self._bounds()])
                if found is not None:
                    return found
                continue
            name = self._own_name(spec)
            want, got = expected[name], actual[spec.name]
            if spec.role is Role.MEMORY_OUT and self.keeps_action:
                last = actual.get("discrete_actions", actual.get("action", actual.get("continuous_actions")))
                assert last is not None
                if got.reshape(len(got), -1)[:, -last.shape[1] :].tolist() != last.tolist():
                    return f"{spec.name} does not keep the action"
                kept = self.policy.signature.memory
                own = [] if kept is None or kept.output is None else [expected[kept.output].reshape(len(got), -1)]
                want = np.concatenate([*own, last], 1)
            if [d for d in spec.shape if d is not None] != list(got.shape[1:]):
                return f"{spec.name} has the shape {got.shape}, not {spec.shape}"
            if got.size != want.size or not np.allclose(
                got.reshape(want.shape).astype(np.float64),
                want.astype(np.float64),
                rtol=RTOL,
                atol=atol,
                equal_nan=True,
            ):
                return f"{spec.name} is not {name}: {got.reshape(-1)[:6]} instead of {want.reshape(-1)[:6]}"
        for name, value in self.dressed.constants.items():
            if actual[name].tolist() != value.tolist():
                return f"constant {name} is {actual[name]}"
        return self._scores_compared(expected, actual, scores)

    @property
    def keeps_action(self) -> bool:
        """Whether the last action comes back with the memory, as ML-Agents 0.2 does not feed it."""
        roles = [{s.role for s in p.signature.inputs} for p in (self.policy, self.dressed)]
        return Role.PREV_ACTION in roles[0] - roles[1]

    def _own_name(self, spec: TensorSpec) -> str:
        names = {s.name for s in self.policy.signature.outputs}
        if spec.name in names:
            return spec.name
        return "deterministic_action" if spec.name.startswith("deterministic_") else "action"

    def _scores_compared(self, expected: Feeds, actual: Feeds, scores: list[str]) -> str | None:
        """What is drawn from has the distribution of the policy's own log-probabilities."""
        if not scores:
            return None
        drawn = iter(scores)
        parts = [None if b - a == 1 else actual[next(drawn)] for a, b in self._bounds()]
        return self._branches_compared(expected, parts)

    def _bounds(self) -> list[tuple[int, int]]:
        sizes = self.dressed.signature.branches
        ends = np.cumsum(sizes).tolist()
        return [(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    def _branches_compared(self, expected: Feeds, parts: Sequence[np.ndarray | None]) -> str | None:
        roles = {s.name: s.role for s in self.policy.signature.outputs}
        name = next(n for n in ("action_log_probs", "discrete_actions", "action") if n in expected)
        best = next((n for n in ("deterministic_discrete_actions", "deterministic_action") if n in expected), None)
        for number, ((begin, end), got) in enumerate(zip(self._bounds(), parts, strict=True)):
            if got is None:
                continue
            if roles[name] is Role.DETERMINISTIC:
                assert best is not None
                if got.argmax(1).tolist() != expected[best].reshape(len(got), -1)[:, number].tolist():
                    return f"the best of branch {number} is another"
                continue
            own = expected[name] if roles[name] is Role.LOG_PROBS else np.log(expected[name])
            want, have = _softmax(own[:, begin:end]), _softmax(got)
            if not np.allclose(want, have, 1e-4, 1e-5, equal_nan=True):
                return f"branch {number} is drawn from {have[0]} instead of {want[0]}"
        return None


def _softmax(x: np.ndarray) -> np.ndarray:
    e = np.exp(x.astype(np.float64) - x.max(1, keepdims=True))
    return np.asarray(e / e.sum(1, keepdims=True))


def _copied(model: onnx.ModelProto) -> onnx.ModelProto:
    return onnx.ModelProto.FromString(model.SerializeToString())


def _sample(spec: TensorSpec, policy: Policy, rows: int, rng: np.random.Generator) -> np.ndarray:
    shape = [rows if d is None else d for d in spec.shape]
    if spec.role is Role.PREV_ACTION or np.dtype(spec.dtype).kind in "iu":
        high = int((spec.distribution or {}).get("high", 1)) + 1
        return rng.integers(0, high, shape).astype(spec.dtype)
    if spec.role is Role.MASKS:
        return np.ones(shape, spec.dtype)
    if spec.role is Role.VISUAL:
        high = policy.signature.preprocess[spec.name]["range"][1]
        return (rng.random(shape) * high).astype(spec.dtype)
    return rng.standard_normal(shape).astype(spec.dtype)


def runner_of(model: onnx.ModelProto) -> Callable[[Mapping[str, Any]], Feeds]:
    """All outputs of a model in onnxruntime, by name; of what is fed, the inputs are taken."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    taken = {i.name for i in session.get_inputs()}
    names = [o.name for o in session.get_outputs()]

    def run(feeds: Mapping[str, Any]) -> Feeds:
        return dict(zip(names, session.run(None, {k: v for k, v in feeds.items() if k in taken}), strict=True))

    return run
