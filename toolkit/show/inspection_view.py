"""Pictures of one query: beside its references with the matches by kind, in the map from above, in numbers."""

import json
import textwrap
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from toolkit.capture.images import read_for_display
from toolkit.capture.world_up import up_of_cameras
from toolkit.geometry import Floats
from toolkit.localizers.correspondences import Correspondences
from toolkit.show.answers import Answer
from toolkit.show.choice import shown_name
from toolkit.show.figures import BLUE, ESTIMATED, GRAY, GREEN, MAP, ORANGE, SKY, TRUE, new_figure, number, styled
from toolkit.show.localized import ShownImage, sure_points
from toolkit.show.metrics import is_posed
from toolkit.show.top_view import draw_dots, draw_headings, ground_axes, places_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PURPLE = "#CC79A7"
WAYS = {"guided": GREEN, "descriptors": SKY, "lifted": PURPLE}
"""Colors of inliers, by how they were found."""
MARKERS = {"sift": "o", "aliked": "^", "superpoint": "s"}
"""By kind of features."""
REJECTED = ESTIMATED
LONGEST_SIDE = 900
"""Pixels of a photograph that are drawn: no figure shows more."""
LINES = 60
"""Lines of inliers, and of rejected matches, that are drawn at most: more of them hide the pictures."""
SURE = 2.4477
"""Deviations in the plane within which 95 % of a normal distribution lie."""
MAX_POINTS = 20_000
LABELS = {
    "num_matches": ("matches by descriptors", "{:.0f}"), "num_inliers": ("of them, inliers", "{:.0f}"),
    "inlier_ratio": ("their share", "{:.0%}"), "num_guided": ("found again by the pose", "{:.0f}"),
    "rmse_px": ("error of reprojection [px]", "{:.2f}"), "coverage": ("image covered", "{:.0%}"),
    "p_correct": ("probability of being right", "{:.1%}"), "rival_support": ("support of the best rival", "{:.0%}"),
    "agreement": ("inliers of a second kind", "{:.0f}"), "position_std_m": ("deviation of position [m]", "{:.2g}"),
    "rotation_std_deg": ("deviation of rotation [deg]", "{:.2g}"), "scale_std": ("deviation of scale", "{:.1%}"),
}  # fmt: skip
"""Of the numbers: what they are called, and how they are written."""
OF_NETWORKS = {
    "num_matches": ("references shown to it", "{:.0f}"), "num_inliers": ("of them, consistent", "{:.0f}"),
    "inlier_ratio": ("their share", "{:.0%}"),
}  # fmt: skip
OF_MATCHES = ("num_guided", "rmse_px", "coverage", "p_correct", "rival_support", "agreement")
"""What a pose without matches does not have."""


@styled
def draw_inspection(one: Answer) -> "Figure":
    """Draw a query beside its best reference and above the others, in the map from above, and its numbers.

    Lines join what query and reference both see. Inliers are colored by how they were found (`WAYS`), rejected matches
    are red; the shape of a mark tells the kind of features (`MARKERS`).
    """
    figure = new_figure(11, 9.4)
    above, strip, below = figure.subfigures(3, 1, squeeze=False, height_ratios=[4.0, 2.0, 3.6])[:, 0]
    details, found = one.details, one.correspondences
    axis = above.subplots()
    references = details.captioned_references()
    _draw_joined(axis, one)
    axis.set_title(_caption(one), fontsize=9)
    legend = _marks_of(found)
    if legend:
        above.legend(handles=legend, loc="outside lower center", ncols=6, fontsize=8)
    others = references[1:]
    of_rig = [(image, f"query, {_camera_name(image)}", True) for image in details.cameras[1:]]
    counted = details.has_matches
    more = [(image, text + f": {image.num_inliers} inliers" * counted, agrees) for image, text, agrees in of_rig]
    panels = np.ravel(strip.subplots(1, max(4, min(6, len(others) + len(more))), squeeze=False))
    for panel in panels:
        panel.set_axis_off()
    for panel, (image, text, agrees) in zip(panels, [*others, *more], strict=False):
        _draw_photograph(panel, image)
        _draw_marks(panel, image, found, np.zeros(2), size=4)
        panel.set_title(textwrap.fill(text, 30), fontsize=8, color="black" if agrees else REJECTED)
    from_above, near, table = below.subplots(1, 3, width_ratios=[1.15, 1.0, 1.0])
    _draw_from_above(from_above, [(one, "estimated", ESTIMATED)])
    _draw_near(near, [(one, "estimated", ESTIMATED)])
    _draw_table(table, [one])
    name = shown_name(one.name, 110)
    figure.suptitle(f"{one.headline}\n{name}\n{textwrap.fill(one.reason, 130)}", fontsize=10)
    return figure


