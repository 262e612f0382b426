"""Evaluate and draw the sequence stage: recall after each step, and the query recordings from above."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.tables import POSE_NAMES, as_strings, read_query_table
from toolkit.figures.style import GREEN, ORANGE, SKY, VERMILLION, new_figure, percent, shared_legend, styled
from toolkit.figures.top_view import Ground, Layer, draw_places
from toolkit.files import older_files, pair_name, require_whole, why_older
from toolkit.geometry import Floats
from toolkit.results.metrics import WRONG, Threshold, is_below, is_posed, pose_errors, summary_of, threshold_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

SINGLE, SEQUENCE = "single", "sequence"
"""Names of the first and the last step."""
CHANGES = ("rescued", "broken")
"""A query is rescued if it is within a threshold only with its sequence; broken if only without."""
_KEY = ["timestamp", "device_id"]


def warn_of_older(poses_dir: str | Path) -> None:
    """Warn once of all sequences that were made from other poses of single queries, which `SequencePair.find` omits."""
    older = [why for name, why in older_files(poses_dir, "sequence").items() if name.endswith(".txt")]
    if older:
        log.warning("Sequences of %d pairs are not used: %s", len(older), older[0])


@dataclass(frozen=True)
class SequencePair:
    """The files of the sequence stage of one pair: query poses after each step, and the poses of all frames."""

    stem: Path
    """RUN/SCENE/poses/<pair>; the stage's files are `<stem>_sequence*`."""

    @classmethod
    def find(cls, poses_dir: str | Path, scene: str, map_device: str, query_device: str) -> "SequencePair | None":
        """Return the files of a pair; None if the stage wrote none, or made them from other poses of single queries."""
        stem = Path(poses_dir) / pair_name(scene, map_device, query_device)
        single, sequence = (stem.with_name(f"{stem.name}{end}.txt") for end in ("", "_sequence"))
        found = single.is_file() and sequence.is_file() and not why_older(sequence, "sequence")
        return cls(stem) if found else None

    @property
    def path(self) -> Path:
        """The poses of the frames."""
        return self.stem.with_name(f"{self.stem.name}_sequence.txt")

    def _whole(self, end: str) -> Path:
        """Return a file of the pair; raise ArtifactError if it is damaged."""
        path = self.stem.with_name(self.stem.name + end)
        require_whole(path, of=None if end == ".txt" else self.path)
        return path

    @cached_property
    def frames(self) -> pd.DataFrame:
        """One row per frame, see `sequence.COLUMNS`."""
        return read_query_table(self._whole("_sequence.csv"), ["recording", "piece", "used"])

    @cached_property
    def steps(self) -> dict[str, Trajectory]:
        """Query poses after each step: `single`, the steps that the stage wrote, and `sequence`."""
        steps = {SINGLE: Trajectory.read(self._whole(".txt"))}
        if (path := self._whole("_sequence_steps.csv")).is_file():
            for name, rows in read_query_table(path, ["step", *POSE_NAMES]).groupby("step", sort=False):
                qt = rows[list(POSE_NAMES)].to_numpy(float)
                steps[str(name)] = Trajectory(rows["timestamp"].to_numpy(np.int64), as_strings(rows["device_id"]), qt)
        return {**steps, SEQUENCE: Trajectory.read(self._whole("_sequence.txt"))}

    def odometry_tracks(self, session: Session) -> list[Floats]:
        """Return the positions (n, 3) of each piece of odometry, rigidly placed in the map by the step `voted`."""
        voted, odometry, tracks = self.steps.get("voted"), session.odometry, list[Floats]()
        if voted is None or odometry is None:
            return tracks
        for _, rows in self.frames.groupby(["recording", "piece"], dropna=True):
            in_map, in_odom = (each.lookup(rows["timestamp"], rows["device_id"]) for each in (voted, odometry))
            both = np.flatnonzero(is_posed(in_map) & is_posed(in_odom))
            if len(both):
                map_from_odom = in_map[both[0]] @ geometry.invert(in_odom[both[0]])
                tracks.append((map_from_odom @ in_odom[is_posed(in_odom)])[:, :3, 3])
        return tracks

    def tracks(self) -> list[Floats]:
        """Return the positions (n, 3) of the frames of each piece, as estimated by the stage."""
        sequence, tracks = self.steps[SEQUENCE], list[Floats]()
        for _, rows in self.frames.groupby(["recording", "piece"], dropna=True):
            poses = sequence.lookup(rows["timestamp"], rows["device_id"])
            tracks.append(poses[is_posed(poses)][:, :3, 3])
        return tracks

    def changes(self, keys: pd.DataFrame, truth: Trajectory | Floats, limit: Threshold, length: float) -> pd.DataFrame:
        """Return the queries for which just one pose, the single or the sequence one, is within a threshold: timestamp,
        device_id, change (`rescued` or `broken`), and the errors of both poses, in lengths of `length`.
        """
        table, within = keys[_KEY].copy(), list[NDArray[np.bool_]]()
        for step, prefix in ((SINGLE, "single_"), (SEQUENCE, "")):
            rotation_deg, translation = pose_errors(self.steps[step], truth, keys)
            translation = translation / length
            within.append(is_below(rotation_deg, translation, limit))
            table[f"{prefix}rotation_error_deg"], table[f"{prefix}translation_error_m"] = rotation_deg, translation
        single, sequence = within
        table.insert(2, "change", np.select([sequence & ~single, single & ~sequence], CHANGES, ""))
        return table[table["change"] != ""].reset_index(drop=True)

    def recalls(
        self, keys: pd.DataFrame, truth: Trajectory, limits: Sequence[Threshold], unit: str, length: float
    ) -> list[dict[str, Any]]:
        """Return one row per step: number of queries, recall at each threshold, median errors, and the numbers of
        queries rescued and broken at the last threshold, compared with the single poses."""
        rows, first = [], None
        for step, poses in self.steps.items():
            rotation_deg, translation = pose_errors(poses, truth, keys)
            translation = translation / length
            within = is_below(rotation_deg, translation, limits[-1])
            first = within if first is None else first
            counts = {"rescued": int((within & ~first).sum()), "broken": int((first & ~within).sum())}
            summary = summary_of(rotation_deg, translation, limits, unit)
            rows.append({"step": step, "queries": len(keys), **summary, **counts})
        return rows


