"""Draw the pictures of the documentation: `make docs-images`, after `make browser-setup`.

They show a run of the demo, which is made first if it is missing, as a person sees it: the report in a browser,
the viewer in JupyterLab. With `make docs-images PHOTOS=folder`, also a photograph in a map, see `docs.photographs`.
"""

import io
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from docs import chromium, photographs
from toolkit import pipeline
from toolkit.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from playwright.sync_api import Browser

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
WINDOW_M = np.array([[-25.0, -12.0], [25.0, 78.0]])
"""What `street` shows around the photograph: low and high corner, meters to the right and ahead."""
LARGEST = 300_000
"""Largest size of a picture in bytes: pages are also read over slow lines."""
DPI = 165
"""Pixels an inch of the picture of a result."""


def main() -> None:
    """Make every picture."""
    if reason := chromium.why_missing():
        sys.exit(f"make docs-images {reason}.")
    if sys.argv[1:]:
        save(street(photographs.run_of(sys.argv[1])), IMAGES / "street.webp")
    else:
        print("street.webp stays: it is made from photographs, make docs-images PHOTOS=folder")
    run = pipeline.run(ROOT / "data_manifests" / "demo.yaml")
    capture = run.parent.parent / "data" / run.name
    save(result(run, capture / "sessions"), IMAGES / "result.webp")
    with chromium.open_browser() as browser:
        save(report(browser, run), IMAGES / "report.png")
        save(viewer(browser, run, capture / "sessions"), IMAGES / "inline.png")


def street(run: Path) -> bytes:
    """Return the picture of a photograph beside its place in the map, from above: what lies ahead of it is up."""
    from toolkit.figures import style
    from toolkit.figures.query_images import draw_image, draw_matches
    from toolkit.figures.top_view import Ground, Layer, draw_layers
    from toolkit.geometry import shifted, unit
    from toolkit.results.localized import sure_points

    pair = photographs.pair_of(run)
    details, errors = pair.details(0), pair.localizations.errors.iloc[0]
    camera, result = details.cameras[0], details.result
    center, right = camera.world_from_cam[:3, 3], camera.world_from_cam[:3, 0]
    up = np.array([0.0, 0.0, 1.0])
    right = unit(right - up * (right @ up))
    ground = Ground(np.stack([right, np.cross(up, right)]), ["to the right [m]", "ahead [m]"], 1.0)
    cameras, here = (shifted(poses, -center) for poses in (pair.map_session.world_from_cam(), camera.world_from_cam))
    points = sure_points(pair.local_map)[0]
    layers = [
        Layer(points - center, "map points", "0.6", s=3, lw=0),
        Layer(camera.points[camera.agrees] - center, "seen in the photograph", style.GREEN, s=7, lw=0),
        Layer(cameras, f"{len(cameras)} map photographs", style.MAP, 0.05, s=14, lw=0),
        Layer(here[None], "the photograph", style.ESTIMATED, 0.09, s=60, lw=0, zorder=5),
    ]

    @style.styled
    def draw() -> "Figure":
        figure = style.new_figure(11, 5.9)
        picture, above = figure.subplots(1, 2, width_ratios=[2.1, 1.0])
        draw_image(picture, camera, 5.2)
        draw_matches(picture, camera, 9, only=camera.agrees)
        draw_layers(above, ground, layers, WINDOW_M)
        above.spines[["top", "right"]].set_visible(False)
        above.grid(alpha=0.2)
        style.shared_legend(figure, [above], ncols=4, fontsize=11, markerscale=1.4)
        picture.set_title(
            f"A photograph that is not in the map: {result.status_text}, {camera.num_agreeing} of its points are "
            f"in the map\nstated deviation {100 * result.position_std:.1f} cm and {result.rotation_std_deg:.3f}°, "
            f"off by {100 * errors['translation_error_m']:.1f} cm and {errors['rotation_error_deg']:.3f}°",
            fontsize=12,
        )
        above.set_title("where it was taken", fontsize=12)
        return figure

    return style.picture_of(draw())


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
