"""Show one of many queries in a notebook, with a list to choose another in an interactive session."""

import difflib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.errors import ArtifactError, ToolkitError
from toolkit.files import image_name, own_name
from toolkit.runs.kernel import TEXT_BARS


def shown_name(name: str, most: int = 1000) -> str:
    """Return an image's name as the user knows it: without its session, and at most its last `most` letters."""
    name = own_name(name.rpartition("/raw_data/")[2])
    return name if len(name) <= most else f"…{name[1 - most :]}"


def find_query(query: object, images: Mapping[str, int], count: int) -> int:
    """Return the number of a query.

    Args:
        query: its number, the name of one of its images, or a unique end of the name.
        images: number of the query by the name of each image.
        count: number of queries.

    Raises:
        ArtifactError: no query matches, or several do; names the nearest.
    """
    if isinstance(query, int | np.integer) and not isinstance(query, bool):
        if 0 <= query < count:
            return int(query)
        raise ArtifactError(f"query: found {query}, expected a number from 0 to {count - 1}, or the name of an image.")
    if not isinstance(query, str | Path):
        raise ArtifactError(f"query: found {query!r}, expected a number or the name of an image.")
    name = image_name(str(query))
    if name in images:
        return images[name]
    numbers = {number for image, number in images.items() if image.endswith(f"/{name}")}
    if len(numbers) == 1:
        return numbers.pop()
    if numbers:
        raise ArtifactError(f"query: {len(numbers)} queries have an image name that ends in {name!r}; give more of it.")
    close = difflib.get_close_matches(name, images, n=1, cutoff=0.0)
    hint = f"The nearest of its {len(images)} images is {close[0]!r}." if close else "The pair has no queries."
    raise ArtifactError(f"query: no query of the pair has an image {str(query)!r}. {hint}")


@dataclass
class Choice:
    """The query that `choose` shows now; None without queries."""

    shown: Any

    def attempt(self, ask: Callable[[Any], Any]) -> None:
        """Display `ask` of the shown query, or print its error, so that a notebook does not fail."""
        from IPython.display import display

        if self.shown is not None:
            try:
                display(ask(self.shown))
            except ToolkitError as error:
                print(error)


def choose(queries: Any, chosen: int | str = 0) -> Choice:
    """Show a query, and a list to choose another in its place; return the choice.

    The picture is ordinary output, which a saved notebook keeps. There is no list when the pipeline runs the notebook.

    Args:
        queries: `RetrievedPair`, `InspectedPair` or `WorstQueries`: has `names`, and `look`, which takes a number.
        chosen: number or name of the first query; ignored if it is a number and there are no queries.

    Raises:
        ArtifactError: the query does not exist.
    """
    from IPython.display import display

    if not len(queries.names) and isinstance(chosen, int):
        print("There are no queries to show.")
        return Choice(None)
    choice = Choice(queries.look(chosen))
    if TEXT_BARS in os.environ:
        display(choice.shown)
        return choice
    import ipywidgets

    number = chosen if isinstance(chosen, int) else getattr(choice.shown, "number", 0)
    options = [(f"{k}: {shown_name(name)}", k) for k, name in enumerate(queries.names)]
    layout = ipywidgets.Layout(width="95%")
    dropdown = ipywidgets.Dropdown(options=options, value=number, description="query", layout=layout)
    display(dropdown)
    handle = display(choice.shown, display_id=True)

    def show(change: dict[str, Any]) -> None:
        try:
            choice.shown = queries.look(change["new"])
        except ToolkitError as error:
            handle.update({"text/plain": str(error)}, raw=True)
        else:
            handle.update(choice.shown)

    dropdown.observe(show, "value")
    return choice