@styled
def draw_sequence(
    capture: Capture,
    pair: SequencePair,
    map_device: str,
    query_device: str,
    up: ArrayLike | None = None,
    unit: tuple[str, float] = ("m", 1.0),
) -> "Figure":
    """Draw a pair's recordings from above: odometry before and after, and the single queries; return the figure.

    With ground truth, queries that the sequence rescued or broke (5 degrees, 0.5 m) are marked.
    """
    map_poses, session = capture[f"{map_device}_map"].world_from_cam(), capture[f"{query_device}_query"]
    map_poses, before, after = map_poses[is_posed(map_poses)], pair.odometry_tracks(session), pair.tracks()
    single, table = pair.steps[SINGLE], pair.frames
    # A query that was localized again may be used with another pose than the drawn single pose.
    agreeing = table[(table["used"].astype(str) == "True") & table["again_status"].isna()]
    agrees = pd.MultiIndex.from_arrays([single.timestamps, single.device_ids]).isin(agreeing.set_index(_KEY).index)
    queries, marks = single.world_from_device, _marks(pair, session, unit[1])
    sky: dict[str, Any] = {"marker": ".", "markersize": 4, "lw": 1.2}
    layers = [
        Layer(map_poses, f"map, {map_device}", "0.78", s=12),
        *(Layer(track, "odometry, rigidly placed", ORANGE, track=True, ls="--", lw=1.2) for track in before),
        *(Layer(track, "frames of the sequence", SKY, track=True, **sky) for track in after),
        Layer(queries[agrees], "single queries that agree", GREEN, s=34, marker="x", zorder=3),
        Layer(queries[~agrees], "single queries that are in doubt", VERMILLION, s=34, marker="x", zorder=3),
        *(
            Layer(marks[name], f"{name}: {len(marks[name])}", "black", hollow=True, s=70, marker=marker, lw=1, zorder=4)
            for name, marker in (("rescued", "^"), ("broken", "v"))
        ),
    ]
    # The map and the tracks define the panels; single poses far off are not drawn.
    defining = np.concatenate([map_poses[:, :3, 3], *after])
    figure, _, panels = draw_places(Ground.below(map_poses, up, unit), layers, defining)
    shared_legend(figure, [axis for axis, _, _ in panels], ncols=4, fontsize=8)
    figure.suptitle(f"{query_device} recordings in the {map_device} map, from above")
    return figure


def _marks(pair: SequencePair, session: Session, length: float) -> dict[str, Floats]:
    """Return the sequence's positions (n, 3) of the queries that it rescued and broke, as far as they have a pose."""
    marks = dict.fromkeys(CHANGES, np.zeros((0, 3)))
    if session.ground_truth is None:
        return marks
    keys = pair.frames[pair.frames["single_status"].notna()][_KEY].reset_index(drop=True)
    true = session.ground_truth.lookup(keys["timestamp"], keys["device_id"])
    has_truth = is_posed(true)
    changes = pair.changes(keys[has_truth].reset_index(drop=True), true[has_truth], WRONG, length)
    for name in CHANGES:
        rows = changes[changes["change"] == name]
        poses = pair.steps[SEQUENCE].lookup(rows["timestamp"], rows["device_id"])
        marks[name] = poses[is_posed(poses)][:, :3, 3]
    return marks


@styled
def draw_steps(table: pd.DataFrame) -> "Figure":
    """Draw the recall after each step, of `SequencePair.recalls` of pairs: a panel per threshold, a dot per pair, a bar
    for their mean.
    """
    columns = [name for name in table.columns if name.startswith("recall@")]
    steps = list(dict.fromkeys(table["step"]))
    figure = new_figure(1.5 + 3.4 * len(columns), 3.6)
    plots = figure.subplots(1, len(columns), squeeze=False, sharey=True)[0]
    for plot, column in zip(plots, columns, strict=True):
        for _, pair in table.groupby(["map_device", "query_device"], sort=False):
            values = 100 * pair.set_index("step")[column].reindex(steps)
            plot.plot(range(len(steps)), values, ".", color="0.6", markersize=5)
        means = 100 * table.groupby("step")[column].mean().reindex(steps)
        plot.bar(range(len(steps)), means, color=SKY, alpha=0.6, width=0.6)
        for x, mean in enumerate(means):
            plot.text(x, 3, percent(mean / 100), ha="center", fontsize=8)
        plot.set_xticks(range(len(steps)), steps, rotation=45, ha="right")
        plot.set_title(f"recall @ {threshold_text(column)}", fontsize=10)
    plots[0].set_ylabel("queries [%]")
    figure.suptitle("Recall after each step: mean of all pairs (bars), each pair (dots)")
    return figure
