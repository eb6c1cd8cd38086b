"""The page's files: all there, nothing foreign, the same bytes each time; and what is refused."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.javascript import node as javascript
from export_model.exporter.serve import site as site_of_bundles
from export_model.exporter.serve.onefile import one_file
from export_model.exporter.serve.scenes import other_side
from export_model.exporter.serve.server import TYPES
from export_model.exporter.serve.site import PAGE, assemble, assemble_one_file, write_site
from export_model.signatures.errors import BundleError, UnsupportedOpError, UsageError
from fixtures import path as fixture
from tests.commands import export_model, files_in, is_refused
from tests.exporting import load_policy
from tests.serve.conftest import Bundle

OWN = [p for p in sorted(PAGE.rglob("*")) if p.is_file()]


@pytest.mark.parametrize("path", OWN, ids=lambda p: p.relative_to(PAGE).as_posix())
def test_no_file_of_the_page_names_another_origin(path: Path) -> None:
    text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"(https?:)?//[a-z0-9.-]+\.[a-z]{2,}", text)
    assert path.suffix in TYPES, "the server would not serve it"


def test_every_file_that_is_named_is_there(bundle: Bundle) -> None:
    site = assemble(bundle("continuous"))
    for name, data in site.items():
        folder = Path(name).parent
        if name.endswith(".mjs"):
            for found in re.findall(rb'^(?:import|export) .*?from "(\.[^"]+)"', data, re.M):
                parts = [p for p in (folder / found.decode()).parts if p != "."]
                while ".." in parts:
                    at = parts.index("..")
                    del parts[at - 1 : at + 1]
                assert "/".join(parts) in site, (name, found)
    for found in re.findall(rb'(?:src|href)="([^"#]+)"', site["index.html"]):
        assert found.decode() in site
    said = json.loads(site["site.json"])
    assert [b["name"] for b in said["backends"]] == ["js", "cpu", "wasm", "webgl", "webgpu"]
    assert all(b["script"] is None or b["script"] in site for b in said["backends"])
    assert said["absent"] == []
    assert all(b"sourceMappingURL" not in data for name, data in site.items() if name.startswith("vendor/"))


def test_a_bundle_gives_the_same_bytes_each_time(bundle: Bundle) -> None:
    assert assemble(bundle("recurrent")) == assemble(bundle("recurrent"))


@pytest.mark.parametrize(
    ("name", "scene", "side"),
    [
        ("3DBall", "ball3d", None),
        ("GridWorld", "gridworld", None),
        ("Hallway", "hallway", None),
        ("Tennis-LeftBrain", "tennis", "left"),
        ("Tennis-RightBrain", "tennis", "right"),
        ("Crawler2D", "crawler2d", None),
        ("continuous", None, None),
    ],
)
def test_known_environments_are_found_by_name_and_shape(
    bundle: Bundle, name: str, scene: str | None, side: str | None
) -> None:
    said = json.loads(assemble(bundle(name))["site.json"])
    assert (said["scene"], said["side"]) == (scene, side)
    assert said["opponent"] == (other_side(name)[0] if side else None)


def test_a_scene_that_is_asked_for_must_fit(bundle: Bundle) -> None:
    assert json.loads(assemble(bundle("3DBall"), "none")["site.json"])["scene"] is None
    assert json.loads(assemble(bundle("3DBall"), "ball3d")["site.json"])["scene"] == "ball3d"
    with pytest.raises(UsageError, match="does not fit"):
        assemble(bundle("3DBall"), "gridworld")


def test_a_brain_without_the_other_plays_alone(bundle: Bundle, tmp_path: Path) -> None:
    shutil.copytree(bundle("Tennis-LeftBrain"), tmp_path / "Tennis-LeftBrain")
    site = assemble(tmp_path / "Tennis-LeftBrain")
    assert json.loads(site["site.json"])["opponent"] is None
    assert not any(name.startswith("opponent/") for name in site)


# ---- the golden inputs -----------------------------------------------------------------------------------------------


def tensor(data: bytes, entry: dict[str, Any]) -> np.ndarray:
    dtype = {"int64": "<i4", "int32": "<i4", "bool": "u1", "float32": "<f4"}[entry["dtype"]]
    count = int(np.prod(entry["shape"]))
    return np.frombuffer(data, dtype, count, entry["offset"]).reshape(entry["shape"]).astype(entry["dtype"])


@pytest.mark.parametrize("name", ["3DBall", "discrete", "Hallway", "visual"])
def test_golden_answers_are_onnxruntimes(bundle: Bundle, name: str, tmp_path: Path) -> None:
    """The reference comes from the numpy kernels; onnxruntime is the other opinion."""
    pytest.importorskip("onnxruntime")
    assert export_model(bundle(name) / f"{name}.bytes", "-o", tmp_path, "--to", "onnx", "--verify", "none").status == 0
    policy = load_policy(tmp_path / name, runtime="onnxruntime")
    site = assemble(bundle(name))
    said = json.loads(site["golden.json"])
    assert {c["rows"] for c in said["cases"]} >= {1, 2, 7}
    memory = policy.signature.memory
    assert sum(c["continues"] for c in said["cases"]) == (0 if memory is None else 3)
    for case in said["cases"]:
        feeds = {e["name"]: tensor(site["golden.bin"], e) for e in case["inputs"]}
        answers = policy.run(feeds, [e["name"] for e in case["outputs"]])
        for entry in case["outputs"]:
            if entry.get("floored") or entry.get("ties"):
                continue
            expected = tensor(site["golden.bin"], entry)
            bound = said["tolerance"][entry["name"]]
            np.testing.assert_allclose(answers[entry["name"]], expected, rtol=bound["rtol"], atol=bound["atol"])


def test_what_a_sampler_decides_is_not_golden(bundle: Bundle) -> None:
    said = json.loads(assemble(bundle("sampled"))["golden.json"])
    assert said["left_out"] == ["action"]
    assert all(e["name"] != "action" for c in said["cases"] for e in c["outputs"])


# ---- what is refused -------------------------------------------------------------------------------------------------


def test_bundles_that_cannot_be_shown_are_refused(bundle: Bundle, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="not a bundle"):
        assemble(tmp_path)
    source = bundle("continuous") / "continuous.bytes"
    for targets, missing in (("bytes", "tfjs/model.json"), ("tfjs", "continuous.bytes")):
        assert export_model(source, "-o", tmp_path, "--to", targets, "--verify", "none").status == 0
        with pytest.raises(BundleError, match=f"has no {re.escape(missing)}"):
            assemble(tmp_path / "continuous")
    changed = shutil.copytree(bundle("continuous"), tmp_path / "changed")
    (changed / "tfjs" / "model.json").write_text("{}")
    with pytest.raises(BundleError, match="changed since"):
        assemble(changed)


def test_without_the_npm_packages_the_page_runs_on_the_policys_module(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = bundle("continuous")
    monkeypatch.setenv(javascript.JS_VARIABLE, str(tmp_path))
    site = assemble(folder)
    said = json.loads(site["site.json"])
    assert [b["name"] for b in said["backends"]] == ["js"]
    assert all("export-model runtimes install tfjs" in a["why"] for a in said["absent"])
    assert not any(name.startswith("vendor/") for name in site)


# ---- one file --------------------------------------------------------------------------------------------------------

FILES = re.compile(rb'<script type="application/json" id="files">(.*?)</script>', re.S)


def test_one_file_is_small_and_holds_nothing_that_runs_but_one_script(bundle: Bundle) -> None:
    page = assemble_one_file(bundle("3DBall"))
    assert page == assemble_one_file(bundle("3DBall"))
    assert len(page) <= 200_000
    (script,) = re.findall(rb"<script>(.*?)</script>", page, re.S)
    digest = base64.b64encode(hashlib.sha256(script).digest()).decode()
    assert f"default-src 'none'; script-src 'sha256-{digest}' blob:; style-src 'sha256-".encode() in page
    assert not re.search(rb'(?:src|href)="(?!data:|#)', page)
    files = json.loads(FILES.findall(page)[0])
    assert files["policy.json"] == json.loads(assemble(bundle("3DBall"))["policy.json"])


def test_what_a_bundle_says_stays_data_in_one_file(bundle: Bundle) -> None:
    site = assemble(bundle("continuous"))
    evil = "</script><script>alert(1)</script><!--\u2028"
    site["policy.json"] = json.dumps({"labels": evil}).encode()
    page = one_file(site)
    assert page.count(b"</script>") == 2
    assert b"<!--" not in FILES.findall(page)[0]
    assert json.loads(FILES.findall(page)[0])["policy.json"] == {"labels": evil}


def test_one_file_replaces_only_its_own(bundle: Bundle, tmp_path: Path) -> None:
    place = tmp_path / "deep" / "page.html"
    for _ in range(2):
        ran = export_model("serve", bundle("continuous"), "-o", place)
        assert ran.status == 0, ran.err
        assert place.read_bytes() == assemble_one_file(bundle("continuous"))
    place.write_text("mine")
    is_refused(export_model("serve", bundle("continuous"), "-o", place), "already exists")
    assert files_in(tmp_path / "deep") == {"page.html"}


def test_a_page_is_not_made_of_a_damaged_model(bundle: Bundle, tmp_path: Path) -> None:
    """policy.json may have the hash of anything."""
    folder = shutil.copytree(bundle("continuous"), tmp_path / "continuous")
    content = (folder / "continuous.bytes").read_bytes()[:-900]
    (folder / "continuous.bytes").write_bytes(content)
    contract = json.loads((folder / "policy.json").read_text())
    contract["files"]["continuous.bytes"] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    (folder / "policy.json").write_text(json.dumps(contract))
    is_refused(export_model("serve", folder, "-o", tmp_path / "page.html"), "continuous")
    assert not (tmp_path / "page.html").exists()


def test_a_policy_that_is_no_module_is_shown_by_tensorflow_js_alone(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page says why; where there is no TensorFlow.js either, as in a page of one file, it is not made."""
    folder = bundle("continuous")

    def refuse(*_: object) -> None:
        raise UnsupportedOpError("Foo is not written as source code", issues=[])

    monkeypatch.setattr(site_of_bundles, "engine_of", refuse)
    said = json.loads(assemble(folder)["site.json"])
    assert "js" not in {b["name"] for b in said["backends"]}
    assert said["absent"] == [{"name": "js", "why": "Foo is not written as source code"}]
    with pytest.raises(BundleError, match="cannot be shown"):
        assemble_one_file(folder)
    monkeypatch.setenv(javascript.JS_VARIABLE, str(tmp_path))
    with pytest.raises(BundleError, match="cannot be shown"):
        assemble(folder)


