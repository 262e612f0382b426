"""Draw one localized query: beside its references with the matches by kind, in the map from above, and in numbers."""

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.lines import Line2D

from toolkit.figures.answers import Answer, folder_of
from toolkit.figures.query_images import PURPLE, draw_image, draw_joined, draw_matches, style_of
from toolkit.figures.style import BLUE, ESTIMATED, GRAY, MAP, ORANGE, TRUE, new_figure, styled
from toolkit.figures.top_view import Ground, Layer, Places, draw_layers, window_of
from toolkit.geometry import Floats, shifted
from toolkit.pose.result import Correspondences
from toolkit.results.images import sure_points
from toolkit.results.metrics import is_posed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SURE = 2.4477
"""Radius of the 95 % region of a 2D normal distribution, standard deviations."""
MAX_POINTS = 20_000
NAMES, COLORS = ("as it was", "again"), (ESTIMATED, PURPLE)
"""Of the answers in a figure; a single answer is called `estimated`."""


@styled
def draw_answers(answers: Sequence[Answer], title: str) -> "Figure":
    """Draw a query, localized once or twice: beside its best reference, in the map from above, and in numbers.

    Lines join the points that the query and its best reference both see. Inliers are colored by how they were found
    (`query_images.WAYS`), rejected matches are red; markers tell the kind of features. A single answer also has its
    further references.
    """
    several = len(answers) > 1
    heights = [3.3, 3.6] if several else [4.0, 2.0, 3.6]
    figure = new_figure(11, sum(heights) - 0.1)
    above, *strip, below = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axis, answer, name in zip(above.subplots(1, len(answers), squeeze=False)[0], answers, NAMES, strict=False):
        draw_joined(axis, answer.details, 3.3, by_kind=True)
        axis.set_axis_off()
        of_answer = f"{name}: {answer.result.status_text}\n{textwrap.fill(answer.reason, 78)}"
        axis.set_title(of_answer if several else answer.caption, fontsize=8.5)
        if marks := _marks_of(answer.result.correspondences):
            axis.legend(handles=marks, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3 if several else 6,
                        fontsize=7.5)  # fmt: skip
    for part in strip:
        _draw_further(part, answers[0])
    from_above, near, table = below.subplots(1, 3, width_ratios=[1.0, 0.9, 1.0 + 0.25 * several])
    _draw_from_above(from_above, answers)
    _draw_near(near, answers)
    _draw_table(table, answers)
    figure.suptitle(title, fontsize=10)
    return figure


def _draw_further(figure: Any, answer: Answer) -> None:
    """Draw the references but the best, and the further cameras of a rig."""
    details = answer.details
    images = details.captioned_references()[1:]
    for image in details.cameras[1:]:
        count = f": {image.num_inliers} points agree" if details.has_matches else ""
        images.append((image, f"query, {folder_of(image.name)}{count}", True))
    panels = figure.subplots(1, max(4, min(6, len(images))), squeeze=False)[0]
    for panel in panels:
        panel.set_axis_off()
    for panel, (image, text, agrees) in zip(panels, images, strict=False):
        draw_image(panel, image, 2.4, textwrap.fill(text, 30), "black" if agrees else ESTIMATED)
        draw_matches(panel, image, 4, by_kind=True)


def _marks_of(correspondences: Correspondences) -> list[Line2D]:
    """Return legend entries: the kinds of correspondences with their counts."""
    marks = []
    for agrees, text in ((True, "agree"), (False, "rejected")):
        kinds, counts = np.unique(correspondences.found_by[correspondences.inlier == agrees], return_counts=True)
        for kind, count in zip(kinds.tolist(), counts, strict=True):
            label = f"{kind.replace('/', ', ')}: {count} {text}"
            marks.append(Line2D([], [], ls="", ms=5, label=label, **style_of(kind, agrees)))
    return marks


