"""The page in Chromium: the policy acts, answers what is asked, says whether it is right, and asks nobody else."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.serve.site import assemble, assemble_one_file, write_site
from fixtures.trained import run_folder
from tests.commands import export_model
from tests.exporting import load_policy
from tests.serve.browsing import CHECKED, Visit, served, visit, with_backends
from tests.serve.conftest import Bundle

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("browser")]

VERDICT = "document.querySelector('#verdict').textContent"
#: Without webgpu: whether it runs is the machine's matter.
STATES = """[...document.querySelectorAll('[data-backend]')].map((row) => [row.dataset.backend, row.dataset.state])
  .filter(([backend]) => backend !== "webgpu")"""
STATUS = "({...document.querySelector('#status').dataset})"
ACTIONS = "[...document.querySelectorAll('.answering .bars .value')].map((cell) => cell.textContent)"
DECIDED = "document.querySelector('#timing').textContent.startsWith('Decided')"
#: Until the answer is another than the one that was noted; how long a decision takes is the machine's matter.
NOTE = ["eval", f"void (window.noted = {ACTIONS}.join())"]
ANOTHER = ["wait", f"{ACTIONS}.join() !== window.noted"]


def see(bundle: Path, *steps: list[object], backends: Sequence[str] = ("js",)) -> Visit:
    """A visit once the check is done; nothing may be written to the console, and no other origin be asked.

    ``backends``: without any, as it is served.
    """
    site = assemble(bundle)
    with served(with_backends(site, *backends) if backends else site) as server:
        seen = visit(server.url, [["wait", CHECKED], *steps])
        # Chromium's own words where there is no graphics card; the page says so in its table.
        assert [said for said in seen.console if said != "warning: No available adapters."] == []
        assert [address for address in seen.requests if not address.startswith(server.url)] == []
        return seen


def test_the_policy_keeps_the_balls_up_for_20_seconds_on_each_backend(bundle: Bundle) -> None:
    played: list[list[object]] = []
    for backend in ("js", "wasm"):
        played += [
            ["select", "#backend", backend],
            ["wait", "!document.querySelector('#backend').disabled"],
            ["click", "#pause"],
            ["click", "#reset"],
            ["wait", f"{STATUS}.seconds === '0'"],
            ["select", "#speed", "8"],
            ["click", "#pause"],
            ["wait", f"{STATUS}.seconds > 20.5"],
            ["eval", STATUS],
            ["eval", "document.querySelector('#canvas').getAttribute('aria-label')"],
        ]
    seen = see(bundle("3DBall"), *played, ["eval", VERDICT], ["eval", STATES], backends=())
    *each, verdict, states = seen.results[1:]
    for status, described in (each[8:10], each[18:20]):
        assert (status["good"], status["bad"]) == ("12", "0")
        assert described.startswith("12 tilting platforms")
    names = ["js", "cpu", "wasm", "webgl"]
    where = r"checked in your browser on [45] engines\. The original was not run\."
    assert re.match(rf"✓ Computes what was exported \(worst \S+\), {where}", verdict)
    assert states == [[name, "agrees"] for name in names]


def test_without_its_memory_the_hallway_is_a_guess(bundle: Bundle) -> None:
    """The page must feed each agent's own memory back, and begin anew with its episodes."""
    seen = see(bundle("Hallway"), ["select", "#speed", "8"], ["wait", f"Number({STATUS}.good) >= 12"], ["eval", STATUS])
    assert seen.results[-1]["bad"] == "0"


@pytest.mark.parametrize(("name", "least"), [("GridWorld", 10), ("Tennis-LeftBrain", 0), ("Tennis-RightBrain", 0)])
def test_the_other_environments_are_played(bundle: Bundle, name: str, least: int) -> None:
    seen = see(
        bundle(name),
        ["select", "#speed", "8"],
        ["wait", f"{STATUS}.seconds > 10 && Number({STATUS}.good) >= {least}"],
        ["click", "#poke"],
        ["click", "#step"],
        ["eval", "document.querySelector('#pause').textContent"],
        ["click", "#reset"],
        ["wait", f"{STATUS}.seconds === '0'"],
        ["eval", "document.querySelector('#problem').hidden"],
    )
    assert seen.results[-4] == "Play", "a single step pauses"
    assert seen.results[-1]


