"""What people type first who come from another tool, and what to type here. Imports click only.

A row is answered, not obeyed: one option has one name. tests/exporter/test_first_guesses.py types every row.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click

from export_model.signatures.errors import UsageError


class Guess(NamedTuple):
    """Options or words of other tools, which tools these are, and what to type here."""

    typed: tuple[str, ...]
    tools: str
    fix: str


_SOURCE = "give the file without an option: export-model FILE"
_NOTHING = "leave it out: {}"
OPTIONS = (
    Guess(("-i", "-m", "--model", "--input_path", "--input-model"), "onnx2tf, optimum, onnx-mlir", _SOURCE),
    Guess(("--saved-model", "--graphdef", "--keras", "--tflite", "--checkpoint"), "tf2onnx, rl-zoo3", _SOURCE),
    Guess(("--output_format", "--format", "--target", "-f"), "tensorflowjs_converter, ultralytics", "--to onnx"),
    Guess(("--output-dir", "--output_dir", "--outdir", "--output_folder_path"), "onnx2tf, optimum", "-o DIR"),
    Guess(("--check", "--validate", "--verify-output"), "onnx, optimum", "export-model verify exported compares again"),
    Guess(("--task", "--algo"), "optimum, Isaac Lab, rl-zoo3", _NOTHING.format("the file says what it is")),
    Guess(("--input_format", "--framework"), "tensorflowjs_converter", _NOTHING.format("files are known by content")),
    Guess(("--fp16", "--half", "--quantize_float16"), "optimum, ultralytics", "--dtype float16"),
    Guess(("--int8", "--quantize_uint8"), "ultralytics, tensorflowjs_converter", "--quantize int8"),
    Guess(("--inputs",), "tf2onnx", "--input NAME=ROLE, where export-model inspect shows a wrong role"),
    Guess(("--input-shape", "--batch_size", "-b", "--dynamic-axes"), "onnx2tf", "--batch N; without it any number"),
    Guess(("--simplify", "--optimize", "--fold_const"), "onnxsim, tf2onnx", _NOTHING.format("graphs are simplified")),
    Guess(("--device",), "optimum, Isaac Lab", _NOTHING.format("everything runs on the processor")),
)
WORDS = (
    Guess(("convert", "to", "onnx", "tfjs"), "tf2onnx, optimum", "export-model FILE --to onnx"),
    Guess(("check", "validate", "test"), "onnx, polygraphy", "export-model verify BUNDLE, or compare FILE FILE"),
    Guess(("diff",), "polygraphy", "export-model compare FILE FILE"),
    Guess(("info", "show", "view", "summary", "dump"), "netron, saved_model_cli", "export-model inspect FILE"),
    Guess(("run", "enjoy", "eval"), "polygraphy, rl-zoo3", "export-model play BUNDLE --env ENV, or serve BUNDLE"),
    Guess(("help",), "git, pip", "export-model --help"),
    Guess(("version",), "git, docker", "export-model --version"),
    Guess(("doctor", "env", "list"), "flutter, optimum", "export-model runtimes"),
)
#: How files are called that others are told to write.
_WRITTEN = (".onnx", ".tflite", ".pb", ".bytes", ".nn", ".json")
_ANSWERS = {typed: guess.fix for guess in (*OPTIONS, *WORDS) for typed in guess.typed}


def answer_option(error: click.NoSuchOption) -> None:
    """Raise UsageError with what to type for an option of another tool; return where it is no known one."""
    if fix := _ANSWERS.get(error.option_name):
        raise UsageError(f"no such option: {error.option_name}", fix=fix) from error


def answer_word(word: str) -> None:
    """Raise UsageError with what to type for a command of another tool, unless a file is called so."""
    if word in _ANSWERS and not Path(word).exists():
        raise UsageError(f"{word!r} is neither a command nor a file", fix=_ANSWERS[word])


def answer_place(sources: Sequence[Path], out: Path) -> None:
    """Raise UsageError where the last of two sources, or ``-o``, is called as a file that is to be written."""
    last = sources[1] if len(sources) == 2 and sources[0].suffix != sources[1].suffix else Path()
    place = out if out.suffix in _WRITTEN else last
    if place.suffix in _WRITTEN and not place.exists():
        raise UsageError(
            f"{place}: no such file, and what is written is a folder of files",
            fix=f"export-model {sources[0] if sources else 'FILE'} -o exported --name {place.stem}",
        )
