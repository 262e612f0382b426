"""What the figures of all stages share: colours, a figure without global state, and files with a caption."""

from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.files import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which people with any colour vision tell apart.
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, GREY = "#E69F00", "#56B4E9", "#5A5A5A"
# One meaning a colour, in pictures and recordings alike.
ESTIMATED, TRUE, MAP = VERMILLION, BLUE, GREY


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure of a size in inches, laid out so that labels do not collide."""
    from matplotlib.figure import Figure  # not pyplot: no state, and nothing is shown twice in a notebook

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def save_figure(figure: "Figure", path: str | Path, caption: str = "") -> Path:
    """Write a figure as PNG, the caption kept in the file where the report finds it, and return the path."""
    # Software would name the version of matplotlib: the same data shall give the same bytes.
    metadata = {"Software": None, "Description": caption}
    with write_atomic(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", pad_inches=0.1, metadata=metadata)
    return Path(path)
