"""``--for px4``: what PX4's mc_nn_control is built with, by the rules of its loading code; PX4 itself is not built."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.consumers.robots.byte_array import bytes_of_array, sources
from export_model.converters.consumers.robots.interface import interface_of_litert
from export_model.converters.consumers.robots.loaders import LOADERS, PX4_OPERATORS
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.checks.consumer import consumers
from export_model.signatures.errors import ProfileError
from fixtures import path as fixture
from tests.commands import export_model as command
from tests.exporting import export_model
from tests.robots.quadrotors import quadrotor

pytestmark = pytest.mark.xdist_group("robots")
FILES = {"quadrotor.tflite", "control_net.cpp", "control_net.hpp", "policy.json", "parity.json"}


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("px4")
    (result,) = export_model(quadrotor(folder), folder / "out", for_="px4", verify="litert")
    assert result.passed, result.report
    return result.folder


def test_one_file_for_one_vehicle_with_the_operators_that_are_registered(bundle: Path) -> None:
    assert {f.name for f in bundle.iterdir()} == FILES
    data = (bundle / "quadrotor.tflite").read_bytes()
    file = interface_of_litert(data, (bundle / "control_net.cpp").read_text())
    assert [(t.is_float, t.dims) for t in (*file.inputs, *file.outputs)] == [(True, (1, 15)), (True, (1, 4))]
    assert file.operators <= PX4_OPERATORS
    assert file.array and not list(LOADERS["PX4"].faults(file))


def test_its_numbers_are_the_sources(bundle: Path, tmp_path: Path) -> None:
    litert = pytest.importorskip("ai_edge_litert.interpreter", reason="get it with: pip install 'export-model[litert]'")
    interpreter = litert.Interpreter(str(bundle / "quadrotor.tflite"))
    interpreter.allocate_tensors()
    (policy,) = read_source(quadrotor(tmp_path)).policies()
    kernels = {n.name: n.value for n in policy.graph.nodes if n.value is not None and n.value.ndim == 2}
    assert [v.shape for v in kernels.values()] == [(15, 64), (64, 64), (64, 4)]
    rng = np.random.default_rng(1)
    for _ in range(20):
        observed = rng.normal(size=(1, 15)).astype(np.float32)
        interpreter.set_tensor(interpreter.get_input_details()[0]["index"], observed)
        interpreter.invoke()
        got = interpreter.get_tensor(interpreter.get_output_details()[0]["index"])
        assert got == pytest.approx(_by_hand(observed, tmp_path), abs=1e-5)


def _by_hand(observed: np.ndarray, folder: Path) -> np.ndarray:
    """What onnx' own evaluator says of the source."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    (answer,) = ReferenceEvaluator(onnx.load(folder / "quadrotor.onnx")).run(None, {"obs": observed})
    return np.asarray(answer)


def test_the_array_is_the_file_as_a_compiler_reads_it(bundle: Path, tmp_path: Path) -> None:
    compiler = shutil.which("g++") or pytest.skip("there is no g++")
    (tmp_path / "main.cpp").write_text(
        '#include <cstdio>\n#include "control_net.hpp"\n'
        "int main() { std::fwrite(control_net_tflite, 1, control_net_tflite_size, stdout); }\n"
    )
    made = [str(bundle / "control_net.cpp"), "main.cpp", "-o", "main"]
    subprocess.run([compiler, "-Wall", "-Wextra", "-Werror", f"-I{bundle}", *made], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "main"], check=True, capture_output=True)
    assert said.stdout == (bundle / "quadrotor.tflite").read_bytes()


@pytest.mark.parametrize("data", [b"", b"\x00", bytes(range(256)), b"x" * 13])
def test_any_bytes_come_back_from_their_array(data: bytes) -> None:
    assert bytes_of_array(sources(data)["control_net.cpp"].decode()) == data


@pytest.mark.parametrize(
    "text", ["", "control_net_tflite[] = {0x1}", "control_net_tflite[] = {zz}", "other[] = {0x01}"]
)
def test_other_text_has_no_bytes(text: str) -> None:
    assert bytes_of_array(text) == b""


@pytest.mark.parametrize(
    ("sizes", "activation", "lacks"),
    [((15, 8, 4), "Tanh", "TANH"), ((14, 8, 4), "Relu", "15"), ((15, 8, 3), "Relu", "4"), ((15, 8, 4), "Elu", "ELU")],
)
def test_what_it_would_not_load_is_refused(sizes: Sequence[int], activation: str, lacks: str, tmp_path: Path) -> None:
    with pytest.raises(ProfileError) as error:
        export_model(quadrotor(tmp_path, sizes, activation), tmp_path / "out", for_="px4", verify="none")
    assert lacks in f"{error.value.what} {error.value.why}" and "--to litert" in (error.value.fix or "")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["discrete", "recurrent", "visual"])
def test_other_kinds_of_policies_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ProfileError):
        export_model(fixture(name), tmp_path, for_="px4", verify="none")


@pytest.mark.parametrize("change", ["another array", "no array", "another file"])
def test_a_change_of_what_is_built_in_is_found(change: str, bundle: Path, tmp_path: Path) -> None:
    folder = tmp_path / "changed"
    shutil.copytree(bundle, folder)
    array, main = folder / "control_net.cpp", folder / "quadrotor.tflite"
    if change == "another array":
        text = array.read_text()
        at = text.rindex("0x")
        array.write_text(text[:at] + ("0x01" if text[at : at + 4] != "0x01" else "0x02") + text[at + 4 :])
    elif change == "no array":
        array.unlink()
    else:
        main.write_bytes(main.read_bytes()[:-1] + b"\x7f")
    (finding,) = consumers("px4", {"litert": main})
    assert not finding.passed and "control_net.cpp" in finding.reason
    done = command("verify", folder)
    assert done.status != 0


def test_the_terminal_says_what_to_do_with_them(bundle: Path, tmp_path: Path) -> None:
    done = command(quadrotor(tmp_path), "-o", tmp_path / "out", "--for", "px4", "--verify", "none")
    assert "control_net.cpp" in done.out and "to PX4" in done.out
    shown = command("snippets", bundle, "--for", "px4")
    assert "control_net.hpp" in shown.out and "mc_nn_control" in shown.out
