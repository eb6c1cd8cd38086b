"""The C runtimes of TensorFlow 1.4 and 1.7, which Unity's TensorFlowSharp drove in 2017 and 2018, by ctypes.

Their wheels, which pip still serves, hold two shared objects with all of the C API. Nothing of the wheels' Python code
runs, and no Python of that age is needed.

``LegacySession`` runs a graph in this process, which can hold one version only. ``legacy_process`` gives a child
process that speaks the frames of converters.runner; an assertion within TensorFlow ends that child, not the caller.

Linux on x86-64 with glibc. No string tensors.
"""

from __future__ import annotations

import ctypes
import hashlib
import mmap
import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
import weakref
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from converters.runner.child import claim_stdout, serve
from converters.runner.process import RuntimeProcess
from converters.runner.wire import Tensors
from exporter.runtimes.cache import cache_folder
from signatures.errors import RuntimeUnavailableError

#: Version → sha256 of its wheel for CPython 3.6, manylinux1, x86-64.
WHEELS = MappingProxyType(
    {
        "1.4.0": "972724621a25d136799959cd03ef77b0cca6e1799cd3448f05514bc519b735ad",
        "1.7.1": "6f18752f79f0e037e0e4298d375dabb233394d5dcbf513b35cfb544e5d78b479",
    }
)
_API_LIBRARY = "_pywrap_tensorflow_internal.so"
#: The API library finds the other one beside itself (RUNPATH $ORIGIN).
_LIBRARIES = ("libtensorflow_framework.so", _API_LIBRARY)

_DTYPES = MappingProxyType(
    {
        1: np.dtype(np.float32),
        2: np.dtype(np.float64),
        3: np.dtype(np.int32),
        4: np.dtype(np.uint8),
        5: np.dtype(np.int16),
        6: np.dtype(np.int8),
        9: np.dtype(np.int64),
        10: np.dtype(np.bool_),
        17: np.dtype(np.uint16),
        19: np.dtype(np.float16),
    }
)
_NUMBERS = {dtype: number for number, dtype in _DTYPES.items()}


class LegacyError(Exception):
    """The runtime refused a graph or failed while running it; the text is TensorFlow's own."""


def unsupported_reason() -> str | None:
    """Why these runtimes cannot run on this machine, or None."""
    if (sys.platform, platform.machine(), platform.libc_ver()[0]) != ("linux", "x86_64", "glibc"):
        return "TensorFlow 1.4 and 1.7 are there for Linux on x86-64 with glibc only"
    return None


# ------------------------------------------------------------------ the libraries


def ensure_runtime(version: str) -> Path:
    """The folder with the two libraries of ``version``, fetched by pip into the user's cache on first use.

    Raises RuntimeUnavailableError.
    """
    target = cache_folder() / f"tf-{version}"
    if target.is_dir():
        return target
    reason = unsupported_reason()
    if reason is not None:
        raise RuntimeUnavailableError(f"TensorFlow {version} does not run here", why=reason)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Built beside its place and renamed, so that the folder is whole whenever it exists.
    with tempfile.TemporaryDirectory(prefix=f".tf-{version}-", dir=target.parent) as scratch:
        wheel = _download(version, Path(scratch))
        built = Path(scratch, "lib")
        built.mkdir()
        with zipfile.ZipFile(wheel) as archive:
            for member in archive.namelist():
                name = member.rpartition("/")[2]
                if name in _LIBRARIES:
                    with archive.open(member) as source, (built / name).open("wb") as copy:
                        shutil.copyfileobj(source, copy)
        _weaken_python_symbols(built / _API_LIBRARY)
        try:
            built.rename(target)
        except OSError:
            if not target.is_dir():  # else another process was faster, with the same files
                raise
    return target


