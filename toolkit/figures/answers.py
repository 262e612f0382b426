"""One localized query: its status in words, numbers, correspondences, pose and rivals, and a figure of them."""

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from toolkit.capture import Session
from toolkit.capture.images import thumbnails
from toolkit.figures.query_images import PURPLE, draw_image, draw_joined, draw_matches, shown_name, style_of
from toolkit.figures.style import (
    BLUE,
    ESTIMATED,
    GRAY,
    GREEN,
    MAP,
    ORANGE,
    TRUE,
    VERMILLION,
    new_figure,
    number,
    picture_of,
    styled,
    zoomable,
)
from toolkit.figures.top_view import Ground, Layer, Places, draw_layers, window_of
from toolkit.geometry import Floats, shifted
from toolkit.manifest import LocalizeSettings
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import CAMERA, QueryResult, Status, View
from toolkit.pose.pnp import bounded_by_rivals
from toolkit.results.localized import QueryDetails, is_predicted, query_details, sure_points
from toolkit.results.metrics import is_posed, pose_errors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

LABELS = {
    "num_matches": ("descriptor matches", "{:.0f}"), "num_inliers": ("inliers among them", "{:.0f}"),
    "inlier_ratio": ("inlier ratio", "{:.0%}"), "num_guided": ("guided matches", "{:.0f}"),
    "rmse_px": ("reprojection error [px]", "{:.2f}"), "coverage": ("image covered", "{:.0%}"),
    "p_correct": ("probability of being right", "{:.1%}"), "rival_support": ("support of the best rival", "{:.0%}"),
    "agreement": ("matches of a second kind", "{:.0f}"), "position_std": ("std. dev. of position [{unit}]", "{:.2g}"),
    "rotation_std_deg": ("std. dev. of rotation [deg]", "{:.2g}"), "scale_std": ("std. dev. of scale", "{:.1%}"),
}  # fmt: skip
"""Numbers about a pose, attributes of a result: label and format of each; `{unit}` stands for the unit of lengths."""
OF_MATCHES = {name for name in LABELS if not name.endswith(("std", "std_deg"))}
"""Numbers that a pose without matches does not have."""
STATUS_COLORS = {Status.OK: GREEN, Status.LOW_CONFIDENCE: ORANGE, Status.FAILED: VERMILLION}
SURE = 2.4477
"""Radius of the 95 % region of a 2D normal distribution, standard deviations."""
MAX_POINTS = 20_000  # drawn; more only take time
NAMES, COLORS = ("as it was", "again"), (ESTIMATED, PURPLE)
"""Of the answers in a figure; a single answer is called `estimated`."""
BELOW: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2), "ncols": 2, "fontsize": 7.5}
"""Legend below a panel."""


