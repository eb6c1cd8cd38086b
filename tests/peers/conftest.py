"""The peers' environment, every fixture exported once, and what the peers make of each."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from fixtures import FIXTURES, path
from tests.peers.environment import HOW, Peers, PeersUnavailableError, ensure_peers, environment

#: A policy's name → what a peer made of it; not to be written to.
Theirs = Callable[[str], Path]


@pytest.fixture(scope="session")
def peers() -> Peers:
    try:
        return ensure_peers()
    except PeersUnavailableError as error:
        pytest.skip(f"{error}; to {HOW}")


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ExportResult]:
    """Policy → its bundle; a fixture with two brains gives two."""
    sources: list[Path | str] = [path(name) for name in FIXTURES]
    out = tmp_path_factory.mktemp("bundles")
    return {r.policy.name: r for r in export(sources, ExportOptions(out, verify="none"))}


@contextmanager
def resident(peers: Peers, module: str, function: str) -> Iterator[Callable[[list[str]], None]]:
    """A peer's console script in a process that has imported it: each start would take TensorFlow's seconds."""
    command = [peers.python, "-P", str(Path(__file__).with_name("resident.py")), module, function]
    piped = subprocess.PIPE
    with subprocess.Popen(command, stdin=piped, stdout=piped, env=environment(), encoding="utf-8") as process:
        assert process.stdin is not None
        assert process.stdout is not None
        to, back = process.stdin, process.stdout

        def run(arguments: list[str]) -> None:
            print(json.dumps(arguments), file=to, flush=True)
            try:
                status, said = json.loads(back.readline() or '[-1, "it ended"]')
            except BaseException:  # the test was interrupted: this answer must not be the next one's
                process.kill()
                raise
            assert status == 0, f"{module} {arguments}: status {status}\n{said}"

        yield run
        to.close()


@pytest.fixture(scope="session")
def official(
    peers: Peers, bundles: dict[str, ExportResult], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Theirs]:
    """What tensorflowjs_converter makes of a SavedModel of ours."""
    home = tmp_path_factory.mktemp("official")
    with resident(peers, "tensorflowjs.converters.converter", "pip_main") as converter:

        def of(name: str) -> Path:
            if not (home / name).exists():
                converter(
                    ["--input_format=tf_saved_model", str(bundles[name].folder / "saved_model"), str(home / name)]
                )
            return home / name

        yield of


@pytest.fixture(scope="session")
def by_tf2onnx(
    peers: Peers, bundles: dict[str, ExportResult], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Theirs]:
    """What tf2onnx makes of a frozen graph of ours; its tensors are called "node:0"."""
    home = tmp_path_factory.mktemp("tf2onnx")
    with resident(peers, "tf2onnx.convert", "main") as convert:

        def of(name: str) -> Path:
            made, graph = home / f"{name}.onnx", bundles[name].folder / f"{name}.bytes"
            if not made.exists():
                sides = bundles[name].policy.signature
                inputs, outputs = (",".join(f"{s.name}:0" for s in side) for side in (sides.inputs, sides.outputs))
                convert(["--graphdef", str(graph), "--inputs", inputs, "--outputs", outputs, "--output", str(made)])
            return made

        yield of