def _download(version: str, folder: Path) -> Path:
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
    command += ["--python-version", "3.6", "--platform", "manylinux1_x86_64", "--dest", str(folder)]
    done = subprocess.run([*command, f"tensorflow=={version}"], capture_output=True, encoding="utf-8", errors="replace")
    wheels = list(folder.glob("*.whl"))
    if done.returncode or len(wheels) != 1:
        said = [line for line in done.stderr.splitlines() if line.strip()]
        raise RuntimeUnavailableError(
            f"TensorFlow {version} could not be fetched",
            why="\n".join(said[-3:]),
            fix="check that pip reaches its index",
        )
    digest = hashlib.sha256(wheels[0].read_bytes()).hexdigest()
    if digest != WHEELS[version]:
        raise RuntimeUnavailableError(
            f"the wheel of TensorFlow {version} is not the one that is known",
            why=f"its sha256 is {digest}, and {WHEELS[version]} was expected",
            fix="check what pip's index serves",
        )
    return wheels[0]


def _weaken_python_symbols(path: Path) -> None:
    """Let the library load where CPython no longer has a symbol that its SWIG code asks for.

    That code never runs here, but every symbol is bound at load time, and CPython 3.10 dropped two that 1.7 names. In
    this private copy the undefined symbols of Python are made weak: the loader binds those it finds and leaves the rest
    null. (ELF64: section headers, then the entries of .dynsym.)
    """
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as image:
        assert image[:6] == b"\x7fELF\x02\x01", f"{path.name} is not a little-endian ELF64 file"
        (sections,) = struct.unpack_from("<Q", image, 0x28)
        size, count = struct.unpack_from("<HH", image, 0x3A)
        headers = [struct.unpack_from("<IIQQQQIIQQ", image, sections + i * size) for i in range(count)]
        for _, kind, _, _, start, length, link, _, _, entry in headers:
            if kind != 11:  # SHT_DYNSYM
                continue
            names = headers[link][4]
            for at in range(start, start + length, entry):
                name, info, _, section = struct.unpack_from("<IBBH", image, at)
                undefined_global = section == 0 and info >> 4 == 1
                if undefined_global and image[names + name : names + name + 3] in (b"_Py", b"PyE", b"PyO"):
                    image[at + 4] = 2 << 4 | info & 15  # STB_WEAK


# ------------------------------------------------------------------ the C API

_pointer, _string, _int, _int64, _size = (
    ctypes.c_void_p,
    ctypes.c_char_p,
    ctypes.c_int,
    ctypes.c_int64,
    ctypes.c_size_t,
)


class _Output(ctypes.Structure):
    """TF_Output: one output of an operation."""

    _fields_ = (("operation", _pointer), ("index", _int))


#: Function → (what it returns, what it takes). tensorflow/c/c_api.h.
_FUNCTIONS: Mapping[str, tuple[Any, tuple[Any, ...]]] = MappingProxyType(
    {
        "TF_Version": (_string, ()),
        "TF_NewStatus": (_pointer, ()),
        "TF_DeleteStatus": (None, (_pointer,)),
        "TF_GetCode": (_int, (_pointer,)),
        "TF_Message": (_string, (_pointer,)),
        "TF_NewBufferFromString": (_pointer, (_string, _size)),
        "TF_DeleteBuffer": (None, (_pointer,)),
        "TF_NewGraph": (_pointer, ()),
        "TF_DeleteGraph": (None, (_pointer,)),
        "TF_NewImportGraphDefOptions": (_pointer, ()),
        "TF_DeleteImportGraphDefOptions": (None, (_pointer,)),
        "TF_GraphImportGraphDef": (None, (_pointer, _pointer, _pointer, _pointer)),
        "TF_GraphOperationByName": (_pointer, (_pointer, _string)),
        "TF_OperationNumOutputs": (_int, (_pointer,)),
        "TF_NewSessionOptions": (_pointer, ()),
        "TF_DeleteSessionOptions": (None, (_pointer,)),
        "TF_SetConfig": (None, (_pointer, _string, _size, _pointer)),
        "TF_NewSession": (_pointer, (_pointer, _pointer, _pointer)),
        "TF_CloseSession": (None, (_pointer, _pointer)),
        "TF_DeleteSession": (None, (_pointer, _pointer)),
        "TF_SessionRun": (
            None,
            (
                *(_pointer, _pointer),  # session, run options
                *(ctypes.POINTER(_Output), ctypes.POINTER(_pointer), _int),  # what is fed
                *(ctypes.POINTER(_Output), ctypes.POINTER(_pointer), _int),  # what is fetched
                *(_pointer, _int),  # operations to run besides
                *(_pointer, _pointer),  # run metadata, status
            ),
        ),
        "TF_AllocateTensor": (_pointer, (_int, ctypes.POINTER(_int64), _int, _size)),
        "TF_DeleteTensor": (None, (_pointer,)),
        "TF_TensorType": (_int, (_pointer,)),
        "TF_NumDims": (_int, (_pointer,)),
        "TF_Dim": (_int64, (_pointer, _int)),
        "TF_TensorByteSize": (_size, (_pointer,)),
        "TF_TensorData": (_pointer, (_pointer,)),
    }
)

