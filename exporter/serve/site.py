"""The page's files, put together in memory: its own, TensorFlow.js, the model, and the inputs to check it with."""

from __future__ import annotations

import functools
import html
import json
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from msgspec import Struct

from export_model.converters.formats import tfjs
from export_model.converters.formats.bundle.bundle import Bundle, dumps, writing
from export_model.converters.formats.bundle.exchange import exchange, stage
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.registry import FROZEN_GRAPH, ONNX, TFJS, WRITTEN
from export_model.converters.runtimes.javascript.node import INSTALL_TFJS, check_packages, js_home, package_version
from export_model.exporter import __version__
from export_model.exporter.serve.engine import engine_of, makers_module
from export_model.exporter.serve.scenes import AUTO, PageScene, other_side, scene_of
from export_model.exporter.serve.selftest import golden
from export_model.exporter.serve.server import DATA, INDEX, TYPES
from export_model.signatures.contract import PARITY, POLICY, json_of
from export_model.signatures.errors import BundleError, RuntimeUnavailableError, UnsupportedOpError, naming

PAGE = Path(__file__).resolve().parent / "page"
#: Stills of the environments, of ``make pictures``.
PREVIEWS = PAGE.parent / "previews"
_PREVIEW = "preview.png"
POLICY_MODULE = Path(tfjs.__file__).resolve().parent / "js" / "policy.mjs"
#: All drawings; a page has that of its scene.
_VIEWS = "views/index.mjs"
#: The file by which a folder is known as ours.
SITE = "site.json"
MADE_BY = "export-model serve"
#: ... and a page of one file.
MARK = f'<meta name="generator" content="{MADE_BY}">'.encode()
#: More than any report of a policy that has a page.
_MOST_REPORT_BYTES = 32_000_000
#: Bytes at the beginning of a page of one file, among which the mark is.
_HEAD = 2000

#: The formats that a page is made of, and why.
NEEDED = {
    TFJS.key: "the page runs TensorFlow.js",
    FROZEN_GRAPH.key: "what the page's answers are held against is computed from it",
}
_TFJS = "@tensorflow/tfjs"
_ORT = "onnxruntime-web"


class _Backend(Struct, frozen=True):
    """What runs a policy besides the module of ``--to js``: ``files`` of a ``package``, the first one its script."""

    name: str
    package: str
    files: tuple[str, ...] = ()
    #: It weighs megabytes: loaded when a visitor chooses it.
    large: bool = False


_BACKENDS = (
    _Backend("cpu", _TFJS),
    _Backend(
        "wasm",
        "@tensorflow/tfjs-backend-wasm",
        (
            "tf-backend-wasm.es2017.min.js",
            "tfjs-backend-wasm.wasm",
            "tfjs-backend-wasm-simd.wasm",
            "tfjs-backend-wasm-threaded-simd.wasm",
        ),
    ),
    _Backend("webgl", _TFJS),
    _Backend("webgpu", "@tensorflow/tfjs-backend-webgpu", ("tf-backend-webgpu.es2017.min.js",)),
    _Backend(
        _ORT,
        _ORT,
        ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm"),
        large=True,
    ),
)
_JS: dict[str, Any] = {"name": "js", "script": None}
"""The policy's own module, which is part of the page."""


def assemble(folder: Path, scene: str = AUTO) -> dict[str, bytes]:
    """The site of a bundle, by path; the same bytes for the same bundle.

    Without the npm packages the page runs on the policy's module alone, and says so. Raises BundleError (its files are
    not those of policy.json, it holds no TensorFlow.js or no .bytes, nothing here runs it), UsageError (the scene does
    not fit).
    """
    site, said, refused = _content(folder, scene, whole=True)
    vendor, backends, absent = _vendor(ONNX.key in said["models"]["model"])
    site.update(vendor)
    if refused is None:
        backends.insert(0, _JS)
    elif backends:
        absent.insert(0, {"name": "js", "why": str(refused)})
    else:
        raise _no_engine(folder, refused, INSTALL_TFJS)
    site[SITE] = dumps({**said, "backends": backends, "absent": absent})
    site[INDEX] = _asking_at_once(site)
    picture = preview(said["scene"])
    if picture is not None:
        site[_PREVIEW] = picture.read_bytes()
        site[INDEX] = _with_picture(site[INDEX], _PREVIEW)
    return site


