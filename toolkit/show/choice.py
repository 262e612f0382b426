"""One of many queries in a notebook: as ordinary output, and with a list to choose another where someone is there."""

import difflib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from toolkit.errors import ArtifactError, ToolkitError
from toolkit.files import image_name, own_name
from toolkit.runs.kernel import TEXT_BARS

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Queries(Protocol[T_co]):
    """Queries to look at."""

    names: Sequence[str]

    def look(self, query: int | str = 0) -> T_co:
        """Return one by its number or name."""


def shown_name(name: str, most: int = 1000) -> str:
    """Return an image's name without its session, or what the user calls it; of more than `most` letters the last."""
    name = own_name(name.rpartition("/raw_data/")[2])
    return name if len(name) <= most else f"…{name[1 - most :]}"


def find_query(query: object, images: Mapping[str, int], count: int) -> int:
    """Return the number of a query.

    Args:
        query: its number, the name of an image of it, or the end of the name if no other query's ends so.
        images: number of the query by the names of all images.
        count: of the queries.

    Raises:
        ArtifactError: there is none, or several; names the nearest.
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
    found = {number for known, number in images.items() if known.endswith(f"/{name}")}
    if len(found) == 1:
        return found.pop()
    if found:
        raise ArtifactError(f"query: {len(found)} queries have an image whose name ends in {name!r}; write more of it.")
    close = difflib.get_close_matches(name, images, n=1, cutoff=0.0)
    near = f"The nearest of its {len(images)} images is {close[0]!r}." if close else "The pair has no queries."
    raise ArtifactError(f"query: no query of the pair has an image {str(query)!r}. {near}")


class Choice(Generic[T]):
    """What `choose` shows; `shown` is the query that was chosen last, None where there is nothing to look at."""

    def __init__(self, shown: T | None) -> None:
        self.shown = shown

    def attempt(self, ask: Callable[[T], Any]) -> None:
        """Show what asking about the query gives, or why it gives nothing; a finished notebook does not fail by it."""
        from IPython.display import display

        if self.shown is not None:
            try:
                display(ask(self.shown))
            except ToolkitError as error:
                print(error)


def choose(queries: Queries[T], chosen: int | str = 0) -> Choice[T]:
    """Show a query, and a list to choose another that takes its place; returns what holds the one that is shown.

    The picture is ordinary output, which a saved notebook keeps; the list is left out where the pipeline runs the
    notebook.

    Args:
        chosen: number or name of the first; a number where there are none shows nothing.

    Raises:
        ArtifactError: no such query.
    """
    from IPython.display import display

    if not len(queries.names) and isinstance(chosen, int):
        print("No queries to look at.")
        return Choice(None)
    choice: Choice[T] = Choice(queries.look(chosen))
    if TEXT_BARS in os.environ:
        display(choice.shown)
        return choice
    import ipywidgets

    number = chosen if isinstance(chosen, int) else getattr(choice.shown, "number", 0)
    options = [(f"{k}: {shown_name(name)}", k) for k, name in enumerate(queries.names)]
    layout = ipywidgets.Layout(width="95%")
    listed = ipywidgets.Dropdown(options=options, value=number, description="query", layout=layout)
    display(listed)
    handle = display(choice.shown, display_id=True)

    def show(change: dict[str, Any]) -> None:
        try:
            choice.shown = queries.look(change["new"])
        except ToolkitError as error:
            handle.update({"text/plain": str(error)}, raw=True)
        else:
            handle.update(choice.shown)

    listed.observe(show, "value")
    return choice
