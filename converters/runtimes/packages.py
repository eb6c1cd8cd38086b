"""Runtimes that are Python packages: is one installed, which version, how is its child started."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from export_model.converters.files.children.python import child_command, module_origin
from export_model.converters.runtimes.base import Runtime, RuntimeInfo


def package_runtime(
    name: str,
    how: str,
    distributions: tuple[str, ...],
    *,
    independent: bool = True,
    originals: bool = False,
    package: str = "",
    child: tuple[str, ...] = (),
) -> Runtime:
    """The runtime of a Python ``package`` (called ``name`` where it is empty), in a child process.

    The child is the module ``child`` of the folder of that name here; ``child`` names another folder and what its
    module is told. Several of the ``distributions`` may provide the package: the first that is installed tells the
    version.
    """
    folder, *told = child or (name,)
    command = partial(child_command, f"export_model.converters.runtimes.{folder}.child", *told)
    find = partial(_find, name, package or name, how, distributions)
    return Runtime(name, find, command, independent=independent, originals=originals)


def _find(name: str, package: str, how: str, distributions: tuple[str, ...]) -> RuntimeInfo:
    origin = module_origin(package)
    return RuntimeInfo(name, origin is not None, None if origin is None else _version(origin, distributions), how)


def _version(origin: str, distributions: tuple[str, ...]) -> str | None:
    """By the folders beside a package; importlib.metadata (25 ms to import) is asked where they are silent."""
    beside = [place.stem.rpartition("-") for place in Path(origin).parent.parent.glob("*-*.dist-info")]
    versions = {re.sub(r"[-_.]+", "-", name).lower(): version for name, _, version in beside}
    for name in distributions:
        if name in versions:
            return versions[name]
    import importlib.metadata

    for name in distributions:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return None