def preview(scene: str | None) -> Path | None:
    """The picture of an environment that messengers show with a link; None where there is none."""
    picture = None if scene is None else PREVIEWS / f"{scene}.png"
    return picture if picture is not None and picture.is_file() else None


def _with_picture(page: bytes, address: str) -> bytes:
    """Return index.html with the picture's address, relative to the page's own."""
    return page.replace(b"</head>", f'<meta property="og:image" content="{html.escape(address)}">\n</head>'.encode(), 1)


def assemble_one_file(folder: Path, scene: str = AUTO, *, picture: str | None = None) -> bytes:
    """The page as one HTML file, which needs no server and no network, on the policy's module.

    ``picture`` lies beside it, for messengers that show one with a link. Raises as ``assemble``, and DamagedFileError.
    """
    from export_model.exporter.serve.onefile import one_file

    site, said, refused = _content(folder, scene, whole=False)
    if refused is not None:
        raise _no_engine(folder, refused, "write a folder, which runs TensorFlow.js: -o NAME")
    absent = [{"name": "TensorFlow.js", "why": "a page of one file runs on the policy's own module alone"}]
    site[SITE] = dumps({**said, "tfjs": None, "backends": [_JS], "absent": absent})
    if picture is not None:
        site[INDEX] = _with_picture(site[INDEX], picture)
    with naming(folder):
        return one_file(site)


def _no_engine(folder: Path, refused: UnsupportedOpError, fix: str) -> BundleError:
    return BundleError("cannot be shown", where=str(folder), why=f"no page runs it: {refused}", fix=fix)


def _content(
    folder: Path, scene: str, *, whole: bool
) -> tuple[dict[str, bytes], dict[str, Any], UnsupportedOpError | None]:
    """(files without npm packages and site.json, what site.json says of the policy, why the policy has no module).

    ``whole``: with what other engines than the module run.
    """
    policy = _open_checked(folder)
    found = scene_of(policy.name, policy.signature, scene)
    opponent = None if found is None or found.side is None else _opponent(policy, found)
    own = sorted(path for path in PAGE.rglob("*") if path.is_file() and path.suffix in TYPES)
    site = {path.relative_to(PAGE).as_posix(): path.read_bytes() for path in own}
    if found is not None:
        site[_VIEWS] = f'import {{ viewOf as own }} from "./{found.id}.mjs";\nexport const viewOf = own;\n'.encode()
    site["policy.mjs"] = POLICY_MODULE.read_bytes()
    site[POLICY] = dumps(policy.content)
    model = _model(policy, "model")
    site.update(model if whole else {})
    models: dict[str, dict[str, str]] = {
        "model": {"folder": "model/", "contract": POLICY, "weights": "model/weights.bin"}
    }
    if policy.has(ONNX) and whole:
        models["model"][ONNX.key] = "model/policy.bin"
        site["model/policy.bin"] = policy.path(ONNX).read_bytes()
    with naming(policy.graph_file):
        graph = runnable(policy.graph())
        policy.check_graph(graph)
        said, data = golden(policy.signature, graph)
    site["golden.json"], site["golden.bin"] = f"{json.dumps(said, separators=(',', ':'))}\n".encode(), data
    players = {"model": (policy, graph)}
    if opponent is not None:
        site.update(_model(opponent, "opponent") if whole else {})
        contract = f"opponent/{POLICY}"
        site[contract] = dumps(opponent.content)
        models["opponent"] = {"folder": "opponent/", "contract": contract, "weights": "opponent/weights.bin"}
        players["opponent"] = opponent, runnable(opponent.graph())
    refused, makers = None, dict[str, str]()
    try:
        for name, player in players.items():
            engine = engine_of(*player)
            makers[name] = f"{name}/engine.mjs"
            site.update({makers[name]: engine.module, models[name]["weights"]: engine.weights})
    except UnsupportedOpError as error:
        refused, makers = error, {}
    site["makers.mjs"] = makers_module(makers)
    site[INDEX] = describe_page(site[INDEX], policy.name, policy.signature.family, found is not None)
    return (
        site,
        {
            "made_by": MADE_BY,
            "version": __version__,
            "name": policy.name,
            "scene": None if found is None else found.id,
            "side": None if found is None else found.side,
            "opponent": None if opponent is None else opponent.name,
            "tfjs": package_version(js_home(), _TFJS),
            "models": models,
            "model_bytes": sum(map(len, model.values())),
            "original": _original(policy),
        },
        refused,
    )