@styled
def draw_comparison(before: Answer, after: Answer, changes: Mapping[str, Any]) -> "Figure":
    """Draw a query localized twice: both answers beside each other, in one map from above, and in one table.

    Args:
        changes: of the settings, between the two.
    """
    ones = [before, after]
    figure = new_figure(11, 7.2)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.3, 3.6])[:, 0]
    for axis, one, name in zip(above.subplots(1, 2), ones, ("as it was", "again"), strict=True):
        _draw_joined(axis, one)
        axis.set_title(f"{name}: {one.status}\n{textwrap.fill(one.reason, 78)}", fontsize=8.5)
        if legend := _marks_of(one.correspondences):
            axis.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, fontsize=7.5)
    from_above, near, table = below.subplots(1, 3, width_ratios=[1.0, 0.9, 1.25])
    named = [(before, "as it was", ESTIMATED), (after, "again", PURPLE)]
    _draw_from_above(from_above, named)
    _draw_near(near, named)
    _draw_table(table, ones)
    changed = json.dumps(changes)[1:-1] if changes else "no setting changed"
    first = before.headline.rpartition(":")[0]
    figure.suptitle(f"{first}, localized again\n{textwrap.fill(changed, 120)}", fontsize=10)
    return figure


def _caption(one: Answer) -> str:
    """Return what stands above query and best reference."""
    references = one.details.captioned_references()
    camera = one.details.cameras[0]
    of_rig = f" ({_camera_name(camera)})" if len(one.details.cameras) > 1 else ""
    if len(camera.matches):
        text = f"query{of_rig}: {camera.num_inliers} of {len(camera.matches)} map points agree"
    else:
        text = f"query{of_rig}: no matches were stored"
    if not references:
        return f"{text} · no reference"
    both = np.isin(camera.matches, references[0][0].matches)
    joined = f", {int(camera.inlier[both].sum())} of them in both" if both.any() else ""
    return f"{text} · {references[0][1]}{joined}"