def test_a_page_is_written_through_no_link(bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "victim.txt").write_text("mine")
    (tmp_path / ".page.html.new").symlink_to("victim.txt")
    assert export_model("serve", bundle("continuous"), "-o", tmp_path / "page.html").status == 0
    assert (tmp_path / "victim.txt").read_text() == "mine"
    assert not (tmp_path / "page.html").is_symlink()
    assert files_in(tmp_path) == {"victim.txt", ".page.html.new", "page.html"}


# ---- --out -----------------------------------------------------------------------------------------------------------


def test_out_writes_the_site_and_replaces_only_its_own(bundle: Bundle, tmp_path: Path) -> None:
    place = tmp_path / "deep" / "page"
    ran = export_model("serve", bundle("continuous"), "--out", place)
    assert ran.status == 0, ran.err
    site = assemble(bundle("continuous"))
    assert {name: (place / name).read_bytes() for name in site} == site
    assert {n for n in files_in(place) if (place / n).is_file()} == set(site)
    (place / "old.txt").write_text("of an older version")
    assert export_model("serve", bundle("3DBall"), "--out", place).status == 0
    assert not (place / "old.txt").exists()
    assert files_in(tmp_path / "deep") == {"page", *(f"page/{n}" for n in files_in(place))}


def test_a_camera_is_painted_in_the_layout_that_its_policy_takes() -> None:
    """PyTorch's images are [C, H, W]: a pixel's channels do not lie side by side."""
    node = javascript.node_executable()
    if node is None:
        pytest.skip("Node is not here")
    script = f"""
      import {{ fed, imageForm }} from "{(PAGE / "images.mjs").as_uri()}";
      const pixels = Float32Array.from({{ length: 2 * 3 * 2 }}, (_, i) => i / 16);
      const first = imageForm({{ shape: [null, 2, 2, 3] }}, {{ layout: "NCHW", range: [-16, 16] }});
      const last = imageForm({{ shape: [null, 2, 3, 2] }}, {{ layout: "NHWC", range: [0, 16] }});
      const plain = ({{ data, shape }}) => [[...data], shape];
      const free = imageForm({{ shape: [null, null, null, 3] }});
      console.log(JSON.stringify([plain(fed(pixels, first)), plain(fed(pixels, last)), free]));
    """
    command = [node, "--input-type=module", "--eval", script]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=True)
    (first, shape), (last, _), free = json.loads(done.stdout)
    rows = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
    np.testing.assert_allclose(np.reshape(first, shape), rows.transpose(2, 0, 1)[None] * 2 - 16)
    np.testing.assert_allclose(np.reshape(last, (2, 3, 2)), rows)
    assert (free["height"], free["width"], free["channels"]) == (36, 36, 3)


def test_a_source_is_exported_for_the_page(bundle: Bundle, tmp_path: Path) -> None:
    place = tmp_path / "page"
    ran = export_model("serve", fixture("continuous"), "--out", place)
    assert ran.status == 0
    assert "not verified" in ran.err
    assert (place / "model" / "model.json").read_bytes() == assemble(bundle("continuous"))["model/model.json"]
    is_refused(export_model("serve", fixture("twobrains"), "--out", place), "holds 2 policies", "-o exported")


@pytest.mark.parametrize("inside", ["notes.txt", "policy.json", "site.json"])
def test_out_never_replaces_what_is_not_ours(bundle: Bundle, tmp_path: Path, inside: str) -> None:
    place = tmp_path / "page"
    place.mkdir()
    (place / inside).write_text("{}")
    is_refused(export_model("serve", bundle("continuous"), "--out", place), "already exists")
    assert files_in(tmp_path) == {"page", f"page/{inside}"}
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(BundleError, match="already exists"):
        write_site({"index.html": b""}, file)


def test_out_and_open_contradict_each_other(bundle: Bundle, tmp_path: Path) -> None:
    is_refused(export_model("serve", bundle("continuous"), "--out", tmp_path / "x", "--open"), "--open")
