"""What bounds a continuous action, a clip or tanh: its trainer knows, and the weights do not say it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.wire_format import WireError, message_fields
from export_model.converters.trainers.mlagents.state import LET_IT_EXPORT, State
from export_model.signatures.errors import SourceError

#: Tags of ModelProto.graph, GraphProto.node and NodeProto.op_type (onnx.proto).
_OP_TYPE = (0x3A, 0x0A, 0x22)


class Bound(Struct, frozen=True):
    """Whether tanh bounds the continuous action, what to note of it, and the file beside the checkpoint that told."""

    squashed: bool = False
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()


def find_bound(state: State, given: Fetched, module: str) -> Bound:
    """Return what bounds the continuous action that ``module`` draws, where there is one.

    SAC's deviation alone depends on the observation, and tanh bounds its action. Where the optimizers name another
    trainer or none is saved, the ``.onnx`` that ML-Agents writes with each checkpoint decides. Raises SourceError where
    there is none and they contradict each other.
    """
    if f"{module}.mu.weight" not in state:
        return Bound()
    trainer, conditional = trainer_of(state), f"{module}.log_sigma.weight" in state
    if trainer is not None and conditional == (trainer == "SAC"):
        return Bound(conditional)
    beside = given.path.with_suffix(".onnx")
    if beside != given.path and beside.is_file() and (ops := set(_op_types(given.bytes_of(beside)))):
        squashed = b"Tanh" in ops  # ML-Agents has tanh nowhere else: its activation is Swish
        bound = "tanh" if squashed else "a clip"
        return Bound(squashed, (f"{beside.name}, beside it, says that {bound} bounds its action",), (beside,))
    if trainer is not None:
        raise SourceError(
            "the checkpoint does not say what bounds its continuous action: a clip, or tanh",
            why=f"its optimizers ({', '.join(_optimizers(state))}) and its deviation are of different trainers; "
            "a plugin may have trained it",
            fix=LET_IT_EXPORT,
        )
    whose, bound = ("depends", "SAC's alone does: tanh") if conditional else ("does not depend", "PPO's: a clip")
    return Bound(conditional, (f"its deviation {whose} on the observation, as {bound} is taken to bound its action",))


def trainer_of(state: State) -> str | None:
    """Which trainer saved the checkpoint, by its optimizers' names; None where none is saved with it."""
    optimizers = _optimizers(state)
    if not optimizers:
        return None
    return "SAC" if "entropy_optimizer" in optimizers else "POCA" if "adam" in optimizers else "PPO"


def _optimizers(state: State) -> list[str]:
    return sorted({m.removeprefix("Optimizer").removeprefix(":") for m in state.modules if m.startswith("Optimizer")})


def _op_types(model: bytes, at: int = 0, end: int | None = None, path: tuple[int, ...] = _OP_TYPE) -> Iterator[bytes]:
    """The op of each node of an ONNX model's graph; none of what is not one."""
    end = len(model) if end is None else end
    try:
        for tag, _, start, stop in message_fields(model, at, end):
            if tag == path[0] and stop <= end:
                yield from _op_types(model, start, stop, path[1:]) if path[1:] else (model[start:stop],)
    except WireError:
        return
