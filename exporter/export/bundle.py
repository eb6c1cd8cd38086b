"""Bundles: the folder that one policy is written to, with its contract.

A bundle is written beside its place and exchanged with what was there, so that a killed run leaves the old one whole.
Only a folder that holds a policy.json of ours is ever replaced.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from converters.format import Artifact
from converters.policy import Policy
from exporter.version import __version__
from signatures.digest import sha256_hex
from signatures.errors import BundleError, UsageError
from signatures.spec import PolicySignature, SourceMap

POLICY, PARITY = "policy.json", "parity.json"
SCHEMA = 1
_STALE_SECONDS = 24 * 3600.0
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def safe_name(name: str) -> str:
    """A name for files and folders: characters outside [A-Za-z0-9._-] become ``-``."""
    cleaned = re.sub(r"[^A-Za-z0-9._-]", "-", name)
    return cleaned if cleaned.strip(".") else "policy"


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


def contract(policy: Policy, source: Mapping[str, Any]) -> dict[str, Any]:
    """The contract as every artefact embeds it: policy.json without the hashes of the files."""
    return {
        "schema": SCHEMA,
        "name": policy.name,
        **policy.signature.to_dict(),
        "source": {**source, **policy.source.to_dict()},
        "tool": {"name": "export-model", "version": __version__},
    }


def dumps(content: Mapping[str, Any]) -> bytes:
    """JSON as the bundle's files have it: keys in their given order, floats at full precision, a final newline."""
    return (json.dumps(content, indent=1, ensure_ascii=True, allow_nan=False) + "\n").encode()


def compact(content: Mapping[str, Any]) -> str:
    """JSON on one line, for embedding."""
    return json.dumps(content, separators=(",", ":"), ensure_ascii=True, allow_nan=False)


@contextmanager
def writing(place: Path, what: str = "cannot be written") -> Iterator[None]:
    """What the system refuses inside is a BundleError about ``place``."""
    try:
        yield
    except OSError as error:
        raise BundleError(
            what, where=str(place), why=error.strerror, fix="make room or rights there, or choose another place"
        ) from error


def write_staged(parent: Path, content: Mapping[str, Any], artifacts: Sequence[Artifact]) -> Path:
    """Write a bundle into a new hidden folder in ``parent``; returns that folder."""
    files = {path: data for artifact in artifacts for path, data in artifact.files.items()}
    hashes = {p: {"sha256": sha256_hex(d), "bytes": len(d)} for p, d in sorted(files.items())}
    tool = content["tool"]
    body = {**{k: v for k, v in content.items() if k != "tool"}, "files": hashes, "tool": tool}
    with writing(parent, "the output folder cannot be written"):
        parent.mkdir(parents=True, exist_ok=True)
        _sweep(parent, content["name"])
        stage = Path(tempfile.mkdtemp(prefix=f".{content['name']}.", dir=parent))
        with contextlib.ExitStack() as undo:
            undo.callback(shutil.rmtree, stage, ignore_errors=True)
            for relative, data in files.items():
                target = stage / relative
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(data)
            (stage / POLICY).write_bytes(dumps(body))
            stage.chmod(0o755)
            undo.pop_all()  # it is whole: the caller has it from here on
    return stage


def _sweep(parent: Path, name: str) -> None:
    """Remove what killed runs left of this policy, a day later: before that, it may be a run that is still going."""
    for left in parent.glob(f".{name}.*"):
        with contextlib.suppress(OSError):  # its own process may just have renamed or removed it
            if left != _aside(parent / name) and time.time() - left.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(left)


def check_replaceable(place: Path) -> None:
    """Raise BundleError when ``place`` exists and is not a bundle of ours."""
    with writing(place, "cannot be looked at"):
        if not place.exists() and not place.is_symlink():
            return
        if place.is_dir() and not place.is_symlink() and (not any(place.iterdir()) or (place / POLICY).is_file()):
            return
    raise BundleError(
        "is in the way and is not a bundle",
        where=str(place),
        why=f"it has no {POLICY}, so it is not this tool's to replace",
        fix="move it, or choose another folder with -o or another --name",
    )


def put_in_place(stage: Path, place: Path) -> None:
    """Exchange a staged bundle with what is at ``place``, and remove the old one."""
    check_replaceable(place)
    with writing(place):
        if not place.exists():
            stage.rename(place)
        elif _exchange(stage, place):
            shutil.rmtree(stage)
        else:
            _two_renames(stage, place)


