"""Which input and output of one policy is which of another's: by role, then name, then shape, then order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from msgspec import Struct

from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role
from export_model.signatures.spec import ActionHead, PolicySignature, TensorSpec

#: Roles that a draw decides the value of: they are alike only where both policies draw with the same noise.
_OF_A_DRAW = frozenset((Role.SAMPLED, Role.LOG_PROB))
#: Roles of actions as they are done, not scores that one is chosen by.
_PLAIN = frozenset((Role.CONTINUOUS, Role.DETERMINISTIC))
#: Roles of actions, which are paired by what they mean.
_ACTIONS = _PLAIN | {Role.SAMPLED}


class Pairing(Struct, frozen=True):
    """Two policies' tensors side by side: canonical names of the reference → of the candidate.

    - ``by_order``: roles of which several tensors have one shape and no name in common, so that their order paired
      them.
    - ``lacking``: inputs of the reference that the candidate does not take; ``surplus``: inputs that it takes beside.
    - ``joined``: vectors that are one on one side and several on the other: the names of each side, in order.
    - ``incomparable``: roles of outputs that the policies' chances keep apart.
    - ``apart``: which actions one side draws and the other does not; ``reshaped``: outputs of another rank, as
      sentences.
    """

    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    by_order: tuple[str, ...] = ()
    lacking: tuple[str, ...] = ()
    surplus: tuple[str, ...] = ()
    joined: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    incomparable: frozenset[Role] = frozenset()
    apart: tuple[str, ...] = ()
    reshaped: tuple[str, ...] = ()


def pair_policies(reference: Policy, candidate: Policy, names: Mapping[str, str] | None = None) -> Pairing:
    """Return which tensor of ``candidate`` is which of ``reference``; ``names`` go first, whatever their roles."""
    ours, theirs = reference.signature, candidate.signature
    inputs, by_order = _pair_specs(ours.inputs, theirs.inputs, names or {})
    outputs, apart = _pair_actions(reference, candidate)
    rest = [s for s in ours.outputs if s.name not in outputs and s.role not in _ACTIONS]
    left = [s for s in theirs.outputs if s.name not in outputs.values() and s.role not in _ACTIONS]
    others, ordered = _pair_specs(rest, left, names or {})
    joined = _join_vectors(
        [s for s in ours.inputs if s.name not in inputs], [s for s in theirs.inputs if s.name not in inputs.values()]
    )
    if apart:
        others = {n: o for n, o in others.items() if ours.output(n).role not in _OF_A_DRAW}
    return Pairing(
        inputs=inputs,
        outputs={**outputs, **others},
        by_order=tuple(dict.fromkeys([*by_order, *ordered])),
        lacking=tuple(s.name for s in ours.inputs if s.name not in inputs and s.name not in joined[0]),
        surplus=tuple(s.name for s in theirs.inputs if s.name not in inputs.values() and s.name not in joined[1]),
        joined=joined,
        incomparable=frozenset((*_OF_A_DRAW, Role.CONTINUOUS)) if apart else frozenset((Role.SAMPLED,)),
        apart=apart,
        reshaped=tuple(_shape_notes(ours, theirs, {**outputs, **others})),
    )


def draws(policy: Policy, head: ActionHead | None = None) -> bool:
    """Whether an action, the first unless one is given, hangs on noise, fed or made inside."""
    chance = [s.name for s in policy.signature.noise]
    chance += [n.name for n in policy.graph.nodes if n.op in SAMPLERS]
    return (head or policy.signature.heads[0]).name in policy.graph.descendants(chance)


def _pair_actions(reference: Policy, candidate: Policy) -> tuple[dict[str, str], tuple[str, ...]]:
    """Pair actions that mean the same: drawn ones with drawn ones, those without chance with those."""
    pairs: dict[str, str] = {}
    notes = []
    for head, other in _pair_heads(reference.signature.heads, candidate.signature.heads):
        ours, theirs = draws(reference, head), draws(candidate, other)
        plain, other_plain = _plain(head, ours), _plain(other, theirs)
        if plain is not None and other_plain is not None:
            pairs[plain.name] = other_plain.name
            if not ours and head.spec.role in _PLAIN:
                pairs[head.name] = other_plain.name
        if ours == theirs and head.spec.role is other.spec.role:
            pairs[head.name] = other.name
        elif ours != theirs:
            sides = ("the reference", "the candidate") if ours else ("the candidate", "the reference")
            notes.append(f"{sides[0]} draws {head.name} and {sides[1]} does not: compared without chance")
    return pairs, tuple(notes)


def _plain(head: ActionHead, drawn: bool) -> TensorSpec | None:
    """The action without chance; None where every output of the head is drawn or a score."""
    return head.plain or (head.spec if not drawn and head.spec.role in _PLAIN else None)


def _pair_heads(ours: Sequence[ActionHead], theirs: Sequence[ActionHead]) -> list[tuple[ActionHead, ActionHead]]:
    """Continuous actions with continuous ones, discrete with discrete."""
    pairs = []
    for head in ours:
        other = next((h for h in theirs if h.is_continuous == head.is_continuous), None)
        if other is not None:
            pairs.append((head, other))
    return pairs


def _pair_specs(
    ours: Sequence[TensorSpec], theirs: Sequence[TensorSpec], names: Mapping[str, str]
) -> tuple[dict[str, str], list[str]]:
    """Pair tensors that ``names`` pairs; of one role those of one name, then by shape, the others of a shape in order.

    Returns the pairs and the roles for which order alone decided.
    """
    pairs: dict[str, str] = {}
    by_order = []
    left = list(theirs)

    def pair(spec: TensorSpec, fitting: Sequence[TensorSpec]) -> None:
        if fitting and spec.name not in pairs:
            pairs[spec.name] = fitting[0].name
            left.remove(fitting[0])

    for spec in ours:
        other = next((names[n] for n in (spec.name, source_name(spec)) if n is not None and n in names), None)
        pair(spec, [o for o in left if other is not None and other in (o.name, source_name(o))])
    for spec in ours:
        pair(spec, [o for o in left if o.role is spec.role and _one_name(spec, o) and alike(spec, o)])
    for spec in ours:
        fitting = [o for o in left if o.role is spec.role and alike(spec, o)]
        if len(fitting) > 1 and spec.name not in pairs:
            by_order.append(str(spec.role))
        pair(spec, fitting)
    return pairs, by_order


def _shape_notes(ours: PolicySignature, theirs: PolicySignature, outputs: Mapping[str, str]) -> Iterator[str]:
    for spec, other in ((ours.output(name), theirs.output(own)) for name, own in outputs.items()):
        if axes_to(spec.shape, other.shape) is None and alike(spec, other):
            yield f"its {other.name} is {other.shape_text}, the reference's {spec.shape_text}: the same numbers"


def _join_vectors(ours: Sequence[TensorSpec], theirs: Sequence[TensorSpec]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Pair the vectors that one side has as one: ML-Agents' networks join them in order."""
    sides = [[s for s in side if s.role is Role.VECTOR and len(s.shape) == 2] for side in (ours, theirs)]
    widths = [[s.shape[1] for s in side] for side in sides]
    known = [[n for n in side if n is not None] for side in widths]
    if known != widths or 1 not in map(len, sides) or sum(known[0]) != sum(known[1]):
        return (), ()
    return tuple(s.name for s in sides[0]), tuple(s.name for s in sides[1])


