"""A policy under a profile, run beside the policy itself: the same inputs under mapped names, layouts and dtypes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

from converters.format import WriteOptions
from converters.formats import written
from converters.graph.options import CompileOptions
from converters.onnx.edit import lifted
from converters.policy import Policy
from converters.source import ReadOptions
from converters.targets.profile import Profile
from converters.targets.unity.checker import UnityVerdict, check_file
from converters.targets.unity.consumers import consumer
from converters.targets.unity.settings import Brain, sensors_of
from exporter.export.sources import read_source
from signatures.roles import Role
from signatures.spec import TensorSpec

Feeds = dict[str, np.ndarray]
ATOL = RTOL = 1e-5
CONTRACT = '{"tool": {"version": "test"}}'


def compiled(path: Path) -> list[Policy]:
    """The policies of a source, as every export has them."""
    return [policy for _, policy in read_source(path, ReadOptions()).compiled(CompileOptions())]


@dataclass
class Pair:
    """A policy and what a profile makes of it, both as ONNX."""

    policy: Policy
    profile: Profile
    dressed: Policy
    plain: onnx.ModelProto
    made: onnx.ModelProto
    data: bytes

    @classmethod
    def of(cls, policy: Policy, profile: Profile) -> Pair:
        """Raises ProfileError where the profile cannot hold the policy."""
        dressed = profile.dress(policy)
        artifact = written("onnx").artifact(dressed, WriteOptions(CONTRACT, profile.opset, profile.name))
        assert profile.check is not None
        profile.check(profile, artifact.files, policy.name)
        data = artifact.files[artifact.main]
        plain = written("onnx").artifact(policy, WriteOptions(CONTRACT))
        return cls(
            policy,
            profile,
            dressed,
            onnx.ModelProto.FromString(plain.files[plain.main]),
            onnx.ModelProto.FromString(data),
            data,
        )

    def brain(self) -> Brain:
        """Behavior Parameters of an agent that the dressed policy is for."""
        inputs = sorted(self.dressed.signature.observations, key=lambda s: int(s.name.removeprefix("obs_")))
        constants = self.dressed.signature.constants
        shapes = [tuple(int(d or 1) for d in s.shape[1:]) for s in inputs]
        branches = constants.get("discrete_action_output_shape", [])
        width = constants.get("continuous_action_output_shape", 0)
        assert isinstance(branches, list) and isinstance(width, int | float)
        return Brain(int(width), tuple(branches), sensors=sensors_of(shapes))

    def verdicts(self, folder: Path) -> dict[str, UnityVerdict]:
        """What our checker says for each release of the profile."""
        path = folder / "policy.onnx"
        path.write_bytes(self.data)
        return {name: check_file(path, consumer(name), self.brain()) for name in self.profile.checkers}

    def made_constant(self, name: str) -> np.ndarray:
        """An output that is the same in every run."""
        return self.dressed.constants[name]

    # ------------------------------------------------------------------ running both

    def difference(self, rows: int, seed: int) -> str | None:
        """What the dressed policy does otherwise than the policy, None for nothing."""
        rng = np.random.default_rng(seed)
        own = {s.name: _sample(s, self.policy, rows, rng) for s in self.policy.signature.inputs}
        masks = self._masks(rows, rng)
        if masks is not None and self.policy.signature.has_input("action_masks"):
            own["action_masks"] = masks.astype(self.policy.signature.input("action_masks").dtype)
        theirs = {s.name: self._mapped(s, own, masks) for s in self.dressed.signature.inputs}
        expected = run(self.plain, own, None)
        draws = [n.output[0] for n in self.made.graph.node if n.op_type == "RandomNormalLike"]
        noise = {s.name: own[s.name] for s in self.policy.signature.noise}
        if len(draws) == 1 and len(noise) == 1:
            theirs[draws[0]] = next(iter(noise.values()))
        scores = [n.input[0] for n in self.made.graph.node if n.op_type == "Multinomial"]
        model = lifted(_copied(self.made), draws) if len(draws) == 1 and len(noise) == 1 else self.made
        actual = run(model, theirs, scores)
        return self._compared(expected, actual, scores, masks, drawn=len(draws) != len(noise) or len(draws) > 1)

    def _masks(self, rows: int, rng: np.random.Generator) -> np.ndarray | None:
        """Masks that leave one action of each branch allowed, and forbid others now and then."""
        sizes = self.dressed.signature.constants.get("discrete_action_output_shape")
        if not isinstance(sizes, list):
            return None
        parts = []
        for size in sizes:
            part = (rng.random((rows, size)) > 0.3).astype(np.float32)
            part[np.arange(rows), rng.integers(0, size, rows)] = 1
            parts.append(part)
        own = self.policy.signature.has_input("action_masks")
        return np.concatenate(parts, 1) if own else np.ones((rows, sum(sizes)), np.float32)

    def _mapped(self, spec: TensorSpec, own: Feeds, masks: np.ndarray | None) -> np.ndarray:
        if spec.role is Role.MASKS:
            assert masks is not None
            return masks
        source = [s for s in self.policy.signature.inputs if s.role is spec.role and s.source == spec.source]
        assert len(source) == 1, spec
        value = own[source[0].name]
        if spec.role is Role.VISUAL:
            done = self.policy.signature.preprocess[source[0].name]
            value = value.transpose(0, 3, 1, 2) if done["layout"] == "NHWC" else value
            value = value / np.float32(done["range"][1])
        return value.astype(np.float32).reshape([len(value), *(d or -1 for d in spec.shape[1:])])

    def _compared(
        self, expected: Feeds, actual: Feeds, scores: list[str], masks: np.ndarray | None, *, drawn: bool
    ) -> str | None:
        for spec in self.dressed.signature.outputs:
            if spec.role is Role.SAMPLED or (drawn and spec.name == "continuous_actions"):
                continue
            name = self._own_name(spec)
            want, got = expected[name], actual[spec.name]
            if got.size != want.size or not np.allclose(
                got.reshape(want.shape).astype(np.float64), want.astype(np.float64), ATOL, RTOL, equal_nan=True
            ):
                return f"{spec.name} is not {name}: {got.reshape(-1)[:6]} instead of {want.reshape(-1)[:6]}"
        for name, value in self.dressed.constants.items():
            if actual[name].tolist() != value.tolist():
                return f"constant {name} is {actual[name]}"
        return self._scores_compared(expected, actual, scores)

    def _own_name(self, spec: TensorSpec) -> str:
        names = {s.name for s in self.policy.signature.outputs}
        if spec.name in names:
            return spec.name
        return "deterministic_action" if spec.name.startswith("deterministic_") else "action"

    def _scores_compared(self, expected: Feeds, actual: Feeds, scores: list[str]) -> str | None:
        """What is drawn from has the distribution of the policy's own log-probabilities."""
        name = next((n for n in ("action_log_probs", "discrete_actions", "action") if n in expected), None)
        roles = {s.name: s.role for s in self.policy.signature.outputs}
        if not scores or name is None or roles[name] not in (Role.LOG_PROBS, Role.PROBS):
            return None
        sizes = self.dressed.signature.constants["discrete_action_output_shape"]
        assert isinstance(sizes, list)
        own = expected[name] if roles[name] is Role.LOG_PROBS else np.log(expected[name])
        parts = iter(scores)
        for begin, size in zip(np.cumsum([0, *sizes]), sizes, strict=False):
            if size == 1:
                continue
            want, got = _softmax(own[:, begin : begin + size]), _softmax(actual[next(parts)])
            if not np.allclose(want, got, 1e-4, 1e-5, equal_nan=True):
                return f"the branch at {begin} is drawn from {got[0]} instead of {want[0]}"
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


def run(model: onnx.ModelProto, feeds: Mapping[str, Any], inner: list[str] | None) -> Feeds:
    if inner:
        model = _copied(model)
        known = {o.name for o in model.graph.output}
        model.graph.output.extend(onnx.ValueInfoProto(name=n) for n in dict.fromkeys(inner) if n not in known)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    taken = {i.name for i in session.get_inputs()}
    values = session.run(None, {k: v for k, v in feeds.items() if k in taken})
    return {o.name: v for o, v in zip(session.get_outputs(), values, strict=True)}