def _draw_joined(axis: "Axes", one: Answer) -> None:
    """Draw the query's image with the most inliers and its best reference at one height, common points joined."""
    details, found = one.details, one.correspondences
    image, references = details.cameras[0], details.captioned_references()[:1]
    width, height = _draw_photograph(axis, image)
    _draw_marks(axis, image, found, np.zeros(2), size=9)
    end = width
    for reference, _, _ in references:
        offset = width * 1.02
        right, scale = _draw_photograph(axis, reference, offset, height)
        end = right
        _draw_marks(axis, reference, found, np.array([offset, 0.0]), size=9, scale=scale, only=image.matches)
        _, i, j = np.intersect1d(image.matches, reference.matches, return_indices=True)
        ends = reference.pixels[j] * scale + [offset, 0.0]
        lines = np.stack([image.pixels[i], ends], axis=1)
        for agrees in (False, True):
            chosen = np.flatnonzero(image.inlier[i] == agrees)
            chosen = chosen[:: len(chosen) // LINES + 1]
            colors = [_color(found, int(image.matches[i[k]])) for k in chosen]
            axis.add_collection(LineCollection(list(lines[chosen]), colors=colors, linewidths=0.6, alpha=0.7))
    axis.set(xlim=(0, end), ylim=(height, 0), aspect="equal")
    axis.set_axis_off()


def _draw_photograph(
    axis: "Axes", image: ShownImage, offset: float = 0.0, height: float | None = None
) -> tuple[float, float]:
    """Draw a photograph in its own pixels; with a `height`, scaled to it and to the right of `offset`.

    Returns:
        Its width and height; with a `height`, its right edge and the scale of its pixels.
    """
    picture, rows, columns = _reduced(image.path)
    if height is None:
        axis.imshow(picture, extent=(0, columns, rows, 0), interpolation="antialiased")
        return float(columns), float(rows)
    scale = height / rows
    right = offset + scale * columns
    axis.imshow(picture, extent=(offset, right, height, 0), interpolation="antialiased")
    return right, scale


@lru_cache(maxsize=16)  # a query that is localized again is drawn again
def _reduced(path: Path) -> tuple[NDArray[np.uint8], int, int]:
    """Return a photograph of at most `LONGEST_SIDE` pixels, and the rows and columns that it has in full."""
    picture = read_for_display(path)
    rows, columns = picture.shape[:2]
    reduced = LONGEST_SIDE / max(rows, columns)
    if reduced < 1:
        size = max(1, round(columns * reduced)), max(1, round(rows * reduced))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return picture, rows, columns


def _draw_marks(
    axis: "Axes",
    image: ShownImage,
    found: Correspondences,
    offset: Floats,
    size: float,
    scale: float = 1.0,
    only: NDArray[np.int64] | None = None,
) -> None:
    """Mark the correspondences that are seen in an image, by kind; `only`: those of these numbers."""
    shown = np.ones(len(image.matches), bool) if only is None else np.isin(image.matches, only)
    kinds, inlier = found.found_by[image.matches], image.inlier
    for agrees in (False, True):
        for kind in sorted(set(kinds.tolist())):
            chosen = shown & (kinds == kind) & (inlier == agrees)
            if chosen.any():
                x, y = (image.pixels[chosen] * scale + offset).T
                color, marker = _style(kind, agrees)
                axis.scatter(x, y, s=size, c=color, marker=marker, lw=0, alpha=0.9 if agrees else 0.6)


def _style(kind: str, agrees: bool) -> tuple[str, str]:
    """Return color and marker of a kind of correspondences."""
    features, _, way = kind.rpartition("/")
    return WAYS.get(way, SKY) if agrees else REJECTED, MARKERS.get(features, "D")


def _color(found: Correspondences, match: int) -> str:
    return _style(str(found.found_by[match]), bool(found.inlier[match]))[0]


def _marks_of(found: Correspondences) -> list[Any]:
    """Return entries of a legend: the kinds of correspondences, and how many there are of each."""
    from matplotlib.lines import Line2D

    marks = []
    for agrees, text in ((True, "inliers"), (False, "rejected")):
        for kind in sorted(set(found.found_by[found.inlier == agrees].tolist())):
            count = int(((found.found_by == kind) & (found.inlier == agrees)).sum())
            color, marker = _style(kind, agrees)
            label = f"{kind.replace('/', ', ')}: {count} {text}"
            marks.append(Line2D([], [], color=color, marker=marker, ls="", ms=5, label=label))
    return marks


Named = Sequence[tuple[Answer, str, str]]
"""Answers with what they are called and their colors."""


def _axes_of(one: Answer) -> tuple[Floats, list[str], Floats]:
    """Return axes and labels of the map from above, and the posed cameras of the map (N, 4, 4)."""
    poses = one.pair.map_session.world_from_cam()
    poses = poses[is_posed(poses)]
    up = one.settings.world_up if one.settings.world_up is not None else up_of_cameras(poses)
    return *ground_axes(up, one.pair.unit[0]), poses


def _draw_from_above(axis: "Axes", named: Named) -> None:
    """Draw the place of the map that the query is in: its points, cameras and references, poses, rivals, the truth."""
    one = named[0][0]
    axes, labels, poses = _axes_of(one)
    unit = one.pair.unit[1]

    def flat(positions: Floats) -> Floats:
        return np.asarray(positions / unit @ axes.T)

    cameras, references = flat(poses[:, :3, 3]), one.details.references
    seen = np.array([image.world_from_cam for image in references]).reshape(-1, 4, 4)
    seen = seen[is_posed(seen)]
    shown = _cameras_of(named)
    anchor = shown[0][0] if shown else seen[0] if len(seen) else None
    place, here = places_of(cameras), np.ones(len(cameras), bool)
    if anchor is not None and len(cameras):
        nearest = int(np.argmin(np.linalg.norm(cameras - flat(anchor[:3, 3]), axis=1)))
        here = place == place[nearest]
    low, high = _bounds([cameras[here], flat(seen[:, :3, 3])])
    span = max(float((high - low).max()), 1.0)
    points, _ = sure_points(one.pair.local_map)
    cloud = flat(points[:: len(points) // MAX_POINTS + 1])
    if len(cloud):
        # What a map sees lies around its cameras; points far out are few and unsure.
        near = ((cloud > low - span) & (cloud < high + span)).all(1)
        if near.any():
            low = np.minimum(low, np.percentile(cloud[near], 2, axis=0))
            high = np.maximum(high, np.percentile(cloud[near], 98, axis=0))
    rivals = [(rival.world_from_rig @ _rig_from_first(one), rival.support) for rival in named[-1][0].rivals or ()]
    every = [*(pose for pose, _, _ in shown), *(pose for pose, _ in rivals)]
    answers = flat(np.array(every).reshape(-1, 4, 4)[:, :3, 3])
    reached = answers[((answers > low - span) & (answers < high + span)).all(1)]
    low, high = _bounds([low[None], high[None], reached])
    middle, half = (low + high) / 2, 0.55 * max(float((high - low).max()), 1.0)
    outside = []
    draw_dots(axis, cloud, s=1, c="0.75", lw=0, rasterized=True)
    axis.scatter([], [], s=9, c="0.75", lw=0, label="map points")  # large enough for a legend
    draw_dots(axis, cameras[here], s=7, c=MAP, lw=0, label="map cameras")
    length = 0.16 * half
    if len(seen):
        draw_headings(axis, flat(seen[:, :3, 3]), seen, axes, length, colors=ORANGE, linewidths=1.2)
        draw_dots(axis, flat(seen[:, :3, 3]), s=16, c=ORANGE, lw=0, label="references")
    for pose, support in rivals:
        at = flat(pose[:3, 3])
        if (np.abs(at - middle) > half).any():
            outside.append(f"rival ({support:.0%})")
            continue
        draw_headings(axis, at[None], pose[None], axes, length, colors=BLUE, linewidths=1.2)
        name = f"rival, {support:.0%} of the support"
        draw_dots(axis, at, s=40, marker="D", facecolors="white", edgecolors=BLUE, label=name)
    for pose, name, color in shown:
        at = flat(pose[:3, 3])
        if (np.abs(at - middle) > half).any():
            outside.append(name)
            continue
        draw_headings(axis, at[None], pose[None], axes, 1.5 * length, colors=color, linewidths=1.2)
        _draw_place(axis, at, name, color, 34)
    axis.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    axis.set(xlabel=labels[0], ylabel=labels[1])
    far = f"\noutside the picture: {', '.join(outside)}" if outside else ""
    axis.set_title(f"from above{far}", fontsize=9)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=7.5)


def _draw_near(axis: "Axes", named: Named) -> None:
    """Draw where the answers are, enlarged so that the uncertainty is seen, and the truth where it is known."""
    from matplotlib.patches import Ellipse

    posed = [(one, name, color) for one, name, color in named if one.pose is not None]
    if not posed:
        axis.set_axis_off()
        axis.text(0.5, 0.5, "no pose", ha="center", va="center", color=GRAY)
        return
    first = posed[0][0]
    axes, labels, _ = _axes_of(first)
    unit_name, unit = first.pair.unit
    origin = _first_camera(first)[:3, 3]
    reach, ellipses = [], []
    for pose, _, _ in _cameras_of(named):
        reach.append(float(np.abs((pose[:3, 3] - origin) / unit @ axes.T).max()))
    for one, name, color in posed:
        if one.covariance is None:
            continue
        spread = axes @ _position_covariance(one) @ axes.T / unit**2
        values, vectors = np.linalg.eigh(spread)
        sizes = 2 * SURE * np.sqrt(np.maximum(values, 0))
        reach.append(float(sizes.max()) * 0.55)
        ellipses.append((one, name, color, sizes, float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))))
    half = 1.35 * max([value for value in reach if np.isfinite(value)], default=0.0) or 0.01
    small, factor = ("cm", 100.0) if unit_name == "m" and half < 1 else (unit_name, 1.0)
    for one, name, color, sizes, angle in ellipses:
        at = (_first_camera(one)[:3, 3] - origin) / unit @ axes.T * factor
        axis.add_patch(Ellipse((float(at[0]), float(at[1])), factor * sizes[1], factor * sizes[0], angle=angle,
                               facecolor=color, alpha=0.2, label=f"95 % region, {name}"))  # fmt: skip
    for pose, name, color in _cameras_of(named):
        _draw_place(axis, (pose[:3, 3] - origin) / unit @ axes.T * factor, name, color, 30)
    half *= factor
    axis.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
    right, up = (f"{label.partition(' [')[0]}, from the pose [{small}]" for label in labels)
    axis.set(xlabel=right, ylabel=up)
    missing = "" if ellipses else ": the method states no uncertainty"
    axis.set_title(f"the pose, enlarged{missing}", fontsize=9)
    axis.grid(alpha=0.25)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=7.5)


