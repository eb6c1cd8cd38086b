"""``export-model demo --files``: policies in the forms that a user may have, so that every command can be tried.

Beside them are the environments that policies are trained in, so that other programs can play them.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.bundle.bundle import writing
from export_model.converters.formats.registry import BARRACUDA, ONNX
from export_model.exporter.demo import BALL, FOLDER
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import export
from export_model.signatures.errors import UsageError

#: The runs of the documentation: a folder for each behavior, as ML-Agents 0.7 to 0.23 leaves it, and as 2.0 does.
_FIRST, _SECOND = "results/first_run", "results/second_run/3DBall"
#: The modules of the environments.
_WORLDS = ("base", "ball3d", "crawler2d", "gridworld", "hallway", "tennis")
#: Path → (the file of this package that it is, or "" where it is made; what it is), in the order in which they are
#: listed.
_TABLE: Mapping[str, tuple[str, str]] = {
    "3DBall.bytes": ("3DBall.bytes", "a frozen TensorFlow graph (ML-Agents 0.7 to 0.8)"),
    "3DBall.onnx": ("", "the same policy as ONNX"),
    "3DBall.nn": ("", "the same for Unity's Barracuda"),
    "Hallway.bytes": ("Hallway.bytes", "a policy with memory (LSTM)"),
    "GridWorld.bytes": ("GridWorld.bytes", "one with discrete actions and masks"),
    "Tennis.bytes": ("Tennis.bytes", "two brains in one file (ML-Agents 0.5)"),
    f"{_FIRST}/3DBall/frozen_graph_def.pb": ("3DBall.bytes", "a training run of two behaviors"),
    f"{_FIRST}/Hallway/frozen_graph_def.pb": ("Hallway.bytes", ""),
    **{
        f"{_SECOND}/{name}.pt": ("3DBall.pt", what)
        for name, what in (
            ("3DBall-250000", "a run that left no .onnx (ML-Agents 2.0 and later)"),
            ("3DBall-500000", ""),
            ("checkpoint", ""),
        )
    },
    "sb3_discrete.onnx": ("sb3_discrete.onnx", "Stable-Baselines3's, by the recipe of its documentation"),
    "torch_actor.onnx": ("torch_actor.onnx", "an actor of PyTorch's exporter, its weights in a file beside it"),
    "torch_actor.onnx.data": ("torch_actor.onnx.data", ""),
    "environments/__init__.py": ("", "what they were trained in, and two others, for Gymnasium"),
    **{f"environments/{name}.py": ("", "") for name in _WORLDS},
}
#: Path → what it is.
FILES: Mapping[str, str] = {path: what for path, (_, what) in _TABLE.items()}


def write_files(out: Path) -> None:
    """Write FILES into ``out``. Raises UsageError, before anything is written, where another file is in the way."""
    made = {**_forms(), **_environments()}
    contents = {path: FOLDER.joinpath(name).read_bytes() if name else made[path] for path, (name, _) in _TABLE.items()}
    for name, content in contents.items():
        path = out / name
        taken = path.is_symlink() or (path.exists() and not (path.is_file() and path.read_bytes() == content))
        if taken or any(parent.is_symlink() for parent in path.parents if parent.is_relative_to(out) and parent != out):
            raise UsageError(f"{path} is another file", why="nothing is overwritten", fix="-o names another folder")
    for name, content in contents.items():
        path = out / name
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def _forms() -> dict[str, bytes]:
    """3DBall in the forms that it is written in here."""
    with scratch_folder() as folder:
        forms = (ONNX, BARRACUDA)
        (result,) = export([BALL], ExportOptions(Path(folder), [f.key for f in forms], verify="none"))
        names = [f.main_of(BALL.stem) for f in forms]
        return {name: (result.folder / name).read_bytes() for name in names}


def _environments() -> dict[str, bytes]:
    """Their Gymnasium form, and what it imports: the package's own modules, each beside the others."""
    form = files("export_model.exporter.demo").joinpath("gymnasium_form.py.tmpl").read_bytes()
    room = files("export_model.exporter.play.environments")
    own = {f"environments/{name}.py": room.joinpath(f"{name}.py").read_text(encoding="utf-8") for name in _WORLDS}
    return {
        "environments/__init__.py": form,
        **{
            path: text.replace("from export_model.exporter.play.environments.", "from .").encode()
            for path, text in own.items()
        },
    }
