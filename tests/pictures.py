"""``python -m tests.pictures``: in docs/pictures page.png and crawler.png, which move, and report.png, from Chromium;
in exporter/serve/previews a still of each environment, for the gallery.

The moving ones are APNGs: one palette for all frames, and in each frame only what changed since the last.
"""

from __future__ import annotations

import base64
import struct
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from export_model.converters.formats.bundle.bundle import Bundle
from export_model.exporter.serve.scenes import scene_of
from export_model.exporter.serve.site import PREVIEWS, assemble_one_file
from fixtures.trained import run_folder
from tests.commands import export_model
from tests.serve.browsing import visit

PICTURES = Path(__file__).resolve().parent.parent / "docs" / "pictures"
FRAMES, MILLISECONDS = 40, 110
#: Colours, beside the transparent one that says "as before".
COLOURS = 127

Pixels = npt.NDArray[np.uint8]


def main() -> None:
    """Make them all."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        report = folder / "report.html"
        ran = export_model(run_folder("3DBall"), "-o", folder, "--html", report)
        assert ran.status == 0, ran.err
        # It names the folder; a picture is of no run in particular.
        report.write_text(report.read_text(encoding="utf-8").replace(scratch, "exported"), encoding="utf-8")
        ran = export_model(run_folder("Crawler2D"), "-o", folder, "--to", "bytes,tfjs", "--verify", "none")
        assert ran.status == 0, ran.err
        save("page.png", moving(folder / "3DBall", "", ".lanes", steps=13))
        save("crawler.png", moving(folder / "Crawler2D", "#beside=nothing", ".lanes", steps=2))
        for name in ("GridWorld", "Hallway", "Tennis"):
            ran = export_model(run_folder(name), "-o", folder, "--to", "bytes,tfjs", "--verify", "none")
            assert ran.status == 0, ran.err
        for name in ("3DBall", "Crawler2D", "GridWorld", "Hallway", "Tennis-LeftBrain"):
            still(folder / name)
        seen = visit(report.as_uri(), [["pixels", "body"]], viewport={"width": 1100, "height": 900})
        save("report.png", animated([pixels(seen.results[0])[:1100]]))


def moving(bundle: Path, fragment: str, selector: str, *, steps: int) -> bytes:
    """A part of a bundle's page, ``steps`` steps further in each frame."""
    page = bundle.with_suffix(".html")
    page.write_bytes(assemble_one_file(bundle))
    once = [
        ["eval", f"{{ for (let n = 0; n < {steps}; n++) document.querySelector('#step').click() }}"],
        ["eval", "new Promise((done) => setTimeout(done, 120))"],
        ["pixels", selector],
    ]
    ready = ["wait", f"document.querySelector('#status{'' if fragment else '-2'}') !== null"]
    hide = ["eval", "document.querySelectorAll('.stage .controls').forEach((e) => (e.hidden = true))"]
    seen = visit(
        page.as_uri() + fragment,
        [ready, hide, *(step for _ in range(FRAMES) for step in once)],
        viewport={"width": 1160, "height": 900},
        reducedMotion="reduce",
    )
    return animated([pixels(r) for r in seen.results if isinstance(r, dict)])


def still(bundle: Path) -> None:
    """A picture of a bundle's environment, 640 pixels wide, as exporter/serve/previews has it."""
    page = bundle.with_suffix(".html")
    page.write_bytes(assemble_one_file(bundle))
    steps = ["eval", "{ for (let n = 0; n < 90; n++) document.querySelector('#step').click() }"]
    wait, shown = ["eval", "new Promise((done) => setTimeout(done, 900))"], ["pixels", "#canvas"]
    ready = ["wait", "document.querySelector('#step') !== null"]
    here = {"width": 696, "height": 900}
    seen = visit(f"{page.as_uri()}#beside=nothing", [ready, steps, wait, shown], viewport=here, reducedMotion="reduce")
    bound = Bundle.open(bundle)
    scene = scene_of(bound.name, bound.signature)
    assert scene is not None
    data = animated([pixels(seen.results[-1])])
    (PREVIEWS / f"{scene.id}.png").write_bytes(data)
    print(f"exporter/serve/previews/{scene.id}.png: {len(data) / 1000:.0f} kB")


def save(name: str, data: bytes) -> None:
    (PICTURES / name).write_bytes(data)
    print(f"docs/pictures/{name}: {len(data) / 1000:.0f} kB")


def pixels(said: dict[str, Any]) -> Pixels:
    """[height, width, 3]."""
    raw = np.frombuffer(base64.b64decode(said["data"]), np.uint8)
    return raw.reshape(said["height"], said["width"], 4)[..., :3]


def animated(frames: Sequence[Pixels]) -> bytes:
    """A PNG; of several frames an APNG, which repeats for ever."""
    table, lookup = palette(frames)
    indices = [lookup[coarse(frame)] for frame in frames]
    height, width = indices[0].shape
    parts = [chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0))]
    if len(frames) > 1:
        parts.append(chunk(b"acTL", struct.pack(">II", len(frames), 0)))
    parts += [chunk(b"PLTE", bytes(3) + table.tobytes()), chunk(b"tRNS", b"\0")]
    sequence = 0
    for number, frame in enumerate(indices):
        if len(frames) > 1:
            timing = struct.pack(">IIIIIHHBB", sequence, width, height, 0, 0, MILLISECONDS, 1000, 0, 1)
            parts.append(chunk(b"fcTL", timing))
            sequence += 1
        shown = frame if number == 0 else np.where(frame == indices[number - 1], 0, frame)
        data = zlib.compress(b"".join(b"\0" + row.tobytes() for row in shown.astype(np.uint8)), 9)
        if number == 0:
            parts.append(chunk(b"IDAT", data))
        else:
            parts.append(chunk(b"fdAT", struct.pack(">I", sequence) + data))
            sequence += 1
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts) + chunk(b"IEND", b"")


def coarse(frame: Pixels) -> npt.NDArray[np.int32]:
    """Colours of five bits a channel, as one number."""
    red, green, blue = (frame[..., k].astype(np.int32) >> 3 for k in range(3))
    return red << 10 | green << 5 | blue


def palette(frames: Sequence[Pixels]) -> tuple[Pixels, npt.NDArray[np.uint8]]:
    """(the most frequent colours as they are on average, coarse colour → its index, from 1)."""
    keys = np.concatenate([coarse(f).reshape(-1) for f in frames[:: max(len(frames) // 8, 1)]])
    values = np.concatenate([f.reshape(-1, 3) for f in frames[:: max(len(frames) // 8, 1)]]).astype(np.float64)
    counts = np.bincount(keys, minlength=1 << 15)
    sums = np.stack([np.bincount(keys, values[:, k], 1 << 15) for k in range(3)], axis=-1)
    chosen = np.argsort(-counts, kind="stable")[:COLOURS]
    table = np.round(sums[chosen] / np.maximum(counts[chosen, None], 1))
    grid = np.arange(1 << 15)
    colours = np.stack([grid >> 10, grid >> 5 & 31, grid & 31], axis=-1) * 8.0 + 4
    nearest = [np.abs(part[:, None] - table).sum(-1).argmin(-1) for part in np.array_split(colours, 64)]
    return table.astype(np.uint8), (np.concatenate(nearest) + 1).astype(np.uint8)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


if __name__ == "__main__":
    main()
