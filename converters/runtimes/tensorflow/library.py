"""Graphs and SavedModels in any TensorFlow from 1.4 on, by its C API (tensorflow/c/c_api.h) and ctypes.

A process holds one version: a second library's SONAME would resolve to the first. No string tensors.
"""

from __future__ import annotations

import ctypes
import math
import os
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from export_model.signatures.dtypes import DATA_TYPES

#: TF_DataType → numpy's.
_DTYPES = {t.tensorflow: t.dtype for t in DATA_TYPES}
_NUMBERS = {dtype: number for number, dtype in _DTYPES.items()}


class TensorFlowError(Exception):
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


class _Buffer(ctypes.Structure):
    _fields_ = (("data", _pointer), ("length", _size), ("free", _pointer))


#: Function → (what it returns, what it takes). tensorflow/c/c_api.h.
_FUNCTIONS: Mapping[str, tuple[Any, tuple[Any, ...]]] = {
    "TF_Version": (_string, ()),
    "TF_NewStatus": (_pointer, ()),
    "TF_DeleteStatus": (None, (_pointer,)),
    "TF_GetCode": (_int, (_pointer,)),
    "TF_Message": (_string, (_pointer,)),
    "TF_NewBuffer": (ctypes.POINTER(_Buffer), ()),
    "TF_NewBufferFromString": (ctypes.POINTER(_Buffer), (_string, _size)),
    "TF_DeleteBuffer": (None, (ctypes.POINTER(_Buffer),)),
    "TF_NewGraph": (_pointer, ()),
    "TF_DeleteGraph": (None, (_pointer,)),
    "TF_NewImportGraphDefOptions": (_pointer, ()),
    "TF_DeleteImportGraphDefOptions": (None, (_pointer,)),
    "TF_GraphImportGraphDef": (None, (_pointer, ctypes.POINTER(_Buffer), _pointer, _pointer)),
    "TF_GraphOperationByName": (_pointer, (_pointer, _string)),
    "TF_OperationNumOutputs": (_int, (_pointer,)),
    "TF_OperationOutputType": (_int, (_Output,)),
    "TF_GraphGetTensorNumDims": (_int, (_pointer, _Output, _pointer)),
    "TF_GraphGetTensorShape": (None, (_pointer, _Output, ctypes.POINTER(_int64), _int, _pointer)),
    "TF_NewSessionOptions": (_pointer, ()),
    "TF_DeleteSessionOptions": (None, (_pointer,)),
    "TF_SetConfig": (None, (_pointer, _string, _size, _pointer)),
    "TF_NewSession": (_pointer, (_pointer, _pointer, _pointer)),
    "TF_LoadSessionFromSavedModel": (
        _pointer,
        (
            *(_pointer, _pointer, _string),  # session options, run options, folder
            *(ctypes.POINTER(_string), _int),  # tags
            *(_pointer, ctypes.POINTER(_Buffer), _pointer),  # graph, MetaGraphDef, status
        ),
    ),
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
    """A TF_Status; at the end it is freed, and raised as TensorFlowError unless it is OK."""
    status = library.TF_NewStatus()
    try:
        yield status
        if library.TF_GetCode(status):
            raise TensorFlowError(library.TF_Message(status).decode("utf-8", "replace"))
    finally:
        library.TF_DeleteStatus(status)


class Session:
    """A graph in a session with one thread, so that sums repeat; both are freed when the object goes.

    The graph is a frozen GraphDef, or a SavedModel's for serving, whose MetaGraphDef ``meta_graph`` holds then.
    ``fitting``: an array is held against what it is fed to, as Python's ``Session.run`` does; the C API looks at its
    dtype alone. The float64 outputs of a ``source`` are given as float32, as which they are exported.
    Raises TensorFlowError on a graph that this version does not take.
    """

    def __init__(
        self, library: ctypes.CDLL, model: Path, *, saved: bool = False, fitting: bool = False, source: bool = False
    ) -> None:
        self._library, self._fits, self._source = library, fitting, source
        self.meta_graph = b""
        self._graph = library.TF_NewGraph()
        self._close = weakref.finalize(self, library.TF_DeleteGraph, self._graph)
        if not saved:
            self._import(model.read_bytes())
        with self._options() as options:
            self._session = self._open_saved(model, options) if saved else self._open(options)
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

    @contextmanager
    def _options(self) -> Iterator[int]:
        """TF_SessionOptions; the graph optimisers stay on, as users have them."""
        # ConfigProto: intra_op_parallelism_threads (2), inter_op_parallelism_threads (5), allow_soft_placement (7)
        config = bytes([2 << 3, 1, 5 << 3, 1, 7 << 3, 1])
        options = self._library.TF_NewSessionOptions()
        try:
            with _status(self._library) as status:
                self._library.TF_SetConfig(options, config, len(config), status)
            yield options
        finally:
            self._library.TF_DeleteSessionOptions(options)

    def _open(self, options: int) -> int:
        with _status(self._library) as status:
            session: int = self._library.TF_NewSession(self._graph, options, status)
        return session

    def _open_saved(self, folder: Path, options: int) -> int:
        library = self._library
        tags = (_string * 1)(b"serve")
        buffer = library.TF_NewBuffer()
        try:
            with _status(library) as status:
                session: int = library.TF_LoadSessionFromSavedModel(
                    *(options, None, os.fsencode(folder)),
                    *(tags, 1),
                    *(self._graph, buffer, status),
                )
            self.meta_graph = ctypes.string_at(buffer.contents.data, buffer.contents.length)
        finally:
            library.TF_DeleteBuffer(buffer)
        return session

    def run(
        self, feeds: Mapping[str, np.ndarray], fetch: Sequence[str], request: object = None
    ) -> dict[str, np.ndarray]:
        """Values of the tensors in ``fetch``, by the names they were asked under; any tensor may be fed.

        Raises TensorFlowError, and ValueError on an array that the tensor it is fed to cannot be.
        """
        fed = {_tensor_name(name): array for name, array in feeds.items()}
        inputs = (_Output * len(fed))(*(self._output(name) for name in fed))
        if self._fits:
            fed = {name: self._fitting(name, tensor, fed[name]) for name, tensor in zip(fed, inputs, strict=True)}
        asked = [name for name in fetch if _tensor_name(name) not in fed]  # the C API refuses what is both
        outputs = (_Output * len(asked))(*(self._output(name) for name in asked))
        given, made = (_pointer * len(fed))(), (_pointer * len(asked))()
        try:
            for i, array in enumerate(fed.values()):
                given[i] = self._tensor(array)
            if asked:  # nor does it run for nothing
                with _status(self._library) as status:
                    self._library.TF_SessionRun(
                        *(self._session, None),
                        *(inputs, given, len(fed)),
                        *(outputs, made, len(asked)),
                        *(None, 0),
                        *(None, status),
                    )
            answers = {name: self._array(tensor) for name, tensor in zip(asked, made, strict=True)}
            return {name: answers[name] if name in answers else fed[_tensor_name(name)] for name in fetch}
        finally:
            for tensor in (*given, *made):
                if tensor:
                    self._library.TF_DeleteTensor(tensor)

    def _output(self, name: str) -> _Output:
        node, _, index = name.partition(":")
        operation = self._library.TF_GraphOperationByName(self._graph, node.encode())
        if not operation or int(index or 0) >= self._library.TF_OperationNumOutputs(operation):
            raise TensorFlowError(f"the graph has no tensor {name!r}")
        return _Output(operation, int(index or 0))

    def _fitting(self, name: str, output: _Output, array: np.ndarray) -> np.ndarray:
        """An array in the dtype and of the shape that a tensor declares; a row where it has no axis for the agents."""
        declared = self._shape(output)
        number = self._library.TF_OperationOutputType(output)
        array = array.astype(_DTYPES.get(number, array.dtype), copy=False)
        if declared is None:
            return array
        sizes = [size for size in declared if size is not None]
        if len(sizes) == len(declared) != array.ndim and math.prod(sizes) == array.size:
            return array.reshape(sizes)
        if len(declared) != array.ndim or any(n not in (None, m) for n, m in zip(declared, array.shape, strict=True)):
            raise ValueError(f"cannot feed an array of shape {array.shape} to {name!r}, which has shape {declared}")
        return array

    def _shape(self, output: _Output) -> tuple[int | None, ...] | None:
        """The declared shape; None for a dynamic axis, and for a dynamic rank."""
        library = self._library
        with _status(library) as status:
            rank = library.TF_GraphGetTensorNumDims(self._graph, output, status)
        if rank < 0:
            return None
        sizes = (_int64 * rank)()
        with _status(library) as status:
            library.TF_GraphGetTensorShape(self._graph, output, sizes, rank, status)
        return tuple(None if size < 0 else size for size in sizes)

    def _tensor(self, array: np.ndarray) -> int:
        if array.dtype not in _NUMBERS:
            raise TensorFlowError(f"a tensor of {array.dtype} cannot be fed")
        dims = (_int64 * array.ndim)(*array.shape)
        tensor: int = self._library.TF_AllocateTensor(_NUMBERS[array.dtype], dims, array.ndim, array.nbytes)
        data = array.tobytes()
        ctypes.memmove(self._library.TF_TensorData(tensor), data, len(data))
        return tensor

    def _array(self, tensor: int) -> np.ndarray:
        library = self._library
        number = library.TF_TensorType(tensor)
        if number not in _DTYPES:
            raise TensorFlowError(f"a tensor of TF_DataType {number} cannot be fetched")
        shape = [library.TF_Dim(tensor, i) for i in range(library.TF_NumDims(tensor))]
        data = ctypes.string_at(library.TF_TensorData(tensor), library.TF_TensorByteSize(tensor))
        array = np.frombuffer(data, _DTYPES[number]).reshape(shape).copy()
        return array.astype(np.float32) if self._source and array.dtype == np.float64 else array


def _tensor_name(name: str) -> str:
    return name if ":" in name else f"{name}:0"


def _close(library: ctypes.CDLL, session: int, graph: int) -> None:
    with _status(library) as status:
        library.TF_CloseSession(session, status)
    with _status(library) as status:
        library.TF_DeleteSession(session, status)
    library.TF_DeleteGraph(graph)