def source_names(spec: TensorSpec) -> frozenset[str]:
    """Return what the source calls the tensors behind one, without the output index; empty where there is none."""
    sources = (spec.source,) if isinstance(spec.source, str) else (spec.source or ())
    return frozenset(name.removesuffix(":0").removeprefix("serving_default_") for name in sources)


def source_name(spec: TensorSpec) -> str | None:
    """Return what the source calls a tensor; None where it is none, or several, of the source."""
    return next(iter(source_names(spec))) if isinstance(spec.source, str) else None


def _one_name(spec: TensorSpec, other: TensorSpec) -> bool:
    return bool(source_names(spec)) and source_names(spec) == source_names(other)


def alike(spec: TensorSpec, other: TensorSpec) -> bool:
    """Whether two tensors can hold the same numbers: of one shape but for the batch, axes of 1, an image's layout."""
    return axes_to(spec.shape, other.shape) is not None or _numbers(spec.shape) == _numbers(other.shape)


def axes_to(shape: Sequence[int | None], other: Sequence[int | None]) -> tuple[int, ...] | None:
    """Return how the axes of a tensor of ``shape`` are ordered to have ``other``; None where no layout does.

    Beside the order that it has, an image may have its channels last or first.
    """
    if len(shape) != len(other):
        return None
    orders = [tuple(range(len(shape)))]
    if len(shape) == 4:
        orders += [(0, 3, 1, 2), (0, 2, 3, 1)]
    for order in orders:
        if all(a is None or b is None or a == b for a, b in zip([shape[i] for i in order[1:]], other[1:], strict=True)):
            return order
    return None


def _numbers(shape: Sequence[int | None]) -> tuple[int | None, ...]:
    return tuple(n for n in shape[1:] if n != 1)
