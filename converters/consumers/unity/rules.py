"""The checks behind the Inspector's list, in ML-Agents' order and words: ``MODEL_CHECKS`` and what they call.

Releases 20, 22 and 23 make the same checks; what an imported model answers them (``model.CheckedModel``) differs. The
texts are Unity's, with its own spelling, since they are what a user has before him.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from export_model.converters.consumers.mlagents.names import (
    ACTION,
    CONTINUOUS,
    DETERMINISTIC,
    DISCRETE,
    EPSILON,
    MASKS,
    PREVIOUS,
    RECURRENT_IN,
    SEQUENCE,
    VECTOR,
    VISUAL,
)
from export_model.converters.consumers.unity.consumers import Checks, Consumer
from export_model.converters.consumers.unity.findings import Complaint, Severity, warning
from export_model.converters.consumers.unity.model import (
    FIRST_VERSION,
    LAST_VERSION,
    CheckedModel,
    InputView,
    action_output,
    truncate,
)
from export_model.converters.consumers.unity.settings import Brain, Sensor
from export_model.signatures.roles import (
    ACTION_SHAPE,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION_NUMBER,
)

_PACKAGE = "com.unity.ml-agents"
_ACTION_OUTPUTS = (ACTION, CONTINUOUS, DISCRETE, DETERMINISTIC + CONTINUOUS, DETERMINISTIC + DISCRETE)
#: Inputs that ML-Agents can feed without a sensor, and of which it looks at nothing.
_TOLERATED = frozenset({EPSILON, MASKS, SEQUENCE, RECURRENT_IN})

#: Signs in the order of the invariant culture.
_SIGNS = "_-,;:!?.'\"()[]{}@*/\\&#%`^+<=>|~$"

Findings = Iterator[Complaint]


def check(model: CheckedModel, brain: Brain, deterministic: bool, consumer: Consumer) -> list[Complaint]:
    """The list that the Inspector shows. Raises UnityThrows where the check itself ends in an exception."""
    return (
        [] if consumer.checks is None else list(_checks(model, brain, deterministic, consumer.profile, consumer.checks))
    )


def _checks(model: CheckedModel, brain: Brain, deterministic: bool, profile: str, known: Checks) -> Findings:
    missing = next(_missing_constants(model, deterministic, profile, known), None)
    if missing is not None:
        yield missing
        return
    if known is Checks.VERSION_2 and model.version != FIRST_VERSION:
        yield _another_version(model.version, profile)
        return
    refused = version_error(model, profile) if known is not Checks.VERSION_2 else None
    if refused is not None:
        yield refused
    if model.memory_size == -1:
        yield warning(
            f"Missing node in the model provided : {MEMORY_SIZE}",
            f"constant {MEMORY_SIZE}",
            "set it to 0, or to the length of recurrent_in",
        )
        return
    if model.version == FIRST_VERSION:
        yield from _inputs_of_version_2(model, brain, deterministic)
        yield from _shapes(model, brain, _testers_of_version_2(brain), spared="visual_observation")
    elif model.version == LAST_VERSION:
        yield from _inputs_of_version_3(model, brain, deterministic, profile)
        yield from _shapes(model, brain, {observation(i): _tester(sensor) for i, sensor in enumerate(brain.sensors)})
    yield from _actions(model, brain)


def version_error(model: CheckedModel, profile: str) -> Complaint | None:
    """The one finding that also stops a player: the version is not loaded, or its memory is not.

    Raises UnityThrows where the version or the memory's size is read and not there.
    """
    version = model.version
    text = None
    if version < FIRST_VERSION:
        text = (
            "Model was trained with a older version of the trainer than is supported. Either retrain with an newer "
            f"trainer, or use an older version of {_PACKAGE}.\n"
            f"Model version: {version} Minimum supported version: {FIRST_VERSION}"
        )
    elif version > LAST_VERSION:
        text = (
            "Model was trained with a newer version of the trainer than is supported. Either retrain with an older "
            f"trainer, or update to a newer version of {_PACKAGE}.\n"
            f"Model version: {version}  Maximum supported version: {LAST_VERSION}"
        )
    elif model.memory_size > 0 and version == FIRST_VERSION:
        text = (
            f"Models from {_PACKAGE} 1.x that use recurrent neural networks are not supported in newer versions. "
            f"Either retrain with an newer trainer, or use an older version of {_PACKAGE}.\n"
        )
    if text is None:
        return None
    fix = f"no retraining is needed: --for {profile} writes version {LAST_VERSION}, its memory included"
    return Complaint(Severity.ERROR, text, f"constant {VERSION_NUMBER}", fix)


# ------------------------------------------------------------------ what must be there before anything is looked at


def _another_version(version: int, profile: str) -> Complaint:
    """What ML-Agents 1.x says, which knows version 2 alone."""
    text = (
        "Model was trained with a newer version of the trainer than is supported. Either retrain with an older "
        f"trainer, or update to a newer version of {_PACKAGE}.\n"
        f"Model version: {version} Supported version: {FIRST_VERSION}"
    )
    if version < FIRST_VERSION:
        text = (
            f"Version of the trainer the model was trained with ({version}) is not compatible with the Brain's version "
            f"({FIRST_VERSION})."
        )
    return Complaint(
        Severity.ERROR, text, f"constant {VERSION_NUMBER}", f"no retraining is needed: use --for {profile}"
    )


def _missing_constants(model: CheckedModel, deterministic: bool, profile: str, known: Checks) -> Findings:
    """Each would end the check; the first does."""
    for name in (VERSION_NUMBER, MEMORY_SIZE):
        if model.constant(name) is None:
            yield warning(
                f'Required constant "{name}" was not found in the model file.',
                f"constant {name}",
                f"a constant output of that very name is needed; --for {profile} writes it",
            )
    listed = _ACTION_OUTPUTS if known is Checks.DETERMINISTIC else _ACTION_OUTPUTS[:3]
    if not any(model.has_output(name) for name in listed):
        yield warning(
            "The model does not contain any Action Output Node.",
            "outputs",
            f"name the actions {CONTINUOUS} or {DISCRETE}; --for {profile} does",
        )
    if not model.names_kinds:
        yield from _deprecated_constants(model, profile)
        return
    for name, kind, end in ((CONTINUOUS, "Continuous", ".."), (DISCRETE, "Discrete", ".")):
        if model.has_output(name):
            yield from _kind_of_action(model, name, kind, end, deterministic, profile)


def _deprecated_constants(model: CheckedModel, profile: str) -> Findings:
    said = {
        ACTION_SHAPE: "The model does not contain any Action Output Shape Node.",
        IS_CONTINUOUS: f'Required constant "{IS_CONTINUOUS}" was not found in the model file. '
        "This is only required for model that uses a deprecated model format.",
    }
    fix = f"name the actions {CONTINUOUS} or {DISCRETE}, with the shape's constant; --for {profile} does"
    yield from (warning(text, f"constant {name}", fix) for name, text in said.items() if model.constant(name) is None)


def _kind_of_action(model: CheckedModel, name: str, kind: str, end: str, deterministic: bool, profile: str) -> Findings:
    shape = CONTINUOUS_SHAPE if name == CONTINUOUS else DISCRETE_SHAPE
    if model.constant(shape) is None:
        yield warning(
            f"The model uses {kind.lower()} action but does not contain {kind} Action Output Shape Node.",
            f"constant {shape}",
            f"a constant output {shape} is needed; --for {profile} writes it",
        )
        return
    there = model.has_continuous(deterministic) if name == CONTINUOUS else model.has_discrete(deterministic)
    if not there:
        inference, variant = ("deterministic", "Deterministic") if deterministic else ("stochastic", "")
        wanted = action_output(name, deterministic)
        yield warning(
            f"The model uses {inference} inference but does not contain {variant} {kind} Action Output Tensor. "
            f"Uncheck `Deterministic inference` flag{end}",
            f"output {wanted}",
            f"{shape} must be above 0 and an output {wanted} there; --for {profile} writes both",
        )


# ------------------------------------------------------------------ inputs


def _inputs_of_version_3(model: CheckedModel, brain: Brain, deterministic: bool, profile: str) -> Findings:
    names = model.input_names
    for index, sensor in enumerate(brain.sensors):
        if observation(index) not in names:
            yield _noobservation(index, sensor)
    if model.memory_size > 0 and RECURRENT_IN not in names:
        yield _no_recurrent_input(f"name the memory's input {RECURRENT_IN}, or set {MEMORY_SIZE} to 0")
    if model.has_discrete(deterministic) and MASKS not in names:
        yield _no_masks(profile)


def _inputs_of_version_2(model: CheckedModel, brain: Brain, deterministic: bool) -> Findings:
    names = model.input_names
    if brain.vector_observation_size != 0 and VECTOR not in names:
        yield warning(
            "The model does not contain a Vector Observation Placeholder Input. "
            "You must set the Vector Observation Space Size to 0.",
            f"input {VECTOR}",
            f"name the observation {VECTOR}, as version 2 has it, or set Space Size to 0",
        )
    cameras = 0
    for index, sensor in enumerate(brain.sensors):
        if len(sensor.shape) == 3:
            if f"{VISUAL}{cameras}" not in names:
                yield warning(
                    "The model does not contain a Visual Observation Placeholder Input for sensor component "
                    f"{cameras} ({sensor.kind}).",
                    f"input {VISUAL}{cameras}",
                    "take the camera off the agent, or give the file that was trained with it",
                )
            cameras += 1
        if len(sensor.shape) == 2 and observation(index) not in names:
            yield _noobservation(index, sensor)
    expected = sum(i.name.startswith(VISUAL) for i in model.inputs)
    if expected > cameras:
        yield warning(
            f"The model expects {expected} visual inputs, but only found {cameras} visual sensors.",
            "sensors",
            "give the agent the cameras that it was trained with",
        )
    if model.memory_size > 0 and not all(any(n.endswith(end) for n in names) for end in ("_h", "_c")):
        yield _no_recurrent_input("a version 2 with memory is not loaded any more; version 3 is")
    if model.has_discrete(deterministic) and MASKS not in names:
        yield _no_masks("")


def _noobservation(index: int, sensor: Sensor) -> Complaint:
    return warning(
        f"The model does not contain an Observation Placeholder Input for sensor component {index} ({sensor.kind}).",
        f"input {observation(index)}",
        f"sensor {index} ({sensor.name}, {'x'.join(map(str, sensor.shape))}) is fed as {observation(index)}: "
        "name the input so, or take the sensor off the agent",
    )


def _no_recurrent_input(fix: str) -> Complaint:
    return warning("The model does not contain a Recurrent Input Node but has memory_size.", "inputs", fix)


def _no_masks(profile: str) -> Complaint:
    return warning(
        "The model does not contain an Action Mask but is using Discrete Control.",
        f"input {MASKS}",
        f"an input {MASKS} is needed for discrete actions"
        + (f"; --for {profile} adds one that is really applied" if profile else ""),
    )


# ------------------------------------------------------------------ shapes of inputs

Tester = Callable[[InputView], Complaint | None]


def _shapes(model: CheckedModel, brain: Brain, testers: dict[str, Tester], spared: str | None = None) -> Findings:
    """Every input by name, in alphabetical order: unknown ones are reported, the others compared."""
    testers[PREVIOUS] = lambda view: _previous_action(view, brain)
    for view in sorted(model.inputs, key=lambda i: culture_key(i.name)):
        if view.name in testers:
            found = testers[view.name](view)
            if found is not None:
                yield found
        elif view.name not in _TOLERATED and (spared is None or spared not in view.name):
            yield warning(
                f"Model contains an unexpected input named : {view.name}",
                f"input {view.name}",
                "nothing feeds it: give the agent its sensor, rename the input, or fix it with --set NAME=VALUE",
            )


def culture_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sorts as .NET's invariant culture does: signs, digits, letters; small letters before capital ones."""
    return [(1 + c.isalnum() + c.isalpha(), _SIGNS.find(c), c.lower()) for c in name], name.swapcase()


