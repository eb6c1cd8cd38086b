"""Artefacts that play as their reference does, and what else play says: on the command line, and in Python."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

import export_model as public
from export_model.exporter.play.environments import ENVIRONMENTS
from export_model.exporter.play.episodes import SIDE_BY_SIDE, play_episodes
from export_model.exporter.play.named import world_maker
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.worlds import StepOutcome, WorldView
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.plays import DIFFERENT, EQUIVALENT, NOT_DECIDED
from export_model.signatures.errors import UsageError
from export_model.signatures.spec import PolicySignature
from fixtures import path as fixture
from fixtures import trained
from tests.commands import export_model, is_refused
from tests.play.conftest import FEW, Play
from tests.play.faults import order, through
from tests.reports.validation import check_play

ONE = VerifyOptions(runtimes="onnxruntime")
POLICIES = ("3DBall", "GridWorld", "Hallway", "Crawler2D", "Tennis-LeftBrain")


@pytest.mark.parametrize("name", POLICIES)
def test_a_bundle_plays_as_its_reference(name: str, bundles: Path, play: Play) -> None:
    report = play(bundles / name, name.split("-")[0], judging=ONE)
    assert report.passed is True, report.sentence
    (played,) = report.played
    assert (played.format, played.runtime, played.compared.verdict) == ("onnx", "onnxruntime", EQUIVALENT)
    said = trained.report()["policies"][name.split("-")[0]]["drawn"]
    assert report.episodes.success.mean() >= said["success"] - 0.05
    assert report.recorded >= 9
    assert (played.compared.equal == 200) is (name != "Crawler2D")  # whose steps are as chaotic as a walk's


def test_the_source_itself_is_the_reference_where_a_runtime_reads_it(bundles: Path, play: Play) -> None:
    report = play(
        trained.run_folder("GridWorld"), "GridWorld", judging=VerifyOptions(runtimes="tensorflow,onnxruntime")
    )
    assert report.reference == "source/tensorflow"
    assert {(p.format, p.runtime) for p in report.played} >= {("onnx", "onnxruntime"), ("saved_model", "tensorflow")}
    assert report.passed is True


def test_returns_are_those_of_the_environment_played_by_hand(bundles: Path, play: Play) -> None:
    """An oracle of its own: onnxruntime's session and the environment, without the actor."""
    import onnxruntime

    report = play(bundles / "GridWorld", "GridWorld", options=PlayOptions(FEW, 7, deterministic=True), judging=ONE)
    session = onnxruntime.InferenceSession(
        str(bundles / "GridWorld/GridWorld.onnx"), providers=["CPUExecutionProvider"]
    )
    environment = ENVIRONMENTS["GridWorld"](FEW)
    seen, _ = environment.reset(seed=int(np.random.SeedSequence((7, 0)).generate_state(1)[0]))
    total, playing = np.zeros(FEW), np.ones(FEW, bool)
    while playing.any():
        feeds = {"state": seen["state"], "action_masks": seen["action_masks"]}
        (action,) = session.run(["deterministic_action"], feeds)
        seen, rewards, terminated, truncated, _ = environment.step(action)
        total += rewards * playing
        playing &= ~(terminated | truncated)
    np.testing.assert_array_equal(report.played[0].episodes.returns, total)
    np.testing.assert_array_equal(report.episodes.returns, total)


def test_the_same_seed_gives_the_same_episodes_and_another_others(bundles: Path, play: Play) -> None:
    first, again, other = (
        play(bundles / "GridWorld", "GridWorld", options=PlayOptions(FEW, seed), judging=ONE) for seed in (1, 1, 2)
    )
    assert first.episodes.returns.tolist() == again.episodes.returns.tolist()
    assert first.episodes.lengths.tolist() != other.episodes.lengths.tolist()


def test_more_episodes_than_fit_side_by_side_are_played_in_turns(bundles: Path) -> None:
    policy = public.load(bundles / "Hallway", runtime="onnxruntime")
    world = world_maker("Hallway", bundles / "Hallway")(policy.signature)
    counts: list[int] = []
    found = play_episodes(world, policy, SIDE_BY_SIDE + 30, 0, advance=lambda done, count, rate: counts.append(done))
    assert len(found.returns) == SIDE_BY_SIDE + 30 and found.success.mean() > 0.99
    assert counts == sorted(counts) and counts[-1] == SIDE_BY_SIDE + 30
    # The turns are other episodes.
    assert found.lengths[:30].tolist() != found.lengths[SIDE_BY_SIDE:].tolist()


# ------------------------------------------------------------------ the other side