def _original(policy: Bundle) -> dict[str, str] | None:
    """Return the runtime of the original that the bundle agreed with, and within what share of the tolerance.

    None where the bundle's report does not say that the original ran.
    """
    from export_model.converters.runtimes.pool import INDEPENDENT
    from export_model.exporter.verify.findings import share_text
    from export_model.exporter.verify.verdict import runtime_title

    try:
        with (policy.folder / PARITY).open("rb") as file:
            report = json_of(file.read(_MOST_REPORT_BYTES))
    except (OSError, ValueError):
        return None
    original = report.get("original") if isinstance(report, dict) and report.get("passed") is True else None
    if original not in INDEPENDENT:
        return None
    comparisons = report.get("comparisons")
    shares = [c.get("share") for c in comparisons if isinstance(c, dict)] if isinstance(comparisons, list) else []
    worst = max((s for s in shares if isinstance(s, float | int)), default=0.0)
    return {"runtime": runtime_title(original), "share": share_text(worst)}


def describe_page(page: bytes, name: str, family: str, acts: bool) -> bytes:
    """Return index.html with a title and a description, which messengers show of a link."""
    where = "acts in your browser, beside the same network untrained" if acts else "answers in your browser"
    text = html.escape(f"A trained policy ({family}) {where}. Its answers are checked on your own machine.")
    title = html.escape(f"{name} · export-model")
    tags = (
        f'<title>{title}</title>\n<meta name="description" content="{text}">\n'
        f'<meta property="og:title" content="{title}">\n<meta property="og:description" content="{text}">\n'
        '<meta property="og:type" content="website">\n'
    )
    head, _, rest = page.decode().partition("<title>")
    return (head + tags + rest.partition("\n")[2].partition("\n")[2]).encode()


def _asking_at_once(site: Mapping[str, bytes]) -> bytes:
    """index.html, which asks for all modules at once: a browser else finds them import by import, round by round."""
    from export_model.exporter.serve.onefile import modules_of

    links = "".join(f'<link rel="modulepreload" href="{name}">\n' for name in modules_of(site))
    return site[INDEX].replace(b"</head>", f"{links}</head>".encode())


def write_site(site: Mapping[str, bytes], place: Path) -> None:
    """Write a site, in place of an older one of ours. Raises BundleError where something else is in the way."""
    with writing(place):
        _check_free(place, _is_site, f"it has no {SITE} that says so", "folder")
        with stage(place) as new:
            for name, data in site.items():
                target = new / name
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(data)
            exchange(new, place)


def write_file(page: bytes, place: Path) -> None:
    """Write a page of one file, in place of an older one. Raises BundleError where something else is in the way."""
    with writing(place):
        _check_free(place, _is_page, f"it does not say that {MADE_BY} wrote it", "name")
        with stage(place) as new:
            (new / place.name).write_bytes(page)
            (new / place.name).replace(place)


