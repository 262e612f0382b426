"""Common parts of all figures: style, colors, figures without global state, PNG files with a caption, JPEGs."""

import base64
import io
import math
from collections.abc import Callable, Iterable
from functools import cache, wraps
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import Colormap, LogNorm
    from matplotlib.figure import Figure, SubFigure
    from PIL.Image import Image

P = ParamSpec("P")
R = TypeVar("R")

SHOWN_DPI, STORED_DPI = 110, 160
"""Pixels per inch of figures as notebooks show them at first, and as they are stored (`savefig.dpi` of the style)."""
STYLE = Path(__file__).with_name("figures.mplstyle")
# Colors of Okabe and Ito, distinguishable with any color vision.
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, GRAY = "#E69F00", "#56B4E9", "#5A5A5A"
# Each color has the same meaning in pictures and recordings.
ESTIMATED, TRUE, MAP = VERMILLION, BLUE, GRAY
ERROR_RANGE_M = (0.01, 1.0)
"""Range of position errors that error colors distinguish, on a logarithmic scale, meters."""


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Make a function draw in the common style, without changing matplotlib's global style."""

    @wraps(draw)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> R:
        import matplotlib as mpl

        with mpl.rc_context(fname=STYLE):
            return draw(*args, **kwargs)

    return in_style


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure, size in inches, with a layout that avoids overlaps; notebooks can display it."""
    from matplotlib.figure import Figure  # pyplot has global state, and notebooks would show its figures twice

    figure = Figure(figsize=(width, height), layout="constrained")
    figure._repr_html_ = lambda: zoomable(picture_of(figure), str(figure.get_label()))  # type: ignore[method-assign]
    return figure


def picture_of(figure: "Figure") -> bytes:
    """Return a figure as notebooks display and store it: as a JPEG file if that has less than half the size of PNG.

    So photographs become JPEG; lines and text stay PNG, which is sharper and no larger.
    """
    picture = rendered(figure)
    png, small = _as_png(picture), as_jpeg(picture, picture.width)
    return small if 2 * len(small) < len(png) else png


def mime_type(picture: bytes) -> str:
    """Return the MIME type of a PNG or JPEG file."""
    return "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg"


def zoomable(picture: bytes, title: str = "") -> str:
    """Return HTML of a PNG or JPEG file: as large as its figure, and in full size after a click, without scripts.

    Where a program removes style sheets, as JupyterLab does in notebooks that it does not trust, it stays small.
    """
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as opened:
        width = round(opened.width * SHOWN_DPI / STORED_DPI)
    data = base64.b64encode(picture).decode()
    return (
        "<style>details.zoom[open]{overflow:auto}"
        "details.zoom[open] img{width:auto!important;max-width:none!important}</style>"
        "<details class='zoom'><summary style='display:block;cursor:zoom-in' title='Enlarge, or back'>"
        f"<img src='data:{mime_type(picture)};base64,{data}' alt='{escape(title)}' "
        f"style='width:{width}px;max-width:100%'></summary></details>"
    )


def as_jpeg(picture: "Image", max_width: int) -> bytes:
    """Return a picture as a JPEG file, at most `max_width` pixels wide and ten times as high."""
    small = picture.convert("RGB")
    small.thumbnail((max_width, 10 * max_width))
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=85, optimize=True)
    return stream.getvalue()


def plain_log(axes: "Axes", sides: str) -> None:
    """Label logarithmic axes 0.001 instead of 10^-3; `sides`: x, y or xy. Call it after setting their limits."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for side in sides:
        axis: Axis = getattr(axes, f"{side}axis")
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: np.format_float_positional(value, 6, trim="-")))
        axis.set_minor_formatter(NullFormatter())


def shared_legend(figure: "Figure | SubFigure", axes: Iterable["Axes"], **style: Any) -> None:
    """Draw one legend below a figure with the labels of several axes; `style` is passed to `Figure.legend`."""
    handles: dict[str, Any] = {}
    for axis in axes:
        handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", **style)


def save_figure(figure: "Figure", path: str | Path, caption: str = "") -> Path:
    """Write a figure as PNG and return the path; the caption is stored in the file for the report."""
    return save_picture(rendered(figure), path, caption)


def save_picture(picture: "Image", path: str | Path, caption: str = "") -> Path:
    """Write a rendered figure as `save_figure` does; in another thread, it takes no time of that which draws."""
    with write_atomic(path) as temporary:
        temporary.write_bytes(_as_png(picture, caption))
    return Path(path)


@styled
def rendered(figure: "Figure") -> "Image":
    """Return the pixels of a figure, RGB, as it is stored: with the style's resolution and border."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    # Compute layout and border here: `savefig` would draw the whole figure once more for that.
    figure.dpi = mpl.rcParams["savefig.dpi"]
    canvas, engine = FigureCanvasAgg(figure), figure.get_layout_engine()
    renderer = canvas.get_renderer()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    border = figure.get_tightbbox(renderer).padded(mpl.rcParams["savefig.pad_inches"])
    figure.savefig(io.BytesIO(), format="raw", bbox_inches=border)
    return Image.fromarray(np.asarray(canvas.renderer.buffer_rgba())).convert("RGB")


def _as_png(picture: "Image", caption: str = "") -> bytes:
    from PIL.PngImagePlugin import PngInfo

    stream, text = io.BytesIO(), PngInfo()
    text.add_text("Description", caption)
    # Stronger compression takes three times as long and saves nothing on figures.
    picture.save(stream, "PNG", pnginfo=text, compress_level=1)
    return stream.getvalue()


def error_scale() -> "tuple[Colormap, LogNorm]":
    """Return the color map of position errors: perceptually uniform, visible on white and on black; sky if unknown."""
    import matplotlib as mpl
    from matplotlib.colors import ListedColormap, LogNorm

    colors = mpl.colormaps["plasma"](np.linspace(0.25, 0.85, 256))
    return ListedColormap(colors).with_extremes(bad=SKY), LogNorm(*ERROR_RANGE_M, clip=True)


def error_colors(errors_m: ArrayLike) -> NDArray[np.uint8]:
    """Return the colors (N, 3) RGB of errors (N,), meters; unknown errors, NaN, are sky blue."""
    colors, scale = error_scale()
    return colors(scale(np.ma.masked_invalid(np.asarray(errors_m, np.float64))), bytes=True)[:, :3]


def error_bar(figure: "Figure", unit: str = "m", **where: Any) -> None:
    """Draw the legend of the error colors; `where` is passed to matplotlib's `Figure.colorbar`."""
    from matplotlib.cm import ScalarMappable

    colors, scale = error_scale()
    bar = figure.colorbar(ScalarMappable(scale, colors), extend="both", **where)
    bar.set_label(f"position error [{unit}]")
    bar.set_ticks([0.01, 0.1, 1.0], labels=["0.01", "0.1", "1"])


@cache
@styled
def draw_error_legend(unit: str = "m") -> bytes:
    """Return the legend of the error colors as PNG; `unit`: unit of the errors."""
    figure = new_figure(1.3, 2.4)
    error_bar(figure, unit, cax=figure.subplots())
    return _as_png(rendered(figure))


def percent(share: float) -> str:
    """Format a share, 0 to 1, in percent without the sign."""
    return "–" if math.isnan(share) else f"{100 * share:.1f}".removesuffix(".0")


def number(value: float) -> str:
    """Format an error for a table with about three significant digits."""
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "–"
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"
