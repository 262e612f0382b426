"""Draw one localized query: beside its references with the matches by kind, in the map from above, and in numbers."""

import json
import textwrap
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
"""Colors of correspondences that agree with the pose, by how they were found."""
MARKERS = {"sift": "o", "aliked": "^", "superpoint": "s"}
"""Markers, by kind of features."""
REJECTED = ESTIMATED
LONGEST_SIDE = 900
"""Longer side of a drawn image, pixels, at most: no figure shows more detail."""
LINES = 60
"""Lines drawn at most for correspondences that agree, and for rejected ones: more would hide the images."""
SURE = 2.4477
"""Radius of the 95 % region of a 2D normal distribution, standard deviations."""
MAX_POINTS = 20_000
LABELS = {
    "num_matches": ("descriptor matches", "{:.0f}"), "num_inliers": ("inliers among them", "{:.0f}"),
    "inlier_ratio": ("inlier ratio", "{:.0%}"), "num_guided": ("guided matches", "{:.0f}"),
    "rmse_px": ("reprojection error [px]", "{:.2f}"), "coverage": ("image covered", "{:.0%}"),
    "p_correct": ("probability of being right", "{:.1%}"), "rival_support": ("support of the best rival", "{:.0%}"),
    "agreement": ("matches of a second kind", "{:.0f}"), "position_std_m": ("std. dev. of position [{unit}]", "{:.2g}"),
    "rotation_std_deg": ("std. dev. of rotation [deg]", "{:.2g}"), "scale_std": ("std. dev. of scale", "{:.1%}"),
}  # fmt: skip
"""Label and format of each number; `{unit}` stands for the pair's unit of length."""
OF_NETWORKS = {
    "num_matches": ("references given to it", "{:.0f}"), "num_inliers": ("consistent ones", "{:.0f}"),
    "inlier_ratio": ("their share", "{:.0%}"),
}  # fmt: skip
"""Labels and formats that differ for poses of a feed-forward network."""
OF_MATCHES = ("num_guided", "rmse_px", "coverage", "p_correct", "rival_support", "agreement")
"""Numbers that a pose without matches does not have."""


_read = lru_cache(maxsize=16)(read_for_display)  # localizing a query again draws the same images again


@styled
def draw_inspection(answer: Answer) -> "Figure":
    """Draw a query beside its best reference, its further references, the map from above, and the query's numbers.

    Lines join the points that the query and its best reference both see. Inliers are colored by how they were found
    (`WAYS`), rejected matches are red; markers tell the kind of features (`MARKERS`).
    """
    figure = new_figure(11, 9.4)
    above, strip, below = figure.subfigures(3, 1, squeeze=False, height_ratios=[4.0, 2.0, 3.6])[:, 0]
    details, correspondences = answer.details, answer.correspondences
    axis = above.subplots()
    references = details.captioned_references()
    _draw_joined(axis, answer)
    axis.set_title(_caption(answer), fontsize=9)
    legend = _marks_of(correspondences)
    if legend:
        above.legend(handles=legend, loc="outside lower center", ncols=6, fontsize=8)
    further = [
        (image, f"query, {_camera_name(image)}" + f": {image.num_inliers} points agree" * details.has_matches, True)
        for image in details.cameras[1:]
    ]
    images = [*references[1:], *further]
    panels = np.ravel(strip.subplots(1, max(4, min(6, len(images))), squeeze=False))
    for panel in panels:
        panel.set_axis_off()
    for panel, (image, text, agrees) in zip(panels, images, strict=False):
        _draw_photograph(panel, image)
        _draw_marks(panel, image, correspondences, np.zeros(2), size=4)
        panel.set_title(textwrap.fill(text, 30), fontsize=8, color="black" if agrees else REJECTED)
    from_above, near, table = below.subplots(1, 3, width_ratios=[1.15, 1.0, 1.0])
    _draw_from_above(from_above, [(answer, "estimated", ESTIMATED)])
    _draw_near(near, [(answer, "estimated", ESTIMATED)])
    _draw_table(table, [answer])
    name = shown_name(answer.name, 110)
    figure.suptitle(f"{answer.headline}\n{name}\n{textwrap.fill(answer.reason, 130)}", fontsize=10)
    return figure


