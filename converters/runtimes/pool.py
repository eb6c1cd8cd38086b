"""The runtimes' processes: started on first use, shared by all policies of a run, ended together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager

from export_model.converters.files.children.process import RuntimeProcess
from export_model.converters.formats.format import Format
from export_model.converters.runtimes.registry import RUNTIMES, RuntimeInfo, available_runtimes
from export_model.signatures.errors import RuntimeUnavailableError, UsageError, suggestion

#: Runtimes that compute by themselves; numpy and js are this project's own.
INDEPENDENT = tuple(r.name for r in RUNTIMES if r.independent)
#: Runtimes that read originals by themselves.
_ORIGINALS = tuple(r.name for r in RUNTIMES if r.originals)
#: Runtimes that ``auto`` leaves out: a browser is started only when it is asked for, and js shows little beside others.
_ON_REQUEST = frozenset(r.name for r in RUNTIMES if r.taken_by != "auto")
#: Runtimes that no word takes.
BY_NAME = frozenset(r.name for r in RUNTIMES if r.taken_by == "name")
_IN_BROWSERS = frozenset(r.name for r in RUNTIMES if r.browser)
_KNOWN = {r.name: r for r in RUNTIMES}
_COMMANDS: Mapping[str, Callable[[], list[str]]] = {r.name: r.command for r in RUNTIMES}


def chosen_runtimes(
    wanted: str | Sequence[str], formats: Iterable[Format]
) -> tuple[tuple[str, ...], list[RuntimeInfo]]:
    """(runtimes to use, what is known of all of them) for ``none``, or names, or words that stand for several.

    ``auto`` are those that are installed and fit the formats, without a browser's; ``browser`` those in a browser;
    ``full`` all that fit the formats and this system can have, but those that no word takes. Raises UsageError on a
    name that is none, RuntimeUnavailableError when one that was asked for is not installed.
    """
    infos = list(available_runtimes())
    known = {info.name: info for info in infos}
    useful = {*_ORIGINALS, *(r for f in formats for r in f.runtimes)}
    if wanted == "none":
        return (), infos
    automatic = tuple(i.name for i in infos if i.installed and i.name in useful and i.name not in _ON_REQUEST)
    if wanted == "auto":
        return automatic, infos
    several = {
        "auto": automatic,
        "browser": [n for n in known if n in _IN_BROWSERS],
        "full": [n for n in known if known[n].supported and n in useful and n not in BY_NAME],
        "js": ["node"],  # what --to calls the module that it runs
    }
    words = [word for word in wanted.split(",") if word] if isinstance(wanted, str) else wanted
    names = [name for word in words for name in several.get(word, (word,))]
    for name in names:
        if name not in known:
            raise UsageError(
                f"unknown runtime {name!r}", fix=f"{suggestion(name, known)}the runtimes are {', '.join(known)}"
            )
        if not known[name].installed:
            raise RuntimeUnavailableError(f"the runtime {name} is not installed", fix=known[name].how)
    return tuple(dict.fromkeys(["numpy", *names])), infos


def unverified_error(
    formats: Iterable[Format], used: Sequence[str], infos: Iterable[RuntimeInfo], where: str | None = None
) -> RuntimeUnavailableError:
    """Return the error that no independent runtime ran a file of ``formats``: none was asked for, or none is here."""
    kinds = list(formats)
    fitting = {name for form in kinds for name in form.runtimes}.intersection(INDEPENDENT)
    known = sorted((i for i in infos if i.name in fitting and i.supported), key=lambda i: i.name != "onnxruntime")
    here = [i.name for i in known if i.installed]
    if here:
        state, remedy = "was asked for", f"--runtimes {here[0]}"
    else:
        state, remedy = "is installed", known[0].how if known else "export-model runtimes says how to install one"
    return RuntimeUnavailableError(
        f"no independent runtime {state}, so nothing was compared",
        where=where,
        why=f"{', '.join(used)} alone took part; {kinds[0].label} runs in {', '.join(i.name for i in known) or 'none'}",
        fix=f"{remedy}, or --allow-unverified",
    )


class RuntimePool(AbstractContextManager["RuntimePool"]):
    """Hands out a process per runtime; ``commands`` starts them, by name (the registry's where it is not given)."""

    def __init__(self, commands: Mapping[str, Callable[[], list[str]]] = _COMMANDS) -> None:
        self._commands = commands
        self._processes: dict[str, RuntimeProcess] = {}
        self._timed_out: set[str] = set()

    def start(self, names: Iterable[str]) -> None:
        """Start these runtimes' processes side by side; ``process`` waits for one, when it is needed.

        Raises RuntimeUnavailableError where a program is not there; the processes that were started stay.
        """
        for name in names:
            self._launch(name)

    def process(self, name: str) -> RuntimeProcess:
        """The runtime's process, started and ready. Raises RuntimeUnavailableError."""
        process = self._launch(name)
        process.start()
        return process

    def _launch(self, name: str) -> RuntimeProcess:
        if name not in self._processes:
            known = _KNOWN.get(name)
            self._processes[name] = RuntimeProcess(
                name,
                self._commands[name](),
                confined=known is None or known.confined,
                browser=known is not None and known.browser,
                own_words=None if known is None else known.own_words,
                timed_out=self._timed_out,
            )
        self._processes[name].launch()
        return self._processes[name]

    def versions(self) -> dict[str, str]:
        """Versions of the runtimes that ran, by name."""
        return {n: p.version for n, p in self._processes.items() if p.version is not None}

    def __exit__(self, *error: object) -> None:
        for process in self._processes.values():
            process.hang_up()
        for process in self._processes.values():
            process.close()
