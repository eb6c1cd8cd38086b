"""Whether a policy whose weights were rounded still decides as it did.

Its formats are held against the rounded policy by numbers, as any policy's are; what rounding changed is no error of
theirs. It is judged by what an agent does: how many choices are other ones, and how far continuous actions move beside
how far they vary, on typical inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.files.children.process import RunFailedError
from export_model.exporter.verify.findings import Decisions, Finding, failure
from export_model.exporter.verify.participants import Feeds, PolicyUnderTest
from export_model.exporter.verify.reference import Reference
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.roles import Role
from export_model.signatures.sampling import Case, draw_typical
from export_model.signatures.spec import PolicySignature

#: The share of choices that may be other ones, and of its spread that a number may move (root mean square). Of 176
#: public and genuine policies four do not keep int8's (two of them by 8.8% and 11.2%), all keep float16's.
LIMITS: dict[Storage, float] = {"float16": 0.01, "int8": 0.05}
_CASES = 4
#: Below this share of its size a number counts as one that is always the same, which moves by no more than it.
_STILL = 1e-3


def decisions(
    whole: PolicyUnderTest,
    small: PolicyUnderTest,
    storage: Storage,
    session: Session,
) -> list[Finding]:
    """A finding for each action: ``small``, by the numpy kernels, beside ``whole``, by its source's runtime.

    Where both have the same graph (a bundle that is verified again), it is the source alone that says what was.
    """
    names = list(dict.fromkeys(_action_names(small.signature)))
    seed = session.options.seed
    pairs: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    try:
        with (
            Reference(whole, session.runtimes, session.pool, seed) as before,
            Reference(small, session.runtimes, session.pool, seed) as after,
        ):
            again = whole.reference == small.reference
            if again and before.original is None:
                return []
            ask = before.original.run if again and before.original is not None else partial(_one, before)
            steps = draw_typical(small.signature, seed=seed, count=_CASES)
            sides = (_play_steps(small.signature, steps, each) for each in (ask, partial(_one, after)))
            for asked, given in zip(*sides, strict=True):
                for name in names:
                    if name in asked and name in given:
                        pairs.setdefault(name, []).append((asked[name], given[name]))
            source = "the source" if before.original is not None else "the policy with all digits, in numpy"
    except RunFailedError as error:
        return [failure("weights", storage, error)]
    limit, found = LIMITS[storage], list[Finding]()
    for name, answers in pairs.items():
        was, made = (np.concatenate([answer[side] for answer in answers]) for side in (0, 1))
        off, said = compare_decisions(_choices(small.signature, name, was), _choices(small.signature, name, made))
        text = f"{said} {source}; {limit:.0%} is allowed"
        found.append(
            Decisions(
                format="weights",
                runtime=storage,
                output=name,
                max_abs_diff=off,
                max_rel_diff=off,
                tolerance=Tolerance(limit, 0.0),
                passed=off <= limit,
                worst_input=None,
                reason=text,
            )
        )
    return found


def _one(reference: Reference, feeds: Feeds) -> Mapping[str, np.ndarray]:
    return reference.answers([feeds])[0]


def _play_steps(
    signature: PolicySignature, steps: Sequence[Case], ask: Callable[[Feeds], Mapping[str, np.ndarray]]
) -> Iterator[Mapping[str, np.ndarray]]:
    """The answers to each step; a memory is empty before the first, and is fed back from then on."""
    memory = signature.memory
    fed, kept = (None, None) if memory is None else (memory.input, memory.output)
    carried: dict[str, np.ndarray] = {fed: np.zeros_like(steps[0].feeds[fed])} if fed else {}
    for step in steps:
        answers = ask({**step.feeds, **carried})
        yield answers
        if fed and kept is not None and kept in answers:
            carried = {fed: answers[kept]}


def compare_decisions(was: np.ndarray, made: np.ndarray) -> tuple[float, str]:
    """How much of what is decided is otherwise, and a sentence that ends before whose decisions those were."""
    finite = np.isfinite(was)
    if was.shape != made.shape or not (finite == np.isfinite(made)).all():
        return math.inf, "it is of another shape, or finite elsewhere, than that of"
    if was.dtype.kind != "f":
        other = int((was != made).sum())
        share = other / max(was.size, 1)
        return share, f"{other} of {was.size} choices ({share:.2%}) are other ones than those of"
    wide, moved = (np.where(finite, a, 0).astype(np.float64) for a in (was, made))
    size = np.sqrt(np.mean(wide**2, axis=0))
    varies = np.maximum(np.std(wide, axis=0), _STILL * size)
    moved = np.sqrt(np.mean((moved - wide) ** 2, axis=0))
    share = float(np.divide(moved, varies, out=np.where(moved > 0, np.inf, 0.0), where=varies > 0).max(initial=0.0))
    return share, f"it moved by {share:.2%} of its spread from that of"


def _action_names(signature: PolicySignature) -> Iterator[str]:
    """The actions, without chance where there is such an output."""
    for head in signature.heads:
        if head.plain is not None:
            yield head.plain.name
        elif head.spec.role is not Role.SAMPLED:
            yield head.name


def _choices(signature: PolicySignature, name: str, values: np.ndarray) -> np.ndarray:
    """What is decided: of scores the best of each branch."""
    if signature.output(name).role not in (Role.LOG_PROBS, Role.PROBS):
        return values
    sizes = signature.branches if sum(signature.branches) == values.shape[-1] else (values.shape[-1],)
    parts = np.split(values, np.cumsum(sizes)[:-1], axis=-1)
    return np.stack([part.argmax(axis=-1) for part in parts], axis=-1)
