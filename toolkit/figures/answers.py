"""The result of localizing one query: status in words, numbers, correspondences, pose and rivals."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd

from toolkit.figures.style import number
from toolkit.geometry import Floats
from toolkit.manifest import LocalizeSettings
from toolkit.pose.confidence import bounded_by_rivals
from toolkit.pose.result import CAMERA, QueryResult, Status
from toolkit.results.images import LocalizedPair, QueryDetails
from toolkit.results.metrics import is_posed, pose_errors

LABELS = {
    "num_matches": ("descriptor matches", "{:.0f}"), "num_inliers": ("inliers among them", "{:.0f}"),
    "inlier_ratio": ("inlier ratio", "{:.0%}"), "num_guided": ("guided matches", "{:.0f}"),
    "rmse_px": ("reprojection error [px]", "{:.2f}"), "coverage": ("image covered", "{:.0%}"),
    "p_correct": ("probability of being right", "{:.1%}"), "rival_support": ("support of the best rival", "{:.0%}"),
    "agreement": ("matches of a second kind", "{:.0f}"), "position_std_m": ("std. dev. of position [{unit}]", "{:.2g}"),
    "rotation_std_deg": ("std. dev. of rotation [deg]", "{:.2g}"), "scale_std": ("std. dev. of scale", "{:.1%}"),
}  # fmt: skip
"""Numbers about a pose, columns of a pair's table and attributes of an estimate: label and format of each; `{unit}`
stands for the pair's unit of length."""
OF_NETWORKS = {
    "num_matches": ("references given to it", "{:.0f}"), "num_inliers": ("consistent ones", "{:.0f}"),
    "inlier_ratio": ("their share", "{:.0%}"),
}  # fmt: skip
"""Labels and formats that differ for poses of a feed-forward network."""
OF_MATCHES = ("num_guided", "rmse_px", "coverage", "p_correct", "rival_support", "agreement")
"""Numbers that a pose without matches does not have."""


@dataclass(frozen=True)
class Answer:
    """How one query of a pair was localized."""

    pair: LocalizedPair
    number: int
    """Number of the query in the pair."""
    result: QueryResult
    settings: LocalizeSettings
    """Settings that it was localized with."""
    retrieved: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Rank, from 1, and score of each retrieved reference, by name; for a rig, the best rank among its cameras."""

    @property
    def name(self) -> str:
        """Name of its first image."""
        return str(self.pair.localizations.names[self.number])

    @property
    def headline(self) -> str:
        """Number, devices and status of the query."""
        devices = f"{self.pair.query_session.device} in the map of {self.pair.map_session.device}"
        return f"query {self.number} of {devices}: {self.result.status_text}"

    @cached_property
    def numbers(self) -> dict[str, float]:
        """The known ones of `LABELS`; lengths in the pair's unit."""
        numbers = {name: float(getattr(self.result, name)) for name in LABELS}
        numbers["position_std_m"] /= self.pair.results.unit[1]
        return {name: value for name, value in numbers.items() if np.isfinite(value)}

    @property
    def reason(self) -> str:
        """Why it has this status, in words."""
        return reason_in_words(self.result, self.numbers, self.settings)

    @property
    def caption(self) -> str:
        """What the drawn image and its best reference see."""
        camera, references = self.details.cameras[0], self.details.captioned_references()
        of_rig = f" ({folder_of(camera.name)})" if len(self.details.cameras) > 1 else ""
        counts = f"{camera.num_inliers} of {len(camera.matches)} map points agree"
        text = f"query{of_rig}: {counts if len(camera.matches) else 'no matches were stored'}"
        if not references:
            return f"{text} · no reference"
        both = np.isin(camera.matches, references[0][0].matches)
        joined = f", {int(camera.inlier[both].sum())} of this image" if both.any() else ""
        return f"{text} · {references[0][1]}{joined}"

    @property
    def texts(self) -> dict[str, str]:
        """The known numbers, errors and seconds as texts by their label."""
        by_network, unit = _is_by_network(self.result.found_by), self.pair.results.unit[0]
        labels = LABELS | OF_NETWORKS if by_network else LABELS
        hidden = set(OF_MATCHES) if by_network else set[str]()
        if self.result.world_from_rig is not None and not self.numbers.get("num_matches"):
            hidden = {*OF_MATCHES, *OF_NETWORKS}
        if not self.numbers.get("agreement"):
            hidden.add("agreement")
        shown = {name: each for name, each in labels.items() if name in self.numbers and name not in hidden}
        texts = {label.format(unit=unit): form.format(self.numbers[name]) for name, (label, form) in shown.items()}
        texts = {"method": self.result.found_by, **texts}
        if self.error is not None:
            texts[f"true position error [{unit}]"] = _digits(self.error[1])
            texts["true rotation error [deg]"] = _digits(self.error[0])
        return {**texts, "seconds": f"{self.result.seconds:.2f}"}

    @property
    def rig_from_cam(self) -> Floats:
        """Pose of the drawn image, (4, 4)."""
        session, rows = self.pair.query_session, self.pair.rows[self.number]
        names = [session.image_name(int(row)) for row in rows]
        return np.asarray(session.rig_from_cam(rows)[names.index(self.details.cameras[0].name)])

    @cached_property
    def details(self) -> QueryDetails:
        """Its images and references, with their correspondences."""
        return self.pair.details(self.number, self.result)

    @property
    def true_pose(self) -> Floats | None:
        """world_from_rig (4, 4); None if unknown."""
        true = self.pair.true_poses[self.number]
        return true if is_posed(true) else None

    @property
    def error(self) -> tuple[float, float] | None:
        """Rotation error, degrees, and position error in the pair's unit; None without a pose or ground truth."""
        pose, true_pose = self.result.world_from_rig, self.true_pose
        if pose is None or true_pose is None:
            return None
        rotation_deg, translation = pose_errors(pose[None], true_pose[None])
        return float(rotation_deg[0]), float(translation[0]) / self.pair.results.unit[1]

    @cached_property
    def matches(self) -> pd.DataFrame:
        """Counts of the correspondences: one row per kind (`sift/guided`), columns agree and rejected."""
        matches = self.result.correspondences
        counts = pd.DataFrame({"agree": matches.inlier, "rejected": ~matches.inlier}, dtype=int)
        return counts.groupby(pd.Index(matches.found_by.astype(object), name="found by")).sum()

    @cached_property
    def references(self) -> pd.DataFrame:
        """One row per reference that was retrieved or used, best first.

        Columns: name; rank and score of the retrieval (for a rig, of the camera that ranks it highest); used (whether
        the pose was computed from it); rejected (whether it contradicts the used references); shared (points
        that agree with the pose and that it observes; missing if its views were not stored).
        """
        retrieved, matches, used = self.retrieved, self.result.correspondences, self.result.references
        names = list(dict.fromkeys([*used, *self.result.rejected, *retrieved]))
        kept = set(matches.view_reference.tolist())
        rows = []
        for name in names:
            rank, score = retrieved.get(name, (None, np.nan))
            number = used.index(name) if name in used else -1
            seen = matches.view_of[matches.view_reference == number]
            shared = int(matches.inlier[seen].sum()) if number in kept else None
            rows.append((name, rank, score, name in used, name in self.result.rejected, shared))
        table = pd.DataFrame(rows, columns=["name", "rank", "score", "used", "rejected", "shared"])
        return table.astype({"rank": "Int64", "shared": "Int64"})

    def __repr__(self) -> str:
        return f"{self.headline}\n{self.name}\n{self.reason}"


