"""The table of causes: what goes wrong between a policy and the agent that it acts for.

A cause is a change of what was logged into what the policy must have been given, or of what the policy answers into
what must have been logged. One that makes the steps fit is the explanation. Each row of ``CAUSES`` makes the changes of
one kind; the order is that in which two that explain as much are named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import combinations, pairwise

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.recording import NONE, Array, Arrays, Recording
from export_model.exporter.logs.replay import MemoryUse
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

#: Units that are mixed up: factor, and what it looks like.
UNITS: tuple[tuple[float, str], ...] = (
    (180 / np.pi, "degrees where the log has radians"),
    (np.pi / 180, "radians where the log has degrees"),
    (-1.0, "the other sign"),
    (255.0, "0 to 255 where the log has 0 to 1"),
    (1 / 255, "0 to 1 where the log has 0 to 255"),
    (1000.0, "thousandths of the log's unit"),
    (0.001, "thousands of the log's unit"),
    (100.0, "hundredths of the log's unit"),
    (0.01, "hundreds of the log's unit"),
    (3.6, "km/h where the log has m/s"),
    (1 / 3.6, "m/s where the log has km/h"),
    (2 * np.pi, "radians where the log has turns"),
    (1 / (2 * np.pi), "turns where the log has radians"),
    (9.80665, "m/s² where the log has multiples of g"),
    (1 / 9.80665, "multiples of g where the log has m/s²"),
)
#: Bounds that robots' code clips observations to.
CLIPS = (1.0, 3.0, 5.0, 10.0, 18.0, 100.0)
#: What ML-Agents, rl_games and skrl clip what they normalised to.
NORMALISED_CLIP = 5.0
#: Columns of a drawn action whose pairs are tried.
MOST_DRAWN_ACTIONS = 24
#: Steps that it takes to tell a scale of an action.
FEWEST = 8
#: Pairs of columns that are tried as swapped; of more, only neighbours.
MOST_PAIRS, NEIGHBOURS = 20_000, 8

#: Changes the inputs, [steps, …] each; must not change them in place.
InputChange = Callable[[Arrays], dict[str, Array]]
#: Changes answers that were computed for the steps of a recording, [steps, columns], into what must have been logged;
#: NaN where nothing can be said.
AnswerChange = Callable[[Array, Recording], Array]


class Cause(Struct, frozen=True):
    """One explanation. ``kind`` is its row of the table, ``where`` the tensor or column, ``says`` the sentence."""

    kind: str
    where: str
    says: str
    inputs: InputChange | None = None
    use: MemoryUse = MemoryUse.KEPT
    #: the logged output that ``answers`` is about
    output: str | None = None
    answers: AnswerChange | None = None

    def change_inputs(self, inputs: Arrays) -> Arrays:
        """The inputs as the policy must have been given them."""
        return inputs if self.inputs is None else self.inputs(inputs)

    def to_dict(self) -> dict[str, str]:
        """For JSON."""
        return {"kind": self.kind, "where": self.where, "says": self.says}


Maker = Callable[[PolicySignature, Recording], Iterator[Cause]]


def column_name(signature: PolicySignature, name: str, column: int) -> str:
    """``vector_observation[3]``, with the text that people gave to it."""
    texts = signature.labels.get("observations", {}).get(name) if signature.labels else None
    return f"{name}[{column}]" + (f" ({texts[column]})" if texts else "")


def vectors(signature: PolicySignature, recording: Recording) -> list[tuple[TensorSpec, Array]]:
    """The observations that are rows of floats, with what was logged of them."""
    return [
        (s, recording.inputs[s.name])
        for s in signature.observations
        if s.name in recording.inputs and len(s.shape) == 2 and s.dtype.startswith("float")
    ]


def images(signature: PolicySignature, recording: Recording) -> list[tuple[TensorSpec, Array]]:
    """The observations that are images, [steps, height, width, channels]."""
    found = [s for s in signature.observations if s.role is Role.VISUAL and s.name in recording.inputs]
    return [(s, recording.inputs[s.name]) for s in found if len(s.shape) == 4]


def on(name: str, change: Callable[[Array], Array]) -> InputChange:
    """Change the input ``name`` alone."""
    return lambda inputs: {**inputs, name: np.asarray(change(inputs[name]), inputs[name].dtype)}


def scale_column(name: str, column: int, factor: float, offset: float = 0.0) -> InputChange:
    """Multiply a column, then add to it."""

    def change(array: Array) -> Array:
        copy = array.copy()
        copy[:, column] = copy[:, column] * array.dtype.type(factor) + array.dtype.type(offset)
        return copy

    return on(name, change)


def reorder(name: str, order: Array) -> InputChange:
    """Take the columns in another order."""
    return on(name, lambda array: array[:, order])


def _memory(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    pair = signature.recurrence
    if pair is None or pair[0] in recording.logged:
        return
    says = {
        MemoryUse.NOT_RESET: "the memory was not reset when an episode began",
        MemoryUse.LATE: "the memory was fed back one step late",
        MemoryUse.DROPPED: "the memory was not fed back: it was zero at every step",
    }
    for use, sentence in says.items():
        yield Cause("memory", pair[0], sentence, use=use)


def _previous(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec in signature.inputs:
        if spec.role is Role.PREV_ACTION and recording.inputs[spec.name].any():
            says = "the policy was not given the action of the step before: it was zero at every step"
            yield Cause("previous_action", spec.name, says, on(spec.name, np.zeros_like))


def _masks(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec in signature.inputs:
        if spec.role is Role.MASKS and spec.name in recording.logged:
            yield from _inverse_mask(spec.name, signature, recording)
            if (recording.inputs[spec.name] < 1).any():
                yield Cause("mask", spec.name, "the mask was not applied", on(spec.name, np.ones_like))


def _inverse_mask(name: str, signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    """The mask the other way round, which says nothing of the steps that it would leave no action."""

    def leave_actions(masks: Array) -> Array:
        edges = np.cumsum((0, *signature.branches)).tolist()
        return np.asarray(np.all([(masks[:, a:b] < 1).any(axis=1) for a, b in pairwise(edges)], axis=0))

    if leave_actions(recording.inputs[name]).sum() < FEWEST:
        return
    heads = [head.name for head in signature.heads if not head.is_continuous and head.name in recording.outputs]
    change = on(name, lambda a: np.where(leave_actions(a)[:, None], 1 - a, a))
    for head in heads[:1]:
        yield Cause(
            "mask",
            name,
            "the mask was inverted",
            change,
            output=head,
            answers=lambda a, r: np.where(leave_actions(r.inputs[name])[:, None], a, np.nan),
        )


def _normaliser(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec, logged in vectors(signature, recording):
        given = spec.distribution or {}
        if given.get("kind") != "normal":
            continue
        mean, std = (np.broadcast_to(np.asarray(given[k], logged.dtype), logged.shape[1:]) for k in ("mean", "std"))

        twice = "the policy was given values that were normalised already: the normaliser was applied twice"
        bound = float(given.get("clip", NORMALISED_CLIP))
        yield Cause("normaliser", spec.name, twice, on(spec.name, _normalise(mean, std, bound)))
        missing = "the log has normalised values, or the normaliser was left out: the policy takes raw ones"
        yield Cause("normaliser", spec.name, missing, on(spec.name, _raw(mean, std)))


def _normalise(mean: Array, std: Array, bound: float) -> Callable[[Array], Array]:
    return lambda array: ((array - mean) / std).clip(-bound, bound)


def _raw(mean: Array, std: Array) -> Callable[[Array], Array]:
    return lambda array: array * std + mean


def _stated_scales(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    """Scales that the interface states, applied twice or not at all."""
    interface = signature.interface
    for spec, logged in vectors(signature, recording) if interface is not None else ():
        terms = interface.observations.get(spec.name, ()) if interface is not None else ()
        widths = [term.width for term in terms]
        if None in widths or sum(w or 0 for w in widths) != logged.shape[1]:
            continue
        first, stated = 0, []
        for term, width in zip(terms, widths, strict=True):
            last = first + (width or 0)
            scale = np.resize(np.asarray(term.scale or (1.0,), logged.dtype), last - first)
            if (scale != 1).any() and scale.all():
                stated.append((f"the scale of {term.name} ({term.source}) was", first, last, scale))
            first = last
        if len(stated) > 1:
            every = np.ones(logged.shape[1], logged.dtype)
            for _, a, b, scale in stated:
                every[a:b] = scale
            stated.insert(0, (f"the scales of {len(stated)} terms were", 0, len(every), every))
        for says, a, b, scale in stated:
            where = f"{spec.name}[{a}…{b - 1}]"
            twice, missing = (on(spec.name, _scale_columns(a, b, factors)) for factors in (scale, 1 / scale))
            yield Cause("stated_scale", where, f"{says} applied twice", twice)
            yield Cause("stated_scale", where, f"{says} not applied", missing)


def _scale_columns(first: int, last: int, factors: Array) -> Callable[[Array], Array]:
    def change(array: Array) -> Array:
        copy = array.copy()
        copy[:, first:last] *= factors
        return copy

    return change


def _times(factor: float) -> Callable[[Array], Array]:
    return lambda array: array * array.dtype.type(factor)


def _within(bound: float) -> Callable[[Array], Array]:
    return lambda array: array.clip(-bound, bound)


def _units(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec, logged in vectors(signature, recording):
        for factor, looks in UNITS:
            says = f"the policy was given {factor:.6g} × what was logged: {looks}"
            if logged.shape[1] > 1:
                yield Cause("unit", spec.name, says, on(spec.name, _times(factor)))
            for column in range(logged.shape[1]):
                where = column_name(signature, spec.name, column)
                yield Cause("unit", where, says, scale_column(spec.name, column, factor))


def _swaps(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec, logged in vectors(signature, recording):
        size = logged.shape[1]
        few = size * (size - 1) // 2 <= MOST_PAIRS
        for i, j in combinations(range(size), 2):
            if few or j - i <= NEIGHBOURS:
                order = np.arange(size)
                order[[i, j]] = j, i
                where = f"{column_name(signature, spec.name, i)}, {column_name(signature, spec.name, j)}"
                yield Cause("swap", where, "the two columns are swapped", reorder(spec.name, order))
    for a, b in combinations(signature.observations, 2):
        if a.shape == b.shape and a.dtype == b.dtype and {a.name, b.name} <= recording.inputs.keys():
            yield Cause("swap", f"{a.name}, {b.name}", "the two observations are swapped", _exchange(a.name, b.name))


def _exchange(a: str, b: str) -> InputChange:
    return lambda inputs: {**inputs, a: inputs[b], b: inputs[a]}


def _orders(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    """Axes and quaternions in another order; stacked frames the other way round."""
    for spec, logged in vectors(signature, recording):
        size = logged.shape[1]
        for width in (3, 4):
            for first in range(size - width + 1):
                for turn in range(1, width):
                    order = np.arange(size)
                    order[first : first + width] = np.roll(order[first : first + width], turn)
                    where = f"{spec.name}[{first}…{first + width - 1}]"
                    said = "a quaternion's w first, not last, or the reverse" if width == 4 else "axes in another order"
                    yield Cause("order", where, f"the columns are in another order: {said}", reorder(spec.name, order))
        for frames in range(2, min(size, 16) + 1):
            if size % frames or size == frames:
                continue
            grid = np.arange(size).reshape(frames, -1)
            says = f"{frames} stacked frames are the other way round: the oldest first, not last, or the reverse"
            yield Cause("order", spec.name, says, reorder(spec.name, grid[::-1].reshape(-1)))
            says = f"{frames} stacked frames are laid out value by value, not frame by frame, or the reverse"
            yield Cause("order", spec.name, says, reorder(spec.name, grid.T.reshape(-1)))


def _clips(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec, logged in vectors(signature, recording):
        for bound in CLIPS:
            if np.abs(logged).max(initial=0) > bound:
                says = f"what the policy was given was clipped to ±{bound:g}"
                yield Cause("clip", spec.name, says, on(spec.name, _within(bound)))


def _images(signature: PolicySignature, recording: Recording) -> Iterator[Cause]:
    for spec, logged in images(signature, recording):
        flips: Mapping[str, Callable[[Array], Array]] = {
            "the image's rows are the other way round (upside down)": lambda a: a[:, ::-1],
            "the image's columns are the other way round (mirrored)": lambda a: a[:, :, ::-1],
            "the image is turned by 180°": lambda a: a[:, ::-1, ::-1],
            "the image is 255 times brighter than what was logged": lambda a: a * 255,
            "the image is 255 times darker than what was logged": lambda a: a / 255,
            "the image is of −1 to 1 where the log has 0 to 1": lambda a: a * 2 - 1,
            "the image is inverted": lambda a: 1 - a,
        }
        for says, change in flips.items():
            yield Cause("image", spec.name, says, on(spec.name, change))
        if logged.shape[1] == logged.shape[2]:
            says = "the image's rows and columns are exchanged"
            yield Cause("image", spec.name, says, on(spec.name, lambda a: a.swapaxes(1, 2)))
        if logged.shape[3] > 1:
            says = "the image's channels are the other way round (BGR for RGB)"
            yield Cause("image", spec.name, says, on(spec.name, lambda a: a[..., ::-1]))


#: kind → what makes its changes, in the order in which they are tried and named.
CAUSES: Mapping[str, Maker] = {
    "memory": _memory,
    "previous_action": _previous,
    "mask": _masks,
    "image": _images,
    "normaliser": _normaliser,
    "stated_scale": _stated_scales,
    "clip": _clips,
    "unit": _units,
    "swap": _swaps,
    "order": _orders,
}


def input_causes(signature: PolicySignature, recording: Recording) -> list[Cause]:
    """All changes of the inputs, and of how the memory is kept, that ``recording`` may be explained by."""
    return [cause for make in CAUSES.values() for cause in make(signature, recording)]


def lag_causes(name: str) -> Iterator[Cause]:
    """An action, a number or a choice, that belongs to another step."""
    says = "each action is the one that was decided a step before"
    yield Cause("lag", name, says, output=name, answers=lambda a, r: _of(r.before, a))
    says = "each action is the one that belongs to the next step's observation"
    yield Cause("lag", name, says, output=name, answers=lambda a, r: _of(r.after, a))


def drawn_action_causes(name: str, logged: Array, mean: Array) -> list[Cause]:
    """Changes of an action of numbers that was drawn around ``mean``, both [steps, columns]: swapped, moved columns."""
    size = logged.shape[1]
    found = []
    for i, j in combinations(range(min(size, MOST_DRAWN_ACTIONS)), 2):
        order = np.arange(size)
        order[[i, j]] = j, i
        says = "the two actions are swapped"
        where = f"{name}[{i}], {name}[{j}]"
        found.append(Cause("swap", where, says, output=name, answers=lambda a, r, o=order: a[:, o]))  # type: ignore[misc]
    apart = np.median(logged - mean, axis=0)
    text = ", ".join(f"{number:+.2g}" for number in apart[:6])
    says = f"about {text} was added to what the policy drew (a default pose that was added, or left out)"
    found.append(Cause("action_offset", name, says, output=name, answers=lambda a, r: a + apart))
    return found


def action_causes(name: str, logged: Array, computed: Array) -> list[Cause]:
    """Changes of an action of numbers, [steps, columns], read off the log: swapped, scaled, moved, clipped columns."""
    if len(logged) < FEWEST:
        return []
    changes = (_scaled_action, _clipped_action, _squashed_action)
    return [cause for change in changes for cause in change(name, logged, computed)]


def _of(rows: Array, computed: Array) -> Array:
    """The answers of other rows; NaN where there is no such row."""
    return np.where((rows == NONE)[:, None], np.nan, computed[rows])


def _scaled_action(name: str, logged: Array, computed: Array) -> Iterator[Cause]:
    """Each logged column as a multiple of one that was computed, plus a constant: the pair that fits best."""
    size = logged.shape[1]
    source, factor, offset = np.arange(size), np.ones(size), np.zeros(size)
    for column in range(size):
        best = np.inf
        for other in [column, *(c for c in range(size) if c != column)]:
            x, y = computed[:, other].astype(np.float64), logged[:, column].astype(np.float64)
            spread = x.var()
            a = float(((x - x.mean()) * (y - y.mean())).mean() / spread) if spread > 1e-12 else 1.0
            b = float(y.mean() - a * x.mean())
            left = float(np.abs(y - a * x - b).max())
            if left < best * 0.1:
                best, source[column], factor[column], offset[column] = left, other, a, b
    factor = np.where(np.abs(factor - 1) < 1e-4, 1.0, factor)
    offset = np.where(np.abs(offset) < 1e-4, 0.0, offset)
    parts, places = [], []
    for column in range(size):
        text = [f"{factor[column]:.4g} ×"] if factor[column] != 1 else []
        text += [f"the policy's {name}[{source[column]}]"] if text or source[column] != column or offset[column] else []
        text += [f"{'+' if offset[column] > 0 else '−'} {abs(offset[column]):.4g}"] if offset[column] else []
        if text:
            places.append(f"{name}[{column}]")
            parts.append(f"{name}[{column}] is {' '.join(text)}")
    if not parts:
        return
    swapped = bool((source != np.arange(size)).any())
    kind = "swap" if swapped else "action_scale" if (factor != 1).any() else "action_offset"
    more = f" and {len(parts) - 3} more" if len(parts) > 3 else ""
    says = f"what was logged is not the policy's action as it is: {', '.join(parts[:3])}{more}"
    if kind == "action_offset":
        says += " (a default pose that was added, or left out)"
    yield Cause(
        kind, ", ".join(places), says, output=name, answers=lambda a, r: a[:, source] * factor + offset
    )  # fmt: skip


def _clipped_action(name: str, logged: Array, computed: Array) -> Iterator[Cause]:
    low, high = logged.min(axis=0).astype(np.float64), logged.max(axis=0).astype(np.float64)
    beyond = (computed.min(axis=0) < low - 1e-4) | (computed.max(axis=0) > high + 1e-4)
    if beyond.any():
        bound = max(abs(float(low[beyond].min())), abs(float(high[beyond].max())))
        says = f"the action was clipped to ±{bound:.4g} before it was logged"
        yield Cause("clip", name, says, output=name, answers=lambda a, r: np.clip(a, low, high))


def _squashed_action(name: str, logged: Array, computed: Array) -> Iterator[Cause]:
    """An action that went through tanh on one side only."""
    if np.abs(logged).max() <= 1:
        says = "what was logged is the tanh of the policy's action"
        yield Cause("squash", name, says, output=name, answers=lambda a, r: np.tanh(a))
    if np.abs(computed).max() < 1:
        says = "the policy's action is the tanh of what was logged"
        yield Cause("squash", name, says, output=name, answers=lambda a, r: np.arctanh(np.clip(a, -1, 1)))