@styled
def draw_comparison(before: Answer, after: Answer, changes: Mapping[str, Any]) -> "Figure":
    """Draw a query localized twice: both answers side by side, together in the map from above, and in one table.

    Args:
        changes: settings that were changed for the second answer.
    """
    answers = [before, after]
    figure = new_figure(11, 7.2)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.3, 3.6])[:, 0]
    for axis, answer, name in zip(above.subplots(1, 2), answers, ("as it was", "again"), strict=True):
        _draw_joined(axis, answer)
        axis.set_title(f"{name}: {answer.status}\n{textwrap.fill(answer.reason, 78)}", fontsize=8.5)
        if legend := _marks_of(answer.correspondences):
            axis.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, fontsize=7.5)
    from_above, near, table = below.subplots(1, 3, width_ratios=[1.0, 0.9, 1.25])
    labeled = [(before, "as it was", ESTIMATED), (after, "again", PURPLE)]
    _draw_from_above(from_above, labeled)
    _draw_near(near, labeled)
    _draw_table(table, answers)
    changed = json.dumps(changes)[1:-1] if changes else "no setting changed"
    first = before.headline.rpartition(":")[0]
    figure.suptitle(f"{first}, localized again\n{textwrap.fill(changed, 120)}", fontsize=10)
    return figure


def _caption(answer: Answer) -> str:
    """Return the title of the panel with the query and its best reference."""
    references = answer.details.captioned_references()
    camera = answer.details.cameras[0]
    of_rig = f" ({_camera_name(camera)})" if len(answer.details.cameras) > 1 else ""
    if len(camera.matches):
        text = f"query{of_rig}: {camera.num_inliers} of {len(camera.matches)} map points agree"
    else:
        text = f"query{of_rig}: no matches were stored"
    if not references:
        return f"{text} · no reference"
    both = np.isin(camera.matches, references[0][0].matches)
    joined = f", {int(camera.inlier[both].sum())} of this image" if both.any() else ""
    return f"{text} · {references[0][1]}{joined}"