def _check_free(place: Path, is_ours: Callable[[Path], bool], why: str, other: str) -> None:
    if place.is_symlink() or (place.exists() and not is_ours(place)):
        raise BundleError(
            "already exists and is not a page of ours",
            where=str(place),
            why=why,
            fix=f"move it, or choose another {other} with --out",
        )


def _is_page(place: Path) -> bool:
    if not place.is_file():
        return False
    with place.open("rb") as file:
        return MARK in file.read(_HEAD)


def _is_site(place: Path) -> bool:
    if not place.is_dir():
        return False
    if not any(place.iterdir()):
        return True
    try:
        content = json.loads((place / SITE).read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("made_by") == MADE_BY


def _open_checked(folder: Path) -> Bundle:
    found = Bundle.open(folder)
    found.verify_hashes()
    for needed, why in NEEDED.items():
        if not found.has(WRITTEN[needed]):
            raise BundleError(
                f"has no {WRITTEN[needed].first_file_of(found.name)}",
                where=str(folder),
                why=why,
                fix=f"export it again with --to {','.join(sorted(NEEDED))} and without --for",
            )
    return found


def _model(found: Bundle, place: str) -> dict[str, bytes]:
    """The model of a bundle: data alone. What else lies in its folder (a script, a page) would be its maker's code."""
    names = [n for n in found.contract.files if TFJS.owns(n, found.name) and PurePosixPath(n).suffix in DATA]
    folder = f"{TFJS.main_of(found.name)}/"
    return {f"{place}/{name.removeprefix(folder)}": (found.folder / name).read_bytes() for name in sorted(names)}


def _opponent(first: Bundle, scene: PageScene) -> Bundle | None:
    """The other player's bundle, where it lies beside this one; the page says so where it does not."""
    for other in other_side(first.name):
        beside = first.folder.resolve().parent / other
        if (beside / POLICY).is_file():
            second = _open_checked(beside)
            found = scene_of(other, second.signature)
            if found is not None and found.id == scene.id and found.side != scene.side:
                return second
    return None


def _vendor(onnx: bool) -> tuple[dict[str, bytes], list[dict[str, Any]], list[dict[str, str]]]:
    """Files of npm packages, the backends that they give, those that are not here; ``onnx``: whether a model is."""
    home = js_home()
    files: dict[str, bytes] = {}
    backends: list[dict[str, Any]] = []
    absent: list[dict[str, str]] = []
    tfjs = package_version(home, _TFJS) is not None
    if tfjs:
        check_packages(home)
        files["vendor/tf.es2017.min.js"] = _dist(home, _TFJS, "tf.es2017.min.js")
    for backend in _BACKENDS:
        if not tfjs or package_version(home, backend.package) is None:
            absent.append({"name": backend.name, "why": f"its npm package is not installed ({INSTALL_TFJS})"})
            continue
        if backend.name == _ORT and not onnx:
            continue
        files.update({f"vendor/{file}": _dist(home, backend.package, file) for file in backend.files})
        script = f"vendor/{backend.files[0]}" if backend.files else None
        backends.append({"name": backend.name, "script": script, **({"large": True} if backend.large else {})})
    return files, backends, absent


@functools.cache
def _dist(home: Path, package: str, file: str) -> bytes:
    try:
        return _without_map((home / "node_modules" / package / "dist" / file).read_bytes())
    except OSError as error:
        raise RuntimeUnavailableError(
            f"{file} of {package} cannot be read", where=str(home), why=error.strerror, fix=INSTALL_TFJS
        ) from error


def _without_map(script: bytes) -> bytes:
    """Without the line that names a source map, which is not there: a browser's tools would ask for it."""
    head, _, last = script.rstrip().rpartition(b"\n")
    return head + b"\n" if last.startswith(b"//# sourceMappingURL=") else script
