"""Frozen graphs in an old TensorFlow, by its C API (tensorflow/c/c_api.h) and ctypes.

A process holds one version: a second library's SONAME would resolve to the first. No string tensors.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from export_model.signatures.dtypes import DATA_TYPES

#: What the C API had then.
_DTYPES = {t.tensorflow: t.dtype for t in DATA_TYPES if t.tensorflow < 20}
_NUMBERS = {dtype: number for number, dtype in _DTYPES.items()}


class LegacyError(Exception):
    """The runtime refused a graph or failed while running it; the text is TensorFlow's own."""


_pointer, _string, _int, _int64, _size = (
    ctypes.c_void_p,
    ctypes.c_char_p,
    ctypes.c_int,
    ctypes.c_int64,
    ctypes.c_size_t,
)


class _Output(ctypes.Structure):
    _fields_ = (("operation", _pointer), ("index", _int))


#: Function → (what it returns, what it takes). tensorflow/c/c_api.h.
_FUNCTIONS: Mapping[str, tuple[Any, tuple[Any, ...]]] = {
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


def load_library(path: str) -> ctypes.CDLL:
    """The library at ``path``, its functions declared; raises OSError where the loader refuses it."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # read by TensorFlow when it is loaded
    # DEEPBIND: its own copies of protobuf and the like, whatever else is in the process.
    library = ctypes.CDLL(path, mode=os.RTLD_LOCAL | os.RTLD_LAZY | os.RTLD_DEEPBIND)
    for name, (result, arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def library_version(library: ctypes.CDLL) -> str:
    """What the runtime says of itself."""
    return str(library.TF_Version().decode())


@contextmanager
def _status(library: ctypes.CDLL) -> Iterator[int]:
    """A TF_Status; at the end it is freed, and raised as LegacyError unless it is OK."""
    status = library.TF_NewStatus()
    try:
        yield status
        if library.TF_GetCode(status):
            raise LegacyError(library.TF_Message(status).decode("utf-8", "replace"))
    finally:
        library.TF_DeleteStatus(status)


class LegacySession:
    """A frozen graph in a session with one thread, so that sums repeat. Both are freed when the object goes.

    Raises LegacyError on a graph that this version does not take.
    """

    def __init__(self, graph: bytes, library: ctypes.CDLL) -> None:
        self._library = library
        self._graph = library.TF_NewGraph()
        self._close = weakref.finalize(self, library.TF_DeleteGraph, self._graph)
        self._import(graph)
        self._session = self._open()
        self._close.detach()
        self._close = weakref.finalize(self, _close, library, self._session, self._graph)

    def _import(self, graph: bytes) -> None:
        library = self._library
        options = library.TF_NewImportGraphDefOptions()
        buffer = library.TF_NewBufferFromString(graph, len(graph))
        try:
            with _status(library) as status:
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
            with _status(library) as status:
                library.TF_SetConfig(options, config, len(config), status)
            with _status(library) as status:
                session: int = library.TF_NewSession(self._graph, options, status)
        finally:
            library.TF_DeleteSessionOptions(options)
        return session

    def run(self, feeds: Mapping[str, np.ndarray], fetch: Sequence[str], _: object = None) -> dict[str, np.ndarray]:
        """Values of the tensors in ``fetch``, by the names they were asked under; any tensor may be fed."""
        inputs = (_Output * len(feeds))(*(self._output(name) for name in feeds))
        outputs = (_Output * len(fetch))(*(self._output(name) for name in fetch))
        given, made = (_pointer * len(feeds))(), (_pointer * len(fetch))()
        try:
            for i, array in enumerate(feeds.values()):
                given[i] = self._tensor(array)
            with _status(self._library) as status:
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


def _close(library: ctypes.CDLL, session: int, graph: int) -> None:
    with _status(library) as status:
        library.TF_CloseSession(session, status)
    with _status(library) as status:
        library.TF_DeleteSession(session, status)
    library.TF_DeleteGraph(graph)
