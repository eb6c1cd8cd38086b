"""The page as one HTML file: modules, style and the policy's files in it, nothing else loaded.

A browser loads no modules from ``file:``, so they are put into one script, each as a function of its own. The policy's
files are data in a ``<script type="application/json">``, in which no ``<`` is left: nothing that a bundle says can end
that element. The security policy names the script and the style by their hashes, allows the modules that a visitor
drops (``blob:``), and no connection.
"""

from __future__ import annotations

import base64
import hashlib
import json
import posixpath
import re
from collections.abc import Mapping
from pathlib import PurePosixPath

from export_model.exporter.serve.server import DATA, INDEX
from export_model.signatures.errors import DamagedFileError

_IMPORT = re.compile(r'^import \{([^}]*)\} from "(\.[^"]+)";$', re.M)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) ([\w$]+))", re.M)
_MAIN = "main.mjs"


def one_file(site: Mapping[str, bytes]) -> bytes:
    """The files of a site (by path) as one HTML file. Raises DamagedFileError where a file of the bundle is no JSON."""
    bundled = "\n".join(_as_function(name, _without_comments(site[name].decode())) for name in modules_of(site))
    script = f'"use strict";\n{bundled}'
    style = _without_comments(site["page.css"].decode())
    files = {name: _embed(name, data) for name, data in sorted(site.items()) if PurePosixPath(name).suffix in DATA}
    held = _as_json(files).replace("<", "\\u003c")
    icon = f"data:image/svg+xml;base64,{base64.b64encode(site['icon.svg']).decode()}"
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}' blob:; style-src '{_hash(style)}'; img-src data: blob:; "
        "base-uri 'none'; form-action 'none'"
    )
    page = site[INDEX].decode()
    for pattern, text in (
        (r'(?<=<meta http-equiv="Content-Security-Policy" content=")[^"]*', policy),
        (r'<link rel="icon"[^>]*>', f'<link rel="icon" href="{icon}">'),
        (r'<link rel="stylesheet"[^>]*>', f"<style>{style}</style>"),
        (r'<script type="module"[^>]*></script>\n', ""),
        (r"</body>", f'<script type="application/json" id="files">{held}</script>\n<script>{script}</script>\n</body>'),
    ):
        parts = re.split(pattern, page)
        assert len(parts) == 2, pattern
        page = text.join(parts)
    return page.encode()


def _embed(name: str, data: bytes) -> object:
    if not name.endswith(".json"):
        return base64.b64encode(data).decode()
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise _damaged_error(f"{name} must be JSON", str(error)[:200]) from error


def _as_json(files: Mapping[str, object]) -> str:
    try:
        return json.dumps(files, separators=(",", ":"), allow_nan=False)
    except ValueError as error:
        raise _damaged_error("a number in its files is not finite", "no browser reads such JSON") from error


def _damaged_error(what: str, why: str) -> DamagedFileError:
    return DamagedFileError(what, why=why, fix="export the policy again")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def modules_of(site: Mapping[str, bytes]) -> list[str]:
    """All modules that main.mjs needs, each after what it imports."""
    done: dict[str, None] = {}

    def visit(name: str) -> None:
        if name in done:
            return
        done[name] = None  # a circle would find this, and its functions are not made yet
        for _, path in _IMPORT.findall(site[name].decode()):
            visit(_resolve_path(name, path))
        del done[name]
        done[name] = None

    visit(_MAIN)
    return list(done)


def _as_function(name: str, text: str) -> str:
    def import_line(found: re.Match[str]) -> str:
        names = re.sub(r" as ", ": ", " ".join(found[1].split()))
        return f"const {{ {names} }} = {_variable(_resolve_path(name, found[2]))};"

    exported = _EXPORT.findall(text)
    body = _EXPORT.sub("", _IMPORT.sub(import_line, text))
    assert not re.search(r"^(?:import|export)\b", body, re.M), name
    assert "</script" not in body and "<!--" not in body, name
    return f"const {_variable(name)} = (() => {{\n{body}return {{ {', '.join(exported)} }};\n}})();"


def _variable(name: str) -> str:
    return "m_" + re.sub(r"\W", "_", name)


def _resolve_path(name: str, path: str) -> str:
    """What a module means by a relative path: ``views/a.mjs`` and ``../b.mjs`` are ``b.mjs``."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(name), path))


def _without_comments(text: str) -> str:
    """Without the comments that begin a line, and without indentation (the page has no text that spans lines)."""
    text = re.sub(r"^[ \t]*/\*.*?\*/[ \t]*\n", "", text, flags=re.M | re.S)
    text = re.sub(r"^[ \t]*//.*\n", "", text, flags=re.M)
    return re.sub(r"^[ \t]+|^\n", "", text, flags=re.M)
