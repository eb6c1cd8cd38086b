"""What a stranger's file is called, or says, acts nowhere: in no terminal, page, report or picture, and in no code."""

from __future__ import annotations

import ast
import contextlib
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper, save

from export_model import exporter
from export_model.converters.runtimes.javascript.node import node_executable
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.cli.terminal import say, say_json, say_lines
from export_model.exporter.snippets.contract import string_literal
from export_model.signatures.errors import SourceError
from fixtures import path as fixture
from tests.commands import Ran, export_model
from tests.handmade import continuous_policy, graph_bytes, node

#: A colour, the clipboard, a line of its own, C1, text that runs backwards, separators, a cursor that goes home.
NAME = "x\x1b[31my\x1b]52;c;eA==\x07\nPASSED: all\r\x9b2J\u202eevil\u2028z\x7f</script><b>"
COMMANDS: dict[str, tuple[str, ...]] = {
    "inspect": ("inspect", "FILE"),
    "inspect --json": ("inspect", "FILE", "--json"),
    "inspect's pictures": ("inspect", "FILE", "--svg", "OUT/a.svg"),
    "inspect --unity": ("inspect", "ONNX", "--unity", "all"),
    "export": ("FILE", "-o", "OUT", "--verify", "none", "-v"),
    "export, its reports": ("FILE", "-o", "OUT", "--verify", "numpy", "--html", "OUT/a.html", "--junit", "OUT/a.xml"),
    "export, Markdown": ("FILE", "-o", "OUT", "--verify", "numpy", "--markdown", "-", "-v"),
    "export, names kept": ("FILE", "-o", "OUT", "--verify", "numpy", "--names", "source", "-v"),
    "export, tolerances": (
        "FILE",
        "-o",
        "OUT",
        "--verify",
        "numpy",
        "--tolerances",
        "TOL",
        "--html",
        "OUT/a.html",
        "-v",
    ),
    "export, labels": ("FILE", "-o", "OUT", "--verify", "none", "--labels", "LABELS", "-v"),
    "a list of sources": ("LIST", "-o", "OUT", "--verify", "none", "--html", "OUT/a.html", "--junit", "OUT/a.xml"),
    "a list, as JSON": ("LIST", "-o", "OUT", "--verify", "none", "--json"),
    "a recording": ("FILE", "-o", "OUT", "--verify", "numpy", "--golden", "NPZ"),
    "a file that is not there": ("inspect", f"OUT/{NAME}"),
    "an op that nothing knows": ("FOREIGN", "-o", "OUT"),
    "an option": ("FILE", f"--{NAME}"),
    "an option's value": ("FILE", "--opset", NAME),
    "a role": ("FILE", "--input", f"{NAME}=vector_observation"),
    "another output": ("compare", "FILE", "ONNX", "--runtimes", "numpy", "--allow-unverified"),
    "a bundle that is none": ("verify", f"OUT/{NAME}"),
    "its error as JSON": ("snippets", f"OUT/{NAME}", "--json"),
}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frozen graph and an ONNX model whose every name would act."""
    folder = tmp_path_factory.mktemp("given")
    (folder / "policy.bytes").write_bytes(graph_bytes(continuous_policy(f"{NAME}/")))
    foreign = [*continuous_policy(), node(NAME, f"Odd{NAME}", "mu")]
    next(n for n in foreign if n.name == "action").input[0] = NAME
    (folder / "foreign.bytes").write_bytes(graph_bytes(foreign))
    rule = {"output": NAME, "atol": 1, "reason": NAME}
    (folder / "tolerances.json").write_text(json.dumps({"tolerance": [rule, {"atol": 1, "reason": NAME}]}))
    (folder / "labels.json").write_text(json.dumps({"actions": {NAME: [NAME]}, NAME: NAME}))
    line = NAME.replace("\n", "\\n").replace("\r", "").replace("\u2028", "")
    lines = [folder / "policy.bytes", f"{line}.onnx", f"{folder}/{line}", f"https://{line}@example.invalid/{line}"]
    (folder / "list.txt").write_text("\n".join(map(str, lines)), encoding="utf-8")
    np.savez(folder / "recorded.npz", **{NAME: np.ones(3, np.float32)})
    weights = numpy_helper.from_array(np.ones((3, 2), np.float32), NAME)
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["obs_0", NAME], [f"{NAME}!"], NAME), helper.make_node(NAME, [f"{NAME}!"], ["a"])],
        NAME,
        [helper.make_tensor_value_info("obs_0", TensorProto.FLOAT, [NAME, 3])],
        [helper.make_tensor_value_info("a", TensorProto.FLOAT, [NAME, 2])],
        [weights],
    )
    save(helper.make_model(graph, producer_name=NAME), folder / "policy.onnx")
    return folder


def clean(text: str) -> None:
    assert not [c for c in text if not c.isprintable() and c not in "\n\t\u200b"], text
    assert not any(line.startswith("PASSED: all") for line in text.split("\n")), text


@pytest.mark.parametrize("what", COMMANDS)
def test_no_command_says_or_writes_what_acts(
    what: str, given: Path, tmp_path: Path, processes: RuntimePool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (
        "export_model.exporter.export.again",
        "export_model.exporter.compare.comparison",
        "export_model.converters.runtimes.pool",
    ):
        monkeypatch.setattr(f"{module}.RuntimePool", lambda: contextlib.nullcontext(processes))
    places = {"FILE": "policy.bytes", "ONNX": "policy.onnx", "FOREIGN": "foreign.bytes"}
    places |= {"TOL": "tolerances.json", "LABELS": "labels.json", "LIST": "list.txt", "NPZ": "recorded.npz"}
    arguments = [str(given / places[a]) if a in places else a.replace("OUT", str(tmp_path)) for a in COMMANDS[what]]
    ran: Ran = export_model(*arguments)
    clean(ran.out)
    clean(ran.err)
    assert ran.out + ran.err
    assert "Traceback" not in ran.err
    for file in [*tmp_path.glob("a.*"), *tmp_path.rglob("parity.json")]:
        text = file.read_text(encoding="utf-8")
        clean(text)
        assert "</script><b>" not in text or file.suffix == ".json"


def test_an_error_has_its_own_lines_and_no_others() -> None:
    message = str(SourceError(NAME, where=NAME, why=f"{NAME}\nmore", fix=NAME))
    clean(message)
    own = [line for line in message.split("\n") if not line.startswith(" " * 7)]
    assert [line[:6] for line in own[1:]] == ["  why:", "  fix:"]


@pytest.mark.parametrize(
    "name", ["::error::x", "  ::add-mask::x", "##vso[task.setvariable variable=x]", "##[error]", "##teamcity[x]"]
)
def test_no_log_of_a_ci_obeys_a_name(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(name)
    say_lines(f"a\n{name}: b", colour="red")
    say_json({"name": name})
    said = capsys.readouterr().out
    assert "##" not in said
    assert not [line for line in said.split("\n") if line.strip().startswith("::")]
    assert json.loads(said[said.index("{") :]) == {"name": name}


def test_there_is_one_way_to_the_terminal() -> None:
    """Whoever prints by himself prints what a stranger wrote."""
    root = Path(exporter.__file__).parent
    for file in sorted(root.rglob("*.py")):
        if file.relative_to(root).as_posix() in ("cli/terminal.py", "cli/main.py"):
            continue
        for found in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(found, ast.Call):
                assert ast.unparse(found.func) not in ("print", "click.echo", "click.secho", "sys.stdout.write"), file


@pytest.mark.parametrize("text", [NAME, "😀 \U0001f600", "`${x}`", "a\\b\"c'd", "</script>", "-->", "\u2029"])
def test_a_quoted_text_is_itself_in_python_json_and_javascript(text: str) -> None:
    literal = string_literal(text)
    assert ast.literal_eval(literal) == json.loads(literal) == text
    assert not {*"<>&\n\u2028\u2029"} & {*literal}
    program = node_executable()
    if program is not None:
        code = f"process.stdout.write(JSON.stringify({literal}))"
        done = subprocess.run([program, "-e", code], capture_output=True, encoding="utf-8", check=True)
        assert json.loads(done.stdout) == text


@pytest.mark.parametrize("name", ["continuous.onnx", "policy.json"])
def test_a_pipe_in_a_bundle_is_waited_for_by_nobody(name: str, tmp_path: Path) -> None:
    assert export_model(fixture("continuous"), "-o", tmp_path, "--verify", "none").status == 0
    (tmp_path / "continuous" / name).unlink()
    os.mkfifo(tmp_path / "continuous" / name)
    ran = export_model("verify", tmp_path / "continuous", "--runtimes", "numpy", "--allow-unverified")
    assert ran.status == 2
    assert "it must be a file" in ran.err
