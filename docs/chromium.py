"""Headless Chromium, and JupyterLab in it: what the browser tests and the pictures of the documentation share.

Chromium is the system's; Playwright only drives it. `make browser-setup` installs both.
"""

import io
import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page, Route

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# WebGL in software: no screen and no GPU are needed. The rest keeps Chromium from calling its maker.
FLAGS = (
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update"),
    *("--disable-sync", "--disable-dev-shm-usage"),
)
LAB_SETTINGS = {
    "apputils-extension/notification": {"fetchNews": "false", "checkForUpdates": False},
    # Cells out of sight keep their outputs, and with them the viewer.
    "notebook-extension/tracker": {"windowingMode": "none"},
}
LOCAL = ("127.0.0.1", "localhost", "[::1]", "::1", "")


def why_missing() -> str:
    """Return what the browser tests lack on this machine, empty if nothing."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        return "needs Playwright: run `make browser-setup`"
    if find_chromium() is None:
        return f"needs Chromium: none of {', '.join(NAMES)} is on PATH. Run `make browser-setup`, or set CHROMIUM"
    return ""


def find_chromium() -> str | None:
    """Return the browser to start: $CHROMIUM, or the first of `NAMES` on PATH."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def open_browser() -> "Iterator[Browser]":
    """Start headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Traffic:
    """The requests of a page to other machines, and its failures."""

    outside: list[str] = field(default_factory=list)
    """Requests to other machines; all were refused."""
    failed: list[str] = field(default_factory=list)
    """Other requests without an answer, or with one that says error."""
    errors: list[str] = field(default_factory=list)
    """Errors of the console, and uncaught exceptions."""


def watch(page: "Page") -> Traffic:
    """Block requests of a page to other machines, and record its requests and errors."""
    traffic = Traffic()

    def guard(route: "Route") -> None:
        url = urlsplit(route.request.url)
        if (url.hostname or "") in LOCAL or url.scheme in ("data", "blob", "file"):
            route.continue_()
        else:
            traffic.outside.append(route.request.url)
            route.abort()

    def answered(response: Any) -> None:
        if response.status >= 400:
            traffic.failed.append(f"{response.status} {response.url}")

    def ended(request: Any) -> None:
        if request.url not in traffic.outside:
            traffic.failed.append(f"{request.failure} {request.url}")

    def said(message: Any) -> None:
        # A refused request is also an error of the console; it is already in `outside`.
        if message.type == "error" and message.location.get("url") not in traffic.outside:
            traffic.errors.append(message.text)

    page.route("**/*", guard)
    page.on("response", answered)
    page.on("requestfailed", ended)
    page.on("console", said)
    page.on("pageerror", lambda error: traffic.errors.append(str(error)))
    return traffic


@contextmanager
def serve_lab(folder: Path, state: Path, config: Path | None = None) -> Iterator[str]:
    """Start JupyterLab on the notebooks of a folder; yield its URL with `{}` where a notebook's name goes.

    Args:
        folder: what it serves.
        state: an empty folder for its settings and logs, so that those of the user are left alone.
        config: what it is configured by, as `make lab` does with `notebooks/lab_config.py`; None: nothing.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    token = secrets.token_hex(16)
    for name, settings in LAB_SETTINGS.items():
        path = state / "settings" / "@jupyterlab" / f"{name}.jupyterlab-settings"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(settings))
    environment = {
        **os.environ,
        "JUPYTER_CONFIG_DIR": str(state / "config"),
        "JUPYTER_DATA_DIR": str(state / "data"),
        "JUPYTER_RUNTIME_DIR": str(state / "runtime"),
        "JUPYTERLAB_SETTINGS_DIR": str(state / "settings"),
        "JUPYTERLAB_WORKSPACES_DIR": str(state / "workspaces"),
        "JUPYTER_TOKEN": token,
    }
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", "--ip=127.0.0.1", f"--port={port}"]
    command += ["--ServerApp.port_retries=0", f"--ServerApp.root_dir={folder}", "--LabApp.expose_app_in_browser=True"]
    command += [] if config is None else [f"--config={config}"]
    log = state / "lab.log"
    with open(log, "wb") as stream:
        server = subprocess.Popen(command, env=environment, stdout=stream, stderr=stream)
    root = f"http://127.0.0.1:{port}"
    try:
        _wait_for(f"{root}/api?token={token}", server, log)
        yield f"{root}/lab/tree/{{}}?token={token}"
    finally:
        server.terminate()  # ends its kernels as well
        try:
            server.wait(30)
        except subprocess.TimeoutExpired:
            server.kill()


