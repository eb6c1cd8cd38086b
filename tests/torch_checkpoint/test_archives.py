"""The two forms of torch.save, taken apart: dtypes, strides, bounds; and nothing in a pickle is ever run."""

from __future__ import annotations

import builtins
import io
import os
import pickle
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from export_model.converters.files.torch_archive import Archive
from export_model.converters.files.unpickle import PickledTensor, unpickle
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError
from fixtures.torch_checkpoint import FOLDER
from tests.commands import export_model
from tests.torch_checkpoint.pt_files import Call, Stored, Writer, actor, checkpoint, pickled, zipped

FORMS = ("zip", "row")


def saved(folder: Path, data: bytes) -> Path:
    path = folder / "checkpoint.pt"
    path.write_bytes(data)
    return path


def archive(folder: Path, data: bytes) -> Archive:
    return Archive(data)


def tensor(opened: Archive) -> np.ndarray:
    assert isinstance(opened.value, PickledTensor)
    return opened.array(opened.value, "x")


# ------------------------------------------------------------------ tensors


@pytest.mark.parametrize("byteorder", ["little", "big"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dtype", ["float32", "float64", "float16", "int64", "int32", "int16", "int8", "uint8", "bool"])
def test_every_dtype(dtype: str, form: str, byteorder: str, tmp_path: Path) -> None:
    writer = Writer(byteorder)
    array = (np.arange(6).reshape(2, 3) % 5).astype(dtype)
    value = writer.tensor(array)
    found = tensor(archive(tmp_path, getattr(writer, form)(value)))
    assert found.dtype == array.dtype and found.dtype.isnative
    assert np.array_equal(found, array)


def test_bfloat16_is_the_upper_half_of_float32(tmp_path: Path) -> None:
    writer = Writer()
    values = np.array([1.0, -2.5, 0.0], np.float32)
    halves = (values.view(np.uint32) >> 16).astype(np.uint16)
    found = tensor(archive(tmp_path, writer.zip(writer.tensor(halves, kind="BFloat16Storage"))))
    assert found.dtype == np.float32
    assert np.array_equal(found, values)


@given(st.permutations([0, 1, 2]), st.integers(0, 5))
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
def test_strides_and_offsets(tmp_path: Path, order: list[int], offset: int) -> None:
    """Whatever view of a storage was saved: numpy's own transposes say what it holds."""
    writer = Writer()
    whole = np.arange(offset + 24, dtype=np.float32)
    view = whole[offset:].reshape(2, 3, 4).transpose(order)
    call = writer.tensor(whole)
    steps = tuple(s // 4 for s in view.strides)
    changed = Call(call.module, call.name, (call.arguments[0], offset, view.shape, steps, False, None))
    assert np.array_equal(tensor(archive(tmp_path, writer.zip(changed))), view)


def test_a_tensor_that_leaves_its_storage_is_refused(tmp_path: Path) -> None:
    for offset, shape, strides in ((1, (3,), (1,)), (0, (2, 2), (2, 1)), (0, (2,), (5,)), (0, (2**30, 2**30), (1, 1))):
        writer = Writer()
        stored = writer.tensor(np.zeros(3, np.float32)).arguments[0]
        made = Call("torch._utils", "_rebuild_tensor_v2", (stored, offset, shape, strides, False, None))
        with pytest.raises(DamagedFileError, match="beyond its storage"):
            tensor(archive(tmp_path, writer.zip(made)))


def test_a_tensor_that_repeats_its_storage_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    writer = Writer()
    stored = writer.tensor(np.zeros(1, np.float32)).arguments[0]
    made = Call("torch._utils", "_rebuild_tensor_v2", (stored, 0, (2**30, 2**30), (0, 0), False, None))
    with pytest.raises(DamagedFileError, match="more numbers than the file"):
        tensor(archive(tmp_path, writer.zip(made)))


@pytest.mark.parametrize("count", [2**40, 10**30, -1])
def test_a_storage_that_claims_to_be_huge_is_refused_before_memory_is_taken(count: int, tmp_path: Path) -> None:
    value = Call("torch._utils", "_rebuild_tensor_v2", (Stored("0", "FloatStorage", 1), 0, (1,), (1,), False, None))
    for data in (Writer().zip(value), Writer().row(value)):
        claimed = data.replace(b"J\x01\x00\x00\x00tQ", pickled(count)[2:-1] + b"tQ")
        assert claimed != data
        if data.startswith(b"PK"):  # the entry's length and checksum change with it
            inner = pickled(value).replace(b"J\x01\x00\x00\x00tQ", pickled(count)[2:-1] + b"tQ")
            claimed = zipped({"a/data.pkl": inner, "a/data/0": bytes(4)})
        with pytest.raises(DamagedFileError, match="more than the file"):
            archive(tmp_path, claimed)


def test_a_compressed_archive_is_refused_before_it_unfolds(tmp_path: Path) -> None:
    writer = Writer()
    data = writer.zip(writer.tensor(np.zeros(10**6, np.float32)), compression=zipfile.ZIP_DEFLATED)
    assert len(data) < 10**5
    with pytest.raises(NotAPolicyError, match="is compressed"):
        archive(tmp_path, data)


def test_a_memo_of_two_thousand_million_entries_takes_no_memory() -> None:
    """The standard library's own machine allocates 32 GiB for these bytes: why ours stays."""
    tracemalloc.start()
    try:
        assert unpickle(io.BytesIO(b"\x80\x04]r\xff\xff\xff\x7f."), lambda _: None) == []
        with pytest.raises(DamagedFileError, match="cannot be read"):
            unpickle(io.BytesIO(b"\x80\x05\x96" + (1 << 40).to_bytes(8, "little") + b"."), lambda _: None)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()


# ------------------------------------------------------------------ nothing is run


class _Runs:
    """Pickles as a call of ``function``."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.function, self.arguments


def _forms(payload: bytes) -> dict[str, bytes]:
    head = b"".join(map(pickled, (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})))
    return {"zip": zipped({"a/data.pkl": payload}), "row": head + payload, "bare": payload}


# Protocols 0 and 1 have no first byte of their own: a bare pickle of theirs is no pickle to the eye.
@pytest.mark.parametrize(
    ("form", "protocol"),
    [(f, p) for f in ("zip", "row", "bare") for p in range(6) if f != "bare" or p > 1],
)
@pytest.mark.parametrize("name", ["system", "eval", "exec", "open", "loads"])
def test_code_in_a_pickle_is_refused_by_name_and_not_run(
    name: str, protocol: int, form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    touched = tmp_path / "touched"
    code = f"__import__('pathlib').Path({str(touched)!r}).write_text('x')"
    function, argument = {
        "system": (os.system, f"echo x > {touched}"),
        "eval": (builtins.eval, code),
        "exec": (builtins.exec, code),
        "open": (builtins.open, str(touched)),
        "loads": (pickle.loads, pickle.dumps(_Runs(builtins.eval, code))),
    }[name]
    arguments = (argument, "w") if name == "open" else (argument,)
    payload = pickle.dumps({"Policy": _Runs(function, *arguments)}, protocol)
    path = saved(tmp_path, _forms(payload)[form])
    ran = export_model(path, "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 2
    if form == "bare":
        assert "a pickle that PyTorch did not write" in ran.err
    else:
        assert f".{name}" in ran.err and "nothing in it is run" in ran.err.replace("\n", " ")
    assert not touched.exists() and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("torch.storage", "_load_from_bytes"),  # unpickles what it is given, without limits
        ("torch", "load"),
        ("torch.jit", "load"),
        ("torch._utils", "_import_dotted_name"),
        ("builtins", "getattr"),
        ("numpy.core.multiarray", "_reconstruct"),
        ("collections", "OrderedDict.fromkeys"),
        ("mlagents.trainers.torch_entities.networks", "SimpleActor"),
    ],
)
def test_every_name_that_is_not_needed_is_refused_by_name(module: str, name: str, tmp_path: Path) -> None:
    call = Call(module, name, ("x",))
    for data in (Writer().zip({"Policy": call}), Writer().row({"Policy": call})):
        with pytest.raises(NotAPolicyError, match=f"{module}.{name}".replace(".", r"\.")):
            archive(tmp_path, data)


@pytest.mark.parametrize(
    ("module", "name", "said"),
    [
        ("torch.nn.modules.container", "Sequential", "saved whole"),
        ("torch.optim.adam", "Adam", "saved whole"),
        ("numpy._core.multiarray", "_reconstruct", "settings, statistics or data"),
        ("gymnasium.spaces.box", "Box", "settings, statistics or data"),
        ("posix", "system", "would run that"),
        ("builtins", "eval", "would run that"),
        ("torch.storage", "_load_from_bytes", "only its name"),
        ("__main__", "Args", "only its name"),
        ("osmium", "Reader", "only its name"),
    ],
)
def test_what_a_pickle_asks_for_says_what_it_is(module: str, name: str, said: str, tmp_path: Path) -> None:
    """A file with settings beside its weights is not called an attack."""
    with pytest.raises(NotAPolicyError) as caught:
        archive(tmp_path, Writer().zip({"Policy": Call(module, name, ("x",))}))
    assert said in str(caught.value)
    assert "attack" not in str(caught.value)
    assert caught.value.fix


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (b"(S'x'\nios\nsystem\n.", "STRING"),
        (b"(I1\nios\nsystem\n.", "os.system"),
        (b"\x80\x02ccollections\nOrderedDict\n)\x81.", "NEWOBJ"),
        (b"\x80\x02\x82\x01.", "EXT1"),
        (b"Pname\n.", "PERSID"),
        (b"\x80\x02}}b.", None),
        (b"\x80\x02(.", "a mark for a value"),
        (b"\x80\x02t.", "a mark that is not there"),
        (b"\x80\x02].s.", None),
        (b"\x80\x02h\x05.", "cannot be read"),
        (b"\x80\x02}]K\x01s.", "a key in its pickle is a list"),
        (b"\x80\x02K\x01", "cannot be read"),
        (b"\x80\x02K\x01K\x01R.", "other than a function"),
        (b"\x80\x02K\x01Q.", "must be a tuple"),
        (b"\x80\x02cbuiltins\n.", "cannot be read"),
        (b"\x80\x05\x8e" + struct.pack("<Q", 2**60) + b"x.", "cannot be read"),
        (b"\x80\x02r\xff\xff\xff\x7f.", "cannot be read"),
        (b"\x80\x02X\xff\xff\xff\x7fabc.", "cannot be read"),
    ],
)
def test_pickles_that_are_wrong(payload: bytes, words: str | None, tmp_path: Path) -> None:
    path = saved(tmp_path, zipped({"a/data.pkl": payload}))
    with pytest.raises(ExportModelError) as caught:
        read_source(path)
    assert caught.value.exit_status == 2
    assert words is None or words in str(caught.value)


def test_a_pickle_that_is_nested_deeply_is_only_data(tmp_path: Path) -> None:
    deep = b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b"."
    with pytest.raises(NotAPolicyError, match="must be a checkpoint of a policy"):
        read_source(saved(tmp_path, zipped({"a/data.pkl": deep})))


# ------------------------------------------------------------------ damage


SMALL = actor(observed=2, hidden=2, actions=1, branches=(2,))
WHOLE = {form: checkpoint(SMALL, form) for form in ("zip", "legacy")}


def test_what_is_written_here_is_read(tmp_path: Path) -> None:
    for data in WHOLE.values():
        assert read_source(saved(tmp_path, data)).policies()


@pytest.mark.parametrize("form", WHOLE)
@given(data=st.data())
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
def test_damaged_archives_give_our_errors_only(form: str, data: st.DataObject, tmp_path: Path) -> None:
    changed = bytearray(WHOLE[form])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(changed) - 1))
        kind = data.draw(st.sampled_from(("set", "cut", "insert", "remove")))
        if kind == "set":
            changed[at] = data.draw(st.integers(0, 255))
        elif kind == "cut" and at:
            del changed[at:]
        elif kind == "insert":
            changed[at:at] = data.draw(st.binary(min_size=1, max_size=9))
        else:
            del changed[at : at + data.draw(st.integers(1, 9))]
        if not changed:
            break
    path = saved(tmp_path, bytes(changed))
    try:
        read_source(path).policies()
    except ExportModelError as error:
        assert error.exit_status == 2


@given(data=st.data())
@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
def test_damaged_pickles_give_our_errors_only(data: st.DataObject, tmp_path: Path) -> None:
    """Below the archive's checksums: the pickle alone is changed, the rest fits."""
    writer = Writer()
    pickle_bytes = bytearray(pickled({"Policy": writer.state(SMALL), "global_step": 3}))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(pickle_bytes) - 1))
        pickle_bytes[at] = data.draw(st.integers(0, 255))
    entries = {f"a/data/{k}": v.tobytes() for k, v in writer.storages.items()}
    path = saved(tmp_path, zipped({"a/data.pkl": bytes(pickle_bytes), **entries}))
    try:
        read_source(path).policies()
    except ExportModelError as error:
        assert error.exit_status == 2


@given(st.dictionaries(st.sampled_from(sorted(SMALL)), st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=1))
@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
def test_weights_of_other_shapes_give_our_errors_only(tmp_path: Path, shapes: dict[str, tuple[int, ...]]) -> None:
    changed = {**SMALL, **{n: np.ones(s, np.float32) for n, s in shapes.items()}}
    path = saved(tmp_path, checkpoint(changed))
    try:
        read_source(path).policies()
    except ExportModelError as error:
        assert error.exit_status == 2


def test_what_pytorch_wrote_and_what_is_written_here_are_taken_apart_alike(tmp_path: Path) -> None:
    """The writer of these tests is held against a genuine file: its tensors, written again, are the same."""
    genuine = Archive((FOLDER / "ppo_1_1.pt").read_bytes())
    arrays = {n: genuine.array(t, n) for n, t in genuine.value["Policy"].items()}
    again = archive(tmp_path, checkpoint(arrays))
    assert list(again.value["Policy"]) == list(arrays)
    for name, wanted in arrays.items():
        found = again.array(again.value["Policy"][name], name)
        assert found.shape == wanted.shape or wanted.size == 0
        assert np.array_equal(found, wanted)
