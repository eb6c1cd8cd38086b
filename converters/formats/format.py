"""What a format is: one object, declared in the ``__init__`` of its room, that answers every question about it.

How its files are recognised, read and written, what an artefact of it takes and gives, which runtimes run it, what it
is called everywhere (``--to``, parity.json, tolerances, budgets). The modules of its functions come from
``defer_imports``, so that the list of formats (converters/formats/registry.py) costs nothing.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct, field

from export_model.signatures.code import CodeOptions

if TYPE_CHECKING:
    import numpy as np

    from export_model.converters.compiler.passes.weights import Storage
    from export_model.converters.files.chunks import Pieces
    from export_model.converters.files.fetch import Fetched
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.intermediate_tensors import InnerTensors, Loaded
    from export_model.converters.formats.source import ReadOptions, SourceModel
    from export_model.converters.graph.jitter import Jitter
    from export_model.converters.graph.nodes import Graph
    from export_model.converters.policy.policy import Policy
    from export_model.signatures.contract import FileEntry
    from export_model.signatures.spec import PolicySignature
if not TYPE_CHECKING:  # what asks a record for its signature looks these names up
    Storage = Pieces = Fetched = Content = InnerTensors = Loaded = ReadOptions = SourceModel = Jitter = Graph = (
        Policy
    ) = FileEntry = PolicySignature = np = Any

Dims = tuple[int | None, ...]
#: Takes inputs by name, what to fetch, and how rounding is disturbed (None: not at all).
Kernels = Callable[["dict[str, np.ndarray]", Sequence[str], "Jitter | None"], "dict[str, np.ndarray]"]


class _Deferred:
    """A module whose functions are named before it is imported: it is when the first of them is called."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __getattr__(self, function: str) -> Callable[..., Any]:
        return lambda *given: getattr(importlib.import_module(self._module), function)(*given)


def defer_imports(room: str, *modules: str) -> list[Any]:
    """Modules of a room, for what its ``Format`` is made of; the type checker is given them as they are."""
    return [_Deferred(f"{room}.{module}") for module in modules]


class WriteOptions(Struct, frozen=True):
    """What a writer needs beside the policy.

    - ``contract``: the contract as JSON text.
    - ``opset``: of the ONNX.
    - ``profile``: its name where the file is made for one consumer (``--for``).
    - ``checked``: whether the result is to be proved valid (ONNX: by its checker).
    - ``weights``: how weights that were rounded are kept.
    - ``batch``: for how many agents the file is (None: for any number).
    - ``misread``: the ONNX ops that the consumer lacks or misreads in some form.
    - ``code``: how source code is written.
    """

    contract: str
    opset: int = 15
    profile: str | None = None
    checked: bool = True
    weights: Storage = "float32"
    batch: int | None = None
    misread: frozenset[str] = frozenset()
    code: CodeOptions = CodeOptions()


class Artifact(Struct, frozen=True):
    """One policy in one format: relative path (``/`` between parts) → what the file is made of."""

    format: Format
    name: str
    files: Mapping[str, Pieces]

    @property
    def main(self) -> str:
        """The path that a loader is given: a file, or the folder that all files lie in."""
        return self.format.main_of(self.name)

    @property
    def size(self) -> int:
        """Bytes of all files together."""
        return sum(data.size for data in self.files.values())

    def write(self, folder: Path) -> dict[str, FileEntry]:
        """Write its files to a folder; what each became, by its path. Raises OSError."""
        from export_model.signatures.contract import FileEntry  # it loads numpy

        for parent in dict.fromkeys(relative.rpartition("/")[0] for relative in self.files):
            (folder / parent).mkdir(parents=True, exist_ok=True)
        return {relative: FileEntry(data.write(folder / relative), data.size) for relative, data in self.files.items()}


class Port(Struct, frozen=True):
    """An input or output: the name that a caller uses, its dtype (numpy's name) and shape where the file tells them.

    ``tensor`` is the tensor behind the name, where the format has both (the signatures of TensorFlow).
    """

    name: str
    dtype: str | None = None
    shape: Dims | None = None
    tensor: str | None = None


class Ports(Struct, frozen=True):
    """What an artefact takes and gives, whichever tool made it; ``path`` and ``options`` are what its loader takes.

    ``open`` is set where any node can be asked for (a frozen graph): ``outputs`` are then all nodes that can be.
    ``left_out`` are outputs of its policy that it was written without.
    """

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    open: bool = False
    left_out: tuple[str, ...] = ()


class Member(Struct, frozen=True):
    """A source inside of another (a run folder's export, a bundle's artefact), to be read in its place.

    ``name`` is the policy's where the folder says it, ``notes`` go to the policy's, ``files`` are those that said so.
    """

    path: Path
    name: str | None = None
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()


class Code(Struct, frozen=True):
    """A snippet: how to call an artefact of a format.

    ``text`` has ``$path`` for what a loader is given, in quotes, and ``$play`` for Python that calls a function
    ``policy`` with the inputs by name, and prints the action.
    """

    name: str
    title: str
    language: str
    text: str