def _wait_for(url: str, server: "subprocess.Popen[bytes]", log: Path, seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and server.poll() is None:
        try:
            urllib.request.urlopen(url, timeout=5).close()
        except OSError:
            time.sleep(0.5)
        else:
            return
    raise RuntimeError(f"JupyterLab did not start:\n{log.read_text()[-3000:]}")


def copy_notebook(stage: str, run: Path, sessions_root: Path, folder: Path) -> str:
    """Copy a stage's notebook to a folder, with parameters that name the files of a run; return its name.

    Its results and caches are copies of the run's, beside it: a notebook may not write into a run.
    """
    import nbformat

    from toolkit.files import SceneFiles
    from toolkit.notebook import notebook_parameters, notebook_path

    source, files = notebook_path(stage), SceneFiles(run, sessions_root.parent.name)
    results = shutil.copytree(files.of_stage(stage), folder / "results")
    places = {**files.folders(stage), "sessions_root": sessions_root, "out_dir": results}
    parameters = notebook_parameters(source)
    for name in {"features_dir", "map_dir"} & {*parameters}:
        if places[name].is_dir():
            shutil.copytree(places[name], folder / name)
        places[name] = folder / name
    parameters |= {name: str(path) for name, path in places.items() if name in parameters}
    content = nbformat.read(source, as_version=4)
    cell = next(cell for cell in content.cells if "parameters" in cell.metadata.get("tags", []))
    cell.source = "\n".join(f"{name} = {value!r}" for name, value in parameters.items())
    nbformat.write(content, folder / source.name)
    return source.name


def run_notebook(page: "Page", url: str, seconds: float = 300) -> list[str]:
    """Open a notebook in JupyterLab, run all its cells and wait for the last; return the errors of its cells."""
    deadline = time.monotonic() + seconds
    page.goto(url)
    page.wait_for_function("window.jupyterapp !== undefined", timeout=1000 * seconds)
    while not page.evaluate(_IS_READY):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{url.partition('?')[0]}: no kernel after {seconds:.0f} s.")
        time.sleep(0.5)
    page.evaluate(_START)
    page.wait_for_function("window.errorsOfCells !== undefined", timeout=1000 * seconds)
    return list(page.evaluate("window.errorsOfCells"))


_IS_READY = """() => {
  const panel = window.jupyterapp.shell.currentWidget;
  return panel?.sessionContext?.isReady && panel.context.isReady
    && panel.sessionContext.session?.kernel?.status === "idle";
}"""
_START = """() => {
  const cells = window.jupyterapp.shell.currentWidget.content.model.sharedModel.cells;
  window.jupyterapp.commands.execute("notebook:run-all-cells").finally(() => {
    window.errorsOfCells = cells.flatMap(cell => cell.outputs ?? [])
      .filter(output => output.output_type === "error").map(output => output.ename + ": " + output.evalue);
  });
}"""


def find_viewer(page: "Page", seconds: float = 120) -> "Locator":
    """Wait for the rerun viewer in a notebook's outputs, scroll to it, and return its canvas."""
    canvas = page.locator(".jp-OutputArea-output canvas").first
    canvas.wait_for(timeout=1000 * seconds)
    canvas.evaluate("element => element.scrollIntoView({block: 'center'})")
    return canvas


def wait_for_scene(canvas: "Locator", seconds: float = 120) -> bytes:
    """Wait until a viewer has drawn something and return its last screenshot, whatever that shows.

    An empty viewer has a few grays; points, pictures and cameras have many colors (see `is_scene`).
    """
    deadline = time.monotonic() + seconds
    while True:
        # Of the page, not of the element: there Playwright waits for two equal frames, which take long in software.
        box = canvas.bounding_box()
        png = canvas.page.screenshot(clip=box, timeout=1000 * seconds)  # type: ignore[arg-type]
        if is_scene(png) or time.monotonic() > deadline:
            return png
        time.sleep(1)


def is_scene(png: bytes) -> bool:
    """Tell whether a picture of a viewer shows a scene: many colors, on more than a tenth of its pixels."""
    count, share = colors(png)
    return count >= 100 and share > 0.1


def colors(png: bytes) -> tuple[int, float]:
    """Return the number of colors of a picture, with 16 steps a channel, and the share of pixels without the most
    common one."""
    import numpy as np
    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), np.int64).reshape(-1, 3) // 16
    counts = np.bincount(pixels @ [256, 16, 1])
    return int(np.count_nonzero(counts)), float(1 - counts.max() / counts.sum())