def _draw_joined(axis: "Axes", answer: Answer) -> None:
    """Draw the query image with the most points and its best reference at one height, and join common points."""
    details, correspondences = answer.details, answer.correspondences
    image, references = details.cameras[0], details.captioned_references()[:1]
    width, height = _draw_photograph(axis, image)
    _draw_marks(axis, image, correspondences, np.zeros(2), size=9)
    end = width
    for reference, _, _ in references:
        offset = width * 1.02
        right, scale = _draw_photograph(axis, reference, offset, height)
        end = right
        _draw_marks(axis, reference, correspondences, np.array([offset, 0.0]), size=9, scale=scale, only=image.matches)
        _, i, j = np.intersect1d(image.matches, reference.matches, return_indices=True)
        ends = reference.pixels[j] * scale + [offset, 0.0]
        lines = np.stack([image.pixels[i], ends], axis=1)
        for agrees in (False, True):
            chosen = np.flatnonzero(image.inlier[i] == agrees)
            chosen = chosen[:: len(chosen) // LINES + 1]
            colors = [_color(correspondences, int(image.matches[i[k]])) for k in chosen]
            axis.add_collection(LineCollection(list(lines[chosen]), colors=colors, linewidths=0.6, alpha=0.7))
    axis.set(xlim=(0, end), ylim=(height, 0), aspect="equal")
    axis.set_axis_off()


def _draw_photograph(
    axis: "Axes", image: ShownImage, offset: float = 0.0, height: float | None = None
) -> tuple[float, float]:
    """Draw an image in its own pixels; with a `height`, scaled to it and to the right of `offset`.

    Returns:
        Width and height of the image; with a `height`, its right edge and the scale of its pixels.
    """
    picture, rows, columns = _read(image.path, LONGEST_SIDE), image.camera.height, image.camera.width
    if height is None:
        axis.imshow(picture, extent=(0, columns, rows, 0), interpolation="antialiased")
        return float(columns), float(rows)
    scale = height / rows
    right = offset + scale * columns
    axis.imshow(picture, extent=(offset, right, height, 0), interpolation="antialiased")
    return right, scale


def _draw_marks(
    axis: "Axes",
    image: ShownImage,
    correspondences: Correspondences,
    offset: Floats,
    size: float,
    scale: float = 1.0,
    only: NDArray[np.int64] | None = None,
) -> None:
    """Mark the correspondences seen in an image, by kind; with `only`, just those numbers."""
    shown = np.ones(len(image.matches), bool) if only is None else np.isin(image.matches, only)
    kinds, inlier = correspondences.found_by[image.matches], image.inlier
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


def _color(correspondences: Correspondences, match: int) -> str:
    return _style(str(correspondences.found_by[match]), bool(correspondences.inlier[match]))[0]


def _marks_of(correspondences: Correspondences) -> list[Any]:
    """Return legend entries: the kinds of correspondences with their counts."""
    from matplotlib.lines import Line2D

    marks = []
    for agrees, text in ((True, "agree"), (False, "rejected")):
        for kind in sorted(set(correspondences.found_by[correspondences.inlier == agrees].tolist())):
            count = int(((correspondences.found_by == kind) & (correspondences.inlier == agrees)).sum())
            color, marker = _style(kind, agrees)
            label = f"{kind.replace('/', ', ')}: {count} {text}"
            marks.append(Line2D([], [], color=color, marker=marker, ls="", ms=5, label=label))
    return marks


Labeled = Sequence[tuple[Answer, str, str]]
"""Answers, each with a label and a color."""


def _axes_of(answer: Answer) -> tuple[Floats, list[str], Floats]:
    """Return axes and labels of the map from above, and the posed cameras of the map (N, 4, 4)."""
    poses = answer.pair.map_session.world_from_cam()
    poses = poses[is_posed(poses)]
    up = answer.settings.world_up if answer.settings.world_up is not None else up_of_cameras(poses)
    return *ground_axes(up, answer.pair.unit[0]), poses


def _draw_from_above(axis: "Axes", labeled: Labeled) -> None:
    """Draw the place of the map around the query from above: map points, cameras, references, poses, rivals, truth."""
    answer = labeled[0][0]
    axes, labels, poses = _axes_of(answer)
    unit = answer.pair.unit[1]

    def flat(positions: Floats) -> Floats:
        return np.asarray(positions / unit @ axes.T)

    cameras, references = flat(poses[:, :3, 3]), answer.details.references
    seen = np.array([image.world_from_cam for image in references]).reshape(-1, 4, 4)
    seen = seen[is_posed(seen)]
    shown = _cameras_of(labeled)
    anchor = shown[0][0] if shown else seen[0] if len(seen) else None
    if anchor is not None and len(cameras):
        place = places_of(cameras)
        nearest = int(np.argmin(np.linalg.norm(cameras - flat(anchor[:3, 3]), axis=1)))
        cameras = cameras[place == place[nearest]]
    low, high = _bounds([cameras, flat(seen[:, :3, 3])])
    span = max(float((high - low).max()), 1.0)
    points, _ = sure_points(answer.pair.local_map)
    cloud = flat(points[:: len(points) // MAX_POINTS + 1])
    if len(cloud):
        # The scene lies around the map cameras; the few points far away are unreliable.
        near = ((cloud > low - span) & (cloud < high + span)).all(1)
        if near.any():
            low = np.minimum(low, np.percentile(cloud[near], 2, axis=0))
            high = np.maximum(high, np.percentile(cloud[near], 98, axis=0))
    rivals = [(rival.world_from_rig @ _rig_from_first(answer), rival.support) for rival in labeled[-1][0].rivals or ()]
    poses = np.array([*(pose for pose, _, _ in shown), *(pose for pose, _ in rivals)]).reshape(-1, 4, 4)
    centers = flat(poses[:, :3, 3])
    near_centers = centers[((centers > low - span) & (centers < high + span)).all(1)]
    low, high = _bounds([low[None], high[None], near_centers])
    middle, half = (low + high) / 2, 0.55 * max(float((high - low).max()), 1.0)
    outside = []
    draw_dots(axis, cloud, s=1, c="0.75", lw=0, rasterized=True)
    axis.scatter([], [], s=9, c="0.75", lw=0, label="map points")  # a larger dot for the legend
    draw_dots(axis, cameras, s=7, c=MAP, lw=0, label="map cameras")
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


def _draw_near(axis: "Axes", labeled: Labeled) -> None:
    """Draw the positions of the answers and the truth, enlarged to show the uncertainty."""
    from matplotlib.patches import Ellipse

    posed = [(answer, name, color) for answer, name, color in labeled if answer.pose is not None]
    if not posed:
        axis.set_axis_off()
        axis.text(0.5, 0.5, "no pose", ha="center", va="center", color=GRAY)
        return
    axes, labels, _ = _axes_of(posed[0][0])
    unit_name, unit = posed[0][0].pair.unit
    shown, rig_from_cam = _cameras_of(labeled), _rig_from_first(labeled[0][0])
    origin = shown[0][0][:3, 3]
    reach, ellipses = [], []
    for pose, _, _ in shown:
        reach.append(float(np.abs((pose[:3, 3] - origin) / unit @ axes.T).max()))
    for (pose, _, _), (answer, name, color) in zip(shown, posed, strict=False):  # the truth is shown last
        if answer.covariance is None:
            continue
        spread = axes @ _position_covariance(answer, rig_from_cam) @ axes.T / unit**2
        values, vectors = np.linalg.eigh(spread)
        sizes = 2 * SURE * np.sqrt(np.maximum(values, 0))
        reach.append(float(sizes.max()) * 0.55)
        ellipses.append((pose, name, color, sizes, float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))))
    half = 1.35 * max([value for value in reach if np.isfinite(value)], default=0.0) or 0.01
    small, factor = ("cm", 100.0) if unit_name == "m" and half < 1 else (unit_name, 1.0)
    for pose, name, color, sizes, angle in ellipses:
        at = (pose[:3, 3] - origin) / unit @ axes.T * factor
        axis.add_patch(Ellipse((float(at[0]), float(at[1])), factor * sizes[1], factor * sizes[0], angle=angle,
                               facecolor=color, alpha=0.2, label=f"95 % region, {name}"))  # fmt: skip
    for pose, name, color in shown:
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
    """Return a number with two significant digits if it is small: an error below a millimeter is not 0.000 m."""
    return np.format_float_positional(value, 2, fractional=False, trim="-") if value < 0.1 else number(value)


def _draw_table(axis: "Axes", answers: Sequence[Answer]) -> None:
    """Write the numbers of the answers, one column each; numbers that differ are bold."""
    rows: list[tuple[str, list[str]]] = [("method", [answer.method for answer in answers])]
    by_network = all(answer.method.rpartition("/")[2].startswith("feed_forward") for answer in answers)
    labels, unit = LABELS | OF_NETWORKS if by_network else LABELS, answers[0].pair.unit[0]
    no_matches = all(answer.pose is not None and not answer.numbers.get("num_matches") for answer in answers)
    for key, (text, form) in labels.items():
        if (by_network and key in OF_MATCHES) or (no_matches and key in (*OF_MATCHES, *OF_NETWORKS)):
            continue
        values = [form.format(answer.numbers[key]) if key in answer.numbers else "–" for answer in answers]
        if set(values) != {"–"} and not (key == "agreement" and set(values) == {"0"}):
            rows.append((text.format(unit=unit), values))
    rivals = [answer.rivals for answer in answers]
    if any(poses is None for poses in rivals):
        rows.append(("other poses", ["not kept" if poses is None else str(len(poses)) for poses in rivals]))
    if any(answer.error is not None for answer in answers):
        errors = [answer.error or (np.nan, np.nan) for answer in answers]
        rows.append((f"true position error [{unit}]", [_digits(distance) for _, distance in errors]))
        rows.append(("true rotation error [deg]", [_digits(angle) for angle, _ in errors]))
    rows.append(("seconds", [f"{answer.seconds:.2f}" for answer in answers]))
    axis.set_axis_off()
    columns = [1.0] if len(answers) == 1 else [0.74, 1.0]
    head = [("", ["as it was", "again"])] if len(answers) > 1 else []
    step = min(0.072, 1.0 / (len(rows) + len(head)))
    for line, (text, values) in enumerate([*head, *rows]):
        y = 1.0 - line * step
        axis.text(0.0, y, text, fontsize=8, va="top", color="0.25", transform=axis.transAxes)
        weight = "bold" if len(set(values)) > 1 else "normal"
        for x, value in zip(columns, values, strict=True):
            axis.text(x, y, value, fontsize=8, va="top", ha="right", weight=weight, transform=axis.transAxes)


def _rig_from_first(answer: Answer) -> Floats:
    """Return rig_from_cam (4, 4) of the drawn image."""
    session, rows = answer.pair.query_session, answer.pair.rows[answer.number]
    names = [session.image_name(int(row)) for row in rows]
    return np.asarray(session.rig_from_cam(rows)[names.index(answer.details.cameras[0].name)])


def _cameras_of(labeled: Labeled) -> list[tuple[Floats, str, str]]:
    """Return world_from_cam, label and color of the answers with a pose, and of the ground truth if known."""
    # A rig is shown by the camera that the first answer draws.
    rig_from_cam = _rig_from_first(labeled[0][0])
    shown = [(answer.pose @ rig_from_cam, name, color) for answer, name, color in labeled if answer.pose is not None]
    true = labeled[0][0].true_pose
    return [*shown, *([] if true is None else [(true @ rig_from_cam, "true", TRUE)])]


def _position_covariance(answer: Answer, rig_from_cam: Floats) -> Floats:
    """Return the covariance (3, 3) of a camera's position in the world, square meters.

    A small motion of the rig in its own frame, rotation w and translation t, moves a camera at c by t + w x c.
    """
    assert answer.pose is not None
    assert answer.covariance is not None
    x, y, z = rig_from_cam[:3, 3]
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    moves = answer.pose[:3, :3] @ np.hstack([lever, np.eye(3)])
    return np.asarray(moves @ answer.covariance @ moves.T)


def _draw_place(axis: "Axes", at: Floats, name: str, color: str, size: float) -> None:
    """Draw the position of a camera; the ground truth is a ring, so that a dot inside stays visible."""
    style: dict[str, Any] = {"s": 70, "facecolors": "none"} if color == TRUE else {"s": size, "facecolors": color}
    draw_dots(axis, at, edgecolors=color, lw=1.3, zorder=5, label=name, **style)


def _bounds(parts: Sequence[Floats]) -> tuple[Floats, Floats]:
    held = np.concatenate([*parts, np.zeros((0, 2))])
    held = held if len(held) else np.zeros((1, 2))
    return held.min(0), held.max(0)


def _camera_name(image: ShownImage) -> str:
    return Path(image.name).parent.name
