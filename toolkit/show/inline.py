"""Recordings in a notebook: the viewer where someone is there to use it; where not, what is worth keeping."""

import html
import io
import os
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from toolkit.errors import ArtifactError
from toolkit.runs.kernel import TEXT_BARS
from toolkit.show.pictures import as_jpeg
from toolkit.show.viewer import open_command

ASSETS = "RERUN_NOTEBOOK_ASSET"
"""Variable of the viewer's package: where the page gets the viewer from. Read when the package is imported."""
MAX_INLINE_BYTES = 200_000_000
MAX_WIDTH = 1400
"""Of a JPEG, pixels."""


def show_picture(path: str | Path) -> Any:
    """Return a picture for a notebook, small enough to be kept with it: as it is, or as a JPEG if that is smaller.

    Raises:
        ArtifactError: there is no such picture, or it cannot be read.
    """
    import PIL.Image
    from IPython.display import Image

    try:
        with PIL.Image.open(path) as picture:
            small = as_jpeg(picture, MAX_WIDTH)
        return Image(data=min(Path(path).read_bytes(), small, key=len))
    except (OSError, SyntaxError, ValueError) as error:
        raise ArtifactError(f"{path}: no picture can be read here ({error}). Run the cells above again.") from None


def show_recording(path: str | Path, height: int = 600) -> Any:
    """Show a recording in a notebook: a link, the command that opens it, and the viewer itself.

    The viewer is served by this process and needs no network. It is left out where the pipeline runs the notebook:
    saved pages do not keep what a viewer shows.

    Args:
        height: of the viewer, pixels.

    Returns:
        The viewer's widget, None where it is left out.

    Raises:
        ArtifactError: there is no such recording.
    """
    from IPython.display import HTML, display

    path = Path(path)
    if not path.is_file():
        raise ArtifactError(f"{path}: no such recording. Run the notebook's cells above, with recordings = True.")
    # Relative to the notebook, so that the run folder can be moved.
    link = html.escape(os.path.relpath(path.resolve(), Path.cwd()), quote=True)
    size_mb = path.stat().st_size / 1e6
    display(
        HTML(
            f'<p>Recording: <a href="{link}" download>{html.escape(path.name)}</a> ({size_mb:.1f} MB). '
            f"Open it in the project's environment with<br><code>{html.escape(open_command(path.resolve()))}</code></p>"
        )
    )
    if TEXT_BARS in os.environ:
        return None
    if path.stat().st_size > MAX_INLINE_BYTES:
        display(HTML("<p>It is too large to be shown here; use the command.</p>"))
        return None
    os.environ.setdefault(ASSETS, "serve-local")
    with redirect_stdout(io.StringIO()):  # it tells its address
        import rerun_notebook

    viewer = rerun_notebook.Viewer(width="auto", height=height)
    viewer.send_rrd(path.read_bytes())
    display(viewer)
    return viewer
