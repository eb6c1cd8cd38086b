"""The loop of a Python child process: load models, run them, answer frames.

A fault in a model must not end the process that other models wait for, so every request is answered, with the error's
text if it failed. What native code prints goes to stderr; stdout carries frames only.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, BinaryIO, NoReturn, Protocol

from export_model.converters.files.children.frames import Tensors, read_frame, write_frame
from export_model.signatures.cycles import raise_gc_threshold


class Model(Protocol):
    """A loaded model."""

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        """Outputs by name; ``request`` is the whole header, for what one runtime alone can do."""
        ...


def _runs(model: Model, runs: Sequence[Mapping[str, Any]], tensors: Tensors) -> Tensors:
    """Several runs in one request; what is fed to several of them crosses once."""
    answers: Tensors = {}
    for number, each in enumerate(runs):
        feeds = {name: tensors[key] for name, key in each["feeds"].items()}
        answers.update({f"{number}/{name}": a for name, a in model.run(feeds, each["fetch"], each).items()})
    return answers


Loader = Callable[[Mapping[str, Any]], Model]


def claim_stdout() -> BinaryIO:
    """A stream to the real stdout; file descriptor 1 becomes stderr, so that no library can write between frames.

    The first call of a child: from here on it ends when its parent does.
    """
    end_with_parent()
    raise_gc_threshold()
    stream = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return stream


def end_with_parent() -> None:
    """A parent that is killed closes stdin, which is noticed between requests only: this looks during one, too."""
    parent = os.getppid()

    def look() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=look, daemon=True).start()


def serve(runtime: str, version: str, load: Loader, faults: tuple[type[Exception], ...], out: BinaryIO) -> NoReturn:
    """Answer requests until stdin ends, then end the process. ``faults`` are what bad models and inputs raise."""
    models: dict[str, Model] = {}
    caught: tuple[type[Exception], ...] = (*faults, KeyError, ValueError, TypeError, OSError)
    source = sys.stdin.buffer
    gc.freeze()  # what was imported is not looked at again
    while True:
        try:
            header, tensors = read_frame(source)
        except EOFError:
            # Everything was answered and flushed, and nobody listens any more. Taking TensorFlow down in order would
            # cost a second, which the parent would wait for.
            os._exit(0)
        try:
            command = header["cmd"]
            if command == "hello":
                write_frame(out, {"ok": True, "runtime": runtime, "version": version})
            elif command == "load":
                models[header["id"]] = load(header)
                write_frame(out, {"ok": True})
            elif command == "run":
                write_frame(out, {"ok": True}, models[header["id"]].run(tensors, header["fetch"], header))
            elif command == "runs":
                write_frame(out, {"ok": True}, _runs(models[header["id"]], header["runs"], tensors))
            elif command == "unload":
                models.pop(header["id"], None)
                gc.collect()  # TensorFlow's graphs hold themselves, and their weights
                write_frame(out, {"ok": True})
            else:
                write_frame(out, {"ok": False, "error": f"unknown command {command!r}"})
        except caught as error:
            write_frame(out, {"ok": False, "error": f"{type(error).__name__}: {error}"})