def test_a_slider_changes_the_action_to_what_python_answers(bundle: Bundle) -> None:
    folder = bundle("continuous")
    seen = see(
        folder,
        ["wait", DECIDED],
        NOTE,
        ["focus", ".slider input[type=range]"],
        ["press", "End"],
        ANOTHER,
        ["eval", "[...document.querySelectorAll('.slider input[type=number]')].map((box) => box.valueAsNumber)"],
        ["eval", ACTIONS],
    )
    values, after = seen.results[-2:]
    policy = load_policy(folder, runtime="numpy")
    expected = policy.decide(np.array([values], np.float32), deterministic=True).action[0]
    shown = [float(text.replace("−", "-")) for text in after]
    np.testing.assert_allclose(shown, expected, atol=6e-3)  # three digits are shown, of inputs with four


def test_masks_memory_and_chance_have_their_controls(bundle: Bundle) -> None:
    seen = see(
        bundle("recurrent"),
        ["wait", DECIDED],
        ["eval", ACTIONS],
        ["click", ".asking .boxes input[type=checkbox]"],  # the first action of the first branch
        ["wait", f"{ACTIONS}[0] === '0 %'"],
        ["click", "#next-step"],
        ["wait", "!document.querySelector('.asking canvas').getAttribute('aria-label').includes('all 0')"],
        ["click", ".asking fieldset button"],
        ["wait", "document.querySelector('.asking canvas').getAttribute('aria-label').includes('all 0')"],
    )
    assert seen.results[2][0] != "0 %"


def test_images_can_be_painted_and_filled(bundle: Bundle) -> None:
    seen = see(
        bundle("visual"),
        ["wait", DECIDED],
        ["eval", ACTIONS],
        NOTE,
        ["click", ".picture"],
        ANOTHER,
        NOTE,
        ["click", ".painting button"],
        ANOTHER,
        ["eval", ACTIONS],
    )
    assert seen.results[2] != seen.results[-1]


def test_a_wrong_answer_is_not_called_right(bundle: Bundle) -> None:
    site = assemble(bundle("discrete"))
    entry = next(e for e in json.loads(site["golden.json"])["cases"][0]["outputs"] if e["name"] == "value_estimate")
    data = bytearray(site["golden.bin"])
    at = slice(entry["offset"], entry["offset"] + 4)
    data[at] = (np.frombuffer(bytes(data[at]), "<f4") + np.float32(0.25)).tobytes()
    with served(with_backends({**site, "golden.bin": bytes(data)}, "js", "cpu", "wasm")) as server:
        seen = visit(server.url, [["wait", CHECKED], ["eval", VERDICT], ["eval", STATES]])
    assert seen.results[1].startswith("✗ Other answers: this page's own code is off by 0.250 at value_estimate")
    assert {state for _, state in seen.results[2]} == {"differs"}


def test_a_backend_that_fails_says_why(bundle: Bundle) -> None:
    site = assemble(bundle("continuous"))
    broken = {name: data for name, data in site.items() if not name.endswith(".wasm")}
    with served(broken) as server:
        seen = visit(
            server.url,
            [
                ["wait", CHECKED],
                ["eval", STATES],
                ["eval", "document.querySelector('[data-backend=wasm] .wide').textContent"],
                ["eval", VERDICT],
            ],
        )
    assert dict(seen.results[1]) == {"js": "agrees", "cpu": "agrees", "wasm": "did not run", "webgl": "agrees"}
    assert seen.results[2]
    assert "of 5 did not run" in seen.results[3]


