"""The result of localizing one query: status in words, numbers, correspondences, pose and rivals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pandas as pd

from toolkit.geometry import Floats
from toolkit.localizers.base import CAMERA
from toolkit.localizers.confidence import bounded_by_rivals
from toolkit.localizers.correspondences import Correspondences, LocalizedQuery, Rival
from toolkit.manifest import LocalizeSettings
from toolkit.show.localized import LocalizedPair, QueryDetails
from toolkit.show.metrics import pose_errors

NUMBERS = (
    "num_inliers", "num_matches", "inlier_ratio", "num_guided", "rmse_px", "coverage", "p_correct", "rival_support",
    "agreement", "position_std_m", "rotation_std_deg", "scale_std",
)  # fmt: skip
"""Numbers about a pose: columns of a pair's table, and attributes of an estimate."""


@dataclass(frozen=True)
class Answer:
    """How one query of a pair was localized."""

    pair: LocalizedPair
    number: int
    """Number of the query in the pair."""
    status: str
    """`ok`, `low_confidence...` or `failed: ...`."""
    method: str
    """Method that found the pose or, without a pose, that was tried."""
    reason: str
    """Why it has this status, in words."""
    numbers: dict[str, float]
    """The known ones of `NUMBERS`; lengths in `pair.unit`."""
    localized: LocalizedQuery
    """Names of images and references, correspondences, rivals."""
    pose: Floats | None
    """world_from_rig (4, 4), or world_from_cam of a camera without a rig; None without a pose."""
    covariance: Floats | None
    """(6, 6), see `PoseEstimate`; None if unknown."""
    settings: LocalizeSettings
    """Settings that it was localized with."""
    seconds: float
    """Time that it took."""
    true_pose: Floats | None = None
    """world_from_rig (4, 4); None if unknown."""
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
        return f"query {self.number} of {devices}: {self.status}"

    @property
    def correspondences(self) -> Correspondences:
        return self.localized.correspondences

    @property
    def rivals(self) -> Sequence[Rival] | None:
        """Other poses that some matches support; None: the run is too old to have stored them."""
        return self.localized.rivals

    @cached_property
    def details(self) -> QueryDetails:
        """Its images and references, with their correspondences."""
        no_pose = np.full((4, 4), np.nan)
        return self.pair.details(self.number, self.localized, no_pose if self.pose is None else self.pose)

    @property
    def error(self) -> tuple[float, float] | None:
        """Rotation error, degrees, and position error in `pair.unit`; None without a pose or ground truth."""
        if self.pose is None or self.true_pose is None:
            return None
        rotation_deg, translation = pose_errors(self.pose[None], self.true_pose[None])
        return float(rotation_deg[0]), float(translation[0]) / self.pair.unit[1]

    @cached_property
    def matches(self) -> pd.DataFrame:
        """Counts of the correspondences: one row per kind (`sift/guided`), columns agree and rejected."""
        matches = self.correspondences
        counts = pd.DataFrame({"agree": matches.inlier, "rejected": ~matches.inlier}, dtype=int)
        return counts.groupby(pd.Index(matches.found_by.astype(object), name="found by")).sum()

    @cached_property
    def references(self) -> pd.DataFrame:
        """One row per reference that was retrieved or used, best first.

        Columns: name; rank and score of the retrieval (for a rig, of the camera that ranks it highest); used (whether
        the pose was computed from it); rejected (whether it contradicts the used references); shared (points
        that agree with the pose and that it observes; missing if its views were not stored).
        """
        retrieved, matches, used = self.retrieved, self.correspondences, self.localized.references
        names = list(dict.fromkeys([*used, *self.localized.rejected, *retrieved]))
        kept = set(matches.view_reference.tolist())
        rows = []
        for name in names:
            rank, score = retrieved.get(name, (None, np.nan))
            number = used.index(name) if name in used else -1
            seen = matches.view_of[matches.view_reference == number]
            shared = int(matches.inlier[seen].sum()) if number in kept else None
            rows.append((name, rank, score, name in used, name in self.localized.rejected, shared))
        table = pd.DataFrame(rows, columns=["name", "rank", "score", "used", "rejected", "shared"])
        return table.astype({"rank": "Int64", "shared": "Int64"})

    def __repr__(self) -> str:
        return f"{self.headline}\n{self.name}\n{self.reason}"


def reason_in_words(
    status: str, stated: str, numbers: Mapping[str, float], settings: LocalizeSettings, method: str = "pnp"
) -> str:
    """Return in a sentence why a query has its status.

    Args:
        stated: reason that the localizer states besides the status.
        numbers: the known ones of `NUMBERS`.
        settings: settings of the localization, which hold the limits.
        method: method of the pose; for `feed_forward`, inliers are references, not matches.
    """
    kind, _, detail = status.partition(": ")
    more = f" {stated[0].upper()}{stated[1:]}." if stated else ""
    if kind == "failed":
        return _why_failed(detail, numbers, settings) + more
    if status == CAMERA:
        return "The matches contradict the camera's intrinsics." + more
    if detail:
        return f"{detail[0].upper()}{detail[1:]}.{more}"
    if settings.method == "nearest":
        return "This is the unchanged pose of the best reference, which is never called ok." + more
    if kind == "low_confidence":
        return " ".join([*_doubts(numbers, settings), *_support(numbers, method)]) + more
    return " ".join(_support(numbers, method)) + more


def _why_failed(detail: str, numbers: Mapping[str, float], settings: LocalizeSettings) -> str:
    count, least = int(numbers.get("num_matches", 0)), settings.pnp.min_inliers
    if detail == "too few matches":
        return f"No pose: {count} matches with the map are too few to compute one."
    if detail == "no consistent pose":
        return f"No pose: too few of {count} matches agree on any pose."
    if detail.startswith("too few inliers"):
        return f"No pose: {detail} among {count} matches; at least {least} are required."
    if detail == "no references":
        return "No pose: the retrieval has no references for this query."
    return f"No pose: {detail}."


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
    if method.rpartition("/")[2].startswith("feed_forward"):
        return [f"{numbers['num_inliers']:.0f} of {numbers['num_matches']:.0f} references agree on the pose."]
    share, coverage = numbers.get("inlier_ratio", np.nan), numbers.get("coverage", np.nan)
    text = f"{numbers['num_inliers']:.0f} of {numbers['num_matches']:.0f} matches agree on the pose ({share:.0%})"
    parts = [text + (f", in {coverage:.0%} of the image." if coverage > 0 else ".")]
    rival = numbers.get("rival_support", 0.0)
    parts.append(f"The best other pose has {rival:.0%} of its support." if rival else "No other pose was found.")
    return parts