def _testers_of_version_2(brain: Brain) -> dict[str, Tester]:
    testers: dict[str, Tester] = {VECTOR: lambda view: _vector(view, brain)}
    cameras = [s for s in brain.sensors if len(s.shape) == 3]
    testers.update({f"{VISUAL}{i}": _tester(sensor) for i, sensor in enumerate(cameras)})
    testers.update({observation(i): _tester(s) for i, s in enumerate(brain.sensors) if len(s.shape) == 2})
    return testers


def _tester(sensor: Sensor) -> Tester:
    test = _camera if len(sensor.shape) == 3 else _row
    return lambda view: test(view, sensor)


def _row(view: InputView, sensor: Sensor) -> Complaint | None:
    """A vector, or a list of entities."""
    held = [view.channels, view.width]
    if list(sensor.shape) == held[: len(sensor.shape)]:
        return None
    if view.height > 1:
        held = [view.height, view.width, view.channels]
    elif len(sensor.shape) == 1 and view.width <= 1:
        held = [view.channels]
    return _mismatch("An Observation", list(sensor.shape), held, view, sensor)


def _camera(view: InputView, sensor: Sensor) -> Complaint | None:
    channels, height, width = sensor.shape
    if (channels, height, width) == (view.channels, view.height, view.width):
        return None
    held = [view.width, view.height, view.channels]
    return _mismatch("The visual Observation", [width, height, channels], held, view, sensor)


