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
from toolkit.capture.world_up import up_of_cameras
from toolkit.errors import ArtifactError
from toolkit.files import pair_name, require_current, require_whole
from toolkit.geometry import Floats
from toolkit.show.figures import GREEN, ORANGE, SKY, VERMILLION, new_figure, percent, shared_legend, styled
from toolkit.show.metrics import (
    WRONG,
    Threshold,
    is_below,
    is_posed,
    parse_threshold,
    pose_errors,
    recall,
    threshold_name,
    unit_of,
)
from toolkit.show.top_view import ground_axes, places_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

MAX_PLACES = 4
SINGLE, SEQUENCE = "single", "sequence"
"""Names of the first and the last step."""
CHANGES = ("rescued", "broken")
"""A query is rescued if it is within a threshold only with its sequence; broken if only without."""
_KEY = ["timestamp", "device_id"]


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
        if not (single.is_file() and sequence.is_file()):
            return None
        try:
            require_current(sequence, "sequence")
        except ArtifactError as error:
            log.warning("Not used: %s", error)
            return None
        return cls(stem)

    @property
    def path(self) -> Path:
        """The poses of the frames."""
        return self.stem.with_name(f"{self.stem.name}_sequence.txt")

    def _path(self, end: str) -> Path:
        """Return a file of the pair; raise ArtifactError if it is damaged."""
        path = self.stem.with_name(self.stem.name + end)
        require_whole(path, of=None if end == ".txt" else self.stem.with_name(f"{self.stem.name}_sequence.txt"))
        return path

    @cached_property
    def frames(self) -> pd.DataFrame:
        """One row per frame, see `sequence.COLUMNS`."""
        return read_query_table(self._path("_sequence.csv"), ["recording", "piece", "used"])

    @cached_property
    def steps(self) -> dict[str, Trajectory]:
        """Query poses after each step: `single`, the steps that the stage wrote, and `sequence`."""
        steps = {SINGLE: Trajectory.read(self._path(".txt"))}
        if (path := self._path("_sequence_steps.csv")).is_file():
            for name, rows in read_query_table(path, ["step", *POSE_NAMES]).groupby("step", sort=False):
                qt = rows[list(POSE_NAMES)].to_numpy(float)
                steps[str(name)] = Trajectory(rows["timestamp"].to_numpy(np.int64), as_strings(rows["device_id"]), qt)
        return {**steps, SEQUENCE: Trajectory.read(self._path("_sequence.txt"))}

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
        """Return the queries for which just one pose, the single or the sequence one, is within a threshold.

        Args:
            keys: the queries, columns timestamp and device_id.
            truth: their true poses.
            limit: threshold, degrees and lengths.
            length: the unit of lengths, in the unit of the poses.

        Returns:
            timestamp, device_id, change (`rescued` or `broken`), and the errors of both poses.
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
            shares = recall(rotation_deg, translation, limits)
            rows.append({
                "step": step,
                "queries": len(keys),
                **{f"recall@{threshold_name(t, unit)}": share for t, share in zip(limits, shares, strict=True)},
                "median_rotation_deg": float(np.median(rotation_deg)),
                "median_translation_m": float(np.median(translation)),
                "rescued": int((within & ~first).sum()),
                "broken": int((first & ~within).sum()),
            })  # fmt: skip
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

    Args:
        capture: capture of the map to draw; places far apart get panels of their own.
        up: up direction (3,); None: estimated from the map's cameras.
        unit: unit that lengths are shown in, see `metrics.length_unit`.
    """
    map_poses = capture[f"{map_device}_map"].world_from_cam()
    map_poses, session = map_poses[is_posed(map_poses)], capture[f"{query_device}_query"]
    axes, labels = ground_axes(up_of_cameras(map_poses) if up is None else up, unit[0])
    flat = axes.T / unit[1]
    single, table = pair.steps[SINGLE], pair.frames
    before, after = ([track @ flat for track in tracks] for tracks in (pair.odometry_tracks(session), pair.tracks()))
    centers, queries = map_poses[:, :3, 3] @ flat, single.world_from_device[:, :3, 3] @ flat
    # A query that was localized again may be used with another pose than the drawn single pose.
    agreeing = table[(table["used"].astype(str) == "True") & table["again_status"].isna()]
    agrees = pd.MultiIndex.from_arrays([single.timestamps, single.device_ids]).isin(agreeing.set_index(_KEY).index)
    marks = _marks(pair, session, unit[1])
    # The map and the tracks define the panels; single poses far off are not drawn.
    place = places_of(np.concatenate([centers, *after]))
    count = min(place.max(initial=0) + 1, MAX_PLACES)
    figure = new_figure(5.2 * count + 1, 5)
    plots = figure.subplots(1, count, squeeze=False)[0]
    shown = np.concatenate([centers, *after])
    for number, plot in enumerate(plots):
        in_panel = shown[place == number]
        plot.scatter(*centers[place[: len(centers)] == number].T, s=12, c="0.78", label=f"map, {map_device}")
        low, high = (in_panel.min(axis=0), in_panel.max(axis=0)) if len(in_panel) else (np.zeros(2), np.ones(2))
        low, high = low - 3 / unit[1], high + 3 / unit[1]

        def inside(points: Floats, low: Floats = low, high: Floats = high) -> NDArray[np.bool_]:
            return np.asarray(((points > low) & (points < high)).all(axis=1))

        for tracks, style, name in (
            (before, {"color": ORANGE, "linestyle": "--", "linewidth": 1.2}, "odometry, rigidly placed"),
            (after, {"color": SKY, "marker": ".", "markersize": 4, "linewidth": 1.2}, "frames of the sequence"),
        ):
            for track in tracks:
                kept = np.where(inside(track)[:, None], track, np.nan)
                if np.isfinite(kept).any():
                    plot.plot(*kept.T, label=name, **style)
        for chosen, color, name in ((agrees, GREEN, "agree"), (~agrees, VERMILLION, "are in doubt")):
            drawn = inside(queries) & chosen
            if drawn.any():
                plot.scatter(*queries[drawn].T, s=34, marker="x", c=color, label=f"single queries that {name}")
        for name, marker in (("rescued", "^"), ("broken", "v")):
            points = marks[name] @ flat
            if len(points := points[inside(points)]):
                style = {"facecolors": "none", "edgecolors": "black", "linewidths": 1}
                plot.scatter(*points.T, s=70, marker=marker, label=f"{name}: {len(marks[name])}", **style)
        plot.set_xlabel(labels[0])
        plot.set_aspect("equal", adjustable="datalim")
    plots[0].set_ylabel(labels[1])
    shared_legend(figure, plots, ncols=4, fontsize=8)
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
    """Draw the recall after each step, one panel per threshold: a dot per pair, a bar for their mean.

    Args:
        table: rows of `SequencePair.recalls` with map_device and query_device.
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
        degrees, length = parse_threshold(column)
        plot.set_title(f"recall @ {degrees:g}°, {length:g} {unit_of(column)}", fontsize=10)
    plots[0].set_ylabel("queries [%]")
    figure.suptitle("Recall after each step: mean of all pairs (bars), each pair (dots)")
    return figure
