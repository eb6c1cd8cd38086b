"""ONNX models and PyTorch checkpoints of the zoo: weights that lie elsewhere, ops of strangers, pickles that run."""

from __future__ import annotations

from pathlib import Path

from tests.hostile.making import (
    Maker,
    case,
    elsewhere,
    onnx_policy,
)


def _onnx_cases() -> None:
    def written(folder: Path, data: bytes) -> Path:
        path = folder / "policy.onnx"
        path.write_bytes(data)
        return path

    def outside(location: str) -> Maker:
        return lambda folder, marker: written(folder, elsewhere(onnx_policy(), location))

    def link(folder: Path, marker: Path) -> Path:
        (folder / "weights.bin").symlink_to("/etc/passwd")
        return written(folder, elsewhere(onnx_policy(), "weights.bin"))

    def pipe(folder: Path, marker: Path) -> Path:
        import os

        os.mkfifo(folder / "weights.bin")
        return written(folder, elsewhere(onnx_policy(), "weights.bin"))

    def custom(folder: Path, marker: Path) -> Path:
        from onnx import helper

        nodes = [
            helper.make_node("MatMul", ["obs_0", "kernel"], ["continuous_actions"]),
            helper.make_node("WriteFile", ["obs_0"], ["unused"], domain="evil.ops"),
        ]
        return written(folder, onnx_policy(nodes, domains=["evil.ops"]))

    def context(folder: Path, marker: Path) -> Path:
        from onnx import helper

        made = helper.make_node(
            "EPContext", ["obs_0"], ["continuous_actions"], domain="com.microsoft", ep_cache_context="/etc/passwd"
        )
        return written(folder, onnx_policy([made], domains=["com.microsoft"]))

    def in_function(folder: Path, marker: Path) -> Path:
        import onnx
        from onnx import helper

        model = onnx.ModelProto.FromString(
            onnx_policy([helper.make_node("F", ["obs_0"], ["continuous_actions"], domain="own")])
        )
        model.opset_import.add(domain="own", version=1)
        outer = onnx.ModelProto.FromString(elsewhere(onnx_policy(), "../../../../../../../../etc/passwd"))
        constant_ = helper.make_node("Constant", [], ["k"], value=outer.graph.initializer[0])
        nodes = [constant_, helper.make_node("MatMul", ["x", "k"], ["y"])]
        model.functions.append(helper.make_function("own", "F", ["x"], ["y"], nodes, [helper.make_opsetid("", 13)]))
        return written(folder, model.SerializeToString())

    makers: dict[str, Maker] = {
        "weights above its folder": outside("../../../../../../../../etc/passwd"),
        "weights at an absolute path": outside("/etc/passwd"),
        "weights behind a link": link,
        "weights in a pipe": pipe,
        "weights that are its folder": outside("."),
        "weights with a NUL in the path": outside("a\0/etc/passwd"),
        "a custom operator": custom,
        "a context of a device": context,
        "weights elsewhere in a function": in_function,
    }
    for label, make in makers.items():
        case(f"ONNX, {label}")(make)
        case(f"compare with an ONNX, {label}", "candidate")(make)


_onnx_cases()


def _pickles() -> None:
    import zipfile

    def archive(data: bytes) -> Maker:
        def make(folder: Path, marker: Path) -> Path:
            path = folder / "policy.pt"
            with zipfile.ZipFile(path, "w") as made:
                made.writestr("archive/data.pkl", data.replace(b"MARKER", str(marker).encode()))
                made.writestr("archive/version", "3\n")
            return path

        return make

    start, copies = b"\x80\x02", b"0(" + b"h\x00h\x01\x85R" * 20_000 + b"l."
    pickles = {
        "a command": start + b"cposix\nsystem\n(Vtouch MARKER\ntR.",
        "a command by its other name": start + b"cos\nsystem\n(Vtouch MARKER\ntR.",
        "an instance of a builtin": start + b"(Vopen('MARKER','w')\ni__builtin__\nexec\n.",
        "20,000 copies of a Size": start + b"ctorch\nSize\nq\x00(" + b"K\x01" * 50_000 + b"tq\x01" + copies,
        "20,000 copies of an OrderedDict": (
            start + b"ccollections\nOrderedDict\nq\x00(" + b"(K\x01K\x02l" * 50_000 + b"lq\x01" + copies
        ),
    }
    for label, data in pickles.items():
        case(f"PyTorch checkpoint, {label}")(archive(data))


_pickles()
