"""What README and the pages say of tolerances, options and limits is what the program does."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest

from export_model.converters.consumers.profiles import PROFILES, profile
from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.cli.app import app
from export_model.exporter.demo import BALL
from export_model.exporter.export.sources import read_source
from export_model.exporter.snippets.registry import TARGETS
from export_model.exporter.verify import cut, rounding, statistics
from export_model.exporter.verify.checks import decisions, densities, draws, mixed
from export_model.exporter.verify.difference import SHARE, SIZE
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.tolerances import ATOL, RTOL, Tolerance, tolerance_for
from export_model.exporter.verify.work import SECONDS
from export_model.signatures.errors import ParityError, RuntimeUnavailableError, SourceError, UsageError
from export_model.signatures.masks import MOST_FORBIDDEN
from export_model.signatures.sampling import HUGE_BATCH, LARGE_BATCH, MOST_IDS, draw_cases
from fixtures import path
from tests.commands import ROOT, export_model
from tests.docs.blocks import name_of, pages
from tests.faults.judging import ROWS
from tests.support_tables import section

#: Options of other programs that the pages show.
FOREIGN = {
    *(
        "--allow-tcp",
        "--rm",
        "--disable-gpu",
        "--no-sandbox",
        "--input_format",
        "--output_format",
        "--user",
        "--inputs",
        "--outputs",
        "--first",
        "--write",  # of python -m tests.faults
    ),
}
NUMBER = re.compile(r"1e-5 \+ 1e-5·\|b\|")


def prose(page: Path) -> str:
    return " ".join(page.read_text(encoding="utf-8").split())


def options() -> set[str]:
    """All options of the command line, of every command, and its own ones."""
    found = {o for p in app.params for o in p.opts}
    for name in app.commands:
        command = app.commands[name]
        every = [command, *(command.commands.values() if isinstance(command, click.Group) else ())]
        found |= {o for c in every for p in c.params for o in (*p.opts, *p.secondary_opts)}
    return found | {"--help"}


@pytest.mark.parametrize("page", [p for p in pages() if name_of(p) != "CHANGELOG.md"], ids=name_of)
def test_every_option_in_the_text_is_one(page: Path) -> None:
    """In words and code spans; the blocks of a page are run."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    named = set(re.findall(r"`(--[a-z0-9_-]+)[^`]*`", text))
    assert named - FOREIGN <= options()


@pytest.mark.parametrize("name", ["README.md", "docs/index.md", "docs/agreement.md"])
def test_the_rule_is_the_one_that_is_applied(name: str) -> None:
    text = prose(ROOT / name)
    assert (ATOL, RTOL) == (1e-5, 1e-5)
    assert VerifyOptions().tolerance == Tolerance(1e-5, 1e-5)
    assert "1e-5" in text
    assert re.search(r"rounding was measured to explain", text), "the bound that goes before the tolerance"
    assert "never a warning" not in text
    for found in re.finditer(r"\|a − b\| ≤ ([\w.-]+) \+ ([\w.-]+)·\|b\|", text):
        assert found.groups() in {("1e-5", "1e-5"), ("atol", "rtol"), ("t", "t")}


def test_the_figures_of_agreement_are_those_of_the_program() -> None:
    text = prose(ROOT / "docs" / "agreement.md")
    words = {1: "one", 2: "two", 4: "four", 6: "six", 18: "eighteen"}
    for claim in (
        f"at most {words[rounding.FACTOR]} times the largest movement",
        f"{words[rounding.RUNS]} runs, and {words[rounding.MORE_RUNS]} more",
        "calls a right sampler wrong once in 10⁶ times",
        f"at {mixed.DRAWS} rows of many inputs in one batch ({mixed.FEW} with",
        f"classes against the reference's log-probabilities, {mixed.DRAWS} draws",
        "down to one in 10⁹",
        f"and {LARGE_BATCH}, and of vectors alone one of {HUGE_BATCH:,} in",
        f"no more than {MOST_IDS} ",
        f"about {SECONDS} seconds of inputs",
        "never less than 2⁻¹⁷",
        "a thousandth of its variation",
        "`action_probs` (5e-3)",
        draws.CLASSES_SEEN,
        draws.NUMBERS_SEEN,
    ):
        assert claim in text, claim
    assert (SHARE, SIZE) == (1e-3, 2.0**-17)
    assert (1e-6, float(np.log(1e-9))) == (statistics.FALSE_ALARM, cut.NEVER)
    assert densities.DENSITY_DRAWS == densities.KINDS * 512
    formats = prose(ROOT / "docs" / "formats.md")
    assert decisions.LIMITS == {"float16": 0.01, "int8": 0.05}
    assert "at most 1% (float16) or 5% (int8) of the choices" in formats


#: What docs/agreement.md says in figures before its part on reports, and where it is held to what is.
HELD_BY = {
    r"status 3 with `--require all`": "tests/reports/test_partial.py",
    r"NOT VERIFIED with the reason \(status 3\)": "tests/exporter/test_verdicts.py",
    r"N\(0, 1\); zeros; the ±5 clip and beyond; 8 to 10,000": "test_the_inputs_of_agreement_are_those_that_are_drawn",
    r"\(with noise up to ±6\)|\(N\(0, 1\), and up to ±6\)": "test_the_inputs_of_agreement_are_those_that_are_drawn",
    r"batches of 1 to 5, .* alone one of 4,096": "test_the_inputs_of_agreement_are_those_that_are_drawn",
    r"\(1, 2, 7, 32, 64 and 67 with images": "test_the_inputs_of_agreement_are_those_that_are_drawn",
    r"\(64 actions at most\)|no more than 512": "test_the_inputs_of_agreement_are_those_that_are_drawn",
    r"unknown tables get 0 and 1": "tests/verify/test_inputs.py",
    r"about 20 seconds of inputs and 20 of draws": "test_the_figures_of_agreement_are_those_of_the_program",
    r"with 1e-5 for both|within 1e-5 (of the best one's|or rounding)": "test_the_rule_is_the_one_that_is_applied",
    r"no int64: int32 there": "tests/verify/test_bounds.py",
    r"2⁻¹⁷ of the number itself|`action_probs` \(5e-3\)": "test_the_figures_of_agreement_are_those_of_the_program",
    r"n·2⁻¹²⁶ of .* or 0 \||numbers below 2⁻¹²⁶": "tests/faults/test_excuses.py",
    r"log\(sigmoid\(−(18|30)\)\)|log\(0\) − log\(0\)": "tests/faults/test_excuses.py",
    r"in 10⁹|4096 rows of many inputs in one batch \(1024": "test_the_figures_of_agreement_are_those_of_the_program",
    r"once in 10⁶ times|\(below 1e-9\)": "test_the_figures_of_agreement_are_those_of_the_program",
    r"4096 draws \(a .* by 0\.012\)|512 for each of eight": "test_the_figures_of_agreement_are_those_of_the_program",
    r"noise must be N\(0, 1\)": "tests/acting",
    r"an output × 0|4,096 of the policy's own inputs": "test_the_inputs_of_agreement_are_those_that_are_drawn",
    r"all 155 model files of the genuine cases \(87 .*, 24 `\.onnx`\)": "tests/corpus/test_every_frozen_graph.py",
    r"log\(1 − tanh² \+ ε\)|float(32|64)": "tests/docs/test_claims.py",  # names
}


def test_every_figure_of_agreement_is_held() -> None:
    text = (ROOT / "docs" / "agreement.md").read_text(encoding="utf-8").partition("## Reports")[0]
    text = " ".join(re.sub(r"```.*?```|\]\([^)]*\)", "", text, flags=re.DOTALL).split())
    for claim, test in HELD_BY.items():
        text, times = re.subn(claim, "", text)
        assert times, f"the page no longer says {claim}"
        assert test in globals() or (ROOT / test).exists(), test
    assert not re.findall(r"\S*\d\S*", text)


def test_the_inputs_of_agreement_are_those_that_are_drawn() -> None:
    text = prose(ROOT / "docs" / "agreement.md")
    said = re.search(r"batches of 1 to 5, ([\d, and]+), and of .* rows \(([\d, and]+) with images", text)
    assert said is not None
    for fixture, batches in (("continuous", f"1, 2, 3, 4, 5, {said[1]}, {HUGE_BATCH}"), ("visual", said[2])):
        (policy,) = read_source(path(fixture)).policies()
        cases = {c.name: c for c in draw_cases(policy.signature)}
        assert {int(n) for n in re.findall(r"\d+", batches)} <= {c.batch for c in cases.values()}
        greatest = {name: {k: np.abs(v).max() for k, v in case.feeds.items()} for name, case in cases.items()}
        assert greatest["zeros"]["state"] == 0
        assert 5 <= greatest["clip edges"]["state"] < greatest["beyond the clip"]["state"]
        assert 1e3 < greatest["8 to 1e4"]["state"] <= 1e4
        assert max(g["epsilon"] for g in greatest.values()) == pytest.approx(6, abs=0.1)
    assert f"({MOST_FORBIDDEN} actions at most)" in text
    assert f"at {ROWS:,} of the policy's own inputs" in text


def test_the_exception_is_as_the_page_says() -> None:
    class Sac:
        algorithm = "SAC"

    held = tolerance_for(Sac(), "action_probs", Tolerance())  # type: ignore[arg-type]
    assert (held.atol, held.rtol) == (5e-3, 5e-3)
    assert held.reason
    assert tolerance_for(Sac(), "action", Tolerance()) == Tolerance()  # type: ignore[arg-type]


#: What README and the front page say in figures, and where it is held to what is.
HELD = (
    r"0 of [\d,]+ comparisons failed · \d+ trained [\w ]+ and \d+ that [\w ]+ · \d+ runtimes",  # test_figures.py
    r"\d+ trained [\w ]+, and \d+ that the trainers of ML-Agents 0\.3 to 0\.22 wrote",  # test_figures.py
    r"[\d,]+ comparisons in \d+ runtimes",  # test_figures.py
    r"\|a − b\| ≤ 1e-5 \+ 1e-5·\|b\|",  # test_the_rule_is_the_one_that_is_applied
    r"1e-5 \+ 1e-5·\|b\|",
    r"exit status 1",  # tests/reports/test_options.py
    r"Exit status: 0 done, 1 something disagrees, 2 bad input or command line, 3 a runtime",
    r"ML-Agents 0\.1 to 1\.1",  # test_the_words_of_readme…
    r"Python 3\.11 to 3\.13 with `venv`, and Node 20: what the tests run on; pip installs it on 3\.14",
    r"Apache-2\.0",
    r"3DBall|Stable-Baselines3|float32|`model_1500\.pt`|`export-model model_1500\.pt --to c`|--for unity6",
)


@pytest.mark.parametrize("name", ["README.md", "docs/index.md"])
def test_every_figure_of_the_front_pages_is_held(name: str) -> None:
    text = re.sub(r"<!--.*?-->|```.*?```|\]\([^)]*\)", "", (ROOT / name).read_text(encoding="utf-8"), flags=re.DOTALL)
    text = " ".join(text.split())
    for claim in HELD:
        text = re.sub(claim, "", text)
    assert not re.findall(r"\S*\d\S*", text)


def test_the_words_of_readme_are_those_of_the_project() -> None:
    readme = prose(ROOT / "README.md")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    workflow = (ROOT / ".github/workflows/test.yml").read_text(encoding="utf-8")
    tested = json.loads(re.findall(r"matrix: \{ python: (\[.*?\])", workflow)[0])
    assert f"Python {tested[0]} to {tested[-1]} with" in readme and project["requires-python"] == ">=3.11,<3.15"
    assert f"{project['license']}. Tested on Linux" in readme
    table = section("Generations of ML-Agents").partition("### What")[0]
    rows = re.findall(r"^\| (\d[^|]*) \|", table, re.M)
    oldest, newest = re.findall(r"[\d.]*\d", rows[0])[0], re.findall(r"[\d.]*\d", rows[-1])[-1]
    assert f"ML-Agents {oldest} to {newest}," in readme
    statuses = {e.__name__: e.exit_status for e in (ParityError, SourceError, UsageError, RuntimeUnavailableError)}
    assert statuses == {"ParityError": 1, "SourceError": 2, "UsageError": 2, "RuntimeUnavailableError": 3}


def test_the_sizes_that_readme_shows_are_those_that_are_written(tmp_path: Path) -> None:
    """Within a tenth: of the formats, some are written a little smaller or larger from day to day."""
    (written,) = export_model(BALL, "-o", tmp_path, "--verify", "none", "--json").json["policies"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = {kind: float(size) for kind, size in re.findall(r"^ok +(\w+) +\S+ +([\d.]+) kB", readme, re.M)}
    assert shown.keys() == written["sizes"].keys()
    for kind, size in written["sizes"].items():
        assert shown[kind] == pytest.approx(size / 1e3, rel=0.1), kind


def test_the_verdict_that_readme_shows_is_one_that_is_said() -> None:
    defaults = [key for key, kind in WRITTEN.items() if kind.default]
    count = f"({len(defaults)} of {len(defaults)} formats)"
    said = f"PASSED: {', '.join(defaults)} {count} agree with the original in TensorFlow"
    assert said in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_changelog_is_short() -> None:
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 80


#: Option → the words that it takes, of whichever command shows it.
WORDS = {
    "--for": {"help", "serving"} | {n for p in PROFILES for n in (p.name, *p.aliases)} | {t.name for t in TARGETS},
    "--to": {*WRITTEN},
}


@pytest.mark.parametrize("page", pages(), ids=name_of)
@pytest.mark.parametrize("option", WORDS)
def test_every_word_of_an_option_is_one_that_it_takes(page: Path, option: str) -> None:
    """In code spans and in the blocks."""
    text = " ; ".join(re.findall(r"```.*?```|`[^`]+`", page.read_text(encoding="utf-8"), re.DOTALL))
    said = {word for found in re.findall(rf"{option}[ =]([a-z][\w.,-]*\w)", text) for word in found.split(",")}
    new = {"steps"} if name_of(page) == "docs/extending.md" else set()  # what that page adds
    assert said - new <= WORDS[option] | {t.name for t in TARGETS if option == "--for"}


def test_what_is_said_not_to_be_done_is_not() -> None:
    text = prose(ROOT / "docs" / "index.md").partition("## Not for")[2]
    for claim in ("Pruning, retraining, quantising activations", "Core ML or TensorRT", "Running Unity"):
        assert claim in text, claim
    assert not {k for k in WRITTEN if re.search("coreml|mlmodel|tensorrt|engine", k)}
    assert not {o for o in options() if re.search("prune|retrain|activations", o)}
    assert "anything beyond the op table is refused by name" in text


def test_the_loaders_that_robots_md_names_are_held_to_what_it_says() -> None:
    text = prose(ROOT / "docs" / "robots.md")
    assert "opset 11" in text and profile("isaac-lab").opset == 11
    for name in (n for p in PROFILES if p.loaders for n in (p.name,)):
        assert f"| `{name}` |" in text


def test_the_files_and_the_help_are_as_short_as_is_said() -> None:
    """A page of one file weighs about what is said (tests/serve holds it below 200 kB), the help twelve options."""
    said = {int(n) for n in re.findall(r"one file, (\d+) kB", prose(ROOT / "docs/web.md"))}
    assert said and max(said) <= 200
    shown = export_model("--help").out.splitlines()
    assert len(shown) <= 30 and max(map(len, shown)) <= 80
    assert "twelve options" in prose(ROOT / "docs" / "start.md")
    assert len({o for line in shown for o in re.findall(r"^  (?:-\w, )?(--[a-z-]+|-[vq])", line)}) in (11, 12, 13)