def _mismatch(what: str, sensed: list[int], held: list[int], view: InputView, sensor: Sensor) -> Complaint:
    return warning(
        f"{what} of the model does not match. Received TensorProxy of shape [?x{'x'.join(map(str, sensed))}] "
        f"but was expecting [?x{'x'.join(map(str, held))}] for the {sensor.name} Sensor.",
        f"input {view.name}",
        f"the sensor gives {'x'.join(map(str, sensor.shape))}: set it to what the file was trained with, put the "
        "sensors in that order, and see that pictures are NCHW",
    )


def _vector(view: InputView, brain: Brain) -> Complaint | None:
    sizes = [s.shape[0] for s in brain.sensors if len(s.shape) == 1]
    if sum(sizes) == view.last:
        return None
    listed = f"[{', '.join(map(str, sizes))}]" if sizes else "]"
    return warning(
        f"Vector Observation Size of the model does not match. Was expecting {view.last} but received: \n"
        f"Vector observations: {brain.vector_observation_size} x {brain.stacked}\n"
        f"Total [Observable] attributes: 0\nSensor sizes: {listed}.",
        f"input {view.name}",
        f"set Space Size times Stacked Vectors to {view.last}",
    )


def _previous_action(view: InputView, brain: Brain) -> Complaint | None:
    if len(brain.branches) == view.last:
        return None
    return warning(
        "Previous Action Size of the model does not match. "
        f"Received {len(brain.branches)} but was expecting {view.last}.",
        f"input {PREVIOUS}",
        f"give the agent {view.last} discrete branches",
    )


