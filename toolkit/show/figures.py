"""What the figures of all stages share: one style, colors, a figure without global state, files with a caption."""

import io
import math
from collections.abc import Callable
from functools import cache, partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.files import write_atomic
from toolkit.show.pictures import as_shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.colors import Colormap, LogNorm
    from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

STYLE = Path(__file__).with_name("figures.mplstyle")
# Okabe and Ito's colors, which people with any color vision tell apart.
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, GRAY = "#E69F00", "#56B4E9", "#5A5A5A"
# One meaning a color, in pictures and recordings alike.
ESTIMATED, TRUE, MAP = VERMILLION, BLUE, GRAY
ERROR_RANGE_M = (0.01, 1.0)
"""Errors of position that the colors of errors tell apart, on a logarithmic scale."""


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Make a function draw in the style of all figures, without changing the style of anyone else's."""

    @wraps(draw)
    def in_style(*args: P.args, **kwargs: P.kwargs) -> R:
        import matplotlib as mpl

        with mpl.rc_context(fname=STYLE):
            return draw(*args, **kwargs)

    return in_style


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure of a size in inches, laid out so that labels do not collide; notebooks show it."""
    from matplotlib.figure import Figure  # not pyplot: no state, and nothing is shown twice in a notebook

    figure = Figure(figsize=(width, height), layout="constrained")
    figure._repr_mimebundle_ = partial(shown, figure)  # type: ignore[attr-defined]
    return figure


def shown(figure: "Figure", **_: Any) -> dict[str, bytes]:
    """Return a figure as notebooks show and keep it, by the kind of picture."""
    return as_shown(_png_of(figure))


def plain_log(axes: "Axes", sides: str) -> None:
    """Number logarithmic axes plainly, 0.001 and not 10^-3; `sides`: x, y or xy. Their limits are set before."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for side in sides:
        axis: Axis = getattr(axes, f"{side}axis")
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: np.format_float_positional(value, 6, trim="-")))
        axis.set_minor_formatter(NullFormatter())


def save_figure(figure: "Figure", path: str | Path, caption: str = "") -> Path:
    """Write a figure as PNG, the caption kept in the file where the report finds it, and return the path."""
    with write_atomic(path) as temporary:
        temporary.write_bytes(_png_of(figure, caption))
    return Path(path)


@styled
def _png_of(figure: "Figure", caption: str = "") -> bytes:
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    # To lay a figure out and find its border, `savefig` would draw all of it once more.
    figure.dpi = mpl.rcParams["savefig.dpi"]
    renderer, engine = FigureCanvasAgg(figure).get_renderer(), figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
    border = figure.get_tightbbox(renderer).padded(mpl.rcParams["savefig.pad_inches"])
    # Software would name the version of matplotlib: the same data shall give the same bytes.
    metadata, stream = {"Software": None, "Description": caption}, io.BytesIO()
    # Of figures, stronger compression takes thrice the time and saves nothing.
    figure.savefig(stream, bbox_inches=border, metadata=metadata, pil_kwargs={"compress_level": 2})
    return stream.getvalue()


def error_scale() -> "tuple[Colormap, LogNorm]":
    """Return the colors of errors of position: perceptually uniform, without ends that vanish on white or black."""
    import matplotlib as mpl
    from matplotlib.colors import ListedColormap, LogNorm

    colors = mpl.colormaps["plasma"](np.linspace(0.25, 0.85, 256))
    return ListedColormap(colors), LogNorm(*ERROR_RANGE_M, clip=True)


def error_colors(errors_m: ArrayLike) -> NDArray[np.uint8]:
    """Return the colors (N, 3) RGB of errors (N,), meters; what is not known, NaN, is sky blue."""
    errors = np.asarray(errors_m, np.float64)
    colors, scale = error_scale()
    finite = np.isfinite(errors)
    rgb = np.tile(np.array(bytearray.fromhex(SKY[1:]), np.uint8), (len(errors), 1))
    if finite.any():
        rgb[finite] = colors(scale(np.maximum(errors[finite], ERROR_RANGE_M[0])), bytes=True)[:, :3]
    return rgb


def error_bar(figure: "Figure", unit: str = "m", **where: Any) -> None:
    """Draw the legend of errors' colors; `where` goes to matplotlib's `Figure.colorbar`."""
    from matplotlib.cm import ScalarMappable

    colors, scale = error_scale()
    bar = figure.colorbar(ScalarMappable(scale, colors), extend="both", **where)
    bar.set_label(f"error of position [{unit}]")
    bar.set_ticks([0.01, 0.1, 1.0], labels=["0.01", "0.1", "1"])


@cache
@styled
def draw_error_legend(unit: str = "m") -> bytes:
    """Return the legend of errors' colors, PNG; `unit` is that of the errors."""
    figure = new_figure(1.3, 2.4)
    error_bar(figure, unit, cax=figure.subplots())
    return _png_of(figure)


def percent(share: float) -> str:
    """Return a share, 0 to 1, in percent without the sign."""
    return "–" if math.isnan(share) else f"{100 * share:.1f}".removesuffix(".0")


def number(value: float) -> str:
    """Return an error for a table: two or three digits that count."""
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "–"
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"
