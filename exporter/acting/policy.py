"""A policy that was loaded: what it decides, and an agent of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.exporter.acting.generator import Generator, likeliest
from export_model.signatures.batches import Run
from export_model.signatures.errors import BundleError, UsageError, suggestion
from export_model.signatures.ids import check_ids
from export_model.signatures.roles import OBSERVATIONS, Role
from export_model.signatures.spec import ActionHead, PolicySignature, TensorSpec

Array = np.ndarray


class Decision(Struct, frozen=True):
    """What the policy decided for each agent.

    ``continuous`` is float32 [agents, size], ``discrete`` int64 [agents, branches], None where the policy has no such
    actions; ``memory`` float32 [agents, size] is what to pass in at the next step, None where it has none. ``outputs``
    are all outputs by name; an output that is the action itself is the action that was taken, not another draw.
    """

    continuous: Array | None = None
    discrete: Array | None = None
    memory: Array | None = None
    outputs: Mapping[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = (("continuous", self.continuous), ("discrete", self.discrete), ("memory", self.memory))
        return f"<Decision: {', '.join(f'{n} {a.dtype} {list(a.shape)}' for n, a in parts if a is not None)}>"

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

    def __init__(
        self,
        name: str,
        signature: PolicySignature,
        run: Run,
        runtime: str,
        seed: int = 0,
        *,
        draws_itself: bool = False,
    ) -> None:
        """``draws_itself``: the noise is inside the file (``--noise keep``, ``--for``)."""
        self.name, self.signature, self.runtime = name, signature, runtime
        self.draws_itself = draws_itself
        #: runs the file itself: feeds by the names of the inputs, and the outputs that are wanted
        self.run = run
        self._generator = Generator(seed)
        self._scores = signature.log_probs
        # A mean beside its spread is drawn from here, unless the graph has drawn already.
        spread = next((s for s in signature.outputs if s.role in (Role.STD, Role.LOG_STD)), None)
        self._spread = None if signature.noise or draws_itself else spread

    def __repr__(self) -> str:
        return f"<LoadedPolicy {self.name!r} in {self.runtime}: {self.signature.flow}>"

    def _repr_html_(self) -> str:
        from export_model.exporter.inspect.inspection import port_tables
        from export_model.exporter.markup import notebook

        return notebook(f"{self.name}: a policy in {self.runtime}", *port_tables(self.signature))

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
        as its first axis, or no such axis for a single one (answers have it all the same). Images of dtype uint8 are
        brought to the range that the policy takes; others are taken as they are. ``masks`` [agents, ΣB]: 1 allows an
        action, 0 forbids it; all are allowed without it. ``memory`` is that of the last Decision, zero at the start of
        an episode. ``previous`` are the discrete actions of the last step [agents, branches], for a policy that asks
        for them. ``parameters`` are the source's own placeholders. ``deterministic`` takes the likeliest action and the
        mean; without it, a policy that gives its mean and σ (``action_std``, ``action_log_std``) is drawn from.
        ``seed`` starts the draws anew before this decision. Raises UsageError where something is missing, is of the
        wrong shape or is not taken, where an id is outside of its table, where masks forbid all actions of a branch,
        where nothing can be drawn, and where ``deterministic`` asks for what the file does not have.
        """
        if deterministic:
            self._check_plain()
        if seed is not None:
            self.seed(seed)
        given = self._by_name(observations)
        special = {Role.MASKS: masks, Role.MEMORY_IN: memory, Role.PREV_ACTION: previous}
        for word, role in (("masks", Role.MASKS), ("memory", Role.MEMORY_IN), ("previous", Role.PREV_ACTION)):
            if special[role] is not None and not self.takes(role):
                raise UsageError(f"the policy takes no {word}", why="it has no such input", fix=f"leave {word}= out")
        self._check_parameters(parameters or {})
        feeds: dict[str, Array] = {}
        rows: int | None = None
        for spec in self.signature.observations:
            array = self._fitting(spec, self._scale_bytes(spec, given.pop(spec.name)), rows)
            check_ids(spec, array)
            feeds[spec.name], rows = array, len(array)
        for spec in self.signature.inputs:
            if spec.role is Role.PARAMETER:
                feeds[spec.name] = np.asarray((parameters or {})[spec.name], spec.dtype)
            elif spec.role is not Role.NOISE and spec.role not in OBSERVATIONS:
                feeds[spec.name] = self._special(spec, special.get(spec.role), rows)
        for spec in self.signature.noise:
            shape = tuple((rows or 1) if n is None else n for n in spec.shape)
            feeds[spec.name] = np.zeros(shape, np.float32) if deterministic else self._generator.normals(shape)
        return self._decision(self.run(feeds, [s.name for s in self.signature.outputs]), deterministic)

    def _special(self, spec: TensorSpec, value: npt.ArrayLike | None, rows: int | None) -> Array:
        """Masks, memory or previous actions: what is given, else all allowed, and zeros."""
        if value is None:
            shape = tuple((rows or 1) if i == 0 else n or 1 for i, n in enumerate(spec.shape))
            return np.full(shape, 1 if spec.role is Role.MASKS else 0, spec.dtype)
        array = self._fitting(spec, value, rows)
        if spec.role is Role.MASKS:
            self._check_masks(array)
        return array

    def _check_plain(self) -> None:
        """Raise UsageError where an action is drawn inside the graph, and there is none without chance."""
        for head in self.signature.heads:
            sampled = head.spec.role is Role.SAMPLED and self._scores is None
            drawn = head.spec.role is Role.CONTINUOUS and self.draws_itself
            if head.plain is None and (sampled or drawn):
                raise UsageError(
                    f"{head.name!r} cannot be had without chance",
                    why="it is drawn inside the file, which gives neither its mean nor its log-probabilities",
                    fix="export the policy without --for, or leave deterministic= out",
                )

    def _by_name(self, observations: npt.ArrayLike | Mapping[str, npt.ArrayLike]) -> dict[str, npt.ArrayLike]:
        names = [s.name for s in self.signature.observations]
        known = ", ".join(names)
        if not isinstance(observations, Mapping):
            if len(names) != 1:
                raise UsageError(f"the policy has {len(names)} observations", fix=f"give a dict of {known}")
            return {names[0]: observations}
        for name in observations:
            if name not in names:
                raise UsageError(f"unknown observation {name!r}", fix=f"{suggestion(name, names)}there are {known}")
        for name in names:
            if name not in observations:
                raise UsageError(f"the observation {name!r} is missing", fix=f"there are {known}")
        return dict(observations)

    def _check_parameters(self, given: Mapping[str, npt.ArrayLike]) -> None:
        wanted = {s.name: s.shape for s in self.signature.inputs if s.role is Role.PARAMETER}
        for name in given:
            if name not in wanted:
                known = ", ".join(wanted) or "none"
                raise UsageError(f"unknown parameter {name!r}", fix=f"the policy's parameters: {known}")
        for name, shape in wanted.items():
            if name not in given:
                raise UsageError(f"the parameter {name!r} is missing", fix=f"parameters={{{name!r}: …}}")
            found = np.shape(given[name])
            if len(found) != len(shape) or any(n not in (None, m) for n, m in zip(shape, found, strict=True)):
                text = ", ".join("any" if n is None else str(n) for n in shape)
                raise UsageError(f"the parameter {name!r} has the shape {list(found)}", why=f"[{text}] is wanted")

    def needed_outputs(self, *, deterministic: bool) -> list[str]:
        """Return the outputs that a decision is made of: actions or what they are drawn from, and the memory."""
        scores = [] if self._scores is None else [self._scores.name]
        names: list[str] = []
        for head in self.signature.heads:
            if deterministic and head.plain is not None:
                names.append(head.plain.name)
            elif head.is_continuous or head.spec.role in (Role.DETERMINISTIC, Role.PROBS) or not scores:
                names.append(head.name)
            else:
                names += scores
        if self._spread is not None and not deterministic:
            names.append(self._spread.name)
        if self.signature.memory is not None and self.signature.memory.output is not None:
            names.append(self.signature.memory.output)
        return list(dict.fromkeys(names))

    def takes(self, role: Role) -> bool:
        """Whether an input has this role."""
        return any(s.role is role for s in self.signature.inputs)

    def _check_masks(self, masks: Array) -> None:
        start = 0
        for branch, size in enumerate(self.signature.branches):
            forbidden = np.flatnonzero(~(masks[:, start : start + size] > 0).any(axis=1))
            if len(forbidden):
                raise UsageError(
                    f"masks forbid every action of branch {branch} to agent {forbidden[0]}",
                    why="what the policy then does is an accident of the trainer's version",
                    fix="allow an action of every branch",
                )
            start += size

    def _scale_bytes(self, spec: TensorSpec, value: npt.ArrayLike) -> npt.ArrayLike:
        """Bytes of an image as the numbers that the policy takes; what is no image or no bytes, as it is."""
        wanted = self.signature.preprocess.get(spec.name, {}).get("range")
        if spec.role is not Role.VISUAL or wanted is None or getattr(value, "dtype", None) != np.uint8:
            return value
        low, high = wanted
        return np.asarray(value, np.float32) * np.float32((high - low) / 255) + np.float32(low)

    def _fitting(self, spec: TensorSpec, value: npt.ArrayLike, rows: int | None) -> Array:
        try:
            array = np.asarray(value, spec.dtype)
        except (TypeError, ValueError) as error:
            raise UsageError(
                f"{spec.name!r} must be an array of numbers", why=str(error), fix="give rows of one length"
            ) from error
        if array.ndim == len(spec.shape) - 1:
            array = array[None]
        if spec.role is Role.PREV_ACTION and len(spec.shape) == 1 and array.ndim == 2 and array.shape[1] == 1:
            array = array[:, 0]  # ML-Agents 0.3 and 0.4 feed it without an axis for the one branch
        if not spec.fits(array) or len(array) != (len(array) if rows is None else rows):
            wanted = ", ".join(["agents", *("any" if n is None else str(n) for n in spec.shape[1:])])
            raise UsageError(
                f"{spec.name!r} has the shape {list(np.shape(value))}",
                why=f"[{wanted}] is wanted" + ("" if rows is None else f" for {rows} agents"),
            )
        return np.ascontiguousarray(array)

    def _decision(self, outputs: dict[str, Array], deterministic: bool) -> Decision:
        continuous = discrete = None
        taken: dict[str, Array] = {}
        for head in self.signature.heads:
            if head.is_continuous:
                taken[head.name] = continuous = outputs[((deterministic and head.plain) or head.spec).name]
                if self._spread is not None and not deterministic:
                    taken[head.name] = continuous = self._draw(continuous, outputs[self._spread.name])
            else:
                discrete = self._discrete(head, outputs, deterministic)
                if head.spec.role is Role.SAMPLED:
                    taken[head.name] = discrete
                discrete = discrete.reshape(len(discrete), -1)  # other trainers give no axis for the one branch
        memory = self.signature.memory
        kept = None if memory is None or memory.output is None else outputs[memory.output]
        return Decision(continuous, discrete, kept, {**outputs, **taken})

    def _draw(self, mean: Array, spread: Array) -> Array:
        """A draw from N(mean, σ²), as the trainer's own distribution makes it: not squashed, not clipped."""
        assert self._spread is not None
        std = np.exp(spread) if self._spread.role is Role.LOG_STD else spread
        return np.asarray(mean + std * self._generator.normals(mean.shape), np.float32)

    def _discrete(self, head: ActionHead, outputs: Mapping[str, Array], deterministic: bool) -> Array:
        if head.spec.role is Role.DETERMINISTIC:
            return outputs[head.name]
        if deterministic and head.plain is not None:
            return outputs[head.plain.name]
        if head.spec.role is Role.PROBS:
            with np.errstate(divide="ignore"):
                scores = np.log(outputs[head.name].astype(np.float64))
        elif self._scores is None:  # its sampler is all there is
            return outputs[head.name]
        else:
            scores = outputs[self._scores.name]
        branches = head.branches or (scores.shape[1],)
        if sum(branches) != scores.shape[1]:
            raise BundleError(
                f"gives {scores.shape[1]} chances for branches of {list(branches)} actions",
                where=self.name,
                fix="export the policy again",
            )
        return likeliest(scores, branches) if deterministic else self._generator.choices(scores, branches)


