"""TorchScript modules of other versions, and those outside of what is known, hostile or damaged: nothing is run."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path

import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError, UnsupportedOpError, UsageError
from fixtures.goldens import read_npz
from fixtures.torchscript import FOLDER
from tests.commands import export_model


def changed(name: str, folder: Path, old: str, new: str) -> Path:
    """A module whose code has other text; nothing else is changed."""
    path, made = folder / "changed.pt", io.BytesIO()
    with zipfile.ZipFile(FOLDER / f"{name}.pt") as archive, zipfile.ZipFile(made, "w") as out:
        found = 0
        for entry in archive.infolist():
            data = archive.read(entry)
            if entry.filename.endswith(".py"):
                found += data.count(old.encode())
                data = data.replace(old.encode(), new.encode())
            out.writestr(zipfile.ZipInfo(entry.filename), data, entry.compress_type)
    assert found
    path.write_bytes(made.getvalue())
    return path


ELU = "    _0 = __torch__.torch.nn.functional.elu(input, 1., False, )\n"


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ("    _0 = torch.fft_fft(input)\n", "the op torch.fft_fft"),
        ('    _0 = os.system("touch touched")\n', "the op os.system"),
        ('    _0 = __import__("os")\n', "the op __import__"),
        ('    _0 = torch.ops.load_library("x.so")\n', "the op torch.ops.load_library"),
        ("    import os\n    _0 = input\n", "a statement of the kind Import"),
        ("    while True:\n      _0 = input\n", "a statement of the kind While"),
        ("    _0 = [x for x in input]\n", "an expression of the kind ListComp"),
        ("    _0 = (lambda: input)()\n", "an expression of the kind Lambda"),
        ("    _0 = self.__class__\n", "has no attribute '__class__'"),
        ("    _0 = input.__class__\n", "is asked for its __class__"),
        ("    _0 = (self).forward(input, )\n", "calls in one another"),
        ("    _0 = torch.randn([1, 3])\n", "it draws random numbers"),
        (
            "    if bool(torch.gt(torch.sum(input), 0)):\n      _0 = input\n    else:\n      _0 = input\n",
            "a number is taken out of a tensor",
        ),
        ("    for i in range(1000000000):\n      _0 = input\n", "a loop goes round 1000000000 times"),
        ("    for i in range(4000):\n      for j in range(4000):\n        _0 = input\n", "more than 100000 statements"),
        ("    _0 = torch.zeros([100000, 100000, 1000])\n", "torch.zeros"),
        ("    _0 = " + "-" * 50_000 + "1\n", ""),
        ("    _0 = " + "[" * 500 + "]" * 500 + "\n", "cannot be parsed"),
        ("    a = [1, 1]\n" + "    a = [a, a]\n" * 60 + "    _0 = input\n", "a list of more than"),
        ("    a = 3\n" + "    a = torch.mul(a, a)\n" * 90 + "    _0 = input\n", "more than 62 bits"),
        ("    _0 = torch.linear(input, input)\n", "torch.linear"),
        ("    _0 = missing\n", "where a tensor is expected"),
        ("    if input:\n      _0 = input\n    else:\n      _0 = input\n", "which way it goes on"),
        ("    self.count = 3\n    _0 = input\n", "count"),
        ("    _0 = __torch__.nowhere.f(input, )\n", "its code has no __torch__.nowhere.f"),
        ("    return\n", ""),
        ("    (((\n", "cannot be parsed"),
    ],
)
def test_what_is_outside_of_the_known_is_refused_by_name(
    new: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = changed("mlp_script", tmp_path, ELU, new)
    with pytest.raises(ExportModelError) as caught:
        read_source(path).policies()
    assert words in str(caught.value)
    assert caught.value.fix or caught.value.why
    assert os.listdir(tmp_path) == ["changed.pt"]  # noqa: PTH208


def test_the_refusal_names_the_module_and_the_op(tmp_path: Path) -> None:
    path = changed("mlp_script", tmp_path, "torch.linear(input, weight, bias)", "torch.conv1d(input, weight, bias)")
    with pytest.raises(UnsupportedOpError) as caught:
        read_source(path)
    assert list(caught.value.issues) == [("0", "torch.conv1d")]


def test_lengths_that_nothing_tells_are_asked_for() -> None:
    path = FOLDER / "convolved_script.pt"
    ran = export_model("inspect", path)
    assert ran.status == 2
    assert "--sensors" in ran.err
    assert export_model("inspect", path, "--sensors", "55").status == 0
    with pytest.raises(UnsupportedOpError, match="the numbers do not fit"):
        read_source(path, ReadOptions(sensors=((30,),)))
    with pytest.raises(UsageError, match="2 shapes, and the module 1 inputs"):
        read_source(path, ReadOptions(sensors=((30,), (2,))))


def test_a_memory_that_the_file_does_not_begin_with_zeros_is_told(tmp_path: Path) -> None:
    source = (FOLDER / "shifted_script.pt").read_bytes()
    with zipfile.ZipFile(io.BytesIO(source)) as archive:
        entries = {e.filename: (archive.read(e), e.compress_type) for e in archive.infolist()}
    (name,) = [n for n, (data, _) in entries.items() if "/data/" in n and data == bytes(60)]
    path = tmp_path / "late.pt"
    with zipfile.ZipFile(path, "w") as out:
        for entry, (data, method) in entries.items():
            out.writestr(zipfile.ZipInfo(entry), b"\x00\x00\x80?" * 15 if entry == name else data, method)
    (policy,) = read_source(path).policies()
    assert any("does not begin with zeros" in note for note in policy.signature.notes)


@pytest.mark.parametrize("percent", range(10, 100, 15))
def test_a_module_that_is_cut_off_is_refused(percent: int, tmp_path: Path) -> None:
    data = (FOLDER / "isaac_lstm_script.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(data[: len(data) * percent // 100])
    with pytest.raises(ExportModelError):
        read_source(tmp_path / "cut.pt")


def test_code_of_older_pytorch_gives_the_same(tmp_path: Path) -> None:
    """As PyTorch 1.5 to 1.8 printed it: a product with the transposed weight, every operand that has a default."""
    older = (
        "    if torch.eq(torch.dim(input), 2):\n      _0 = torch.__isnot__(bias, None)\n    else:\n      _0 = False\n"
        "    if _0:\n      bias0 = unchecked_cast(Tensor, bias)\n"
        "      ret = torch.addmm(bias0, input, torch.t(weight), beta=1, alpha=1)\n"
        "    else:\n      output = torch.matmul(input, torch.t(weight))\n"
        "      ret = torch.add_(output, bias, alpha=1)\n"
        "    return torch.to(torch.slice(ret, 0, 0, 9223372036854775807, 1), 6, False, False, None)\n"
    )
    path = changed("mlp_script", tmp_path, "    return torch.linear(input, weight, bias)\n", older)
    (policy,) = read_source(path).policies()
    golden = read_npz(FOLDER / "mlp_script.npz")
    given = golden["in/input"][:, 0]
    (name,) = [s.name for s in policy.signature.inputs]
    made = run_graph(policy.graph, {name: given}, ["action"])["action"]
    assert made == pytest.approx(golden["out"][:, 0], abs=2e-6, rel=2e-5)


def test_what_a_module_says_beside_its_numbers_is_left_out(tmp_path: Path) -> None:
    """A ``print`` that was left in for debugging, as in a public policy; a warning."""
    said = '    print(input, "z", 3)\n    torch.warn("deprecated", 2)\n'
    path = changed("mlp_script", tmp_path, ELU, said + ELU)
    (policy,), (whole,) = (read_source(p).policies() for p in (path, FOLDER / "mlp_script.pt"))
    assert [(n.name, n.op, n.inputs) for n in policy.graph.nodes] == [
        (n.name, n.op, n.inputs) for n in whole.graph.nodes
    ]


def test_a_scripted_camera_asks_for_its_shape() -> None:
    with pytest.raises(UnsupportedOpError, match="--sensors 3x84x84"):
        read_source(FOLDER / "painted_script.pt").policies()