def _ground_and_cameras(answer: Answer) -> tuple[Ground, Floats]:
    """Return the ground of the map, and the poses of its cameras (N, 4, 4)."""
    poses = answer.pair.map_session.world_from_cam()
    poses = poses[is_posed(poses)]
    return Ground.below(poses, answer.settings.world_up, answer.pair.results.unit), poses


def _cameras_of(answers: Sequence[Answer]) -> list[tuple[Floats, str, str]]:
    """Return world_from_cam, label and color of the answers with a pose, and of the ground truth if known."""
    # A rig is shown by the camera that the first answer draws.
    rig_from_cam, true = answers[0].rig_from_cam, answers[0].true_pose
    names = NAMES if len(answers) > 1 else ("estimated",)
    estimated = (answer.result.world_from_rig for answer in answers)
    poses = [*zip(estimated, names, COLORS, strict=False), (true, "true", TRUE)]
    return [(pose @ rig_from_cam, name, color) for pose, name, color in poses if pose is not None]


def _dot(pose: Floats, name: str, color: str, heading: float = 0.0) -> Layer:
    """Return the layer of one camera; the ground truth is a ring, so that a dot inside stays visible."""
    true = color == TRUE
    return Layer(pose[None], name, color, heading, hollow=true, s=70 if true else 32, lw=1.3, zorder=5)


def _draw_from_above(axis: "Axes", answers: Sequence[Answer]) -> None:
    """Draw the place of the map around the query from above: map points, cameras, references, poses, rivals, truth."""
    answer = answers[0]
    ground, cameras = _ground_and_cameras(answer)
    points = sure_points(answer.pair.local_map)[0]
    points = points[:: len(points) // MAX_POINTS + 1]
    references = np.array([image.world_from_cam for image in answer.details.references]).reshape(-1, 4, 4)
    references = references[is_posed(references)]
    shown = _cameras_of(answers)
    rivals = [(rival.world_from_rig @ answer.rig_from_cam, rival.support) for rival in answers[-1].result.rivals]
    layers = [
        Layer(points, None, "0.75", s=1, lw=0, rasterized=True),
        Layer(cameras, "map cameras", MAP, s=7, lw=0),
        Layer(references, "references", ORANGE, 0.08, s=16, lw=0),
    ]
    named = [
        (pose, f"rival ({support:.0%})",
         Layer(pose[None], f"rival, {support:.0%} of the support", BLUE, 0.08, hollow=True, s=40, marker="D"))
        for pose, support in rivals
    ] + [(pose, name, _dot(pose, name, color, 0.12)) for pose, name, color in shown]  # fmt: skip
    centers = ground.flat(np.array([pose for pose, _, _ in named]).reshape(-1, 4, 4))
    places = Places(ground.flat(cameras))
    anchor = np.concatenate([ground.flat(pose[None]) for pose, _, _ in shown[:1]] + [ground.flat(references)])[:1]
    place = int(places.nearest(anchor)[0]) if len(anchor) else None
    contents = places.contents(place, ground.flat(points), anchor[:0]) if place is not None else places.cameras
    contents = np.concatenate([contents, ground.flat(references)])
    # What lies farther away than the map is large is named, not drawn.
    low, high = window_of(contents, margin=1.0)
    near = centers[((centers > low) & (centers < high)).all(axis=1)]
    window = window_of(np.concatenate([contents, near]))
    axis.scatter([], [], s=9, c="0.75", lw=0, label="map points")  # a larger dot for the legend
    draw_layers(axis, ground, [*layers, *(layer for _, _, layer in named)], window)
    outside = ((centers < window[0]) | (centers > window[1])).any(axis=1)
    names = [name for (_, name, _), far in zip(named, outside, strict=True) if far]
    far = f"\noutside the picture: {', '.join(names)}" if names else ""
    axis.set_title(f"from above{far}", fontsize=9)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=7.5)


