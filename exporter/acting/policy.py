"""A policy out of a bundle, ready to decide."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from exporter.acting.generator import Generator
from signatures.errors import BundleError, RuntimeUnavailableError, UsageError
from signatures.roles import OBSERVATIONS, Role
from signatures.spec import PolicySignature, TensorSpec

Array = np.ndarray
Run = Callable[[Mapping[str, Array], Sequence[str]], dict[str, Array]]
RUNTIMES = ("onnxruntime", "numpy")


@dataclass(frozen=True)
class Decision:
    """What the policy decided for each agent.

    ``continuous`` is float32 [agents, size], ``discrete`` int64 [agents, branches], None where the policy has no such
    actions; ``memory`` float32 [agents, size] is what to pass in at the next step, None where it has none. ``outputs``
    are the policy's other outputs by name.
    """

    continuous: Array | None = None
    discrete: Array | None = None
    memory: Array | None = None
    outputs: Mapping[str, Array] = field(default_factory=dict)

    @property
    def action(self) -> Array:
        """The actions of a policy that has one kind only. Raises UsageError for a hybrid."""
        if self.continuous is not None and self.discrete is not None:
            raise UsageError("the policy has both kinds of actions", fix="read .continuous and .discrete")
        found = self.discrete if self.continuous is None else self.continuous
        assert found is not None
        return found


class LoadedPolicy:
    """A policy that decides. ``signature`` says what it observes and does."""

    def __init__(self, name: str, signature: PolicySignature, run: Run, runtime: str, seed: int = 0) -> None:
        self.name, self.signature, self.runtime = name, signature, runtime
        self._run = run
        self._generator = Generator(seed)
        heads = 2 if signature.action_space == "hybrid" else 1
        self._heads = signature.outputs[:heads]
        plain = [s for s in signature.outputs[heads:] if s.role is Role.DETERMINISTIC]
        self._plain = {head.name: spec for spec, head in zip(plain, self._heads, strict=False)}
        self._scores = next((s for s in signature.outputs if s.role is Role.LOG_PROBS), None)

    def seed(self, seed: int) -> None:
        """Start the draws anew: the same seed gives the same actions for the same inputs, here and in policy.mjs."""
        self._generator = Generator(seed)

    def agent(self, *, deterministic: bool = False) -> Agent:
        """One group of agents whose memory and previous actions are kept for them."""
        return Agent(self, deterministic=deterministic)

    def decide(
        self,
        observations: npt.ArrayLike | Mapping[str, npt.ArrayLike],
        *,
        masks: npt.ArrayLike | None = None,
        memory: npt.ArrayLike | None = None,
        previous: npt.ArrayLike | None = None,
        parameters: Mapping[str, npt.ArrayLike] | None = None,
        deterministic: bool = False,
        seed: int | None = None,
    ) -> Decision:
        """Actions for the agents whose observations are given.

        ``observations`` is one array where the policy has one observation, else a mapping by name; each has the agents
        as its first axis, or no such axis for a single one (answers have it all the same). ``masks`` [agents, ΣB]: 1
        allows an action, 0 forbids it; all are allowed without it. ``memory`` is that of the last Decision, zero at the
        start of an episode. ``previous`` are the discrete actions of the last step, for a policy that asks for them.
        ``parameters`` are the source's own placeholders. ``deterministic`` takes the likeliest action and the mean.
        ``seed`` starts the draws anew before this decision. Raises UsageError where something is missing or of the
        wrong shape.
        """
        if seed is not None:
            self.seed(seed)
        given = self._named(observations)
        special = {Role.MASKS: masks, Role.MEMORY_IN: memory, Role.PREV_ACTION: previous}
        feeds: dict[str, Array] = {}
        rows: int | None = None
        for spec in sorted(self.signature.inputs, key=lambda s: s.role not in OBSERVATIONS):
            if spec.role in OBSERVATIONS:
                array = self._fitting(spec, given.pop(spec.name), rows)
                rows = len(array)
            elif spec.role is Role.NOISE:
                continue
            elif spec.role is Role.PARAMETER:
                if spec.name not in (parameters or {}):
                    raise UsageError(f"the parameter {spec.name!r} is missing", fix=f"parameters={{{spec.name!r}: …}}")
                array = np.asarray((parameters or {})[spec.name], spec.dtype)
            else:
                value = special.get(spec.role)
                shape = tuple((rows or 1) if i == 0 else n or 1 for i, n in enumerate(spec.shape))
                fill = 1 if spec.role is Role.MASKS else 0
                array = np.full(shape, fill, spec.dtype) if value is None else self._fitting(spec, value, rows)
            feeds[spec.name] = array
        count = rows or 1
        for spec in self.signature.noise:
            shape = tuple(count if n is None else n for n in spec.shape)
            feeds[spec.name] = np.zeros(shape, np.float32) if deterministic else self._generator.normals(shape)
        return self._decision(self._run(feeds, [s.name for s in self.signature.outputs]), deterministic)

    def _named(self, observations: npt.ArrayLike | Mapping[str, npt.ArrayLike]) -> dict[str, npt.ArrayLike]:
        names = [s.name for s in self.signature.observations]
        if not isinstance(observations, Mapping):
            if len(names) != 1:
                raise UsageError(f"the policy has {len(names)} observations", fix=f"give a dict of {', '.join(names)}")
            return {names[0]: observations}
        for name in names:
            if name not in observations:
                raise UsageError(f"the observation {name!r} is missing", fix=f"there are {', '.join(names)}")
        for name in observations:
            if name not in names:
                raise UsageError(f"there is no observation {name!r}", fix=f"there are {', '.join(names)}")
        return dict(observations)

    def _fitting(self, spec: TensorSpec, value: npt.ArrayLike, rows: int | None) -> Array:
        try:
            array = np.asarray(value, spec.dtype)
        except (TypeError, ValueError) as error:
            raise UsageError(
                f"{spec.name!r} is no array of numbers", why=str(error), fix="give rows of one length"
            ) from error
        if array.ndim == len(spec.shape) - 1:
            array = array[None]
        same = array.ndim == len(spec.shape) and all(
            n in (None, m) for n, m in zip(spec.shape[1:], array.shape[1:], strict=True)
        )
        if not same or len(array) != (len(array) if rows is None else rows):
            wanted = ", ".join(["agents", *("any" if n is None else str(n) for n in spec.shape[1:])])
            raise UsageError(
                f"{spec.name!r} has the shape {list(np.shape(value))}",
                why=f"[{wanted}] is wanted" + ("" if rows is None else f" for {rows} agents"),
            )
        return np.ascontiguousarray(array)

    def _decision(self, outputs: dict[str, Array], deterministic: bool) -> Decision:
        continuous = discrete = None
        for head in self._heads:
            if head.role is Role.CONTINUOUS or (head.role is Role.DETERMINISTIC and head.dtype == "float32"):
                plain = self._plain.get(head.name) if deterministic else None
                continuous = outputs[(plain or head).name]
            else:
                discrete = self._discrete(head, outputs, deterministic)
        memory = self.signature.memory
        kept = None if memory is None or memory.output is None else outputs[memory.output]
        return Decision(continuous, discrete, kept, outputs)

    def _discrete(self, head: TensorSpec, outputs: Mapping[str, Array], deterministic: bool) -> Array:
        if head.role is Role.DETERMINISTIC:
            return outputs[head.name]
        if deterministic and head.name in self._plain:
            return outputs[self._plain[head.name].name]
        if head.role is Role.PROBS:
            with np.errstate(divide="ignore"):
                scores = np.log(outputs[head.name])
        elif self._scores is None:  # its sampler is all there is
            return outputs[head.name]
        else:
            scores = outputs[self._scores.name]
        branches = self.signature.branches or (scores.shape[1],)
        parts = np.split(scores, np.cumsum(branches)[:-1], axis=1)
        if deterministic:
            return np.stack([np.argmax(p, axis=1) for p in parts], axis=1).astype(np.int64)
        rows = [[self._generator.choice(p[row]) for p in parts] for row in range(len(scores))]
        return np.array(rows, np.int64)


class Agent:
    """Agents of one episode: their memory and previous actions go from step to step by themselves."""

    def __init__(self, policy: LoadedPolicy, *, deterministic: bool = False) -> None:
        self.policy, self.deterministic = policy, deterministic
        self._last: Decision | None = None

    def reset(self) -> None:
        """An episode begins."""
        self._last = None

    def decide(
        self,
        observations: npt.ArrayLike | Mapping[str, npt.ArrayLike],
        *,
        masks: npt.ArrayLike | None = None,
        parameters: Mapping[str, npt.ArrayLike] | None = None,
    ) -> Decision:
        """As LoadedPolicy.decide, with the memory of the last step."""
        last = self._last
        self._last = self.policy.decide(
            observations,
            masks=masks,
            memory=None if last is None else last.memory,
            previous=None if last is None else last.discrete,
            parameters=parameters,
            deterministic=self.deterministic,
        )
        return self._last


def load_policy(bundle: Path | str, *, runtime: str | None = None, seed: int = 0) -> LoadedPolicy:
    """The policy of a bundle, to be run in this process.

    ``runtime`` is ``onnxruntime`` (needs the bundle's ONNX and ``pip install 'export-model[onnxruntime]'``) or
    ``numpy`` (needs its ``.bytes`` and nothing else; slower); without it, the first that is there. Raises BundleError,
    RuntimeUnavailableError, UsageError.
    """
    from exporter.export.bundle import read_policy_json, signature_of

    folder = Path(bundle)
    content = read_policy_json(folder)
    name = content["name"]
    if runtime not in (None, *RUNTIMES):
        raise UsageError(f"runtime={runtime!r}", fix=f"one of: {', '.join(RUNTIMES)}")
    files = {"onnxruntime": folder / f"{name}.onnx", "numpy": folder / f"{name}.bytes"}
    here = [r for r in RUNTIMES if files[r].is_file() and (r == "numpy" or importlib.util.find_spec(r) is not None)]
    if runtime is not None and runtime not in here:
        if not files[runtime].is_file():
            raise BundleError(f"has no {files[runtime].name}", where=str(folder), fix="export the policy with it again")
        raise RuntimeUnavailableError("onnxruntime is not installed", fix="pip install 'export-model[onnxruntime]'")
    if not here:
        raise BundleError(
            "has nothing that can be run here",
            where=str(folder),
            why="onnxruntime runs its .onnx, numpy its .bytes",
            fix="export the policy with --to bytes,onnx",
        )
    chosen = runtime or here[0]
    signature, _ = signature_of(content)
    return LoadedPolicy(name, signature, _RUNS[chosen](files[chosen]), chosen, seed)


def _in_onnxruntime(file: Path) -> Run:
    import onnxruntime  # noqa: TID251  the caller asked for a policy that acts

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # a policy is small: threads cost more than they bring
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])

    def run(feeds: Mapping[str, Array], fetch: Sequence[str]) -> dict[str, Array]:
        return dict(zip(fetch, session.run(list(fetch), dict(feeds)), strict=True))

    return run


def _in_numpy(file: Path) -> Run:
    from converters.frozen_graph.reader import read_graph
    from converters.graph.compile import CONTRACT_NODE
    from converters.graph.nodes import Graph
    from converters.graph.passes.normalise import normalise
    from converters.graph.run import run_graph

    graph = read_graph(file.read_bytes())
    graph = normalise(Graph(tuple(n for n in graph.nodes if n.name != CONTRACT_NODE)))
    return lambda feeds, fetch: run_graph(graph, feeds, fetch)


_RUNS: Mapping[str, Callable[[Path], Run]] = {"onnxruntime": _in_onnxruntime, "numpy": _in_numpy}
