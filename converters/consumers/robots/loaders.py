"""The rules of loaders: what a program outside Unity asks of a file, each with the line that shows it.

Evidence is a file of the project's public repository at a commit. The files were read, not run here; what they do with
a session is done with onnxruntime in tests/robots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from msgspec import Struct

from export_model.converters.consumers.robots.byte_array import SOURCE
from export_model.converters.consumers.robots.interface import FileInterface, interface_of, interface_of_litert
from export_model.converters.formats.registry import LITERT, ONNX
from export_model.signatures.errors import ProfileError

_RNN = "leggedrobotics/rsl_rl@14d428d7 rsl_rl/models/rnn_model.py"
_EXPORTER = "isaac-sim/IsaacLab@046b71b8 source/isaaclab_rl/isaaclab_rl/rsl_rl/exporter.py"
_RUNNER = "Unitree Robotics' OrtRunner (isaaclab::Algorithms, algorithms.h, 2025)"
_INFERENCE = "edbeeching/godot_rl_agents_plugin@1041a3ab addons/godot_rl_agents/onnx/csharp/ONNXInference.cs"
_INITIALIZE = "edbeeching/godot_rl_agents_plugin, ONNXInference.cs of plugin 0.7 and later"
_PROJECT = "edbeeching/godot_rl_agents_plugin@5b09dc90 Godot RL Agents.csproj (onnxruntime 1.15.1)"

_PX4 = "PX4/PX4-Autopilot@01486656 src/modules/mc_nn_control/mc_nn_control.cpp"
_PX4_CHECKS = "PX4/PX4-Autopilot@18eccd7a src/modules/mc_nn_control/nn_control_checks.hpp"

OBS, ACTIONS = "obs", "actions"
#: How many numbers PX4 feeds and takes, and what it registers of LiteRT's operators.
PX4_OBSERVED, PX4_MOTORS = 15, 4
PX4_OPERATORS = frozenset(("FULLY_CONNECTED", "RELU", "ADD"))
_SCHEMA = 3
HIDDEN, CELL = ("h_in", "h_out"), ("c_in", "c_out")
STATE, OUTPUT = ("state_ins", "state_outs"), "output"
#: How many inputs and outputs of Isaac Lab's files have which names.
_ISAAC_INPUTS = {1: [OBS], 2: [OBS, HIDDEN[0]], 3: [OBS, HIDDEN[0], CELL[0]]}
_ISAAC_OUTPUTS = {1: [ACTIONS], 2: [ACTIONS, HIDDEN[1]], 3: [ACTIONS, HIDDEN[1], CELL[1]]}


class LoaderRule(Struct, frozen=True):
    """``says`` is what the loader asks, ``holds`` whether a file meets it."""

    says: str
    evidence: str
    holds: Callable[[FileInterface], bool]


class Loader(Struct, frozen=True):
    """A program that loads a policy, as a file of ``format``."""

    name: str
    rules: tuple[LoaderRule, ...]
    format: str = ONNX.key
    fix: str = "export without --for, and name the tensors in your own loader"

    def faults(self, file: FileInterface) -> Iterator[LoaderRule]:
        """The rules that a file does not meet."""
        return (rule for rule in self.rules if not rule.holds(file))


def _names(tensors: Sequence[object]) -> list[str]:
    return [getattr(t, "name", "") for t in tensors]


def _shape(file: FileInterface, name: str) -> tuple[int | None, ...]:
    return next((t.dims for t in (*file.inputs, *file.outputs) if t.name == name), ())


def _all_float(file: FileInterface) -> bool:
    return all(t.is_float for t in (*file.inputs, *file.outputs))


LOADERS: Mapping[str, Loader] = {
    loader.name: loader
    for loader in (
        Loader(
            "Isaac Lab",
            (
                LoaderRule(
                    "the inputs are obs, then h_in, then c_in of an LSTM, and no others",
                    f"{_RNN} input_names; {_EXPORTER} export",
                    lambda f: _names(f.inputs) == _ISAAC_INPUTS.get(len(f.inputs)),
                ),
                LoaderRule(
                    "the outputs are actions, then h_out, then c_out, and no others: runners take the first",
                    f"{_RNN} output_names; {_RUNNER}",
                    lambda f: _names(f.outputs) == _ISAAC_OUTPUTS.get(len(f.inputs)),
                ),
                LoaderRule("all are float32", f"{_EXPORTER} torch.zeros; {_RUNNER}", _all_float),
                LoaderRule(
                    "every length is fixed, for one robot: runners multiply the lengths to know how much to copy",
                    f"{_EXPORTER} dynamic_axes={{}}; {_RUNNER}",
                    lambda f: all(None not in t.dims for t in (*f.inputs, *f.outputs)),
                ),
                LoaderRule(
                    "obs and actions are a row [1, n]",
                    f"{_EXPORTER} torch.zeros(1, in_features)",
                    lambda f: all(len(_shape(f, n)) == 2 and _shape(f, n)[0] == 1 for n in (OBS, ACTIONS)),
                ),
                LoaderRule(
                    "a state is [layers, 1, size]",
                    f"{_RNN} get_dummy_inputs",
                    lambda f: all(len(t.dims) == 3 and t.dims[1] == 1 for t in (*f.inputs[1:], *f.outputs[1:])),
                ),
                LoaderRule("the opset is at most 11", f"{_EXPORTER} opset_version=11", lambda f: f.opset <= 11),
            ),
        ),
        Loader(
            "Godot RL Agents",
            (
                LoaderRule(
                    "the inputs are obs and state_ins, and no others: Run is given these two",
                    f"{_INFERENCE} RunInference",
                    lambda f: sorted(_names(f.inputs)) == [OBS, STATE[0]],
                ),
                LoaderRule(
                    "output and state_outs are outputs: they are fetched by name",
                    f"{_INFERENCE} RunInference",
                    lambda f: {OUTPUT, STATE[1]} <= {*_names(f.outputs)},
                ),
                LoaderRule("all are float32", f"{_INFERENCE} DenseTensor<float>, AsEnumerable<float>", _all_float),
                LoaderRule(
                    "obs takes [1, n] and state_ins [1]",
                    f"{_INFERENCE} new int[] {{ batchSize, obs.Count }}, {{ batchSize }}",
                    lambda f: (
                        len(_shape(f, OBS)) == 2
                        and _shape(f, OBS)[0] in (None, 1)
                        and len(_shape(f, STATE[0])) == 1
                        and _shape(f, STATE[0])[0] in (None, 1)
                    ),
                ),
                LoaderRule(
                    "the second length of output is fixed: with it the loader tells means from means and deviations",
                    f'{_INITIALIZE} OutputMetadata["output"].Dimensions[1]',
                    lambda f: len(_shape(f, OUTPUT)) == 2 and _shape(f, OUTPUT)[1] is not None,
                ),
                LoaderRule(
                    "the opset is at most 19 and the IR version at most 9",
                    _PROJECT,
                    lambda f: f.opset <= 19 and f.ir <= 9,
                ),
            ),
        ),
        Loader(
            "PX4",
            (
                LoaderRule(
                    f"there is one input of {PX4_OBSERVED} numbers, for one vehicle, and one output of {PX4_MOTORS}",
                    f"{_PX4_CHECKS} model_layout_problem",
                    lambda f: (
                        [t.dims for t in (*f.inputs, *f.outputs)] == [(1, PX4_OBSERVED), (1, PX4_MOTORS)]
                        and len(f.inputs) == 1
                    ),
                ),
                LoaderRule("all are float32", f"{_PX4_CHECKS} model_layout_problem", _all_float),
                LoaderRule(
                    f"the operators are {', '.join(sorted(PX4_OPERATORS))}: others are not registered",
                    f"{_PX4} RegisterOps",
                    lambda f: f.operators <= PX4_OPERATORS,
                ),
                LoaderRule(
                    f"the version of LiteRT's schema is {_SCHEMA}",
                    f"{_PX4_CHECKS} model_layout_problem",
                    lambda f: f.ir == _SCHEMA,
                ),
                LoaderRule(
                    f"{SOURCE} has the bytes of the file: they are what is built",
                    f"{_PX4} InitializeNetwork",
                    lambda f: f.array,
                ),
            ),
            LITERT.key,
            "register what it lacks in RegisterOps, or change the sizes there, and take --to litert --batch 1",
        ),
    )
}


def file_interface(loader: Loader, files: Mapping[str, bytes], main: str) -> FileInterface:
    """Return what a loader sees of an artefact; ``files`` by name, ``main`` the one that it loads.

    Raises DamagedFileError.
    """
    if loader.format == LITERT.key:
        return interface_of_litert(files[main], files.get(SOURCE, b"").decode("utf-8", "replace"))
    from export_model.converters.formats.onnx.proto import decode_model

    return interface_of(decode_model(files[main]))


def loadable(profile: str, names: Sequence[str], files: Mapping[str, bytes], main: str, policy: str) -> None:
    """Raise ProfileError where one of the loaders ``names`` would not load the files made for ``profile``."""
    for loader in (LOADERS[name] for name in names):
        file = file_interface(loader, files, main)
        for rule in loader.faults(file):
            raise ProfileError(
                f"{policy!r} cannot be made for {profile}: {loader.name} asks that {rule.says}",
                why=f"the file has {', '.join(t.text for t in file.inputs)} → "
                f"{', '.join(t.text for t in file.outputs)}"
                + (f", with {', '.join(sorted(file.operators))}" if file.operators else "")
                + f" ({rule.evidence})",
                fix=loader.fix,
            )