def test_the_bundle_beside_plays_the_other_side(bundles: Path, play: Play, tmp_path: Path) -> None:
    left = bundles / "Tennis-LeftBrain"
    beside = play(left, "Tennis", options=PlayOptions(FEW), judging=ONE)
    assert beside.notes == ("the other side is Tennis-RightBrain, in onnxruntime, without chance",)
    alone = tmp_path / "Tennis-LeftBrain"
    alone.symlink_to(left)
    by_rule = play(alone, "Tennis", options=PlayOptions(FEW), judging=ONE)
    assert by_rule.notes == ("the other side, RightBrain, is a player that follows the ball",)
    named = play(alone, "Tennis", options=PlayOptions(FEW), partner=bundles / "Tennis-RightBrain", judging=ONE)
    assert named.notes == beside.notes
    assert named.episodes.returns.tolist() == beside.episodes.returns.tolist() != by_rule.episodes.returns.tolist()


def test_a_partner_is_refused_where_one_policy_plays(bundles: Path) -> None:
    ran = export_model("play", bundles / "GridWorld", "--env", "GridWorld", "--partner", bundles / "Hallway")
    is_refused(ran, "--partner does not go with --env GridWorld")


# ------------------------------------------------------------------ what differs


def worse(bundles: Path, tmp_path: Path) -> Path:
    """GridWorld that goes up where it should go right, and right for up."""
    model = onnx.load(bundles / "GridWorld/GridWorld.onnx")
    through("action", "Gather", order(1, 0, 2, 3), axis=1)(model)
    onnx.save(model, tmp_path / "worse.onnx")
    return tmp_path / "worse.onnx"


def test_another_return_is_different(bundles: Path, tmp_path: Path, play: Play) -> None:
    report = play(bundles / "GridWorld", "GridWorld", worse(bundles, tmp_path), judging=ONE)
    assert report.passed is False
    (played,) = report.played
    assert played.compared.verdict == DIFFERENT and played.compared.high < -played.compared.margin
    assert "1 of 1 earn another return (onnx in onnxruntime)" in report.sentence


def test_the_command_says_so_with_its_status(bundles: Path, tmp_path: Path) -> None:
    where = (bundles / "GridWorld", "--env", "gridworld", "--runtimes", "onnxruntime")
    ran = export_model("play", *where)
    assert (ran.status, ran.err) == (0, "")
    assert "EQUIVALENT" in ran.out.splitlines()[-1]
    quiet = export_model("play", *where, "--quiet")
    assert (quiet.status, quiet.out, quiet.err) == (0, "", "")
    ran = export_model("play", where[0], worse(bundles, tmp_path), *where[1:], "--json")
    assert (ran.status, ran.json["verdict"], ran.json["passed"]) == (1, DIFFERENT, False)
    check_play(ran.out)
    ran = export_model("play", where[0], worse(bundles, tmp_path), *where[1:])
    assert ran.status == 1
    assert "onnx in onnxruntime: action differs" in ran.out and "first difference: action" in ran.out


def noisy(world: Any, spread: float) -> Any:
    """A world that rewards by chance, other chance for each player: nothing but more episodes decides."""
    chance = np.random.default_rng(0)
    step = world.step

    def stepped(*actions: Any) -> StepOutcome:
        after = step(*actions)
        return StepOutcome(
            after.view, after.rewards + chance.normal(0, spread, len(after.rewards)), after.ended, after.success
        )

    world.step = stepped
    return world


def test_what_more_episodes_would_decide_is_not_decided(bundles: Path, play: Play) -> None:
    make = world_maker("Hallway", bundles / "Hallway")
    report = play(bundles / "Hallway", lambda signature: noisy(make(signature), 0.1), judging=ONE)
    assert (report.passed, report.verdict) == (None, NOT_DECIDED)
    (played,) = report.undecided
    assert played.compared.needed is not None and played.compared.needed > 200
    assert f"about {played.compared.needed:,} episodes would decide" in "\n".join(report.lines())


def test_others_are_played_where_the_first_episodes_do_not_decide(bundles: Path, play: Play) -> None:
    make = world_maker("Hallway", bundles / "Hallway")
    found = {}
    for most in (0, 1600):
        options = PlayOptions(most=most)
        report = play(bundles / "Hallway", lambda signature: noisy(make(signature), 0.02), options=options, judging=ONE)
        (found[most],) = report.played
    assert (found[0].compared.verdict, found[0].compared.episodes) == (NOT_DECIDED, 200)
    assert found[0].compared.needed is not None
    assert found[1600].compared.verdict == EQUIVALENT
    assert 200 < found[1600].compared.episodes <= 1600
    assert len(found[1600].episodes.returns) == len(found[1600].reference.returns) == found[1600].compared.episodes
    # The others do not begin as the first do.
    first, others = np.split(found[1600].reference.lengths[:400], 2)
    assert first.tolist() == found[0].reference.lengths.tolist() != others.tolist()


