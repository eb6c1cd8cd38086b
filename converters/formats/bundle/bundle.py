"""A bundle: the folder of one policy, by its contract. It is opened, checked and written here, and nowhere else."""

from __future__ import annotations

import contextlib
import errno
import json
import shlex
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.fetch import inside, neighbours, path_text
from export_model.converters.formats.bundle.exchange import (
    exchange,
    recover,
    stage,
    sync_contents,
    sync_names,
    take_away,
)
from export_model.converters.formats.embed import contract_text, without_contract
from export_model.converters.formats.format import Artifact, Format
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.shapes import infer_types
from export_model.signatures.contract import PARITY, POLICY, Contract, FileEntry, json_of, parse
from export_model.signatures.digest import sha256_of_file
from export_model.signatures.errors import BundleError, UsageError
from export_model.signatures.fields import WHOLE, FieldError
from export_model.signatures.spec import PolicySignature

#: Tensor → what its artefact says of it: dtype and shape.
Declared: TypeAlias = Mapping[str, tuple[str | None, Sequence[object] | None]]
_AGAIN = "export the policy again"
#: What the name of a bundle ends with whose formats disagree.
FAILED = ".failed"
#: A contract is some kilobytes; one with labels and statistics of large observations some hundred.
_MOST_BYTES = 64 << 20


def bundles_in(place: Path) -> list[Path]:
    """The bundle at ``place``, or those in that folder, by name."""
    if (place / POLICY).is_file():
        return [place]
    if not place.is_dir():
        return []
    return sorted(p for p in place.iterdir() if not p.name.startswith(".") and (p / POLICY).is_file())


def other_folders_in(place: Path) -> tuple[list[Path], list[Path]]:
    """Return (folders in ``place`` that lost their contract, all other folders that are not bundles), by name.

    A folder that lost its contract has a report and no policy.json.
    """
    if not place.is_dir() or (place / POLICY).is_file():
        return [], []
    inside = sorted(p for p in place.iterdir() if not p.name.startswith(".") and p.is_dir())
    others = [p for p in inside if not (p / POLICY).is_file()]
    return [p for p in others if (p / PARITY).is_file()], [p for p in others if not (p / PARITY).is_file()]