def _digits(value: float) -> str:
    """Return a number with two digits that count: an error of a fraction of a millimeter is not 0.000 m."""
    return np.format_float_positional(value, 2, fractional=False, trim="-") if value < 0.1 else number(value)


def _draw_table(axis: "Axes", ones: Sequence[Answer]) -> None:
    """Write the numbers of answers, a column each; where two differ, they are bold."""
    rows: list[tuple[str, list[str]]] = [("method", [one.method for one in ones])]
    by_network = all(one.method.rpartition("/")[2].startswith("feed_forward") for one in ones)
    labels = LABELS | OF_NETWORKS if by_network else LABELS
    without = all(one.pose is not None and not one.numbers.get("num_matches") for one in ones)
    for key, (text, form) in labels.items():
        if (by_network and key in OF_MATCHES) or (without and key in (*OF_MATCHES, *OF_NETWORKS)):
            continue
        values = [form.format(one.numbers[key]) if key in one.numbers else "–" for one in ones]
        if set(values) != {"–"} and not (key == "agreement" and set(values) == {"0"}):
            rows.append((text, values))
    kept = [one.rivals for one in ones]
    if any(rivals is None for rivals in kept):
        rows.append(("other poses", ["not kept" if rivals is None else str(len(rivals)) for rivals in kept]))
    if any(one.error is not None for one in ones):
        errors = [one.error or (np.nan, np.nan) for one in ones]
        unit = ones[0].pair.unit
        rows.append((f"true error of position [{unit[0]}]", [_digits(distance / unit[1]) for _, distance in errors]))
        rows.append(("true error of rotation [deg]", [_digits(angle) for angle, _ in errors]))
    rows.append(("seconds", [f"{one.seconds:.2f}" for one in ones]))
    axis.set_axis_off()
    columns = [1.0] if len(ones) == 1 else [0.74, 1.0]
    head = [("", ["as it was", "again"])] if len(ones) > 1 else []
    step = min(0.072, 1.0 / (len(rows) + len(head)))
    for line, (text, values) in enumerate([*head, *rows]):
        y = 1.0 - line * step
        axis.text(0.0, y, text, fontsize=8, va="top", color="0.25", transform=axis.transAxes)
        weight = "bold" if len(set(values)) > 1 else "normal"
        for x, value in zip(columns, values, strict=True):
            axis.text(x, y, value, fontsize=8, va="top", ha="right", weight=weight, transform=axis.transAxes)