class Format(Struct, frozen=True, eq=False, kw_only=True):
    """A form in which policies are given, written or both. Unsupported features are None or empty.

    - ``key`` is its name, ``aliases`` are words that ``--to`` takes besides, ``label`` is what people call it,
      ``advice`` what to do where it cannot be read.
    - ``sniff`` looks at a file's content. ``marker`` is the file that makes a folder one of this format; ``at`` says
      whether a path that is no file (a folder, a checkpoint's prefix) stands for one.
    - ``read`` gives the models of a file or folder; ``members`` instead says which sources inside are to be read.
      ``takes`` are the options that mean something to it: ``step``, ``sensors``.
    - ``write`` gives the files of an artefact by their path in the bundle; ``main`` is the one that a loader is given,
      with ``{name}`` for the policy's name, ``beside`` a file that it may need next to it. A ``default`` is written
      unless ``--to`` says otherwise.
    - ``vetted`` copies an artefact that anyone may have made to an empty folder, as far as a runtime may be given it:
      what the wanted nodes (of a graph that any node can be asked of) or signatures need, no op that does more than
      compute, no file from elsewhere.
    - ``held`` gives the contract that an artefact of ours embeds, as text or as JSON's values (None: it has none).
      ``misstatement`` says what it states of a policy's interface beside that contract otherwise than a signature does;
      None where it is the same.
    - ``ports`` reads what an artefact takes and gives. ``runtimes`` are those that run it, in the order of reports;
      ``signatures``: it is called by signature; ``predicts``: people call it through ``predict``, for all outputs at
      once; ``inner`` gives the graph's tensors inside of one that is loaded (None: it hides them), ``origins`` what the
      source called them, where an artefact notes it; ``dtypes`` are the only ones that it has (empty: all);
      ``answers`` are the outputs of a policy that an artefact answers (None: all). ``graph`` reads the graph of an
      artefact of ours (None: its reader does).
      ``elsewhere`` is what alone runs it besides, where that cannot be asked; ``unity``: Unity loads it, if its names
      are those that a profile (``--for``) gives; ``consumer`` is the profile whose names its files have, whichever
      those of their bundle are. ``narrow``: it can hold weights in
      float16 or int8. ``fixed``: it can be written for a fixed number of agents.
      ``library`` is a Python package that runs such a file by itself; verification does not ask it.
      ``program``: it is source code; one that was not written just now is run only where its process is confined, since
      anyone may have changed it.
    """

    key: str
    label: str
    aliases: tuple[str, ...] = ()
    advice: str = ""
    sniff: Callable[[Content], bool] | None = None
    marker: str = ""
    at: Callable[[Path], bool] | None = None
    read: Callable[[Fetched, ReadOptions], list[SourceModel]] | None = None
    members: Callable[[Path, ReadOptions], list[Member]] | None = None
    takes: frozenset[str] = frozenset()
    write: Callable[[Policy, WriteOptions], Mapping[str, Pieces]] | None = None
    main: str = ""
    beside: str = ""
    default: bool = False
    held: Callable[[Path], Any] | None = None
    misstatement: Callable[[Path, PolicySignature], str | None] | None = None
    ports: Callable[[Path], Ports] | None = None
    vetted: Callable[[Path, Sequence[str], Path], Path] | None = None
    runtimes: tuple[str, ...] = ()
    signatures: bool = False
    predicts: bool = False
    inner: Callable[[Loaded], AbstractContextManager[InnerTensors]] | None = None
    origins: Callable[[Path], Mapping[str, str]] | None = None
    snippets: tuple[Code, ...] = ()
    dtypes: frozenset[str] = frozenset()
    answers: Callable[[PolicySignature, CodeOptions], list[str]] | None = None
    graph: Callable[[Path], Graph] | None = None
    elsewhere: str = ""
    unity: bool = False
    consumer: str = ""
    narrow: bool = False
    fixed: bool = False
    library: str = ""
    program: bool = False

    @property
    def readable(self) -> bool:
        """Whether it is a source."""
        return self.read is not None or self.members is not None

    def main_of(self, name: str) -> str:
        """The path in a bundle that a loader is given, for the policy ``name``."""
        return self.main.format(name=name)

    def first_file_of(self, name: str) -> str:
        """The file in a bundle without which there is no artefact of this format."""
        return self.main_of(name) + (f"/{self.marker}" if self.marker else "")

    def owns(self, path: str, name: str) -> bool:
        """Whether a file of the bundle of the policy ``name`` is of this format's artefact."""
        main = self.main_of(name)
        return path in (main, self.beside.format(name=name)) or (bool(self.marker) and path.startswith(f"{main}/"))

    def artifact(self, policy: Policy, options: WriteOptions) -> Artifact:
        """The policy in this format, which has a writer. Raises GraphError and its like where it cannot be."""
        assert self.write is not None, f"{self.key} is not written"
        import numpy as np

        with np.errstate(all="ignore"):  # weights may be any numbers
            return Artifact(self, policy.name, self.write(policy, options))

    def loader(self, signature: str = "") -> Mapping[str, Any]:
        """What a child process is told beside the path; ``signature`` is the one to call, where it has some."""
        if self.signatures:
            return {"kind": self.key, "signature": signature}
        return {"kind": "graph", "format": self.key}