class Bundle(Struct, frozen=True):
    """A folder that this tool wrote, with what its policy.json says."""

    folder: Path
    contract: Contract
    #: policy.json as it is, fields that are not known included
    content: Mapping[str, Any]

    @classmethod
    def open(cls, folder: Path) -> Bundle:
        """The bundle in ``folder``. Raises BundleError that names what is wrong with its policy.json."""
        path = folder / POLICY
        try:
            if _file_size(path) > _MOST_BYTES:
                raise unfit(path, "is too large", f"a contract has at most {_MOST_BYTES >> 20} MiB")
            content = json_of(path.read_bytes())
            contract = parse(content)
        except (FileNotFoundError, NotADirectoryError) as error:
            raise _no_bundle(folder) from error
        except OSError as error:
            raise unfit(path, "cannot be read", error.strerror) from error
        except FieldError as error:
            if error.field == WHOLE:
                raise unfit(path, f"{WHOLE} {error.why}", "the file is cut off or damaged") from error
            raise BundleError(
                f"{error.field} {error.why}",
                where=str(path),
                why="this version of export-model does not read such a contract",
                fix=f"{_AGAIN}, or use the version of export-model that wrote it",
            ) from error
        if not contract.files:
            raise unfit(path, "files is empty", "a bundle holds a model")
        return cls(folder, contract, content)

    @property
    def name(self) -> str:
        """The policy's name."""
        return self.contract.name

    @property
    def signature(self) -> PolicySignature:
        """What the policy takes and gives."""
        return self.contract.signature

    def has(self, wanted: Format) -> bool:
        """Whether it holds the policy in a format."""
        return wanted.first_file_of(self.name) in self.contract.files

    def path(self, wanted: Format) -> Path:
        """What a loader is given of a format."""
        return self.folder / wanted.main_of(self.name)

    def size(self, wanted: Format) -> int:
        """Bytes of all files of a format, as policy.json says."""
        return sum(entry.size for path, entry in self.contract.files.items() if wanted.owns(path, self.name))

    def verify_hashes(self, wanted: Format | None = None) -> None:
        """Raise BundleError that names the first file (of a format) which is missing or not what was written."""
        for relative, entry in self.contract.files.items():
            if wanted is None or wanted.owns(relative, self.name):
                self._verify(relative, entry)

    def _verify(self, relative: str, entry: FileEntry) -> None:
        path = self.folder / relative
        if inside(self.folder, relative) is None:
            raise BundleError(
                f"names a file outside the bundle: {relative}",
                where=str(self.folder / POLICY),
                why="a bundle's files are in its folder",
                fix=f"do not use this bundle; {_AGAIN}, or where the links are your own, give what cp -rL copies",
            )
        try:  # the size first: a file may be of any, and policy.json says which
            found = sha256_of_file(path) if _file_size(path) == entry.size else None
        except FileNotFoundError as error:
            raise unfit(path, "is missing", f"{POLICY} names it") from error
        except OSError as error:
            raise unfit(path, "cannot be read", error.strerror) from error
        if found != entry.sha256:
            raise BundleError(
                "has been changed since it was exported",
                where=str(path),
                why=f"its {'size' if found is None else 'sha256'} is not the one in {POLICY}",
                fix=f"{_AGAIN}; compare foreign artefacts with export-model compare",
            )

    @property
    def graph_file(self) -> Path:
        """Its ``.bytes``. Raises BundleError where it has none."""
        relative = f"{self.name}.bytes"
        if relative not in self.contract.files:
            raise BundleError(
                "has no .bytes",
                where=str(self.folder),
                why="it is the graph that this tool reads and runs by itself",
                fix=f"give what it was made from: --source {self.contract.origin.path}; or {_AGAIN}, with --to bytes,…",
            )
        return self.folder / relative

    def graph(self) -> Graph:
        """The graph of its ``.bytes``, without the contract.

        Raises BundleError where it has none, or one that embeds another contract than policy.json; SourceError and its
        like where it is damaged.
        """
        whole = read_graph(self.graph_file.read_bytes())
        self.verify_contract(contract_text(whole) or "")
        return without_contract(whole)

    def verify_contract(self, held: Any) -> None:
        """Raise BundleError where an artefact embeds another contract (text, or JSON's values) than policy.json."""
        try:
            content = json_of(held) if isinstance(held, str | bytes) else held
            same = content == {k: v for k, v in self.content.items() if k != "files"}
        except FieldError:
            same = False
        if not same:
            why = "it is not the contract that the artefact embeds"
            raise unfit(self.folder / POLICY, "has been changed since it was exported", why)

    def check_fits(self, place: Path, declared: Declared) -> None:
        """Raise BundleError where an artefact has a tensor otherwise than policy.json says.

        ``declared`` has its tensors: dtype (None: not said) and shape (an axis that is no int is free; None: not said).
        """
        for spec in (*self.signature.inputs, *self.signature.outputs):
            if spec.name not in declared:
                raise unfit(place, f"has no tensor {spec.name!r}", f"{POLICY} names it")
            dtype, shape = declared[spec.name]
            axes = None if shape is None else [n if isinstance(n, int) else None for n in shape]
            if (dtype is not None and dtype != spec.dtype) or (axes is not None and not _goes(axes, spec.shape)):
                what = f"has {spec.name!r} as {dtype or 'a tensor'} {axes}"
                raise unfit(place, what, f"{POLICY} says {spec.dtype} {list(spec.shape)}")

    def check_graph(self, graph: Graph) -> None:
        """As ``check_fits``, of the graph of its ``.bytes``. Raises GraphError where that is damaged."""
        self.check_fits(self.folder / f"{self.name}.bytes", declared_by(graph))


def unfit(where: Path, what: str, why: str | None) -> BundleError:
    """The error of a bundle that is not, or no more, what an export wrote."""
    return BundleError(what, where=str(where), why=why, fix=_AGAIN)


def declared_by(graph: Graph) -> Declared:
    """What ``Bundle.check_fits`` asks, of a graph. Raises GraphError where it is damaged."""
    types = infer_types(graph)
    return {n.name: (types[n.name].dtype.name, types[n.name].shape) for n in graph.nodes if n.name in types}


def _goes(axes: Sequence[int | None], wanted: Sequence[int | None]) -> bool:
    return len(axes) == len(wanted) and all(a == b or None in (a, b) for a, b in zip(axes, wanted, strict=True))