@dataclass(frozen=True, repr=False)
class Answer:
    """How one query was localized in a map. A notebook displays its figure."""

    result: QueryResult
    settings: LocalizeSettings
    """Settings that it was localized with."""
    views: Sequence[View]
    """Images of the query."""
    rig_from_cams: Floats
    """(C, 4, 4)"""
    map_session: Session
    local_map: LocalMap | None
    """The triangulated maps, pooled."""
    unit: tuple[str, float] = ("m", 1.0)
    """Unit that lengths are shown in, see `metrics.length_unit`."""
    true_pose: Floats | None = None
    """world_from_rig (4, 4); None if unknown."""
    of: str = "query"
    """What is localized, such as `query 3 of hl`."""
    number: int | None = None
    """Number of the query in its pair."""
    retrieved: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Rank, from 1, and score of each retrieved reference, by name; for a rig, the best rank among its cameras."""

    @property
    def name(self) -> str:
        """Name of its first image."""
        return self.views[0].name

    @property
    def headline(self) -> str:
        """What was localized, in which map, and its status."""
        return f"{self.of} in the map of {self.map_session.device}: {self.result.status_text}"

    @cached_property
    def numbers(self) -> dict[str, float]:
        """The known ones of `LABELS`; lengths in `unit`, and named by it."""
        numbers = {name: float(getattr(self.result, name)) for name in LABELS}
        numbers[f"position_std_{self.unit[0]}"] = numbers.pop("position_std") / self.unit[1]
        return {name: value for name, value in numbers.items() if np.isfinite(value)}

    @property
    def reason(self) -> str:
        """Why it has this status, in words."""
        return reason_in_words(self.result, self.numbers, self.settings)

    @property
    def texts(self) -> dict[str, str]:
        """The known numbers, errors and seconds as texts by their label."""
        result, unit, numbers, by_network = self.result, self.unit[0], self.numbers, is_predicted(self.result.found_by)
        no_matches = not result.num_matches and (by_network or result.world_from_rig is not None)
        hidden = set(OF_MATCHES) if no_matches else set[str]()
        if not numbers.get("agreement"):
            hidden.add("agreement")
        texts = {"method": result.found_by} | ({"consistent references": _consistent(result)} if by_network else {})
        for name, (label, form) in LABELS.items():
            value = numbers.get(f"position_std_{unit}" if name == "position_std" else name)
            if value is not None and name not in hidden:
                texts[label.format(unit=unit)] = form.format(value)
        if self.error is not None:
            texts[f"true position error [{unit}]"] = _digits(self.error[1])
            texts["true rotation error [deg]"] = _digits(self.error[0])
        return texts | ({"seconds": f"{self.result.seconds:.2f}"} if np.isfinite(self.result.seconds) else {})

    @cached_property
    def details(self) -> QueryDetails:
        """Its images and references, with their correspondences."""
        return query_details(self.result, self.views, self.rig_from_cams, self.map_session, self.true_pose)

    @property
    def error(self) -> tuple[float, float] | None:
        """Rotation error, degrees, and position error in `unit`; None without a pose or ground truth."""
        pose, true_pose = self.result.world_from_rig, self.true_pose
        if pose is None or true_pose is None:
            return None
        rotation_deg, translation = pose_errors(pose[None], true_pose[None])
        return float(rotation_deg[0]), float(translation[0]) / self.unit[1]

    @cached_property
    def matches(self) -> pd.DataFrame:
        """Counts of the correspondences: one row per kind (`sift/guided`), columns agree and rejected."""
        matches = self.result.correspondences
        counts = pd.DataFrame({"agree": matches.agrees, "rejected": ~matches.agrees}, dtype=int)
        return counts.groupby(pd.Index(matches.found_by.astype(object), name="found by")).sum()

    @cached_property
    def references(self) -> pd.DataFrame:
        """One row per reference that was retrieved or used, best first.

        Columns: name; rank and score of the retrieval (for a rig, of the camera that ranks it highest); used (whether
        the pose was computed from it); rejected (whether it contradicts the used references); shared (points
        that agree with the pose and that it observes; missing if its views were not stored).
        """
        retrieved, matches, used = self.retrieved, self.result.correspondences, self.result.references
        kept, rows = set(matches.view_reference.tolist()), []
        for name in dict.fromkeys([*used, *self.result.rejected, *retrieved]):
            at = used.index(name) if name in used else -1
            shared = int(matches.agrees[matches.view_of[matches.view_reference == at]].sum()) if at in kept else None
            of_retrieval = retrieved.get(name, (None, np.nan))
            rows.append((name, *of_retrieval, name in used, name in self.result.rejected, shared))
        table = pd.DataFrame(rows, columns=["name", "rank", "score", "used", "rejected", "shared"])
        return table.astype({"rank": "Int64", "shared": "Int64"})

    @cached_property
    def figure(self) -> "Figure":
        headline = textwrap.shorten(self.headline, 110, placeholder=" …")
        title = f"{headline}\n{shown_name(self.name, 110)}\n{textwrap.fill(self.reason, 130)}"
        return draw_answers([self], title)

    @property
    def html(self) -> str:
        """Status and reason in words, the pose, the main numbers and a small picture, as HTML."""
        result, rows = self.result, self.texts
        if result.world_from_rig is not None:
            position = ", ".join(f"{x:.3f}" for x in result.world_from_rig[:3, 3])
            rows = {f"position [{'m' if self.unit[0] == 'm' else 'unit of the map'}]": position, **rows}
        cells = "".join(f"<tr><td>{escape(label)}</td><td>{escape(text)}</td></tr>" for label, text in rows.items())
        name = shown_name(self.name, 110)
        name = name if isinstance(self.views[0].image, np.ndarray) or "/" in self.name else self.views[0].image.name
        return (
            f"<div style='display:flex;gap:1em;align-items:flex-start'>{thumbnails([self.views[0].image], 200)}<div>"
            f"<b style='color:{STATUS_COLORS[result.status]}'>{escape(result.status_text)}</b> {escape(name)}"
            f"<p>{escape(self.reason)}</p><table>{cells}</table></div></div>"
        )

    def __repr__(self) -> str:
        return f"{self.headline}\n{self.name}\n{self.reason}"

    def _repr_html_(self) -> str:
        return zoomable(picture_of(self.figure), repr(self))


@dataclass(frozen=True)
class Comparison:
    """One query localized twice. A notebook displays its figure."""

    before: Answer
    after: Answer
    changes: dict[str, Any]
    """What was changed."""

    @cached_property
    def table(self) -> pd.DataFrame:
        """Status, method, numbers, errors and seconds as texts; columns before and after."""
        both = {"before": self.before, "after": self.after}
        texts = {name: {"status": one.result.status_text, **one.texts} for name, one in both.items()}
        return pd.DataFrame(texts, dtype=object)

    @cached_property
    def figure(self) -> "Figure":
        """Both answers side by side."""
        changed = ", ".join(f"{key}: {value}" for key, value in self.changes.items()) or "no setting changed"
        first = f"{self.before.of} in the map of {self.before.map_session.device}"
        return draw_answers([self.before, self.after], f"{first}, localized again\n{textwrap.fill(changed, 120)}")

    def __repr__(self) -> str:
        return f"{self.changes or 'nothing changed'}\nbefore: {self.before!r}\nafter: {self.after!r}"

    def _repr_html_(self) -> str:
        return zoomable(picture_of(self.figure), repr(self))


# In words


def _consistent(result: QueryResult) -> str:
    """Return how many references of a predicted pose agree on it, such as `4 of 5`."""
    return f"{len(result.references)} of {len(result.references) + len(result.rejected)}"


def _digits(value: float) -> str:
    """Return a number with two significant digits if it is small: an error below a millimeter is not 0.000 m."""
    value = round(value, 9)  # what is smaller is rounding
    return np.format_float_positional(value, 2, fractional=False, trim="-") if value < 0.1 else number(value)


def reason_in_words(result: QueryResult, numbers: Mapping[str, float], settings: LocalizeSettings) -> str:
    """Return why a query has its status; `numbers` are the known ones of `LABELS`, `settings` hold the limits."""
    detail = result.reason
    if result.status is Status.FAILED:
        said = [_why_failed(detail, int(numbers.get("num_matches", 0)), settings.pnp.min_inliers)]
    elif detail == CAMERA:
        said = ["The matches contradict the camera's intrinsics."]
    elif detail:
        said = [f"{detail[0].upper()}{detail[1:]}."]
    elif settings.method == "nearest":
        said = ["This is the unchanged pose of the best reference, which is never called ok."]
    else:
        in_doubt = result.status is Status.LOW_CONFIDENCE
        said = [*(_doubts(numbers, settings) if in_doubt else ()), *_support(result, numbers)]
    remark = [f"{result.remark[0].upper()}{result.remark[1:]}."] if result.remark else []
    return " ".join([*said, *remark])


def _why_failed(detail: str, count: int, min_inliers: int) -> str:
    sentences = {
        "too few matches": f"{count} matches with the map are too few to compute one",
        "no consistent pose": f"too few of {count} matches agree on any pose",
        "no references": "the retrieval has no references for this query",
    }
    if detail.startswith("too few inliers"):
        return f"No pose: {detail} among {count} matches; at least {min_inliers} are required."
    return f"No pose: {sentences.get(detail, detail)}."


def _doubts(numbers: Mapping[str, float], settings: LocalizeSettings) -> list[str]:
    doubts, least = [], settings.pnp.ok_probability
    probability, rival = numbers.get("p_correct", np.nan), numbers.get("rival_support", 0.0)
    if probability < least:
        doubts.append(f"It is right with a probability of {probability:.0%}; ok requires {least:.0%}.")
    if bounded_by_rivals(1.0, [rival]) < least:
        doubts.append(f"Another pose has {rival:.0%} of its support, so it may be the right one.")
    return doubts or ["It has too little support to be trusted."]


def _support(result: QueryResult, numbers: Mapping[str, float]) -> list[str]:
    if is_predicted(result.found_by):
        return [f"{_consistent(result)} references agree on the pose."]
    if not numbers.get("num_matches"):
        return ["The pose comes from the references as a whole, not from matches."]
    counts = f"{numbers['num_inliers']:.0f} of {numbers['num_matches']:.0f}"
    text = f"{counts} descriptor matches are inliers ({numbers.get('inlier_ratio', np.nan):.0%})"
    coverage, rival = numbers.get("coverage", np.nan), numbers.get("rival_support", 0.0)
    best = f"The best other pose has {rival:.0%} of its support." if rival else "No other pose was found."
    return [text + (f", in {coverage:.0%} of the image." if coverage > 0 else "."), best]


# As a figure


@styled
def draw_answers(answers: Sequence[Answer], title: str) -> "Figure":
    """Draw a query, localized once or twice: beside its best reference, in the map from above, and in numbers.

    Lines join the points that the query and its best reference both see. Those that agree are colored by how they
    were found (`query_images.WAYS`), rejected matches are red; markers tell the kind of features. A single answer also
    has its further references.
    """
    several = len(answers) > 1
    details = answers[0].details
    further = not several and len(details.cameras) + len(details.captioned_references()) > 2
    heights = [3.3 if several else 4.0, *[2.0] * further, 3.6]
    figure = new_figure(11, sum(heights) - 0.1)
    above, *strip, below = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    for axis, answer, name in zip(above.subplots(1, len(answers), squeeze=False)[0], answers, NAMES, strict=False):
        draw_joined(axis, answer.details, 3.3, by_kind=True)
        axis.set_axis_off()
        of_answer = f"{name}: {answer.result.status_text}\n{textwrap.fill(answer.reason, 78)}"
        axis.set_title(of_answer if several else _caption(answer.details), fontsize=8.5)
        for agrees, column in ((True, "agree"), (False, "rejected")):
            for kind, count in answer.matches[column][answer.matches[column] > 0].items():
                label = f"{str(kind).replace('/', ', ')}: {count} {column}"
                axis.plot([], [], ls="", ms=5, label=label, **style_of(str(kind), agrees))
        if len(answer.matches):
            columns = 3 if several else 6
            axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=columns, fontsize=7.5)
    for part in strip:
        _draw_further(part, details)
    from_above, near, table = below.subplots(1, 3, width_ratios=[1.0, 0.9, 1.0 + 0.25 * several])
    _draw_from_above(from_above, answers)
    _draw_near(near, answers)
    _draw_table(table, answers)
    figure.suptitle(title, fontsize=10)
    return figure


def _caption(details: QueryDetails) -> str:
    """Return what the drawn image and its best reference see."""
    camera, references = details.cameras[0], details.captioned_references()
    of_rig = f" ({Path(camera.name).parent.name})" if len(details.cameras) > 1 else ""
    counts = f"{camera.num_agreeing} of {len(camera.matches)} map points agree"
    text = f"query{of_rig}: {counts if len(camera.matches) else 'no matches were stored'}"
    if not references:
        return f"{text} · no reference"
    both = np.isin(camera.matches, references[0][0].matches)
    joined = f", {int(camera.agrees[both].sum())} of this image" if both.any() else ""
    return f"{text} · {references[0][1]}{joined}"


def _draw_further(figure: "SubFigure", details: QueryDetails) -> None:
    """Draw the references but the best, and the further cameras of a rig."""
    images = details.captioned_references()[1:]
    for image in details.cameras[1:]:
        count = f": {image.num_agreeing} points agree" if details.has_matches else ""
        images.append((image, f"query, {Path(image.name).parent.name}{count}", True))
    panels = figure.subplots(1, max(4, min(6, len(images))), squeeze=False)[0]
    for panel in panels:
        panel.set_axis_off()
    for panel, (image, text, agrees) in zip(panels, images, strict=False):
        inches = 2.4 / max(1.0, image.ratio)
        draw_image(panel, image, inches, textwrap.fill(text, 30), "black" if agrees else ESTIMATED)
        draw_matches(panel, image, 4, by_kind=True)


def _ground_and_cameras(answer: Answer) -> tuple[Ground, Floats]:
    """Return the ground of the map, and the poses of its cameras (N, 4, 4)."""
    poses = answer.map_session.world_from_cam()
    poses = poses[is_posed(poses)]
    return Ground.below(poses, answer.settings.world_up, answer.unit), poses


def _cameras_of(answers: Sequence[Answer]) -> list[tuple[Floats, str, str]]:
    """Return world_from_cam, label and color of the answers with a pose, and of the ground truth if known."""
    # A rig is shown by the camera that the first answer draws.
    rig_from_cam, true = answers[0].details.rig_from_cam, answers[0].true_pose
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
    points = sure_points(answer.local_map)[0]
    points = points[:: len(points) // MAX_POINTS + 1]
    references = np.array([image.world_from_cam for image in answer.details.references]).reshape(-1, 4, 4)
    references = references[is_posed(references)]
    shown, named = _cameras_of(answers), list[tuple[Floats, str, Layer]]()
    for rival in answers[-1].result.rivals:
        pose, label = rival.world_from_rig @ answer.details.rig_from_cam, f"rival, {rival.support:.0%} of the support"
        diamond = Layer(pose[None], label, BLUE, 0.08, hollow=True, s=40, marker="D")
        named.append((pose, "rival", diamond))
    named += [(pose, name, _dot(pose, name, color, 0.12)) for pose, name, color in shown]
    layers = [
        Layer(points, None, "0.75", s=1, lw=0, rasterized=True),
        Layer(cameras, "map cameras", MAP, s=7, lw=0),
        Layer(references, "references", ORANGE, 0.08, s=16, lw=0),
        *(layer for _, _, layer in named),
    ]
    centers = ground.flat(np.array([pose for pose, _, _ in named]).reshape(-1, 4, 4))
    places, of_references = Places(ground.flat(cameras)), ground.flat(references)
    anchor = np.concatenate([ground.flat(pose[None]) for pose, _, _ in shown[:1]] + [of_references])[:1]
    contents = places.cameras
    if len(anchor):
        contents = places.contents(int(places.nearest(anchor)[0]), ground.flat(points), anchor[:0])
    contents = np.concatenate([contents, of_references])
    # What lies farther away than the map is large is named, not drawn.
    low, high = window_of(contents, margin=1.0)
    window = window_of(np.concatenate([contents, centers[((centers > low) & (centers < high)).all(axis=1)]]))
    axis.scatter([], [], s=9, c="0.75", lw=0, label="map points")  # a larger dot for the legend
    draw_layers(axis, ground, layers, window)
    outside = ((centers < window[0]) | (centers > window[1])).any(axis=1)
    names = Counter(name for (_, name, _), far in zip(named, outside, strict=True) if far)
    far = ", ".join(f"{count} rivals" if count > 1 else name for name, count in names.items())
    axis.set_title("from above" + (f"\noutside the picture: {far}" if far else ""), fontsize=9)
    axis.legend(**BELOW)


def _draw_near(axis: "Axes", answers: Sequence[Answer]) -> None:
    """Draw the positions of the answers and the truth, enlarged to show the uncertainty."""
    from matplotlib.patches import Ellipse

    posed = [answer for answer in answers if answer.result.world_from_rig is not None]
    if not posed:
        axis.set_axis_off()
        axis.text(0.5, 0.5, "no pose", ha="center", va="center", color=GRAY)
        return
    unit, length = posed[0].unit
    ground, shown = _ground_and_cameras(posed[0])[0], _cameras_of(answers)
    origin = -shown[0][0][:3, 3]
    shown = [(shifted(pose, origin), name, color) for pose, name, color in shown]
    ellipses, reach = [], [float(np.abs(ground.flat(pose)).max()) for pose, _, _ in shown]
    for of_answer, answer in zip(shown, posed, strict=False):  # the truth is shown last
        # The camera of a rig that the first answer draws is drawn of both.
        details = replace(answer.details, rig_from_cam=answers[0].details.rig_from_cam)
        if details.position_covariance is not None:
            spread = ground.axes @ details.position_covariance @ ground.axes.T
            values, vectors = np.linalg.eigh(spread)
            sizes = 2 * SURE * np.sqrt(np.maximum(values, 0)) / length
            reach.append(float(sizes.max()) * 0.55)
            ellipses.append((of_answer, sizes, float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))))
    half = 1.35 * max([value for value in reach if np.isfinite(value)], default=0.0) or 0.01
    small, factor = ("cm", 100.0) if unit == "m" and half < 1 else (unit, 1.0)
    labels = [f"{label.partition(' [')[0]}, from the pose [{small}]" for label in ground.labels]
    ground = Ground(ground.axes, labels, length / factor)
    for (pose, name, color), sizes, angle in ellipses:
        x, y = ground.flat(pose).tolist()
        style: dict[str, Any] = {"facecolor": color, "alpha": 0.2, "label": f"95 % region, {name}"}
        axis.add_patch(Ellipse((x, y), factor * sizes[1], factor * sizes[0], angle=angle, **style))
    draw_layers(axis, ground, [_dot(*of) for of in shown], factor * half * np.array([[-1.0, -1.0], [1.0, 1.0]]))
    axis.set_title(f"the pose, enlarged{'' if ellipses else ': the method states no uncertainty'}", fontsize=9)
    axis.grid(alpha=0.25)
    axis.legend(**BELOW)


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
