"""``export-model demo --files``: one policy in each form that a user may have, so that every command can be tried, and
the environments that policies are trained in, so that other programs can play them.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from converters.files.folders import scratch_folder
from converters.formats.bundle.bundle import writing
from converters.formats.registry import BARRACUDA, ONNX
from exporter.demo import BALL, HALLWAY
from exporter.export.options import ExportOptions
from exporter.export.pipeline import export
from signatures.errors import UsageError

#: The run of the documentation: a folder for each behavior, as ML-Agents 0.7 to 0.23 leaves it.
_RUN = "results/first_run"
#: The modules of the environments.
_WORLDS = ("base", "ball3d", "crawler2d", "gridworld", "hallway", "tennis")
#: Path → what it is, in the order in which they are listed.
FILES: Mapping[str, str] = {
    "3DBall.bytes": "a frozen TensorFlow graph (ML-Agents 0.7 to 0.8)",
    "3DBall.onnx": "the same policy as ONNX",
    "3DBall.nn": "the same for Unity's Barracuda",
    "Hallway.bytes": "a policy with memory (LSTM)",
    f"{_RUN}/3DBall/frozen_graph_def.pb": "a training run of two behaviors",
    f"{_RUN}/Hallway/frozen_graph_def.pb": "",
    "environments/__init__.py": "what they were trained in, and three others, for Gymnasium",
    **{f"environments/{name}.py": "" for name in _WORLDS},
}


def write_files(out: Path) -> None:
    """Write FILES into ``out``. Raises UsageError, before anything is written, where another file is in the way."""
    contents = dict(zip(FILES, _contents(), strict=True))
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


def _contents() -> list[bytes]:
    ball, hallway = BALL.read_bytes(), HALLWAY.read_bytes()
    with scratch_folder() as folder:
        forms = (ONNX, BARRACUDA)
        (result,) = export([BALL], ExportOptions(Path(folder), [f.key for f in forms], verify="none"))
        onnx, barracuda = ((result.folder / f.main_of(BALL.stem)).read_bytes() for f in forms)
    return [ball, onnx, barracuda, hallway, ball, hallway, *_environments()]


def _environments() -> list[bytes]:
    """Their Gymnasium form, and what it imports: the package's own modules, each beside the others."""
    form = files("exporter.demo").joinpath("gymnasium_form.py.tmpl").read_bytes()
    room = files("exporter.play.environments")
    own = (room.joinpath(f"{name}.py").read_text(encoding="utf-8") for name in _WORLDS)
    return [form, *(text.replace("from exporter.play.environments.", "from .").encode() for text in own)]
