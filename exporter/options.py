"""How to read a source and how to write its policies, as the Python interface and the command line say it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec import Struct, field

from export_model.converters.compiler.options import CompileOptions, NoiseMode
from export_model.converters.formats import source
from export_model.exporter.export.labels import Labels
from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role, parse_role

_NOISE: Mapping[str, NoiseMode] = {"lift": "lift", "keep": "keep", "zero": "zero"}


class ReadOptions(Struct, frozen=True, kw_only=True):
    """How to read a source, where it does not say so itself."""

    #: A run's checkpoint (default: the newest).
    step: int | None = None
    #: Only this brain of a graph that holds several.
    brain: str | None = None
    #: Input name → what it is for; output name → what it means.
    inputs: Mapping[str, str | Role] = field(default_factory=dict)
    outputs: Mapping[str, str | Role] = field(default_factory=dict)
    #: Placeholder → its fixed value.
    values: Mapping[str, float] = field(default_factory=dict)
    #: Shapes of the sensors of a ``.pt``, in order, and the places of those that are goals.
    sensors: Sequence[Sequence[int]] = ()
    goals: Sequence[int] = ()
    #: Activation between the layers of a bare ``.pt``.
    activation: str | None = None
    #: Script that saved a bare ``.pt``, where the names of its layers fit several: ``ppo-pytorch-continuous``.
    script: str | None = None
    #: Known fault of an ONNX model's exporter that is mended: ``gru-reset``.
    repair: str | None = None
    #: File with the statistics that a model of Stable-Baselines3 was trained behind (default: the one next to it), or
    #: ``"none"`` to leave them out.
    normaliser: Path | str | None = None
    #: File that states the interface (default: those next to the source), or ``"none"`` to leave it out.
    interface: Path | str | None = None
    #: Let Keras or PyTorch load what is not plain data. It can run code.
    trust_source: bool = False

    def for_reader(self) -> source.ReadOptions:
        """Return what a format's reader needs of them."""
        sensors = tuple(tuple(shape) for shape in self.sensors)
        normaliser = None if self.normaliser is None else str(self.normaliser)
        interface = None if self.interface is None else str(self.interface)
        return source.ReadOptions(
            step=self.step,
            sensors=sensors,
            trust_source=self.trust_source,
            goals=tuple(self.goals),
            activation=self.activation,
            script=self.script,
            repair=self.repair,
            normaliser=normaliser,
            interface=interface,
        )


class WriteOptions(Struct, frozen=True, kw_only=True):
    """How to write a policy."""

    #: ``canonical`` tensor names (default), or the trainer's own: ``source``. A consumer has names of its own.
    names: str | None = None
    #: Noise drawn in the graph becomes an input (``lift``, the default), stays (``keep``) or is removed (``zero``).
    noise: str | None = None
    #: Make ``action`` the deterministic one.
    deterministic: bool = False
    #: ONNX opset (default: 15, or that of the consumer).
    opset: int | None = None
    #: ``float16`` stores weights in half the bytes, ``quantize="int8"`` in a quarter; computation stays in float32.
    dtype: str = "float32"
    quantize: str | None = None
    #: Write ONNX and LiteRT files for this many agents at a time (default: any number).
    batch: int | None = None
    #: Source code computes exp, log, tanh and others by its ``own`` functions, with the same bits everywhere.
    math: str = "library"
    #: Source code loads its weights from a ``file`` beside it, gives ``all`` outputs, tells of observations that lie
    #: farther than so many deviations from their mean in training.
    weights: str = "source"
    outputs: str = "actor"
    guard: float | None = None
    #: ``"actions"``: the graph computes what is stated of the action, its scale, offset and clip.
    bake: str | None = None
    #: Names of observations and actions: a file or a mapping.
    labels: Labels | None = None


def compile_options(read: ReadOptions, write: WriteOptions | None = None) -> CompileOptions:
    """Return what the compiler needs of both. Raises UsageError."""
    write = write or WriteOptions()
    if write.names not in (None, "canonical", "source"):
        raise UsageError(f"names={write.names!r}: must be canonical or source")
    if write.noise is not None and write.noise not in _NOISE:
        raise UsageError(f"noise={write.noise!r}: must be lift, keep or zero")
    return CompileOptions(
        names=write.names,
        noise=None if write.noise is None else _NOISE[write.noise],
        deterministic=write.deterministic,
        brain=read.brain,
        inputs=_roles(read.inputs, "--input"),
        outputs=_roles(read.outputs, "--output"),
        values=dict(read.values),
    )


def _roles(given: Mapping[str, str | Role], flag: str) -> dict[str, Role]:
    roles: dict[str, Role] = {}
    for name, role in given.items():
        parsed = role if isinstance(role, Role) else parse_role(role)
        if parsed is None:
            known = ", ".join(r.value for r in Role)
            raise UsageError(f"{flag} {name}={role}: unknown role", fix=f"the roles are {known}")
        roles[name] = parsed
    return roles
