"""Draw the pictures of the documentation: `make docs-images`, after `make browser-setup`.

They show a run of the demo, which is made first if it is missing, as a person sees it: the report in a browser,
the viewer in JupyterLab.
"""

import io
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from docs import chromium
from toolkit import pipeline
from toolkit.files import write_atomic

if TYPE_CHECKING:
    from playwright.sync_api import Browser

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
LARGEST = 300_000
"""Largest size of a picture in bytes: pages are also read over slow lines."""
DPI = 165
"""Pixels an inch of the picture of a result."""


def main() -> None:
    """Make every picture."""
    if reason := chromium.why_missing():
        sys.exit(f"make docs-images {reason}.")
    run = pipeline.run(ROOT / "data_manifests" / "demo.yaml")
    capture = run.parent.parent / "data" / run.name
    save(result(run, capture / "sessions"), IMAGES / "result.webp")
    with chromium.open_browser() as browser:
        save(report(browser, run), IMAGES / "report.png")
        save(viewer(browser, run, capture / "sessions"), IMAGES / "inline.png")


def result(run: Path, sessions_root: Path) -> bytes:
    """Return the picture of a query of the phone in the headset's map, with the map from above below it.

    Drawn again with more pixels than those of a run: it is the first that people see, on screens of any density.
    """
    from unittest import mock

    from PIL import Image

    from toolkit.figures import style as figures
    from toolkit.files import SceneFiles
    from toolkit.visualize import visualize_scene

    files, pair = SceneFiles(run, run.name), f"{run.name}_map_hl_query_ios"
    with tempfile.TemporaryDirectory() as folder:
        style = Path(folder) / "sharp.mplstyle"
        style.write_text(re.sub(r"savefig\.dpi: \d+", f"savefig.dpi: {DPI}", figures.STYLE.read_text()))
        alone = {"recordings": False, "session_recordings": False}
        with mock.patch.object(figures, "STYLE", style):
            where = (sessions_root, files.poses_dir, files.maps, folder)
            visualize_scene(*where, alone, map_device="hl", query_device="ios")
        stills = [Image.open(Path(folder) / f"{name}.png").convert("RGB") for name in (f"localization_{pair}_2", pair)]
    width = max(still.width for still in stills)
    page = Image.new("RGB", (width, sum(still.height for still in stills)), "white")
    for still, top in zip(stills, (0, stills[0].height), strict=True):
        page.paste(still, ((width - still.width) // 2, top))
    stream = io.BytesIO()
    page.save(stream, "PNG")
    return stream.getvalue()


def report(browser: "Browser", run: Path) -> bytes:
    """Return a picture of the report's tables, without its head, which has times of this machine."""
    page = browser.new_page(viewport={"width": 1240, "height": 1000})
    page.goto((run / "report.html").as_uri() + "#scene-1")
    return page.screenshot()


def viewer(browser: "Browser", run: Path, sessions_root: Path) -> bytes:
    """Return a picture of notebook 06_visualize in JupyterLab, scrolled to its viewer."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        name = chromium.copy_notebook("visualize", run, sessions_root, folder / "notebooks")
        (folder / "state").mkdir()
        with chromium.serve_lab(folder / "notebooks", folder / "state") as url:
            page = browser.new_page(viewport={"width": 1300, "height": 760})
            if errors := chromium.run_notebook(page, url.format(name)):
                sys.exit(f"{name}: {errors[0]}")
            canvas = chromium.find_viewer(page)
            chromium.wait_for_scene(canvas)
            # The lines above and below it name folders of this machine.
            canvas.evaluate("element => element.scrollIntoView({block: 'start'})")
            picture: bytes = page.screenshot(timeout=120_000)
            page.close()
            return picture


def save(png: bytes, path: Path) -> None:
    """Write a picture in at most `LARGEST` bytes: a photograph as .webp, of as high a quality, anything else as .png,
    with a palette of as many colors, as fit in that.
    """
    from PIL import Image

    image = Image.open(io.BytesIO(png)).convert("RGB")
    for quality, count in ((90, 256), (82, 128), (74, 64), (66, 32)):
        stream = io.BytesIO()
        if path.suffix == ".webp":
            image.save(stream, "WEBP", quality=quality, method=6)
        else:
            image.quantize(count, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
        if stream.tell() <= LARGEST:
            break
    with write_atomic(path) as temporary:
        temporary.write_bytes(stream.getvalue())
    print(f"{path.relative_to(ROOT)}: {image.width} x {image.height}, {stream.tell() // 1000} kB")


if __name__ == "__main__":
    main()
