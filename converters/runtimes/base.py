"""What a runtime is, whichever family it belongs to."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from msgspec import Struct

if TYPE_CHECKING:
    from export_model.converters.graph.ops.approximations import Arithmetic
if not TYPE_CHECKING:  # what asks a record for its signature looks these names up
    Arithmetic = Any

Progress = Callable[[str], None]

#: What the child of a source code's runtime says by itself: no words of the program that it runs, nor of its compiler.
REFUSED = "the compiler refuses it"
OWN_WORDS = (
    rf"(?:\w+Error: )?(?:{REFUSED}|its self test finds \d+ wrong numbers|its weights are refused with \d+|"
    r"an index of \d+ inputs lies outside of the table that it is looked up in)"
)


class RuntimeInfo(Struct, frozen=True):
    """One runtime that artefacts can be verified in; ``how`` is the command that installs it."""

    name: str
    installed: bool
    version: str | None
    how: str
    #: whether this system can have it at all; where it cannot, ``how`` says why
    supported: bool = True


class Runtime(Struct, frozen=True):
    """A runtime: whether it is here, how its child process is started and how it is installed.

    What it loads of a bundle, each format says (``Format.runtimes``).
    ``find`` says whether it is here, without importing it: the import takes seconds, and this is only a question.
    ``command`` gives the argument list of a child process that speaks frames (converters/files/children/frames.py); it
    raises RuntimeUnavailableError. ``install`` fetches it, None where pip or the system's packages do that.
    """

    name: str
    find: Callable[[], RuntimeInfo]
    command: Callable[[], list[str]]
    install: Callable[[Progress], object] | None = None
    #: It reads the files of sources by itself.
    originals: bool = False
    #: It computes by itself; numpy is this project's own.
    independent: bool = True
    #: How it approximates functions (converters/graph/ops/approximations.py).
    arithmetic: Arithmetic = "processor"
    #: All sessions of a process begin to draw alike, whatever their models.
    sessions_alike: bool = False
    #: What is wrong with how it draws, whatever an artefact says: only what is made of its draws is compared.
    poor_draws: str = ""
    #: Multiplications that a policy's products take a second on one core, about (measured).
    products_per_second: float = 1e9
    #: The word that takes it: ``auto`` where it is installed, ``full``, or its own name alone.
    taken_by: Literal["auto", "full", "name"] = "auto"
    #: It loads files for a fixed number of agents alone (``--batch``).
    fixed: bool = False
    #: The dtypes of the tensors that it has; empty: all that its formats have.
    dtypes: frozenset[str] = frozenset()
    #: It runs in a browser (the word ``browser``).
    browser: bool = False
    #: Its child is confined as it starts; those that start a compiler confine themselves, and a browser has a sandbox.
    confined: bool = True
    #: It runs source code, which may say anything; of that a report repeats what this pattern matches, which is its
    #: child's own. None: it runs graphs.
    own_words: str | None = None