def _no_bundle(folder: Path) -> BundleError:
    """Say what there is where no contract lies: nothing, a file, or a folder of something else."""
    if not folder.exists():
        return BundleError("no such folder", where=str(folder), fix=neighbours(folder))
    return BundleError(
        "a file, not a bundle" if folder.is_file() else "not a bundle",
        where=str(folder),
        why=f"a bundle is a folder with a {POLICY}",
        fix=f"export-model {shlex.quote(path_text(folder))} -o exported    (then give the folder that it writes there)",
    )


def dumps(content: Mapping[str, Any]) -> bytes:
    """JSON as the bundle's files have it: keys in their given order, floats at full precision, a final newline."""
    return (json.dumps(content, indent=1, ensure_ascii=True, allow_nan=False) + "\n").encode()


@contextlib.contextmanager
def writing(place: Path, what: str = "cannot be written") -> Iterator[None]:
    """What the system refuses inside is a BundleError about ``place``."""
    try:
        yield
    except OSError as error:
        raise BundleError(
            what, where=str(place), why=error.strerror, fix="free some space or allow writing, or choose another place"
        ) from error


@contextlib.contextmanager
def stage_bundle(place: Path, contract: Contract, artifacts: Sequence[Artifact]) -> Iterator[Path]:
    """A bundle in a new folder beside ``place``, gone afterwards unless it was put in its place. Raises BundleError."""
    with contextlib.ExitStack() as stack:
        with writing(place.parent, "the output folder cannot be written"):
            new = stack.enter_context(stage(place))
            files = {path: entry for artifact in artifacts for path, entry in artifact.write(new).items()}
            whole = replace(contract, files=dict(sorted(files.items())))
            (new / POLICY).write_bytes(dumps(whole.to_dict()))
        yield new


def put_in_place(new: Path, place: Path) -> None:
    """Exchange a staged bundle with what is at ``place``; what was set aside there goes. Raises BundleError."""
    for error in put_all_in_place([(new, place)]).values():
        raise error


def put_all_in_place(staged: Sequence[tuple[Path, Path]]) -> dict[Path, BundleError]:
    """Do as ``put_in_place`` with several, which wait for the disk together; return the errors of places."""
    errors: dict[Path, BundleError] = {}

    def do(step: Callable[[Path, Path], None]) -> None:
        for new, place in staged:
            if place not in errors:
                try:
                    step(new, place)
                except BundleError as error:
                    errors[place] = error

    do(lambda new, place: check_replaceable(place))
    ready = [new for new, place in staged if place not in errors]
    refused: list[OSError] = []
    try:
        sync_contents(ready)
    except OSError as error:
        refused.append(error)
    do(lambda new, place: _exchange_one(new, place, refused))
    sync_names([place for _, place in staged if place not in errors])
    do(lambda new, place: _remove_failed(place))
    return errors


def _exchange_one(new: Path, place: Path, refused: Sequence[OSError]) -> None:
    with writing(place):
        if refused:
            raise refused[0]
        exchange(new, place)


def _remove_failed(place: Path) -> None:
    failed = place.with_name(place.name + FAILED)
    if (failed / POLICY).is_file() and not failed.is_symlink():
        with writing(failed, "cannot be removed"):
            take_away(failed)


def check_replaceable(place: Path) -> None:
    """Put back what a killed run had moved out of ``place``. Raises BundleError where it is not ours."""
    with writing(place, "cannot be looked at"):
        recover(place)
        if not place.exists() and not place.is_symlink():
            return
        if place.is_dir() and not place.is_symlink() and (not any(place.iterdir()) or (place / POLICY).is_file()):
            return
    raise BundleError(
        "already exists and is not a bundle",
        where=str(place),
        why=f"it has no {POLICY}, so it is not this tool's to replace",
        fix="move it, or choose another folder with -o or another --name",
    )


def distinct_names(policies: Sequence[tuple[str, str]]) -> None:
    """Raise UsageError when two (name, where it comes from) fall together on a file system that folds case."""
    seen: dict[str, str] = {}
    for name, where in policies:
        other = seen.setdefault(name.casefold(), where)
        if other != where:
            raise UsageError(
                f"two policies would be written to {name!r}: {other} and {where}",
                why="their names are the same once case and special characters are folded",
                fix="export them one by one, each with --name",
            )


def _file_size(path: Path) -> int:
    """Bytes of a file that can be read to its end. Raises OSError for what is none (a pipe never ends)."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it must be a file", str(path))
    return found.st_size