def _two_renames(stage: Path, place: Path) -> None:
    """For systems without an exchange. If the process dies in between, the next run puts the old one back (recover)."""
    old = _aside(place)
    if old.exists():
        shutil.rmtree(old)
    place.rename(old)
    try:
        stage.rename(place)
    except OSError:
        old.rename(place)
        raise
    shutil.rmtree(old)


def _aside(place: Path) -> Path:
    return place.with_name(f".{place.name}.old")


def recover(place: Path) -> None:
    """Put back a bundle that a killed run had moved aside."""
    old = _aside(place)
    with writing(place, "cannot be looked at"):
        if old.is_dir() and not place.exists():
            old.rename(place)


def _exchange(a: Path, b: Path) -> bool:
    """renameat2(RENAME_EXCHANGE): both paths change places in one step. Linux only; False where it is not to be had."""
    platform: str = sys.platform
    if platform != "linux":
        return False
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is None:
        return False
    result: int = function(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    return result == 0


# ------------------------------------------------------------------ reading a bundle


def read_policy_json(folder: Path) -> dict[str, Any]:
    """policy.json of a bundle; raises BundleError."""
    path = folder / POLICY
    try:
        content: dict[str, Any] = json.loads(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError) as error:
        raise BundleError(
            "is no bundle", where=str(folder), why=f"it has no {POLICY}", fix="give the folder that export-model wrote"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise BundleError("cannot be read", where=str(path), why=str(error), fix="export the policy again") from error
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise BundleError(
            f"has schema {schema!r}, this version reads {SCHEMA}",
            where=str(path),
            fix="export the policy again, or use the version of export-model that wrote it",
        )
    fault = _fault(content)
    if fault:
        raise BundleError("is not complete", where=str(path), why=fault, fix="export the policy again")
    return content


def _fault(content: Mapping[str, Any]) -> str | None:
    """What is wrong with the parts of policy.json that say where to look, None if nothing is."""
    name, files, source = (content.get(key) for key in ("name", "files", "source"))
    if not isinstance(name, str) or name != safe_name(name):
        return f"{name!r} is not the name of a policy"
    if not isinstance(source, dict) or not all(isinstance(source.get(key), str) for key in ("path", "sha256")):
        return "it does not say which source it was made from"
    if not isinstance(files, dict) or not files:
        return "it names no files"
    for path, entry in files.items():
        if not isinstance(entry, dict) or not isinstance(entry.get("sha256"), str):
            return f"it has no sha256 of {path!r}"
        if not isinstance(entry.get("bytes"), int):
            return f"it has no size of {path!r}"
    return None


def check_contract(folder: Path, content: Mapping[str, Any], embedded: str) -> None:
    """Raise BundleError unless policy.json is the contract that an artefact embeds (with the hashes of the files)."""
    try:
        same = json.loads(embedded) == {key: value for key, value in content.items() if key != "files"}
    except (ValueError, RecursionError):
        same = False
    if not same:
        raise BundleError(
            "has been changed since it was exported",
            where=str(folder / POLICY),
            why="it is not the contract that the bundle's own graph embeds",
            fix="export the policy again",
        )


def check_hashes(folder: Path, content: Mapping[str, Any]) -> None:
    """Raise BundleError that names the first file which is missing or not the one that was written."""
    for relative, entry in content["files"].items():
        path = folder / relative
        if not _is_inside(path, folder):
            raise BundleError(
                f"names a file outside of the bundle: {relative}",
                where=str(folder / POLICY),
                why="a bundle's files lie in its folder",
                fix="do not use this bundle; export the policy again",
            )
        try:
            found = sha256_hex(path.read_bytes())
        except FileNotFoundError as error:
            raise BundleError(
                "is missing", where=str(path), why=f"{POLICY} names it", fix="export the policy again"
            ) from error
        except OSError as error:
            raise BundleError(
                "cannot be read", where=str(path), why=error.strerror, fix="export the policy again"
            ) from error
        if found != entry["sha256"]:
            raise BundleError(
                "has been changed since it was exported",
                where=str(path),
                why=f"its sha256 is not the one in {POLICY}",
                fix="export the policy again; compare foreign artefacts with export-model compare",
            )


def _is_inside(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # a loop of links, a null character
        return False


def signature_of(content: Mapping[str, Any]) -> tuple[PolicySignature, SourceMap]:
    """The signature and source map that a policy.json holds."""
    try:
        signature = PolicySignature.from_dict(content)
        return signature, SourceMap.from_dict(content["source"], signature)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise BundleError(
            f"{POLICY} is not complete", why=f"{type(error).__name__}: {error}", fix="export the policy again"
        ) from error
