"""A folder of bundles as a gallery: a page for each policy, and an index that shows what there is.

Served, each page is a site in a folder of its own, with every engine; written, each is one file, which any static host
takes. The index is HTML alone: no script runs on it.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec import Struct

from export_model.converters.formats.bundle.bundle import Bundle, dumps
from export_model.exporter import __version__
from export_model.exporter.export.names import Names
from export_model.exporter.serve.scenes import other_side, scene_of
from export_model.exporter.serve.server import INDEX
from export_model.exporter.serve.site import MADE_BY, PAGE, SITE, assemble, assemble_one_file, preview
from export_model.exporter.tables import count_text
from export_model.signatures.errors import BundleError, ExportModelError

STYLE = "gallery.css"
_CSS = """\
:root { color-scheme: light dark; --paper: #fff; --sheet: #f4f6f8; --ink: #16191d; --soft: #5a626c; --accent: #2f5fb3; }
@media (prefers-color-scheme: dark) {
  :root { --paper: #14171b; --sheet: #1c2026; --ink: #e7e9ec; --soft: #a3abb6; --accent: #8fb4f5; }
}
* { box-sizing: border-box; }
body {
  margin: 0 auto; max-width: 1200px; padding: 32px 20px 56px; background: var(--paper); color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; overflow-wrap: anywhere;
}
h1 { font-size: 26px; margin: 0; } h2 { font-size: 18px; margin: 10px 0 0; align-self: end; }
p { margin: 2px 0; color: var(--soft); }
ul { list-style: none; margin: 24px 0 0; padding: 0; display: grid; gap: 20px; }
ul { grid-template-columns: repeat(auto-fill, minmax(min(320px, 100%), 1fr)); }
li { background: var(--sheet); border-radius: 12px; padding: 14px 16px 16px; }
li { display: grid; grid-template-rows: 1fr auto auto; }
/* What is cut off is the rim that a picture has of the page it was taken from. */
img { display: block; width: 100%; height: auto; align-self: center; clip-path: inset(2px round 12px); }
a { color: var(--accent); } a:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
"""
_PAGE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="export-model serve">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'self'; img-src 'self'">
<title>{title}</title>
<meta name="description" content="{text}">
<meta property="og:title" content="{title}">
<meta property="og:description" content="{text}">
<meta property="og:type" content="website">
{image}<link rel="icon" href="icon.svg">
<link rel="stylesheet" href="gallery.css">
</head>
<body>
<h1>{title}</h1>
<p>{text}</p>
<main><ul>
{cards}
</ul></main>
</body>
</html>
"""
_TEXT = "Trained policies act in your browser, each beside the same network untrained."


class Gallery(Struct, frozen=True):
    """Its files by path, the policies that it shows, and why others are left out."""

    files: Mapping[str, bytes]
    shown: tuple[str, ...]
    left_out: tuple[ExportModelError, ...]


def assemble_gallery(folders: Sequence[Path], *, whole: bool) -> Gallery:
    """The gallery of bundles; ``whole``: each page a site in a folder, else one file.

    A brain whose opponent is shown plays on that page. Bundles of one name get addresses of their own. Raises the first
    BundleError where none can be shown.
    """
    names = Names()
    for own in ("index", "pictures"):
        names.reserve(Path(own), own)
    files: dict[str, bytes] = {STYLE: _CSS.encode(), "icon.svg": (PAGE / "icon.svg").read_bytes()}
    cards: list[str] = []
    shown: list[str] = []
    left_out: list[ExportModelError] = []
    for folder in folders:
        try:
            name = Bundle.open(folder).name
            if folder.name == name and any(other in shown for other in other_side(name)):
                continue
            page = assemble(folder) if whole else {"": _as_file(folder)}
        except ExportModelError as error:
            left_out.append(error)
            continue
        ((own, _),) = names.claim(folder, [name])
        address = f"{own}/" if whole else f"{own}.html"
        files.update({f"{address}{path}": data for path, data in page.items()})
        shown.append(own)
        picture = _picture(folder)
        if picture is not None:
            files[f"pictures/{picture.name}"] = picture.read_bytes()
        cards.append(_card(folder, own, address, picture))
    if not shown:
        raise left_out[0] if left_out else BundleError("no bundle was given", fix="export-model SOURCE -o exported")
    first = next((path for path in sorted(files) if path.startswith("pictures/")), None)
    image = "" if first is None else f'<meta property="og:image" content="{first}">\n'
    title = count_text(len(shown), "policy", "policies")
    files[INDEX] = _PAGE.format(title=title, text=_TEXT, image=image, cards="\n".join(cards)).encode()
    files[SITE] = dumps({"made_by": MADE_BY, "version": __version__, "gallery": shown})
    return Gallery(files, tuple(shown), tuple(left_out))


def _as_file(folder: Path) -> bytes:
    picture = _picture(folder)
    return assemble_one_file(folder, picture=None if picture is None else f"pictures/{picture.name}")


def _picture(folder: Path) -> Path | None:
    """The picture of a policy's environment; None where it has none."""
    found = Bundle.open(folder)
    scene = scene_of(found.name, found.signature)
    return preview(None if scene is None else scene.id)


def _card(folder: Path, name: str, address: str, picture: Path | None) -> str:
    signature = Bundle.open(folder).signature
    facts = html.escape(f"{signature.family} · {signature.action_space} actions")
    image = "" if picture is None else f'<img src="pictures/{picture.name}" alt="" width="640" height="360">'
    return f'<li>{image}<h2><a href="{address}">{name}</a></h2><p>{facts}</p></li>'
