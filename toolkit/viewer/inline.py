"""Show pictures and recordings in a notebook; the viewer only in an interactive session."""

import html
import io
import os
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from toolkit.errors import ArtifactError
from toolkit.figures.style import as_jpeg, zoomable
from toolkit.files import relative_url
from toolkit.runs.kernel import TEXT_BARS
from toolkit.viewer.blueprint import open_command

ASSETS = "RERUN_NOTEBOOK_ASSET"
"""Environment variable that tells rerun_notebook where to load the viewer from; read on import."""
MAX_INLINE_BYTES = 200_000_000
"""Size of a recording up to which the notebook shows it."""


def show_picture(path: str | Path) -> Any:
    """Return a picture file for a notebook, which enlarges it on a click: as it is, or as a JPEG if that is smaller."""
    import PIL.Image
    from IPython.display import HTML

    try:
        with PIL.Image.open(path) as picture:
            small = as_jpeg(picture, picture.width)
        return HTML(zoomable(min(Path(path).read_bytes(), small, key=len), Path(path).stem))
    except (OSError, SyntaxError, ValueError) as error:
        raise ArtifactError(f"{path}: cannot read the picture ({error}). Run the cells above again.") from None


def show_recording(path: str | Path, height: int = 600) -> Any:
    """Show a recording in a notebook: a link, the command that opens it, and the viewer itself, `height` pixels high.

    Return the viewer's widget; None without a viewer. Raise ArtifactError if the recording is missing.
    """
    from IPython.display import HTML, display

    path = Path(path)
    if not path.is_file():
        raise ArtifactError(f"{path}: no such recording. Run the cells above with recordings = True.")
    link = relative_url(path.resolve())
    size_mb = path.stat().st_size / 1e6
    display(
        HTML(
            f'<p>Recording: <a href="{link}" download>{html.escape(path.name)}</a> ({size_mb:.1f} MB). '
            f"Open it in the project's environment with<br><code>{html.escape(open_command(path.resolve()))}</code></p>"
        )
    )
    if path.stat().st_size > MAX_INLINE_BYTES:
        display(HTML("<p>It is too large to show here; use the command.</p>"))
        return None
    viewer = open_viewer(lambda: path, height)
    if viewer is not None:
        display(viewer)
    return viewer


def open_viewer(recording: Callable[[], Path], height: int = 600) -> Any:
    """Return a viewer's widget with a recording, which `recording` returns; None where no viewer can be shown.

    This process serves the viewer, so it needs no network. Saved pages do not store its content, so there is none when
    the pipeline runs the notebook.
    """
    if TEXT_BARS in os.environ:
        return None
    os.environ.setdefault(ASSETS, "serve-local")
    with redirect_stdout(io.StringIO()):  # hide the address that it prints
        import rerun_notebook

    viewer = rerun_notebook.Viewer(width="auto", height=height)
    viewer.send_rrd(recording().read_bytes())
    return viewer