def test_one_file_plays_from_the_disk(bundle: Bundle, tmp_path: Path) -> None:
    """By file://, with nothing beside it: the scene moves, the check passes, nothing is asked for or refused."""
    folder, page = tmp_path / "3DBall", tmp_path / "page.html"
    shutil.copytree(bundle("3DBall"), folder)
    found = [{"share": 0.12}, {"kind": "files"}, {"share": 3e-3}]
    report = {"passed": True, "original": "onnxruntime", "comparisons": found}
    (folder / "parity.json").write_text(json.dumps(report))
    page.write_bytes(assemble_one_file(folder))
    pixels = "document.querySelector('#canvas').toDataURL()"
    seen = visit(
        page.as_uri(),
        [
            ["wait", f"{STATUS}.seconds > 1"],
            ["eval", pixels],
            ["wait", f"{STATUS}.seconds > 2"],
            ["eval", pixels],
            ["wait", CHECKED],
            ["eval", VERDICT],
            ["eval", "document.querySelector('#loading')"],
        ],
    )
    assert seen.results[1] != seen.results[3]
    assert seen.results[-2].startswith("✓ Computes what was exported (worst ")
    assert seen.results[-2].endswith(" The export agreed with onnxruntime (at most 0.12 of the tolerance).")
    assert seen.results[-1] is None
    assert (seen.console, seen.requests) == ([], [page.as_uri()])


def test_a_hand_a_comparison_and_a_drop(bundle: Bundle, tmp_path: Path) -> None:
    """A ball is dragged, an untrained network loses what the trained one keeps, a dropped bundle acts or is refused."""
    page = tmp_path / "page.html"
    page.write_bytes(assemble_one_file(bundle("3DBall")))
    assert export_model(run_folder("3DBall"), "-o", tmp_path, "--to", "js", "--verify", "none").status == 0
    kept = ("3DBall.mjs", "policy.json")
    whole = [[name, base64.b64encode((tmp_path / "3DBall" / name).read_bytes()).decode()] for name in kept]
    x = "document.querySelector('.bars').rows[2].lastChild.textContent"
    said, titles = (
        "document.querySelector('#said').textContent",
        "document.querySelectorAll('.lane .title')[1].textContent",
    )
    second = "({...document.querySelector('#status-2').dataset})"
    seen = visit(
        f"{page.as_uri()}#speed=8",
        [
            ["wait", f"{STATUS}.seconds > 0.5"],
            ["click", "#pause"],
            ["drag", "#canvas", [0.385, 0.65], [0.44, 0.65]],
            ["eval", x],
            ["drag", "#canvas", [0.385, 0.65], [0.33, 0.65]],
            ["eval", x],
            ["click", "#reset"],
            ["click", "#pause"],
            ["wait", f"document.querySelector('#status-2') && {second}.bad > 12"],
            ["eval", STATUS],
            ["eval", "location.hash"],
            ["drop", [["notes.txt", ""]]],
            ["wait", f"{said}.includes('no policy.json with a module beside it')"],
            ["drop", [["policy.json", base64.b64encode(b'{"inputs": 1}').decode()]]],
            ["wait", f"{said}.includes('no contract of export-model')"],
            ["drop", whole[1:]],
            ["wait", f"{said}.includes('export it with js among --to')"],
            ["drop", whole],
            ["wait", f"{titles} === '3DBall (dropped here)' && {second}.seconds > 3"],
            ["eval", "document.querySelector('#apart').textContent"],
        ],
    )
    right, left = (float(seen.results[i].replace("−", "-")) for i in (3, 5))
    assert right > 0.3 > -0.3 > left
    assert seen.results[9]["bad"] == "0"
    assert seen.results[10] == "#speed=8", "what it opens with stands in no address"
    assert seen.results[-1] == "Now the answers differ by 0, the states by 0."
    asked = [address for address in seen.requests if not address.startswith("blob:")]  # the module that was dropped
    assert (seen.console, asked) == ([], [page.as_uri()])


