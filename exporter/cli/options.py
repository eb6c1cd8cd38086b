"""Options that several commands have, each group collected into what the job takes. Imports click only."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Container, Sequence
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from export_model.exporter.cli.console import Console
from export_model.exporter.cli.rows import CANDIDATE, FILE, READING
from export_model.signatures.errors import UsageError, suggestion

#: A value that each option of pairs takes.
_EXAMPLES = {
    "--map": "action=Identity",
    "--input": "obs=vector_observation",
    "--output": "Identity=continuous",
    "--set": "speed=0.5",
}

#: What those want who give such an option a file, as other tools do.
_PLACES = {"--output": " (where to write is -o DIR)", "--input": " (a file to read needs no option)"}


def pairs(values: Sequence[str], flag: str) -> dict[str, str]:
    """NAME=VALUE, given any number of times. Raises UsageError."""
    found = {}
    for value in values:
        name, equals, rest = value.partition("=")
        if not equals or not name or not rest:
            fix = f"for example {flag} {_EXAMPLES[flag]}{_PLACES.get(flag, '')}"
            raise UsageError(f"{flag} {value}: NAME=VALUE is expected", fix=fix)
        found[name] = rest
    return found


def one_bundle(place: Path, command: str) -> Path:
    """The bundle at ``place``, or the only one in that folder; else the place itself. Raises UsageError for several."""
    from export_model.converters.formats.bundle.bundle import bundles_in
    from export_model.exporter.tables import command_text

    found = bundles_in(place)
    if len(found) > 1:
        names = ", ".join(p.name for p in found)
        raise UsageError(
            f"{place} holds {len(found)} bundles", why=names, fix=f"choose one: {command_text(command, found[0])}"
        )
    return found[0] if found else place


def as_given(names: Container[str]) -> list[str]:
    """The options of this call whose parameters ``names`` has, word for word, where the command line had them.

    What ``reading_candidates`` adds counts as what it repeats.
    """
    from export_model.converters.files.fetch import path_text

    context = click.get_current_context()
    words: list[str] = []
    for option in context.command.params:
        name = option.name
        if not isinstance(option, click.Option) or name is None or name.removeprefix(CANDIDATE) not in names:
            continue
        if context.get_parameter_source(name) is not ParameterSource.COMMANDLINE:
            continue
        if option.is_flag:
            words.append(option.opts[0])
            continue
        values = context.params[name] if option.multiple else [context.params[name]]
        told = (path_text(value) if isinstance(value, Path) else str(value) for value in values)
        words += [word for value in told for word in (option.opts[0], value)]
    return words


#: What decides how a policy is read and judged. A report that says how to compare again has these as they were given.
JUDGING = frozenset(
    ("mapped", "source", *(row.name for row in READING), "golden", "sizes", "tolerances", "atol", "rtol", "required")
)
#: What of it a bundle is verified with that an export was judged by.
RULES = frozenset(("golden", "sizes", "tolerances", "atol", "rtol", "required"))


def sensors_of(text: str | None) -> tuple[tuple[tuple[int, ...], ...], tuple[int, ...]]:
    """The shapes that ``--sensors`` gives, and the places of those that are goals.

    ``"8,goal:3,20x4,3x84x84"`` is a vector, another that is a goal, a list of entities and an image C, H, W. Raises
    UsageError.
    """
    parts = [part.strip() for part in (text or "").split(",") if part.strip()]
    for part in parts:
        if not re.fullmatch("(goal:)?[1-9][0-9]{0,6}(x[1-9][0-9]{0,6}){0,2}", part):
            raise UsageError(
                f"--sensors {text}: {part} is not the shape of a sensor",
                fix="give one shape per sensor: 8 for a vector, 20x4 for a list of at most 20 entities of 4 numbers, "
                "3x84x84 (channels, height, width) for an image, goal:8 for a goal",
            )
    shapes = tuple(tuple(int(n) for n in part.removeprefix("goal:").split("x")) for part in parts)
    return shapes, tuple(i for i, part in enumerate(parts) if part.startswith("goal:"))


#: Where files are run; a word means the same in every command.
located = click.option(
    "--verify",
    "--runtimes",
    "runtimes",
    default="auto",
    metavar="WHERE",
    help="auto, full, browser, none, or runtimes by name.",
)
_ROWS = {row.name: row for row in READING}
#: What a format's reader takes.
_READER = tuple(row.name for row in READING if row.reader)
#: For sources that only a loader of their own can read, which runs what they say.
trusting = _ROWS["trust_source"].option()


def reading(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator for options of readers (none named: all); the command gets a ReadOptions, ``read``.

    It stands below ``understanding``, which may say that there is no normaliser.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def parse_and_call(*args: Any, **rest: Any) -> Any:
            from export_model.converters.formats.source import ReadOptions

            told = {name: rest.pop(name) for name in names or _READER}
            if "sensors" in told:
                told["sensors"], told["goals"] = sensors_of(told["sensors"])
            for name in ("normaliser", "interface"):
                told[name] = None if told.get(name) is None else str(told[name])
            return command(*args, read=ReadOptions(**told), **rest)

        made: Callable[..., Any] = parse_and_call
        for name in names or _READER:
            made = _ROWS[name].option()(made)
        return made

    return decorate


#: What ``--set`` says of a normaliser that is to be left out.
_WITHOUT_NORMALISER = "normaliser=none"


def _numbers(values: Sequence[str]) -> dict[str, float]:
    numbers = {}
    words = {"true": 1.0, "false": 0.0}
    for name, text in pairs(values, "--set").items():
        try:
            numbers[name] = words[text.lower()] if text.lower() in words else float(text)
        except ValueError as error:
            raise UsageError(f"--set {name}={text}: a number, true or false is expected") from error
    return numbers


def understanding(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that decide what inference cannot; the command gets them as ``compiling``, a CompileOptions.

    A command's own --names, --noise and --deterministic go into it, too. --set normaliser=none is its ``normaliser``.
    """

    @functools.wraps(command)
    def parse_and_call(
        *args: Any, brain: str | None, inputs: Sequence[str], outputs: Sequence[str], values: Sequence[str], **rest: Any
    ) -> Any:
        from export_model.exporter.options import ReadOptions, WriteOptions, compile_options

        if _WITHOUT_NORMALISER in values:
            if rest.get("normaliser") is not None:
                raise UsageError(f"--normaliser and --set {_WITHOUT_NORMALISER}", fix="give one of them")
            rest["normaliser"] = _WITHOUT_NORMALISER.partition("=")[2]
            values = [v for v in values if v != _WITHOUT_NORMALISER]
        read = ReadOptions(
            brain=brain, inputs=pairs(inputs, "--input"), outputs=pairs(outputs, "--output"), values=_numbers(values)
        )
        write = WriteOptions(**{name: rest.pop(name) for name in ("names", "noise", "deterministic") if name in rest})
        compiling = compile_options(read, write)
        return command(*args, compiling=compiling, **rest)

    made: Callable[..., Any] = parse_and_call
    for row in READING:
        made = made if row.reader else row.option()(made)
    return made


