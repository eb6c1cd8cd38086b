"""An interface goes through every format and comes back as it was, a model's own metadata included."""

from __future__ import annotations

import json
from pathlib import Path

import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.export.sources import read_source
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.interface import Interface, Period, Quantity, Statement, Term, parse_interface
from tests.commands import export_model
from tests.interfaces.made import MJLAB, mjlab, run_with

TASK = "Mjlab-Lift-Cube-Yam"
READABLE = [key for key, f in WRITTEN.items() if f.read is not None]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of mjlab's policy in every format."""
    folder = tmp_path_factory.mktemp("mjlab")
    ran = export_model(mjlab(folder, TASK), "-o", folder / "out", "--to", ",".join(WRITTEN), "--verify", "none")
    assert ran.status == 0, ran.err
    return folder / "out" / "policy"


def interface_in(path: Path) -> Interface | None:
    (policy,) = read_source(path, ReadOptions()).policies()
    return policy.signature.interface


@pytest.mark.parametrize("key", READABLE)
def test_real_metadata_comes_back_from_every_format(written: Path, tmp_path: Path, key: str) -> None:
    found = interface_in(written / WRITTEN[key].main_of("policy"))
    assert found is not None
    assert dict(found.metadata) == MJLAB[TASK]["metadata"]
    assert found == interface_in(written.parent.parent / "policy.onnx")


@pytest.mark.parametrize("key", [k for k in WRITTEN if WRITTEN[k].held is not None])
def test_every_artefact_embeds_it(written: Path, key: str) -> None:
    held = WRITTEN[key].held
    assert held is not None
    text = held(written / WRITTEN[key].main_of("policy"))
    content = text if isinstance(text, dict) else json.loads(text)
    assert content["interface"]["metadata"] == MJLAB[TASK]["metadata"]


def test_the_written_onnx_has_the_metadata_that_robots_read(written: Path) -> None:
    model = onnx.load(written / "policy.onnx")
    found = {p.key: p.value for p in model.metadata_props if not p.key.startswith("export_model")}
    assert found == MJLAB[TASK]["metadata"]


def test_a_chain_of_formats_changes_nothing(written: Path, tmp_path: Path) -> None:
    first = interface_in(written)
    here = written / "policy.bytes"
    for step, key in enumerate(("tfjs", "onnx", "litert", "saved_model", "nn")):
        ran = export_model(here, "-o", tmp_path / str(step), "--to", key, "--verify", "none", "--name", "policy")
        assert ran.status == 0, ran.err
        here = tmp_path / str(step) / "policy" / WRITTEN[key].main_of("policy")
    assert interface_in(here) == first


def test_callers_are_told_scale_names_and_rate(tmp_path: Path) -> None:
    path = run_with(tmp_path, "IO_descriptors.yaml", place="io_descriptors")
    ran = export_model(path, "-o", tmp_path / "out", "--to", "onnx,bytes,c,csharp,js", "--verify", "none")
    assert ran.status == 0, ran.err
    bundle = tmp_path / "out" / "policy"
    told = [export_model("snippets", bundle, "--for", name).out for name in ("onnxruntime", "inference-engine")]
    told += [(bundle / f"policy.{end}").read_text() for end in ("h", "cs", "mjs")]
    for text in told:
        words = " ".join(text.replace("//", " ").replace("#", " ").split())
        assert "base_ang_vel (3, rad/s): feed (value, within -10 to 10) * 0.25" in words
        assert "apply action * 0.5 + [0.4, -0.8]" in words
        assert "a decision every 0.02 s (50 a second; IO_descriptors.yaml: scene.dt)" in words
    assert "0 hip, 1 knee" in told[0]


def test_a_name_cannot_leave_a_comment(tmp_path: Path) -> None:
    """What a stranger calls a term stays within the comment, and is not taken for the contract."""
    labels = {"interface": {"actions": [{"name": f"x */ int y; /* \\   {EMBEDDED}: {{}}", "size": 2, "scale": [2]}]}}
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    path = run_with(tmp_path)
    asked = ("--labels", tmp_path / "labels.json", "--to", "bytes,c,csharp,js", "--verify", "none")
    assert export_model(path, "-o", tmp_path / "out", *asked).status == 0
    for end in ("h", "cs", "mjs"):
        file = tmp_path / "out" / "policy" / f"policy.{end}"
        begin, _, _ = file.read_text().partition(EMBEDDED + ': {"schema"')
        assert "*/" not in begin
        held = WRITTEN[{"h": "c", "cs": "csharp", "mjs": "js"}[end]].held
        assert held is not None
        assert json.loads(held(file))["name"] == "policy"
    assert export_model("verify", tmp_path / "out", "--allow-unverified").status == 0


def test_inspect_and_reports_show_it(tmp_path: Path) -> None:
    path = run_with(tmp_path, "deploy.yaml")
    said = export_model("inspect", path).out
    assert "interface of state:" in said and "interface of action:" in said
    assert "deploy.yaml: observations.base_ang_vel" in said
    assert "kept as text: deploy.yaml: commands" in said
    html = tmp_path / "report.html"
    ran = export_model(path, "-o", tmp_path / "out", "--to", "onnx", "--html", html, "--verify", "onnxruntime")
    assert ran.status == 0, ran.err
    assert "Interface of action" in html.read_text()


names = st.text(st.characters(categories=("L", "N", "P", "Zs")), min_size=1, max_size=20).filter(str.isprintable)
numbers = st.floats(-1e6, 1e6)
ranges = st.tuples(st.none() | st.floats(-9, 0), st.none() | st.floats(0, 9))
terms = st.builds(
    Term,
    name=names,
    source=names,
    size=st.just(2),
    elements=st.sampled_from([(), ("a", "b")]),
    unit=st.none() | names,
    scale=st.lists(numbers, max_size=2).map(tuple),
    offset=st.lists(numbers, max_size=2).map(tuple),
    clip=st.lists(ranges, max_size=2).map(tuple),
    history=st.none() | st.integers(1, 9),
)
statements = st.builds(Statement, names, names)
quantities = st.builds(Quantity, name=names, source=names, values=st.lists(numbers, max_size=3).map(tuple))
interfaces = st.builds(
    Interface,
    st.dictionaries(st.sampled_from(["state", "state_1"]), st.lists(terms, min_size=1, max_size=3).map(tuple)),
    st.lists(terms, max_size=2).map(tuple),
    st.lists(terms, max_size=2).map(tuple),
    st.none() | st.builds(Period, st.floats(1e-6, 1e3), names),
    *(st.lists(s, max_size=2).map(tuple) for s in (statements, quantities, quantities, statements)),
    st.dictionaries(names, st.text(st.characters(exclude_categories=("Cs",)), max_size=30), max_size=3),
)


@given(interfaces)
def test_json_gives_back_what_was_written(made: Interface) -> None:
    again = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert parse_interface(again or None, ["state", "state_1"]) == (made or None)