class Agent:
    """Agents of one episode: their memory and previous actions go from step to step by themselves."""

    def __init__(self, policy: LoadedPolicy, *, deterministic: bool = False) -> None:
        self.policy, self.deterministic = policy, deterministic
        self._last: Decision | None = None

    def __repr__(self) -> str:
        return f"<Agent of {self.policy!r}, {'at the start' if self._last is None else f'last {self._last!r}'}>"

    def reset(self, agents: Sequence[int] | int | None = None) -> None:
        """An episode begins: for all, or for the agents with these numbers (their rows). Raises UsageError."""
        last = self._last
        if agents is None or last is None:
            self._last = None
            return
        rows = np.atleast_1d(np.asarray(agents, np.int64))
        count = next((len(a) for a in (last.continuous, last.discrete) if a is not None), 0)
        if ((rows < 0) | (rows >= count)).any():
            raise UsageError(f"unknown agent {agents}", fix=f"they are numbered 0 to {count - 1}")
        self._last = replace(last, memory=_clear_rows(last.memory, rows), discrete=_clear_rows(last.discrete, rows))

    def decide(
        self,
        observations: npt.ArrayLike | Mapping[str, npt.ArrayLike],
        *,
        masks: npt.ArrayLike | None = None,
        parameters: Mapping[str, npt.ArrayLike] | None = None,
        deterministic: bool | None = None,
    ) -> Decision:
        """As LoadedPolicy.decide, with the memory of the last step; ``deterministic`` for this step only."""
        last = self._last
        self._last = self.policy.decide(
            observations,
            masks=masks,
            memory=None if last is None or not self.policy.takes(Role.MEMORY_IN) else last.memory,
            previous=None if last is None or not self.policy.takes(Role.PREV_ACTION) else last.discrete,
            parameters=parameters,
            deterministic=self.deterministic if deterministic is None else deterministic,
        )
        return self._last


def _clear_rows(array: Array | None, rows: Array) -> Array | None:
    """A copy with these rows zero, as an episode begins."""
    if array is None:
        return None
    copy = array.copy()
    copy[rows] = 0
    return copy