def reading_candidates(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of ``reading`` and ``understanding`` again, as --candidate-…; --trust-source is for both sides.

    The command gets them as ``candidate_read`` and ``candidate_compiling``.
    """

    @understanding
    @reading()
    def collect(*, read: Any, compiling: Any) -> Any:
        return {"candidate_read": read, "candidate_compiling": compiling}

    rows = [row for row in READING if not row.both]

    @functools.wraps(command)
    def parse_and_call(*args: Any, trust_source: bool, **rest: Any) -> Any:
        from export_model.exporter.compare.reading import naming_candidates_options

        told = {row.name: rest.pop(f"{CANDIDATE}{row.name}") for row in rows}
        with naming_candidates_options():
            collected = collect(trust_source=trust_source, **told)
        return command(*args, trust_source=trust_source, **collected, **rest)

    made: Callable[..., Any] = parse_and_call
    for row in rows:
        made = row.option(CANDIDATE)(made)
    return made


def coding(command: Callable[..., Any]) -> Callable[..., Any]:
    """How source code is written; the command gets it as ``code``, a CodeOptions."""

    @functools.wraps(command)
    def parse_and_call(*args: Any, math: str, weights: str, outputs_of: str, guard: float | None, **rest: Any) -> Any:
        from export_model.signatures.code import code_options

        return command(*args, code=code_options(math, weights, outputs_of, guard), **rest)

    for option in (
        click.option("--guard", type=float, metavar="K", help="Source code: count observations beyond K sigma."),
        click.option(
            "--outputs", "outputs_of", metavar="actor|all", default="actor", help="Source code: the outputs it has."
        ),
        click.option("--weights", metavar="PLACE", default="source", help="Source code: weights in a file beside it."),
        click.option(
            "--math", metavar="library|own", default="library", help="Source code: own gives the same bits anywhere."
        ),
    ):
        parse_and_call = option(parse_and_call)
    return parse_and_call


def _required_formats(given: str | None, *, unverified: str | None) -> tuple[str, ...]:
    """Return the formats of ``--require``. Raises UsageError."""
    if given is None:
        return ()
    from export_model.converters.formats.registry import WRITTEN

    wanted = tuple(dict.fromkeys(word.strip() for word in given.split(",") if word.strip()))
    wrong = next((word for word in wanted if word != "all" and word not in WRITTEN), None)
    if wrong is not None or not wanted:
        raise UsageError(
            f"--require {given}: must name formats",
            fix=f"{suggestion(wrong or '', WRITTEN)}all, or {', '.join(WRITTEN)}",
        )
    if unverified is not None:
        raise UsageError(
            f"--require {given} needs a verification", why=f"{unverified} was given", fix="leave one of them out"
        )
    return wanted


def comparing(command: Callable[..., Any]) -> Callable[..., Any]:
    """How to compare; the command gets it as ``options``, a VerifyOptions with the rules of ``console``."""

    @functools.wraps(command)
    def parse_and_call(
        *args: Any,
        console: Console,
        seed: int,
        samples: int,
        steps: int,
        atol: float,
        rtol: float,
        golden: Path | None,
        sizes: Sequence[str],
        required: str | None,
        **rest: Any,
    ) -> Any:
        from export_model.exporter.verify.checks.size import parse_budget
        from export_model.exporter.verify.options import VerifyOptions
        from export_model.exporter.verify.tolerances import Tolerance

        tolerance = Tolerance(atol, rtol)
        unverified = "--allow-unverified" if rest.get("allow_unverified") else None
        if rest.get("runtimes") == "none":
            unverified = "--verify none"
        require = _required_formats(required, unverified=unverified)
        options = VerifyOptions(
            seed=seed,
            samples=samples,
            steps=steps,
            tolerance=tolerance,
            rules=console.rules(),
            golden=golden,
            budget=parse_budget(sizes),
            require=require,
        )
        return command(*args, console=console, options=options, **rest)

    for option in (
        click.option(
            "--samples",
            type=click.IntRange(1),
            metavar="N",
            default=2,
            help="Typical inputs per batch size.",
        ),
        click.option("--seed", type=int, metavar="N", default=0, help="Seed of the inputs."),
        click.option("--steps", type=click.IntRange(1), metavar="N", default=4, help="Steps with the memory fed back."),
        click.option("--max-size", "sizes", multiple=True, metavar="[FORMAT=]SIZE", help="Fail above this size: 1MB."),
        click.option(
            "--require", "required", metavar="FORMATS", help="all, or formats that must be checked; else status 3."
        ),
        click.option("--golden", type=FILE, metavar="FILE", help="Recorded inputs (and outputs), an .npz."),
        click.option("--atol", type=float, metavar="X", default=1e-5, help="Absolute tolerance."),
        click.option("--rtol", type=float, metavar="X", default=1e-5, help="Relative tolerance."),
    ):
        parse_and_call = option(parse_and_call)
    return parse_and_call