def folder_of(name: str) -> str:
    """Return the name of an image's folder, which tells the camera of a rig."""
    return Path(name).parent.name


def _is_by_network(method: str) -> bool:
    return method.rpartition("/")[2].startswith("feed_forward")


def _digits(value: float) -> str:
    """Return a number with two significant digits if it is small: an error below a millimeter is not 0.000 m."""
    value = round(value, 9)  # what is smaller is rounding
    return np.format_float_positional(value, 2, fractional=False, trim="-") if value < 0.1 else number(value)


def reason_in_words(result: QueryResult, numbers: Mapping[str, float], settings: LocalizeSettings) -> str:
    """Return in a sentence why a query has its status.

    Args:
        numbers: the known ones of `LABELS`.
        settings: settings of the localization, which hold the limits.
    """
    detail, method = result.reason, result.found_by
    more = f" {result.remark[0].upper()}{result.remark[1:]}." if result.remark else ""
    if result.status is Status.FAILED:
        return _why_failed(detail, numbers, settings) + more
    if detail == CAMERA:
        return "The matches contradict the camera's intrinsics." + more
    if detail:
        return f"{detail[0].upper()}{detail[1:]}.{more}"
    if settings.method == "nearest":
        return "This is the unchanged pose of the best reference, which is never called ok." + more
    if result.status is Status.LOW_CONFIDENCE:
        return " ".join([*_doubts(numbers, settings), *_support(numbers, method)]) + more
    return " ".join(_support(numbers, method)) + more


def _why_failed(detail: str, numbers: Mapping[str, float], settings: LocalizeSettings) -> str:
    count = int(numbers.get("num_matches", 0))
    sentences = {
        "too few matches": f"{count} matches with the map are too few to compute one",
        "no consistent pose": f"too few of {count} matches agree on any pose",
        "no references": "the retrieval has no references for this query",
    }
    if detail.startswith("too few inliers"):
        return f"No pose: {detail} among {count} matches; at least {settings.pnp.min_inliers} are required."
    return f"No pose: {sentences.get(detail, detail)}."


def _doubts(numbers: Mapping[str, float], settings: LocalizeSettings) -> list[str]:
    doubts, limits = [], settings.pnp
    probability, rival = numbers.get("p_correct", np.nan), numbers.get("rival_support", 0.0)
    if probability < limits.ok_probability:
        doubts.append(f"It is right with a probability of {probability:.0%}; ok requires {limits.ok_probability:.0%}.")
    if bounded_by_rivals(1.0, [rival]) < limits.ok_probability:
        doubts.append(f"Another pose has {rival:.0%} of its support, so it may be the right one.")
    return doubts or ["It has too little support to be trusted."]


def _support(numbers: Mapping[str, float], method: str) -> list[str]:
    if not numbers.get("num_matches"):
        return ["The pose comes from the references as a whole, not from matches."]
    if _is_by_network(method):
        return [f"{numbers['num_inliers']:.0f} of {numbers['num_matches']:.0f} references agree on the pose."]
    share, coverage = numbers.get("inlier_ratio", np.nan), numbers.get("coverage", np.nan)
    text = f"{numbers['num_inliers']:.0f} of {numbers['num_matches']:.0f} matches agree on the pose ({share:.0%})"
    parts = [text + (f", in {coverage:.0%} of the image." if coverage > 0 else ".")]
    rival = numbers.get("rival_support", 0.0)
    parts.append(f"The best other pose has {rival:.0%} of its support." if rival else "No other pose was found.")
    return parts
