"""Draw the picture of the localization view for the documentation: `make docs-view`.

The viewer runs without a window; it needs a Vulkan driver, on Debian the package mesa-vulkan-drivers.
"""

import sys
import time
from contextlib import suppress
from pathlib import Path

from toolkit import pipeline
from toolkit.errors import ToolkitError

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs" / "images" / "localization.png"
PORT = 9877
TRIES, PAUSE_S = 6, 12.0
MAX_WIDTH = 1280


def main() -> None:
    """Make the picture from a run of the demo, which is made first if it is missing."""
    run = pipeline.run(ROOT / "data_manifests" / "demo.yaml")
    draw(run / run.name / "visualization" / f"{run.name}_map_hl_query_ios.rrd", OUT)
    print(OUT)


def draw(recording: Path, out: Path, query: int | None = None) -> None:
    """Save what the viewer shows of a localization view.

    Args:
        recording: `.rrd`.
        out: PNG.
        query: number of the query on the timeline; None: the first.

    Raises:
        ToolkitError: the viewer shows nothing, such as without a Vulkan driver, or a view reports an error.
    """
    import rerun_cli
    from PIL import Image
    from rerun.experimental import ViewerClient

    # The command `rerun` is a wrapper, whose end leaves the viewer running.
    binary = str(Path(rerun_cli.__file__).with_name("rerun"))
    out.parent.mkdir(parents=True, exist_ok=True)
    drawn = False
    with ViewerClient.spawn(headless=True, port=PORT, hide_welcome_screen=True, executable_path=binary) as viewer:
        viewer.open(str(recording.resolve()))
        if query is not None:
            viewer.set_time("query", sequence=query)
        for _ in range(TRIES):
            time.sleep(PAUSE_S)  # until pictures are decoded and notices are gone
            with suppress(Exception):  # too busy to answer; the next try may succeed
                viewer.save_screenshot(str(out.resolve()))
                drawn = True
                break
        reports = [report for view in viewer.get_state().views for report in view.reports]
    if not drawn:
        raise ToolkitError(f"{recording}: the viewer drew nothing. Is a Vulkan driver installed (mesa-vulkan-drivers)?")
    if reports:
        raise ToolkitError(f"{recording}: the viewer complains: {reports[0]}")
    with Image.open(out) as picture:
        small = picture.convert("RGB")
        small.thumbnail((MAX_WIDTH, MAX_WIDTH))
        small.quantize(128, dither=Image.Dither.NONE).save(out, optimize=True)  # pages are also read over slow lines


if __name__ == "__main__":
    try:
        main()
    except ToolkitError as error:
        sys.exit(f"Error: {error}")
