"""What ML-Agents' player does with an imported model: the rows of ``players``, asked of one file and one agent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from msgspec import Struct

from export_model.converters.consumers.mlagents.memory import DRAWN_KEPT
from export_model.converters.consumers.mlagents.names import ACTION, CONTINUOUS, DETERMINISTIC, DISCRETE, RECURRENT_OUT
from export_model.converters.consumers.unity.findings import Thrown
from export_model.converters.consumers.unity.forms import fields
from export_model.converters.consumers.unity.layers import trips
from export_model.converters.consumers.unity.onnx_file import OnnxFile
from export_model.converters.consumers.unity.players import (
    ANY,
    FED,
    OBSERVATION,
    ONE_NUMBER,
    PLAYERS,
    UNKNOWN,
    PlayOutcome,
    ReleasePlayer,
    Row,
)
from export_model.converters.consumers.unity.rules import culture_key
from export_model.converters.consumers.unity.scene import Scene, ScenePort

#: Operators that compute nothing.
_MOVES = frozenset({"Cast", "Concat", "Flatten", "Identity", "Reshape", "Slice", "Squeeze", "Unsqueeze"})
_ABSENT = "mem_out_missing, cont_missing_drawn, disc_missing_drawn"


class PlayEvent(Struct, frozen=True):
    """One thing that comes of playing a model.

    ``exception`` is Unity's text where it throws, ``evidence`` the small models that it was measured with.
    """

    outcome: PlayOutcome
    message: str
    where: str
    fix: str
    exception: str = ""
    evidence: str = ""

    @property
    def fails(self) -> bool:
        """Whether the model cannot be played so."""
        return self.outcome is not PlayOutcome.WARNS

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "outcome": self.outcome.value,
            "message": self.message,
            "exception": self.exception or None,
            "where": self.where,
            "fix": self.fix,
            "evidence": self.evidence or None,
        }


def throws(outcome: PlayOutcome, thrown: Thrown) -> PlayEvent:
    """An exception that stands in the verdict already, as what comes of playing."""
    said = f"{thrown.exception}: {thrown.message}" if thrown.worded else thrown.exception
    return PlayEvent(outcome, thrown.message, thrown.where, thrown.fix, said)


def play(scene: Scene) -> tuple[PlayEvent, ...]:
    """What a player trips over, the worst first; nothing where it plays the model rightly."""
    player = PLAYERS[scene.consumer.name]
    found = [
        *_inputs(scene, player),
        *_absent(scene, player),
        *_outputs(scene, player),
        *_kinds(scene),
        *_kept_action(scene),
        *_layers(scene),
    ]
    order = list(PlayOutcome)
    return tuple(sorted(dict.fromkeys(found), key=lambda played: order.index(played.outcome)))


def _inputs(scene: Scene, player: ReleasePlayer) -> Iterator[PlayEvent]:
    known = {*scene.sensor_shapes, *FED, *scene.model.memories}
    for port in sorted(scene.inputs(), key=lambda p: culture_key(p.name)):
        if port.name not in known:
            yield PlayEvent(
                PlayOutcome.FIRST,
                f"no sensor of the agent and nothing in ML-Agents feeds {port.name}",
                f"input {port.name}",
                "give the agent its sensor, rename the input, or fix it with --set NAME=VALUE",
                UNKNOWN.format(name=port.name),
                "unknown_input, obs_extra, obs_v2_name",
            )
            continue
        groups = {port.name}
        groups |= {OBSERVATION} if port.sensor else set()
        groups |= set() if port.name in ONE_NUMBER else {ANY}
        yield from _matching_rows(player.inputs, groups, port, scene, "input")


def _outputs(scene: Scene, player: ReleasePlayer) -> Iterator[PlayEvent]:
    for port in scene.outputs():
        yield from _matching_rows(player.outputs, {port.name}, port, scene, "output")


def _matching_rows(
    rows: Sequence[Row], groups: set[str], port: ScenePort, scene: Scene, kind: str
) -> Iterator[PlayEvent]:
    for row in rows:
        if groups.intersection(row.of) and row.when(port, scene):
            words = fields(port, scene)
            yield PlayEvent(
                row.outcome,
                row.says.format_map(words),
                f"{kind} {port.name}",
                row.fix.format_map(words),
                row.exception.format_map(words),
                row.evidence,
            )


def _absent(scene: Scene, player: ReleasePlayer) -> Iterator[PlayEvent]:
    for name in scene.fetched:
        if name in scene.model.outputs or (name == RECURRENT_OUT and scene.model.memories):
            continue
        text = f"a player fetches the output {name}, which the file does not have"
        fix, evidence = f"name the output {name}; --for {scene.consumer.profile} does", _ABSENT
        if name == ACTION and {CONTINUOUS, DISCRETE}.intersection(scene.model.outputs):
            text += f": before ML-Agents 1.7 no player knows {CONTINUOUS} and {DISCRETE}"
            fix = "play it in ML-Agents 1.7 or later (--to nn without --for writes for 1.7 to 1.9)"
            evidence = "cases/hybrid_nn_ml-agents-1.0.8"
        yield PlayEvent(PlayOutcome.FIRST, text, f"output {name}", fix, player.absent.format(name=name), evidence)


def _layers(scene: Scene) -> Iterator[PlayEvent]:
    for row, layer in () if scene.nn is None else trips(scene.nn, scene.consumer.name):
        yield PlayEvent(
            row.outcome,
            row.says,
            f"layer {layer.name}",
            row.fix.format(profile=scene.consumer.profile),
            row.exception(layer, scene.nn) if scene.nn is not None else "",
            row.evidence,
        )


def _kinds(scene: Scene) -> Iterator[PlayEvent]:
    acts = [name for name in scene.fetched if name != RECURRENT_OUT]
    brain = scene.brain
    if not acts and (brain.continuous or brain.branches):
        yield PlayEvent(
            PlayOutcome.NOTHING,
            "no output with actions is fetched: no action comes out, and the agent keeps an empty one",
            "outputs",
            f"give the file the actions of this mode, and their shape's constant; --for {scene.consumer.profile} does",
            "",
            "cont_missing_det, disc_missing_det, no_continuous_action_output_shape",
        )
        return
    if ACTION in acts:
        return
    for kind, wanted in ((CONTINUOUS, brain.continuous > 0), (DISCRETE, bool(brain.branches))):
        if acts and wanted and not any(name.endswith(kind) for name in acts):
            yield PlayEvent(
                PlayOutcome.WRONG,
                f"no {kind} are fetched, and the agent has some: they stay 0 (read, not run)",
                f"output {kind}",
                f"give the file {kind} for this mode, or take them off the agent",
            )


def _kept_action(scene: Scene) -> Iterator[PlayEvent]:
    """A memory with the last action in it, where that is another than the one that is played."""
    if scene.file is None or RECURRENT_OUT not in scene.fetched:
        return
    kept = _parts(scene.file, RECURRENT_OUT)
    for kind in (CONTINUOUS, DISCRETE):
        plain = f"{DETERMINISTIC}{kind}"
        if plain in scene.fetched and kept & _parts(scene.file, kind) and not kept & _parts(scene.file, plain):
            yield PlayEvent(
                PlayOutcome.WARNS, DRAWN_KEPT, f"output {RECURRENT_OUT}", "leave it off, or export with --deterministic"
            )


def _parts(file: OnnxFile, name: str) -> set[str]:
    """What a value is put together from, itself included, as far as no number is computed; constants left out."""
    found, waiting = set[str](), [name]
    while waiting:
        value = waiting.pop()
        if value in found or not value or file.is_constant(value):
            continue
        found.add(value)
        node = file.producers.get(value)
        if node is not None and node.op_type in _MOVES:
            waiting.extend(node.input)
    return found