def _rig_from_first(one: Answer) -> Floats:
    """Return rig_from_cam (4, 4) of the image that is drawn."""
    session, rows = one.pair.query_session, one.pair.rows[one.number]
    names = [session.image_name(int(row)) for row in rows]
    return np.asarray(session.rig_from_cam(rows)[names.index(one.details.cameras[0].name)])


def _first_camera(one: Answer) -> Floats:
    """Return world_from_cam (4, 4) of the image that is drawn; the query has a pose."""
    assert one.pose is not None
    return np.asarray(one.pose @ _rig_from_first(one))


def _cameras_of(named: Named) -> list[tuple[Floats, str, str]]:
    """Return world_from_cam, name and color of answers that have a pose, and of the truth if it is known."""
    # Of a rig, the image that the first answer shows stands for all.
    rig_from_cam = _rig_from_first(named[0][0])
    shown = [(one.pose @ rig_from_cam, name, color) for one, name, color in named if one.pose is not None]
    true = named[0][0].true_pose
    return [*shown, *([] if true is None else [(true @ rig_from_cam, "true", TRUE)])]


def _position_covariance(one: Answer) -> Floats:
    """Return the covariance (3, 3) of where the drawn camera is, in the world, square meters.

    A small motion of the rig in its own frame, rotation w and translation t, moves a camera at c by t + w x c.
    """
    assert one.pose is not None
    assert one.covariance is not None
    x, y, z = _rig_from_first(one)[:3, 3]
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    moves = one.pose[:3, :3] @ np.hstack([lever, np.eye(3)])
    return np.asarray(moves @ one.covariance @ moves.T)


def _draw_place(axis: "Axes", at: Floats, name: str, color: str, size: float) -> None:
    """Draw where a camera stands; the truth is a ring, in which an answer is seen."""
    style: dict[str, Any] = {"s": 70, "facecolors": "none"} if color == TRUE else {"s": size, "facecolors": color}
    draw_dots(axis, at, edgecolors=color, lw=1.3, zorder=5, label=name, **style)


def _bounds(parts: Sequence[Floats]) -> tuple[Floats, Floats]:
    held = np.concatenate([*parts, np.zeros((0, 2))])
    held = held if len(held) else np.zeros((1, 2))
    return held.min(0), held.max(0)


def _camera_name(image: ShownImage) -> str:
    return Path(image.name).parent.name
