"""One policy in one world: the reference plays and is recorded, every artefact in every runtime plays beside it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.embed import runnable
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.play.episodes import Episodes, Watch, play_episodes, turn_seed
from export_model.exporter.play.equivalence import Equivalence, equivalence, is_out_of_reach, look_sizes, share_error
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.play.recording import Recorder
from export_model.exporter.play.replay import replay
from export_model.exporter.play.worlds import MakeWorld
from export_model.exporter.verify.asked import Inputs
from export_model.exporter.verify.checks.rollout import rollout
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.participants import Participant, PolicyUnderTest
from export_model.exporter.verify.plays import CONFIDENCE, DIFFERENT, EQUIVALENT, NOT_DECIDED
from export_model.exporter.verify.reference import Reference
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.trial import Trial
from export_model.exporter.verify.verification import Participants, verify
from export_model.signatures.batches import Arrays, Run
from export_model.signatures.errors import ExportModelError
from export_model.signatures.spec import PolicySignature

Progress = Callable[[str], None]
#: Turns that no first episodes reach: their seeds are those of others.
_MORE = 1 << 31


class PlayedArtifact(Struct, frozen=True):
    """One artefact in one runtime: its episodes, and how their returns compare with the reference's."""

    format: str
    runtime: str
    episodes: Episodes
    compared: Equivalence
    #: the reference's episodes that begin like these
    reference: Episodes

    @property
    def where(self) -> str:
        """The format and the runtime."""
        return f"{self.format} in {self.runtime}"

    @property
    def sentence(self) -> str:
        """What is wrong or open; empty where it is equivalent."""
        c = self.compared
        if c.verdict == EQUIVALENT:
            return ""
        off = (
            f"mean return {c.difference:+.3g} ({CONFIDENCE:.0%}: {c.low:+.3g} to {c.high:+.3g}), margin {c.margin:.3g}"
        )
        if c.verdict == DIFFERENT:
            return f"different: {off}"
        needed = "no number of episodes" if c.needed is None else f"about {c.needed:,} episodes"
        return f"not decided: {off}; {needed} would decide (--episodes)"


