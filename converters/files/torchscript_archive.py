"""What ``torch.jit.save`` writes: an archive with a module's attributes, its constants, and its code as text.

Source: torch/csrc/jit/serialization/export_module.cpp, import.cpp (PyTorch 1.4 on): ``<name>/data.pkl`` is the module,
an object of ``__torch__.<path>.<class>`` whose state are its attributes; ``<name>/code/__torch__/….py`` its classes;
``constants.pkl`` a tuple; ``traced_inputs.pkl`` what ``torch.jit.trace`` was given, by method. Each pickle has its
storages in a folder of its own. Code is compressed, tensors are not. Nothing in it is run.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from functools import partial
from typing import Any

from export_model.converters.files.pickled_objects import unpickle_objects
from export_model.converters.files.torch_archive import Archive, Storage
from export_model.converters.files.unpickle import Function, damaged_error
from export_model.converters.files.zip_archives import entry_of

#: Characters of all code; that of a policy has some ten thousands.
MAX_CODE = 1 << 20
_MAX_PICKLE = 16 << 20
_LISTS = ("build_intlist", "build_tensorlist", "build_doublelist", "build_boollist")


def _first(arguments: tuple[Any, ...]) -> Any:
    return arguments[0]


#: The functions that TorchScript's pickles call: a list of one type, a value whose type is told.
_NAMES = {
    **{("torch.jit._pickle", name): Function(name, _first) for name in _LISTS},
    ("torch.jit._pickle", "restore_type_tag"): Function("restore_type_tag", _first),
}


class ScriptArchive(Archive):
    """A module as it was saved: ``value``; ``code`` by its path in the archive, ``constants``, ``traced`` inputs."""

    code: Mapping[str, str]
    constants: tuple[Any, ...]
    traced: Any

    def _of_entries(self, archive: zipfile.ZipFile, entries: Mapping[str, zipfile.ZipInfo], root: str) -> Any:
        code = [n for n in entries if n.startswith(f"{root}code/") and n.endswith(".py")]
        if sum(entries[n].file_size for n in code) > MAX_CODE:
            raise damaged_error(f"its code has more than {MAX_CODE} characters")
        self.code = {n.removeprefix(f"{root}code/"): _text(entry_of(archive, n, MAX_CODE)) for n in code}
        folders = ("data", "constants", "traced_inputs")
        self._check_sizes([e for n, e in entries.items() if n.startswith(tuple(f"{root}{f}/" for f in folders))])
        self._read_order(archive, entries, root)
        found = []
        for folder in folders:
            self._take_storages(entries, f"{root}{folder}/", f"{folder}/")
            data = entry_of(archive, f"{root}{folder}.pkl", _MAX_PICKLE) if f"{root}{folder}.pkl" in entries else None
            storage = partial(self._storage_in, folder)
            found.append(None if data is None else unpickle_objects(data, storage, _NAMES))
        value, constants, self.traced = found
        self.constants = constants if isinstance(constants, tuple) else ()
        return value

    def _storage_in(self, folder: str, identity: tuple[Any, ...]) -> Storage:
        # of what a trace was given the archive keeps the shapes alone, its storages are empty
        found = self._persistent(identity, stored=folder != "traced_inputs")
        return Storage(f"{folder}/{found.key}", found.dtype, found.count)


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise damaged_error("its code is not text") from error