def test_a_crawler_walks_ahead_and_lands_on_its_feet(bundle: Bundle, tmp_path: Path) -> None:
    """It is lifted and flicked while all else waits; then it comes down and walks on."""
    page = tmp_path / "page.html"
    page.write_bytes(assemble_one_file(bundle("Crawler2D")))
    seen_number = "Number(document.querySelector('.bars').rows[{}].lastChild.textContent.replace('−', '-'))"
    height, ahead = seen_number.format(0), seen_number.format(3)
    farthest = "parseFloat(document.querySelector('#status').textContent.replace('farthest ', ''))"
    seen = visit(
        # A walk begins anew after 20 s: at such a speed a busy machine is at neither of its hours a walk too late.
        f"{page.as_uri()}#speed=2",
        [
            ["wait", f"{STATUS}.seconds > 5"],
            ["click", "#pause"],
            ["eval", farthest],
            ["eval", f"{farthest} / {STATUS}.seconds"],
            ["eval", height],
            ["drag", "#canvas", [0.55, 0.85], [0.58, 0.74]],
            ["eval", height],
            ["eval", ahead],
            ["click", "#pause"],
            ["wait", f"{STATUS}.seconds > 15"],
            ["eval", farthest],
        ],
    )
    walked, pace, before, lifted, flicked, later = (seen.results[k] for k in (2, 3, 4, 6, 7, 10))
    assert 1.5 < pace < 2.5
    assert before < 0.6 < lifted  # of the third, which is the one that is shown since
    assert flicked > 0  # how fast is a matter of how long the hand was down
    assert later > walked + 10
    assert (seen.console, seen.requests) == ([], [page.as_uri()])


def test_two_engines_side_by_side_from_one_seed(tmp_path: Path) -> None:
    """In each other's place they act the same, as does an .onnx that is dropped; how little they differ is shown."""
    assert export_model(run_folder("3DBall"), "-o", tmp_path, "--to", "bytes,tfjs,onnx", "--verify", "none").status == 0
    words = "document.querySelector('#apart')?.textContent ?? ''"
    onnx = tmp_path / "3DBall" / "3DBall.onnx"
    played = "document.querySelector('#status-2')?.dataset.seconds > 2"
    site = with_backends(assemble(tmp_path / "3DBall"), "js", "cpu", "wasm", "onnxruntime-web")
    said, model = "document.querySelector('#said').textContent", tmp_path / "3DBall" / "tfjs"
    data = [[p.name, base64.b64encode(p.read_bytes()).decode()] for p in model.iterdir() if p.suffix != ".mts"]
    with served(site) as server:
        seen = visit(
            f"{server.url}#beside=wasm",
            [
                [
                    "wait",
                    f"{played} && document.querySelectorAll('.lane .title')[1].textContent.endsWith('(WebAssembly)')",
                ],
                ["eval", words],
                ["select", "#beside", "onnxruntime-web"],
                ["wait", "document.querySelectorAll('.lane .title')[1].textContent === 'On ONNX Runtime Web'"],
                ["wait", played],
                ["eval", words],
                ["drop", [["theirs.onnx", base64.b64encode(onnx.read_bytes()).decode()]]],
                ["wait", "document.querySelectorAll('.lane .title')[1].textContent === '3DBall (dropped here)'"],
                ["wait", played],
                ["eval", words],
                ["drop", [["notes.txt", ""]]],
                ["wait", f"{said}.includes('neither a tfjs/model.json')"],
                ["drop", [["model.json", base64.b64encode(b'{"modelTopology": {"node": []}}').decode()]]],
                ["wait", f"{said}.includes('no contract of export-model')"],
                ["select", "#beside", ""],
                ["drop", data],
                ["wait", "document.querySelectorAll('.lane .title')[1].textContent === '3DBall (dropped here)'"],
                ["wait", played],
                ["eval", words],
            ],
        )
    for said in (seen.results[1], seen.results[5], seen.results[9], seen.results[-1]):
        answers, states = (float(n) for n in re.findall(r"by (\S+?)[,.](?:\s|$)", said))
        assert 0 <= answers < 1e-3, said
        assert 0 <= states < 1e-3, said
    assert [said for said in seen.console if said != "warning: No available adapters."] == []


def test_the_site_opened_as_a_file_says_what_to_do(bundle: Bundle, tmp_path: Path) -> None:
    write_site(assemble(bundle("continuous")), tmp_path / "site")
    seen = visit(
        (tmp_path / "site" / "index.html").as_uri(), [["eval", "document.querySelector('#loading').innerText"]]
    )
    assert "export-model serve BUNDLE -o page.html" in seen.results[0]
