"""Inspect the retrieval of one query: its references, its similarity to map images, and where good references are."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture, Session
from toolkit.embedders.embedded import Embedded
from toolkit.errors import ArtifactError
from toolkit.figures.query_images import draw_image, query_and_references, shown_name
from toolkit.figures.style import (
    BLUE,
    GRAY,
    GREEN,
    MAP,
    ORANGE,
    TRUE,
    new_figure,
    picture_of,
    shared_legend,
    styled,
    zoomable,
)
from toolkit.figures.top_view import Ground, Layer, draw_layers, window_of
from toolkit.files import image_name, pair_devices, read_references, require_current
from toolkit.geometry import Floats, Ints
from toolkit.results.metrics import MIN_OVERLAP, is_posed, overlap_of
from toolkit.results.pair import find_query

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_COMPARED = 2000
"""Map images that a query is compared with besides its references: a regular sample."""
MAX_IN_ROW = 5
"""References per row."""


@dataclass(frozen=True)
class RetrievedQuery:
    """The retrieval of one query image. A notebook displays its figure."""

    session: Session
    map_session: Session
    number: int
    """Number of the query image: its line in the file of references."""
    row: int
    """Row of the query image in its session."""
    references: pd.DataFrame
    """One row per reference, best first: rank, score, name, overlap (0 to 1, NaN if unknown)."""
    images: Ints
    """(M,) rows of map images in the order that they were taken, by subsession and camera."""
    similarity: Floats
    """(M,) similarity of the query to each map image."""
    overlap: Floats
    """(M,) overlap of each map image with the query, 0 to 1; NaN if unknown."""

    @property
    def name(self) -> str:
        return self.session.image_name(self.row)

    @property
    def is_known(self) -> bool:
        """Whether the overlap is known, that is, the true pose of the query."""
        return bool(np.isfinite(self.overlap).any())

    @cached_property
    def figure(self) -> "Figure":
        return draw_retrieved(self)

    def __repr__(self) -> str:
        good = f", {int((self.references['overlap'] >= MIN_OVERLAP).sum())} overlap" if self.is_known else ""
        return f"query image {self.number}: {self.name}\n{len(self.references)} references{good}"

    def _repr_html_(self) -> str:
        return zoomable(picture_of(self.figure), repr(self))


class RetrievedPair:
    """The query images of one pair with their references, to inspect one at a time."""

    def __init__(
        self,
        sessions_root: str | Path,
        jsonl: str | Path,
        embeddings: str | Path,
    ) -> None:
        """Open the references of a pair, `<scene>_map_<M>_query_<Q>.jsonl`, with the descriptors in the folder
        `embeddings`.

        Raise ArtifactError if the references are missing, damaged, or older than the embeddings.
        """
        capture = Capture.from_sessions_root(sessions_root)
        jsonl = Path(jsonl)
        map_device, query_device = pair_devices(jsonl.stem)
        self.session, self.map_session = capture[f"{query_device}_query"], capture[f"{map_device}_map"]
        require_current(jsonl, "retrieve", missing=False)
        self.embeddings, self.lines = Path(embeddings), read_references(jsonl, "path")
        self.names = [image_name(line["path"]) for line in self.lines]
        """Names of the query images."""

    def look(self, query: int | str = 0) -> RetrievedQuery:
        """Return the retrieval of a query image, by its number, its name, or a unique end of the name.

        A map image overlaps with the query if at least `MIN_OVERLAP` of points at 2, 4, 8 and 16 m in its view lie in
        the query's view at the true pose (`metrics.overlap_in_view`); walls are ignored. Without a true pose, overlap
        is NaN.
        Similarities are computed from the stored descriptors. Raise ArtifactError if no query matches, or several do
        (the nearest is named), or its descriptors are missing.
        """
        number = find_query(query, {name: number for number, name in enumerate(self.names)}, len(self.names))
        line = self.lines[number]
        if self.names[number] not in self.session.row_of_name:
            raise ArtifactError(f"{self.names[number]}: the file of references has this query image, the capture not.")
        row = self.session.row_of_name[self.names[number]]
        names = [image_name(hit["path"]) for hit in line["topk"]]
        map_rows = [self.map_session.row_of_name.get(name, -1) for name in names]
        images, similarity = self._similarities(row, map_rows)
        overlap = self._overlaps(row, images)
        overlap_of_row = dict(zip(images.tolist(), overlap.tolist(), strict=True))
        references = pd.DataFrame({
            "rank": np.arange(1, len(names) + 1),
            "score": [float(hit.get("score", np.nan)) for hit in line["topk"]],
            "name": names,
            "overlap": [overlap_of_row.get(map_row, np.nan) for map_row in map_rows],
        })  # fmt: skip
        return RetrievedQuery(self.session, self.map_session, number, row, references, images, similarity, overlap)

    def _similarities(self, row: int, references: Sequence[int]) -> tuple[Ints, Floats]:
        """Return the rows of posed map images in order, all `references` among them, and the query's similarities."""
        from toolkit.embedders.search import fused_products  # loads FAISS

        session, queries = self.map_session, Embedded.open(self.session, self.embeddings, normalize=True)
        query_rows = np.flatnonzero(queries.rows == row)
        if not len(query_rows):
            raise ArtifactError(f"{self.embeddings}: {self.session.image_name(row)} has no descriptor. Embed again.")
        of_map = Embedded.of_map(session, self.embeddings, normalize=True)
        rows, vectors = of_map.rows, of_map.vectors
        images = session.images.iloc[rows]
        usable = np.lexsort((images["timestamp"], images["sensor_id"].astype(str), session.subsession_of(rows)))
        sampled = np.arange(len(usable)) % max(1, -(-len(usable) // MAX_COMPARED)) == 0
        usable = usable[sampled | np.isin(rows[usable], references)]
        ascending, (query,) = np.sort(usable), queries.vectors[query_rows[:1]]
        values = fused_products(query, vectors[ascending], vectors.dims, lambda a, b: b @ a).astype(np.float64)
        return rows[usable], values[np.searchsorted(ascending, usable)]

    def _overlaps(self, row: int, images: Ints) -> Floats:
        """Return the overlap of map images with a query image; NaN without its true pose."""
        pose = self.session.world_from_cam([row], ground_truth=True)[0]
        if not is_posed(pose):
            return np.full(len(images), np.nan)
        session, camera = self.map_session, self.session.cameras([row])[0]
        sensors, poses = session.images["sensor_id"].iloc[images], session.world_from_cam(images)
        names = [session.image_name(int(image)) for image in images]
        of_images = zip(names, sensors, poses, strict=True)
        shown = ({"path": name, "sensor_id": sensor, "Tws": of_map} for name, sensor, of_map in of_images)
        return np.array([overlap_of(image, session, None, pose, camera) for image in shown])


@styled
def draw_retrieved(query: RetrievedQuery) -> "Figure":
    """Draw the references of a query image as a strip, its similarity along the map, and the map from above.

    With a true pose, images that overlap with the query are green, and references that do not are orange.
    """
    count, session, map_session = len(query.references), query.session, query.map_session
    rows = max(1, -(-count // MAX_IN_ROW))
    figure = new_figure(11, 1.75 * rows + 4.6)
    strip, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.75 * rows + 0.3, 4.3])[:, 0]
    rows_of_map = [map_session.row_of_name.get(name) for name in query.references["name"]]
    of_map = map_session.cameras([row for row in rows_of_map if row is not None])
    (ratio,), ratios = ([one.width / one.height for one in each] for each in (session.cameras([query.row]), of_map))
    axis, panels = query_and_references(strip, count, rows, ratio, max(ratios, default=1.0))
    draw_image(axis, session.image_path(query.row), 2.4 * rows, "query", frame="black")
    for panel, hit, row in zip(panels, query.references.itertuples(), rows_of_map, strict=True):
        known, good = np.isfinite(hit.overlap), hit.overlap >= MIN_OVERLAP
        text = f"{hit.rank}: {hit.score:.2f}" + (f", overlap {hit.overlap:.0%}" if known else "")
        color = (GREEN if good else ORANGE) if known else GRAY
        image = np.full((3, 4, 3), 230, np.uint8) if row is None else map_session.image_path(row)
        draw_image(panel, image, 2.4, text if row is not None else f"{text}, not in the capture", color, color)
    along, above = below.subplots(1, 2, width_ratios=[1.6, 1.0])
    good = query.overlap >= MIN_OVERLAP
    retrieved = np.isin(query.images, [row for row in rows_of_map if row is not None])
    _draw_along(along, query, good, retrieved)
    _draw_from_above(above, query, good, retrieved)
    shared_legend(below, (along, above), ncols=4)
    title = f"query image {query.number}: {shown_name(query.name)}"
    if query.is_known:
        title += f"\ngreen: overlaps with the query by its true pose: {MIN_OVERLAP:.0%} of points assumed in its view"
    figure.suptitle(title, fontsize=10)
    return figure


def _draw_along(axis: "Axes", query: RetrievedQuery, good: NDArray[np.bool_], retrieved: NDArray[np.bool_]) -> None:
    """Draw the similarity of the query to the map images, in the order that they were taken."""
    x = np.arange(len(query.images))
    if query.is_known:
        axis.scatter(x[good], query.similarity[good], s=16, c=GREEN, lw=0, zorder=3, label="overlaps with the query")
    other = "map image" if not query.is_known else "does not overlap"
    axis.scatter(x[~good], query.similarity[~good], s=9, c="0.6", lw=0, zorder=2, label=other)
    axis.scatter(x[retrieved], query.similarity[retrieved], s=55, facecolors="none", edgecolors=BLUE, lw=1.2, zorder=4,
                 label=f"the {int(retrieved.sum())} references")  # fmt: skip
    recordings = np.asarray(query.map_session.subsession_of(query.images), str)
    sensors = query.map_session.images["sensor_id"].to_numpy(str)[query.images]
    # Only recordings are separated if each image has a camera of its own.
    tracks = recordings if len(set(sensors)) > len(sensors) / 2 else np.char.add(recordings, sensors)
    cuts = np.flatnonzero(tracks[1:] != tracks[:-1]) + 1
    for track in np.split(x, cuts):
        axis.plot(track, query.similarity[track], color="0.8", lw=0.8, zorder=1)
    for k, start in enumerate(cuts - 0.5):
        axis.axvline(start, color="0.7", lw=0.8, ls=":", zorder=0, label=None if k else "next camera or recording")
    axis.set(xlabel="map images, in the order they were taken", ylabel="similarity to the query")
    axis.set_title("similarity along the map", fontsize=9)


def _draw_from_above(
    axis: "Axes", query: RetrievedQuery, good: NDArray[np.bool_], retrieved: NDArray[np.bool_]
) -> None:
    """Draw the positions of the map images, the references and, if known, the query."""
    poses, true = query.map_session.world_from_cam(query.images), query.session.world_from_cam([query.row], True)
    layers = [
        Layer(poses[~good], None, "0.6" if query.is_known else MAP, s=9, lw=0),
        Layer(poses[good], None, GREEN, s=16, lw=0),
        Layer(poses[retrieved], None, BLUE, hollow=True, s=55, lw=1.2),
        Layer(true, "the query, true", TRUE, 0.06, s=60, marker="*", zorder=5),
    ]
    # Zoom to the relevant images, as a map may have several places.
    relevant = poses[good | retrieved] if (good | retrieved).any() else poses
    ground = Ground.below(poses)
    window = window_of(ground.flat(np.concatenate([relevant, true[is_posed(true)]])), margin=0.2)
    draw_layers(axis, ground, layers, window)
    places = ground.flat(poses)
    outside = int(((places < window[0]) | (places > window[1])).any(axis=1).sum())
    elsewhere = f"; {outside} map images are elsewhere" if outside else ""
    axis.set_title(f"cameras from above{elsewhere}", fontsize=9)