def test_not_decided_is_a_failure_only_with_strict(bundles: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make = world_maker("Hallway", bundles / "Hallway")
    monkeypatch.setattr(
        "export_model.exporter.play.play.world_maker", lambda *_: lambda signature: noisy(make(signature), 0.1)
    )
    command = ("play", bundles / "Hallway", "--env", "Hallway", "--runtimes", "onnxruntime")
    assert export_model(*command).status == 0
    assert export_model(*command, "--strict").status == 1


# ------------------------------------------------------------------ what cannot be played


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--env", "Hallway"), "the policy does not fit the environment"),
        (("--env", "nowhere"), "unknown environment"),
        (("--env", "GridWorld", "--episodes", "19"), "whole number from 20"),
        (("--env", "GridWorld", "--margin", "0"), "must be a share"),
        (("--env", "GridWorld", "--seed", "-1"), "seed -1: must be a whole number"),
        (("--env", "GridWorld", "--verify", "none"), "nothing that plays"),
        ((), "--env"),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_runs(
    bundles: Path, arguments: tuple[str, ...], says: str
) -> None:
    ran = export_model("play", bundles / "GridWorld", *arguments)
    assert ran.status == 2 and says in ran.err and not ran.out


@pytest.mark.parametrize(
    ("source", "says"),
    [("GridWorld", "the policy does not fit the environment"), ("twobrains", "holds 2 policies")],
)
def test_a_source_that_cannot_play_is_refused_before_it_is_exported(
    source: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(*given: object) -> None:
        raise AssertionError("an artefact was written")

    monkeypatch.setattr("export_model.exporter.export.pipeline.artefacts_of", write)
    path = trained.run_folder(source) if source == "GridWorld" else fixture(source)
    ran = export_model("play", path, "--env", "3DBall")
    assert ran.status == 2 and says in ran.err and not ran.out


def test_a_bundle_that_was_changed_is_refused(bundles: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "GridWorld"
    shutil.copytree(bundles / "GridWorld", copy)
    with (copy / "GridWorld.onnx").open("ab") as file:
        file.write(b"\0")
    is_refused(export_model("play", copy, "--env", "GridWorld"), "has been changed since it was exported")


class Broken:
    """A world that rewards with what is not a number, or never ends."""

    def __init__(self, reward: float) -> None:
        self.name, self.notes, self._reward = "Broken", (), reward

    def begin(self, episodes: int, seed: int) -> WorldView:
        self._count = episodes
        return WorldView({"state": np.zeros((episodes, 8), np.float32)})

    def step(self, continuous: Any, discrete: Any) -> StepOutcome:
        nothing = np.zeros(self._count, bool)
        view = WorldView({"state": np.zeros((self._count, 8), np.float32)})
        return StepOutcome(view, np.full(self._count, self._reward), nothing, nothing)


@pytest.mark.parametrize(("reward", "says"), [(np.nan, "a reward of nan in step 1"), (0.0, "did not end within")])
def test_a_world_that_is_broken_is_refused(
    reward: float, says: str, play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export_model.exporter.play.episodes.MOST_STEPS", 5)

    def make(signature: PolicySignature) -> Broken:
        return Broken(reward)

    with pytest.raises(UsageError, match=says):
        play(fixture("continuous"), make, options=PlayOptions(FEW), judging=ONE)


def test_the_public_module_plays(bundles: Path) -> None:
    report = public.play(
        bundles / "Hallway", "Hallway", options=public.PlayOptions(episodes=FEW, margin="2%"), verify="onnxruntime"
    )
    assert report.passed is True
    assert json.loads(json.dumps(report.to_dict()))["margin"]["asked"] == "2%"
    assert "EQUIVALENT" in repr(report)


@pytest.mark.parametrize(("said", "threads"), [(None, "1"), ("3", "3")])
def test_numpy_takes_one_thread_in_a_command(said: str | None, threads: str, tmp_path: Path) -> None:
    """In a process of its own: the user's environment module says what it finds."""
    (tmp_path / "says.py").write_text("import os\nraise SystemExit(os.environ.get('OPENBLAS_NUM_THREADS'))\n")
    own = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    own |= {} if said is None else {"OPENBLAS_NUM_THREADS": said}
    command = (sys.executable, "-m", "export_model", "play", fixture("continuous"), "--env", "says:make")
    ran = subprocess.run(command, cwd=tmp_path, env=own, capture_output=True, text=True, check=False)
    assert threads in ran.stderr.splitlines(), ran.stderr
