"""Causes tried on a recording: what the policy answers under each, judged step by step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.causes import Cause
from export_model.exporter.logs.judging import (
    BEYOND,
    NOISE_STEP,
    Clip,
    Likelihood,
    Target,
    flat_rows,
    likelihood,
    measured_spread,
    shares,
)
from export_model.exporter.logs.recording import NONE, Array, Arrays, Recording
from export_model.exporter.logs.replay import CHUNK_ELEMENTS, MemoryUse, Replay
from export_model.exporter.verify.tolerances import Tolerance

#: Inputs are moved by so much of their size, and by what text cut off, to see what rounding explains.
MOVED = 2.0**-21
#: How often, and how many times the largest result is allowed (exporter/verify/rounding.py).
MOVES, FACTOR = 2, 4
#: Noise beyond what any graph leaves unclipped.
FAR_NOISE = 1e6
#: Steps that clipping and the usual spread are measured at.
MEASURED_STEPS = 500

Chain = Sequence[Cause]


class Verdict(Struct, frozen=True):
    """What was found of a recording under some causes.

    ``shares``: by target, [steps, columns], of what is allowed; ``draws``: by target that was judged as drawn;
    ``answers``: the policy's, as they were compared.
    """

    shares: Mapping[str, Array]
    draws: Mapping[str, Likelihood]
    answers: Arrays

    @property
    def worst(self) -> Array:
        """The largest share of each step: float64 [steps]."""
        found: Array = np.max([s.max(axis=1, initial=0.0) for s in self.shares.values()], axis=0)
        return found

    @property
    def misfits(self) -> Array:
        """Bool [steps]: not what the policy answers."""
        return np.asarray(self.worst > 1)

    @property
    def costs(self) -> Array:
        """What is to become small, [steps]: the logarithm of the shares; of draws how unlikely they were."""
        found: Array = np.log1p(self.worst)
        for drawn in self.draws.values():
            found = found - drawn.found
        return found

    @property
    def fits(self) -> bool:
        """Whether every step is what the policy answers, and draws can be its own."""
        return not self.misfits.any() and all(d.fits for d in self.draws.values())


class Trials:
    """Tries causes. ``drawn``: actions are judged as draws; else as the action without chance."""

    def __init__(
        self, replay: Replay, recording: Recording, targets: Sequence[Target], tolerance: Tolerance, *, drawn: bool
    ) -> None:
        self.replay, self.recording, self.targets, self.tolerance = replay, recording, tuple(targets), tolerance
        self.drawn = drawn and any(t.drawable for t in targets)
        self._noise = [s.name for s in replay.signature.noise]
        self._clips = self._measured_clips() if self.drawn else {}

    @property
    def _noises(self) -> tuple[float, ...]:
        """The noise that is fed beside none, to measure the spread of what is drawn."""
        return (NOISE_STEP, -NOISE_STEP) if self.drawn and self._noise else ()

    def on(self, recording: Recording) -> Trials:
        """The same for other rows."""
        other = Trials(self.replay, recording, self.targets, self.tolerance, drawn=False)
        other.drawn, other._clips = self.drawn, self._clips
        return other

    def verdict(self, chain: Chain = ()) -> Verdict:
        """Of all steps under the causes of ``chain``, with what rounding explains."""
        (found,) = self.verdicts([chain], sure=True)
        return found

    def verdicts(self, chains: Sequence[Chain], *, sure: bool = False) -> Iterator[Verdict]:
        """One for each chain of causes; ``sure``: with what rounding explains, which takes twice more runs."""
        rows = self.recording.steps
        copies = 1 + (MOVES if sure else 0) + len(self._noises)
        widest = max(a[0].size for a in self.recording.inputs.values() if a.ndim and len(a) == rows)
        size = max(1, CHUNK_ELEMENTS // max(1, rows * copies * widest))
        assert len({_use(c) for c in chains}) <= 1, "chains that use the memory alike are run together"
        for first in range(0, len(chains), size):
            yield from self._some(chains[first : first + size], sure=sure)

    def _some(self, chains: Sequence[Chain], *, sure: bool) -> Iterator[Verdict]:
        variants: list[Arrays] = []
        for chain in chains:
            inputs = self._change_inputs(self.recording.inputs, chain)
            variants.append(inputs)
            if sure:
                variants += [self._change_inputs(self._move_inputs(number), chain) for number in range(MOVES)]
            variants += [{**inputs, **{n: np.full_like(inputs[n], step) for n in self._noise}} for step in self._noises]
        answers = self._answers(variants, _use(chains[0]))
        each = len(variants) // len(chains)
        for number, chain in enumerate(chains):
            found, *others = answers[number * each : (number + 1) * each]
            moved = others[:MOVES] if sure else []
            yield self._judge(chain, found, moved, others[len(moved) :])

    def _change_inputs(self, inputs: Arrays, chain: Chain) -> Arrays:
        for cause in chain:
            inputs = cause.change_inputs(inputs)
        return inputs

    def _move_inputs(self, number: int) -> Arrays:
        """The inputs, moved as far as text and float32 have rounded them."""
        rng = np.random.default_rng(number)
        found = dict(self.recording.inputs)
        for spec in self.replay.signature.observations:
            array = found.get(spec.name)
            if array is None or array.dtype.kind != "f":
                continue
            half = self.recording.rounding.get(spec.name, np.zeros(1))
            step = half.reshape(-1) + MOVED * np.abs(array.reshape(len(array), -1))
            moved = array.reshape(len(array), -1) + step * rng.choice([-1.0, 1.0], step.shape)
            found[spec.name] = moved.astype(array.dtype).reshape(array.shape)
        return found

    def _answers(self, variants: Sequence[Arrays], use: MemoryUse) -> list[dict[str, Array]]:
        """What the policy answers for each variant of the inputs, all run together."""
        rows, count = self.recording.steps, len(variants)
        batched = {s.name for s in self.replay.signature.inputs if s.batched}
        first = variants[0]
        stacked = {n: np.concatenate([v[n] for v in variants]) if n in batched else first[n] for n in first}
        offsets = np.repeat(np.arange(count) * rows, rows)
        links = [
            np.where(np.tile(link, count) == NONE, NONE, np.tile(link, count) + offsets)
            for link in (self.recording.before, self.recording.last)
        ]
        found = self.replay.answers(stacked, links[0], links[1], use)
        return [{n: a[i * rows : (i + 1) * rows] for n, a in found.items()} for i in range(count)]

    def _judge(
        self, chain: Chain, found: dict[str, Array], moved: Sequence[Arrays], noisy: Sequence[Arrays]
    ) -> Verdict:
        explained = {n: FACTOR * _largest_move(found[n], [m[n] for m in moved]) for n in found} if moved else {}
        by_target: dict[str, Array] = {}
        draws: dict[str, Likelihood] = {}
        for target in self.targets:
            logged = self.recording.outputs[target.name]
            own = self._change_answers(chain, target, found)
            # A cause that reads another step's answer can say nothing of the first.
            blank = _blank_rows(own, target) if chain else np.zeros(len(logged), bool)
            if self.drawn and target.drawable:
                other = [self._change_answers(chain, target, answers) for answers in noisy]
                odds = likelihood(target, logged, own, other, self._clips.get(target.name))
                draws[target.name] = odds.without(blank)
                by_target[target.name] = np.zeros((len(logged), 1))
                continue
            half = self.recording.rounding.get(target.name, np.zeros(1))
            wider = Tolerance(self.tolerance.atol + float(half.max()), self.tolerance.rtol)
            share = shares(target, logged, own, wider, explained)
            by_target[target.name] = np.where(blank[:, None], 0.0, share)
        return Verdict(by_target, draws, found)

    def _change_answers(self, chain: Chain, target: Target, found: Arrays) -> Arrays:
        """The answers that ``target`` is judged by, as the causes of ``chain`` change them."""
        names = [n for n in dict.fromkeys([*target.output_names, target.answer]) if n in found]
        for cause in chain:
            if cause.answers is not None and cause.output == target.name:
                changed = {n: cause.answers(flat_rows(found[n]).astype(np.float64), self.recording) for n in names}
                found = {**found, **changed}
        return found

    def _measured_clips(self) -> dict[str, Clip]:
        """By target, how the graph clips what it draws."""
        if not self._noise:
            return {}
        rows = self.recording.rows(np.arange(min(self.recording.steps, MEASURED_STEPS)))

        def answers(noise: float) -> Arrays:
            fed = {n: np.full_like(rows.inputs[n], noise) for n in self._noise}
            return self.replay.answers({**rows.inputs, **fed}, rows.before, rows.last)

        plain, *moved = [answers(noise) for noise in (0.0, NOISE_STEP, -NOISE_STEP)]
        far = [answers(-FAR_NOISE), answers(FAR_NOISE)]
        found = {}
        for target in self.targets:
            if target.noisy:
                bounds = np.stack(
                    [_end(flat_rows(a[target.answer]), sign) for a, sign in zip(far, (-1, 1), strict=True)]
                )
                found[target.name] = Clip(bounds, measured_spread(target, plain, moved, bounds))
        return found


def _end(answers: Array, sign: int) -> Array:
    """Where an action ends that was moved as far as noise can: the same value at all steps, else infinite."""
    spread = answers.max(axis=0) - answers.min(axis=0)
    clipped = (spread < 1e-6) & (np.abs(answers[0]) < FAR_NOISE / 100)
    return np.where(clipped, answers[0].astype(np.float64), sign * np.inf)


def _use(chain: Chain) -> MemoryUse:
    return next((c.use for c in chain if c.use is not MemoryUse.KEPT), MemoryUse.KEPT)


def _blank_rows(answers: Arrays, target: Target) -> Array:
    numbers: Array = flat_rows(answers[target.output_names[0]]).astype(np.float64)
    return np.asarray(np.isnan(numbers).all(axis=1))


def _largest_move(exact: Array, moved: Sequence[Array]) -> Array:
    """How far the largest element of each row moved: float64 [rows]."""
    if exact.dtype.kind != "f":
        return np.zeros(len(exact))
    with np.errstate(invalid="ignore"):  # between two infinities
        apart = [np.abs(flat_rows(m).astype(np.float64) - flat_rows(exact)) for m in moved]
    steps = [np.nan_to_num(each, nan=0.0, posinf=np.inf).max(axis=1, initial=0.0) for each in apart]
    found: Array = np.nan_to_num(np.max(steps, axis=0), nan=0.0, posinf=0.0)
    return found.clip(0.0, BEYOND)