def _draw_near(axis: "Axes", answers: Sequence[Answer]) -> None:
    """Draw the positions of the answers and the truth, enlarged to show the uncertainty."""
    from matplotlib.patches import Ellipse

    posed = [answer for answer in answers if answer.result.world_from_rig is not None]
    if not posed:
        axis.set_axis_off()
        axis.text(0.5, 0.5, "no pose", ha="center", va="center", color=GRAY)
        return
    unit, length = posed[0].pair.results.unit
    ground, shown = _ground_and_cameras(posed[0])[0], _cameras_of(answers)
    origin = -shown[0][0][:3, 3]
    shown = [(shifted(pose, origin), name, color) for pose, name, color in shown]
    ellipses, reach = [], [float(np.abs(ground.flat(pose)).max()) for pose, _, _ in shown]
    for (pose, name, color), answer in zip(shown, posed, strict=False):  # the truth is shown last
        if answer.result.covariance is None:
            continue
        spread = ground.axes @ _position_covariance(answer, answers[0].rig_from_cam) @ ground.axes.T
        values, vectors = np.linalg.eigh(spread)
        sizes = 2 * SURE * np.sqrt(np.maximum(values, 0)) / length
        reach.append(float(sizes.max()) * 0.55)
        ellipses.append((pose, name, color, sizes, float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))))
    half = 1.35 * max([value for value in reach if np.isfinite(value)], default=0.0) or 0.01
    small, factor = ("cm", 100.0) if unit == "m" and half < 1 else (unit, 1.0)
    labels = [f"{label.partition(' [')[0]}, from the pose [{small}]" for label in ground.labels]
    ground = Ground(ground.axes, labels, length / factor)
    for pose, name, color, sizes, angle in ellipses:
        x, y = ground.flat(pose).tolist()
        axis.add_patch(Ellipse((x, y), factor * sizes[1], factor * sizes[0], angle=angle, facecolor=color, alpha=0.2,
                               label=f"95 % region, {name}"))  # fmt: skip
    half *= factor
    draw_layers(axis, ground, [_dot(*of) for of in shown], np.array([[-half, -half], [half, half]]))
    axis.set_title(f"the pose, enlarged{'' if ellipses else ': the method states no uncertainty'}", fontsize=9)
    axis.grid(alpha=0.25)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=7.5)


def _position_covariance(answer: Answer, rig_from_cam: Floats) -> Floats:
    """Return the covariance (3, 3) of a camera's position in the world, square meters.

    A small motion of the rig in its own frame, rotation w and translation t, moves a camera at c by t + w x c.
    """
    assert answer.result.world_from_rig is not None
    assert answer.result.covariance is not None
    x, y, z = rig_from_cam[:3, 3]
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    moves = answer.result.world_from_rig[:3, :3] @ np.hstack([lever, np.eye(3)])
    return np.asarray(moves @ answer.result.covariance @ moves.T)


def _draw_table(axis: "Axes", answers: Sequence[Answer]) -> None:
    """Write the numbers of the answers, one column each; numbers that differ are bold."""
    columns, texts = ([0.74, 1.0] if len(answers) > 1 else [1.0]), [answer.texts for answer in answers]
    rows = {"": list(NAMES)} if len(answers) > 1 else {}
    labels = dict.fromkeys(label for each in texts for label in each)
    rows |= {label: [each.get(label, "–") for each in texts] for label in labels}
    axis.set_axis_off()
    step = min(0.072, 1.0 / len(rows))
    for line, (label, values) in enumerate(rows.items()):
        style: dict[str, Any] = {"fontsize": 8, "va": "top", "transform": axis.transAxes}
        axis.text(0.0, 1.0 - line * step, label, color="0.25", **style)
        weight = "bold" if len(set(values)) > 1 else "normal"
        for x, value in zip(columns, values, strict=True):
            axis.text(x, 1.0 - line * step, value, ha="right", weight=weight, **style)