class Match:
    """The episodes of one policy; ``judge`` is what a comparison makes of its candidates."""

    def __init__(self, make_world: MakeWorld, options: PlayOptions) -> None:
        self._make_world, self._options = make_world, options
        self.policy: Policy | None = None
        self.reference: Episodes | None = None
        #: what played as the reference: ``source/tensorflow``, ``numpy``
        self.reference_name = ""
        self.played: list[PlayedArtifact] = []
        self.notes: tuple[str, ...] = ()
        self.world_name = ""
        #: steps that were kept for the replay
        self.recorded = 0
        #: plays as the reference; its episodes by how many more were asked for
        self._actor_of_reference: LoadedPolicy | None = None
        self._more: dict[int, Episodes] = {}
        self._progress: Progress = lambda text: None

    def take_policy(self, policy: Policy) -> None:
        """Take the policy that is played. Raises UsageError where it does not fit the environment."""
        self.policy = policy
        self._world = self._make_world(policy.signature)
        self.notes, self.world_name = self._world.notes, self._world.name

    @property
    def margin(self) -> float:
        """How far mean returns may be apart."""
        assert self.reference is not None
        return self._options.bound.of(self.reference.returns)

    def judge(
        self,
        tested: PolicyUnderTest,
        session: Session,
        participants: Participants | None,
    ) -> ParityReport:
        """Return the report on the replay; what was played is kept here."""
        self._progress = session.progress

        def record(reference: Reference) -> Inputs:
            return self._record(tested, reference)

        checks = (replay, rollout, self._play)
        return verify(tested, session, participants, record, checks)

    def _record(self, tested: PolicyUnderTest, reference: Reference) -> Inputs:
        """Have the reference play, and keep what it met."""
        assert self.policy is not None
        recorder = Recorder(tested.signature)
        actor = self._actor(_run_of(reference), reference.name)
        actor = self._actor(recorder.recording(self._acting(actor, _run_of(reference))), reference.name)
        episodes = self._episodes(actor, f"the reference, {reference.name}", watch=recorder.watch)
        if tested.graph is self.policy.graph:
            self.reference, self.reference_name = episodes, reference.name
            self._actor_of_reference, self._more = actor, {}
        elif self.reference is None:  # rounded weights are held against themselves by numbers, by returns against these
            graph = runnable(self.policy.graph)
            whole = self._actor(lambda feeds, fetch: run_graph(graph, feeds, fetch), "numpy")
            self.reference, self.reference_name = self._episodes(whole, "the reference, numpy"), "numpy"
            self._actor_of_reference = whole
        inputs = recorder.inputs()
        self.recorded = max(self.recorded, len(inputs.cases))
        return inputs

    def _play(self, trial: Trial, participant: Participant) -> Iterator[Finding]:
        """Have a participant play; what comes of it is no finding of numbers. Raises RunFailedError."""
        assert self.reference is not None

        def run(feeds: Arrays, fetch: Sequence[str]) -> dict[str, np.ndarray]:
            return participant.run([feeds], fetch)[0]

        assert self.policy is not None
        given = tuple(s for s in self.policy.signature.outputs if s.name in participant.outputs)
        signature = replace(self.policy.signature, outputs=given)  # without log-probabilities it draws by itself
        if [h.name for h in signature.heads] != [h.name for h in self.policy.signature.heads]:
            signature = self.policy.signature
        actor = self._actor(run, participant.runtime, signature)
        wanted = actor.needed_outputs(deterministic=self._options.deterministic)
        lacks = [name for name in wanted if name not in participant.outputs]
        if lacks:
            if ":" not in participant.format:  # a SavedModel's other signatures are for other callers
                raise RunFailedError("cannot play", why=f"it has no output {lacks[0]!r}")
            return
        actor = self._actor(self._acting(actor, run), participant.runtime, signature)
        try:
            self.played.append(self._beside_reference(actor, participant))
        except RunFailedError:
            raise
        except ExportModelError as error:  # what it decided is not an action
            raise RunFailedError(
                "stopped playing", why=f"{error.what}: {error.why}" if error.why else error.what
            ) from error
        yield from ()

    def _beside_reference(self, actor: LoadedPolicy, participant: Participant) -> PlayedArtifact:
        """Return what came of the episodes, those that the reference plays beside them kept for the next."""
        name, runtime = participant.name, participant.runtime
        who = f"{name} in {runtime}"

        def reference(more: int) -> Episodes:
            if not more:
                assert self.reference is not None
                return self.reference
            if more not in self._more:
                assert self._actor_of_reference is not None
                said = f"the reference, {self.reference_name}"
                self._more[more] = self._episodes(self._actor_of_reference, said, more)
            return self._more[more]

        decided = decide(reference, lambda more: self._episodes(actor, who, more), self._options, self.margin)
        return PlayedArtifact(name, runtime, *decided)

    def _actor(self, run: Run, runtime: str, signature: PolicySignature | None = None) -> LoadedPolicy:
        assert self.policy is not None
        signature = signature or self.policy.signature
        source = self.policy.source
        kept = source.noise_kept and bool(source.noise)
        return LoadedPolicy(self.policy.name, signature, run, runtime, draws_itself=kept)

    def _acting(self, actor: LoadedPolicy, run: Run) -> Run:
        """Return ``run``, asked for what a decision takes alone."""
        names = actor.needed_outputs(deterministic=self._options.deterministic)
        return lambda feeds, fetch: run(feeds, names)

    def _episodes(
        self, actor: LoadedPolicy, who: str, more: int = 0, watch: Watch = lambda step, playing: None
    ) -> Episodes:
        """Play the first episodes, or ``more`` others."""
        options, begun = self._options, time.monotonic()
        self._progress(f"{who} plays {more or options.episodes} episodes")

        def advance(ended: int, count: int, rate: float) -> None:
            left = (time.monotonic() - begun) * (count - ended) / ended
            self._progress(f"{who}: {ended} of {count} episodes, {rate:,.0f} decisions/s, {left:.0f} s left")

        return play_episodes(
            self._world,
            actor,
            more or options.episodes,
            seed_of(options.seed, more),
            deterministic=options.deterministic,
            watch=watch,
            advance=advance,
        )


def seed_of(seed: int, more: int) -> int:
    """Return the seed of the first episodes (``more`` 0), or of so many others."""
    return turn_seed(seed, _MORE + more) if more else seed


def decide(
    reference: Callable[[int], Episodes], candidate: Callable[[int], Episodes], options: PlayOptions, margin: float
) -> tuple[Episodes, Equivalence, Episodes]:
    """Return the candidate's episodes, the verdict on them, and the reference's that begin like these.

    Both play the first episodes when called with 0. Where those do not decide, others join them, look by look
    (exporter/play/equivalence.py), unless far more than ``most`` would be needed.
    """
    sizes = look_sizes(options.episodes, options.most)
    own, episodes = reference(0), candidate(0)
    for look, tail in enumerate(share_error(len(sizes))):
        if look:
            own, episodes = own.join(reference(sizes[look])), episodes.join(candidate(sizes[look]))
        compared = equivalence(own.returns, episodes.returns, margin, tail)
        if compared.verdict != NOT_DECIDED or is_out_of_reach(compared, sum(sizes), tail):
            break
    return episodes, compared, own


def _run_of(reference: Reference) -> Run:
    """Return how the reference acts: the source where it answers, the numpy kernels for the rest."""

    def run(feeds: Arrays, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        answers = {} if reference.original is None else reference.original.run(feeds)
        rest = [name for name in fetch if name not in answers]
        if rest:
            answers.update(reference.run([feeds], rest)[0])
        return answers

    return run