# ------------------------------------------------------------------ actions


def _actions(model: CheckedModel, brain: Brain) -> Findings:
    if brain.continuous != model.continuous_size:
        yield warning(
            "Continuous Action Size of the model does not match. The BrainParameters and ActuatorComponents expect "
            f"{brain.continuous} but the model contains {model.continuous_size}.",
            f"constant {CONTINUOUS_SHAPE}",
            f"set Continuous Actions to {model.continuous_size}",
        )
    if model.version == FIRST_VERSION and sum(brain.branches) != model.discrete_size:
        yield _branches(f"{sum(brain.branches)}", f"{model.discrete_size}", "the branch sizes together")
    elif model.version == LAST_VERSION:
        found = model.constant(DISCRETE_SHAPE)
        held = () if found is None else tuple(truncate(n) for n in found)
        if len(held) != len(brain.branches):
            yield _branches(f"{len(brain.branches)} branches", f"{len(held)}", f"Branch Sizes to {list(held)}, which")
        else:
            yield from _each_branch(brain.branches, held)


def _branches(expected: str, held: str, what: str) -> Complaint:
    return warning(
        f"Discrete Action Size of the model does not match. The BrainParameters expect {expected} "
        f"but the model contains {held}.",
        f"constant {DISCRETE_SHAPE}",
        f"set {what} to {held}" if "which" not in what else f"set {what.removesuffix(', which')}",
    )


def _each_branch(wanted: tuple[int, ...], held: tuple[int, ...]) -> Findings:
    """Only the first difference is told."""
    for index, (expected, size) in enumerate(zip(wanted, held, strict=True)):
        if expected != size:
            yield warning(
                f"The number of Discrete Actions of branch {index} does not match. "
                f"Was expecting {expected} but the model contains {size} ",
                f"constant {DISCRETE_SHAPE}",
                f"set Branch {index} Size to {size}",
            )
            return


def observation(index: int) -> str:
    """The name of a sensor's input in version 3."""
    return f"obs_{index}"