#: The version that this process has loaded, and its library.
_loaded: dict[str, ctypes.CDLL] = {}


def _library(version: str) -> ctypes.CDLL:
    if version in _loaded:
        return _loaded[version]
    if _loaded:
        raise RuntimeError(f"this process runs TensorFlow {next(iter(_loaded))}; another version needs another process")
    folder = ensure_runtime(version)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # read by TensorFlow when it is loaded
    # DEEPBIND: its own copies of protobuf and the like, even where a modern TensorFlow is in the process already.
    library = ctypes.CDLL(str(folder / _API_LIBRARY), mode=os.RTLD_LOCAL | os.RTLD_LAZY | os.RTLD_DEEPBIND)
    for name, (result, arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    _loaded[version] = library
    return library


@contextmanager
def _checked(library: ctypes.CDLL) -> Iterator[int]:
    """A TF_Status; at the end it is freed, and raised as LegacyError unless it is OK."""
    status = library.TF_NewStatus()
    try:
        yield status
        if library.TF_GetCode(status):
            raise LegacyError(library.TF_Message(status).decode("utf-8", "replace"))
    finally:
        library.TF_DeleteStatus(status)


class LegacySession:
    """A frozen graph in a session of TensorFlow ``version``, with one thread, so that sums repeat.

    Raises LegacyError on a graph that this version does not take.
    """

    def __init__(self, graph: bytes, version: str) -> None:
        self._library = library = _library(version)
        self._graph = library.TF_NewGraph()
        self._close = weakref.finalize(self, library.TF_DeleteGraph, self._graph)
        self._import(graph)
        self._session = self._open()
        self._close.detach()
        self._close = weakref.finalize(self, _close, library, self._session, self._graph)

    @property
    def version(self) -> str:
        """What the runtime says of itself."""
        return str(self._library.TF_Version().decode())

    def _import(self, graph: bytes) -> None:
        library = self._library
        options = library.TF_NewImportGraphDefOptions()
        buffer = library.TF_NewBufferFromString(graph, len(graph))
        try:
            with _checked(library) as status:
                library.TF_GraphImportGraphDef(self._graph, buffer, options, status)
        finally:
            library.TF_DeleteBuffer(buffer)
            library.TF_DeleteImportGraphDefOptions(options)

    def _open(self) -> int:
        library = self._library
        # ConfigProto: intra_op_parallelism_threads (field 2) and inter_op_parallelism_threads (field 5) are 1.
        config = bytes([2 << 3, 1, 5 << 3, 1])
        options = library.TF_NewSessionOptions()
        try:
            with _checked(library) as status:
                library.TF_SetConfig(options, config, len(config), status)
            with _checked(library) as status:
                session: int = library.TF_NewSession(self._graph, options, status)
        finally:
            library.TF_DeleteSessionOptions(options)
        return session

    def run(self, feeds: Mapping[str, np.ndarray], fetch: Sequence[str]) -> dict[str, np.ndarray]:
        """Values of the tensors in ``fetch``, by the names they were asked under; any tensor may be fed."""
        inputs = (_Output * len(feeds))(*(self._output(name) for name in feeds))
        outputs = (_Output * len(fetch))(*(self._output(name) for name in fetch))
        given, made = (_pointer * len(feeds))(), (_pointer * len(fetch))()
        try:
            for i, array in enumerate(feeds.values()):
                given[i] = self._tensor(array)
            with _checked(self._library) as status:
                self._library.TF_SessionRun(
                    *(self._session, None),
                    *(inputs, given, len(feeds)),
                    *(outputs, made, len(fetch)),
                    *(None, 0),
                    *(None, status),
                )
            return {name: self._array(tensor) for name, tensor in zip(fetch, made, strict=True)}
        finally:
            for tensor in (*given, *made):
                if tensor:
                    self._library.TF_DeleteTensor(tensor)

    def _output(self, name: str) -> _Output:
        node, _, index = name.partition(":")
        operation = self._library.TF_GraphOperationByName(self._graph, node.encode())
        if not operation or int(index or 0) >= self._library.TF_OperationNumOutputs(operation):
            raise LegacyError(f"the graph has no tensor {name!r}")
        return _Output(operation, int(index or 0))

    def _tensor(self, array: np.ndarray) -> int:
        if array.dtype not in _NUMBERS:
            raise LegacyError(f"a tensor of {array.dtype} cannot be fed")
        dims = (_int64 * array.ndim)(*array.shape)
        tensor: int = self._library.TF_AllocateTensor(_NUMBERS[array.dtype], dims, array.ndim, array.nbytes)
        data = array.tobytes()
        ctypes.memmove(self._library.TF_TensorData(tensor), data, len(data))
        return tensor

    def _array(self, tensor: int) -> np.ndarray:
        library = self._library
        number = library.TF_TensorType(tensor)
        if number not in _DTYPES:
            raise LegacyError(f"a tensor of TF_DataType {number} cannot be fetched")
        shape = [library.TF_Dim(tensor, i) for i in range(library.TF_NumDims(tensor))]
        data = ctypes.string_at(library.TF_TensorData(tensor), library.TF_TensorByteSize(tensor))
        return np.frombuffer(data, _DTYPES[number]).reshape(shape).copy()

    def close(self) -> None:
        """Free the session and its graph; it also happens when the object goes."""
        self._close()

    def __enter__(self) -> LegacySession:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _close(library: ctypes.CDLL, session: int, graph: int) -> None:
    with _checked(library) as status:
        library.TF_CloseSession(session, status)
    with _checked(library) as status:
        library.TF_DeleteSession(session, status)
    library.TF_DeleteGraph(graph)


# ------------------------------------------------------------------ in a process of its own


def legacy_process(version: str) -> RuntimeProcess:
    """A child process that runs graphs in TensorFlow ``version``. Raises RuntimeUnavailableError."""
    ensure_runtime(version)
    root = str(Path(__file__).resolve().parents[2])
    start = f"import sys, runpy; sys.path.insert(0, {root!r}); runpy.run_module({__name__!r}, run_name='__main__')"
    return RuntimeProcess(f"tf{version}", [sys.executable, "-c", start, version])


class _Model:
    """A session as converters.runner.child wants it."""

    def __init__(self, session: LegacySession) -> None:
        self.session = session

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        return self.session.run(feeds, fetch)


def main() -> None:
    """Entry of the child process; its argument is the version."""
    out = claim_stdout()
    version = sys.argv[1]

    def load(header: Mapping[str, Any]) -> _Model:
        return _Model(LegacySession(Path(header["path"]).read_bytes(), version))

    serve(f"tf{version}", _library(version).TF_Version().decode(), load, (LegacyError,), out)


if __name__ == "__main__":
    main()
