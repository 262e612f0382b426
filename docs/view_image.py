"""Draw the pictures of the localization view for the documentation: `make docs-view`.

One of the demo, and with `make docs-view PHOTOS=folder`, a flight along the queries of photographs, see
`docs.photographs`. The viewer runs without a window; it needs a Vulkan driver, on Debian the package
mesa-vulkan-drivers.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from docs import photographs
from toolkit import pipeline
from toolkit.errors import ToolkitError
from toolkit.figures.top_view import Eye
from toolkit.files import write_atomic
from toolkit.geometry import Floats, unit

if TYPE_CHECKING:
    from PIL.Image import Image
    from rerun.experimental import ViewerClient

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
PORT = 9877
TRIES, LOADING_S, PAUSE_S = 6, 12.0, 1.5
"""Screenshots that are tried, and seconds before the first one and before those of other eyes."""
SIZE = (1280, 720)
FLIGHT_SIZE, FRAMES, FRAME_MS, QUALITY = (960, 540), 12, 250, 50
"""Of the flight: pixels, frames from a query to the next, duration of a frame, and quality of WEBP."""
UP = np.array([0.0, 0.0, 1.0])


def main() -> None:
    """Make the pictures from a run of the demo, which is made first if it is missing, and one of photographs."""
    if sys.argv[1:]:
        run = photographs.run_of(sys.argv[1])
        fly(recording_of(run, "ios", "ios"), photographs.pair_of(run).results.poses, IMAGES / "viewer.webp")
    else:
        print("viewer.webp stays: it is made from photographs, make docs-view PHOTOS=folder")
    draw(recording_of(pipeline.run(ROOT / "data_manifests" / "demo.yaml"), "hl", "ios"), IMAGES / "localization.png")


def recording_of(run: Path, map_device: str, query_device: str) -> Path:
    """Return the recording of a pair."""
    return run / run.name / "visualization" / f"{run.name}_map_{map_device}_query_{query_device}.rrd"


def draw(recording: Path, out: Path) -> None:
    """Save what the viewer shows of a recording, `.rrd`, as a PNG file; raise ToolkitError if it shows nothing."""
    from PIL import Image

    with open_viewer(recording) as viewer:
        picture = screenshot(viewer, SIZE)
    # Pages are also read over slow lines.
    with write_atomic(out) as temporary:
        picture.quantize(256, dither=Image.Dither.NONE).save(temporary, "PNG", optimize=True)
    print(out)


def fly(recording: Path, poses: Floats, out: Path) -> None:
    """Save a flight behind the queries of a recording as an animated WEBP file; raise ToolkitError as `draw` does.

    Args:
        recording: `.rrd`, each query of it with details.
        poses: world_from_cam of the queries (Q, 4, 4), world with z up.
        out: WEBP.
    """
    frames = []
    with open_viewer(recording) as viewer:
        for step in np.linspace(0, len(poses) - 1, FRAMES * (len(poses) - 1) + 1):
            viewer.set_time("query", sequence=round(step))
            look(viewer, _eye_behind(poses, float(step)))
            time.sleep(PAUSE_S)
            frames.append(screenshot(viewer, FLIGHT_SIZE))
    # The first and the last one stay, before it starts over.
    durations = [4 * FRAME_MS, *[FRAME_MS] * (len(frames) - 2), 4 * FRAME_MS]
    style = {"quality": QUALITY, "method": 6, "minimize_size": True, "loop": 0, "duration": durations}
    with write_atomic(out) as temporary:
        frames[0].save(temporary, "WEBP", save_all=True, append_images=frames[1:], **style)
    print(f"{out}: {len(frames)} frames, {out.stat().st_size // 1000} kB")


def _eye_behind(poses: Floats, step: float) -> Eye:
    """Return an eye behind and above the query of a number, between two of them of a fraction."""
    low, share = int(step), step % 1.0
    share = share * share * (3 - 2 * share)  # slow at each query
    first, second = poses[low], poses[min(low + 1, len(poses) - 1)]
    center, ahead = ((1 - share) * first[:3, k] + share * second[:3, k] for k in (3, 2))
    ahead = unit(ahead - UP * (ahead @ UP))
    return Eye(center - 12 * ahead + 7 * UP + 5 * np.cross(ahead, UP), center + 10 * ahead, UP)


# The viewer


@contextmanager
def open_viewer(recording: Path) -> "Iterator[ViewerClient]":
    """Yield a viewer of a recording; raise ToolkitError if one of its views reports an error."""
    import rerun_cli
    from rerun.experimental import ViewerClient

    # The command `rerun` is a wrapper, whose end leaves the viewer running.
    binary = str(Path(rerun_cli.__file__).with_name("rerun"))
    with ViewerClient.spawn(headless=True, port=PORT, hide_welcome_screen=True, executable_path=binary) as viewer:
        viewer.open(str(recording.resolve()))
        time.sleep(LOADING_S)  # until pictures are decoded and notices are gone
        yield viewer
        if reports := [report for view in viewer.get_state().views for report in view.reports]:
            raise ToolkitError(f"{recording}: the viewer complains: {reports[0]}")


def look(viewer: "ViewerClient", eye: Eye) -> None:
    """Move the eye of the 3D view."""
    blueprint = viewer.get_blueprint().blueprint
    controls = next(value for path, value in blueprint.items() if path.endswith("/EyeControls3D"))
    where = {"position": eye.position, "look_target": eye.target, "eye_up": eye.up}
    controls["EyeControls3D"] = {name: vector.tolist() for name, vector in where.items()}
    viewer.set_blueprint(blueprint, of="recording")


def screenshot(viewer: "ViewerClient", size: tuple[int, int]) -> "Image":
    """Return what a viewer shows, at most as large as `size`; raise ToolkitError if it shows nothing."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "view.png"
        for _ in range(TRIES):
            with suppress(Exception):  # too busy to answer; the next try may succeed
                viewer.save_screenshot(str(path))
                break
            time.sleep(LOADING_S)
        else:
            raise ToolkitError("The viewer drew nothing. Is a Vulkan driver installed (mesa-vulkan-drivers)?")
        with Image.open(path) as picture:
            small = picture.convert("RGB")
    small.thumbnail(size)
    return small


if __name__ == "__main__":
    try:
        main()
    except ToolkitError as error:
        sys.exit(f"Error: {error}")
