"""The tables of an evaluation and their figures; for the sequence stage, recall after each step, and the query
recordings from above.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from toolkit import geometry
from toolkit.capture import Capture, Session, Trajectory
from toolkit.capture.names import color_of, in_order
from toolkit.capture.tables import POSE_NAMES, as_strings, read_query_table
from toolkit.figures.style import (
    GREEN,
    ORANGE,
    SKY,
    VERMILLION,
    new_figure,
    number,
    percent,
    plain_log,
    shared_legend,
    styled,
)
from toolkit.figures.top_view import Ground, Layer, draw_places
from toolkit.files import older_files, pair_name, require_whole, why_older
from toolkit.geometry import Floats
from toolkit.pose.base import Status, statuses
from toolkit.results.metrics import (
    REASONS,
    THRESHOLDS,
    WRONG,
    Threshold,
    is_below,
    is_posed,
    named_as_meters,
    pose_errors,
    small_unit,
    summary_of,
    threshold_name,
    threshold_text,
)
from toolkit.results.pair import PairResults
from toolkit.runs.pairs import LEFT_OUT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)
SINGLE, SEQUENCE = "single", "sequence"
"""Names of the first and the last step."""
CHANGES = ("rescued", "broken")
"""A query is rescued if it is within a threshold only with its sequence; broken if only without."""
_KEY = ["timestamp", "device_id"]
BEYOND = 5
"""Error, in stated deviations, beyond which the stated deviation is too small: no chance explains it."""
MIN_FOR_MEDIANS = 30
"""Poses needed to draw the medians of tenths."""
RELIABILITY_BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)


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
        """Return a file of the stage; raise ArtifactError if it is damaged."""
        path = self.stem.with_name(self.stem.name + end)
        require_whole(path, of=self.path)
        return path

    @cached_property
    def frames(self) -> pd.DataFrame:
        """One row per frame, see `sequence.COLUMNS`."""
        return read_query_table(self._whole("_sequence.csv"), ["recording", "piece", "used"])

    @cached_property
    def steps(self) -> dict[str, Trajectory]:
        """Query poses after each step: `single`, the steps that the stage wrote, and `sequence`."""
        steps = {SINGLE: PairResults.open(f"{self.stem}.txt").trajectory}
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
    """Draw `SequencePair.recalls` after each step: a panel per threshold, a dot per pair, a bar for their mean."""
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


# Evaluation


@dataclass
class Evaluation:
    """The tables of a scene. Every pair has a row, also if it could not be evaluated (column `state`)."""

    recall: pd.DataFrame
    """One row per pair: counts, recall, medians over all queries (a missing pose is infinite), `ok_wrong`."""
    errors: pd.DataFrame
    """One row per query of a pair: errors, status, inliers, and why it misses each threshold."""
    retrieval: pd.DataFrame
    """One row per pair: share of queries with a good reference among the first K, and anywhere in the map."""
    losses: pd.DataFrame
    """One row per pair and threshold: queries missed, by reason."""
    overlap: pd.DataFrame
    """One row per pair: query images, and the share of them that overlap with their first reference in view."""
    thresholds: tuple[Threshold, ...] = THRESHOLDS
    messages: list[str] = field(default_factory=list)
    """What was not evaluated, and why."""
    unit: str = "m"
    """Unit of lengths: `m`, `metrics.UNKNOWN_UNIT`, or `m or L` if the unit of some maps is unknown."""
    sequences: pd.DataFrame = field(default_factory=pd.DataFrame)
    """One row per pair and step of the sequence stage: recall, medians, queries rescued and broken."""
    changes: pd.DataFrame = field(default_factory=pd.DataFrame)
    """One row per query that the sequence stage rescued or broke, with its errors before and after."""

    @property
    def pairs(self) -> pd.DataFrame:
        """The pairs, with the `reason` why a pair was left out."""
        state = self.recall["state"].astype(str)
        left_out = state.str.startswith(LEFT_OUT)
        reason = state.str.removeprefix(LEFT_OUT).where(left_out, "")
        return self.recall[["map_device", "query_device"]].assign(reason=reason)


@styled
def draw_evaluation(evaluation: Evaluation) -> dict[str, "Figure"]:
    """Return the figures of an evaluation by name, except figures without data."""
    figures: dict[str, Figure] = {}
    done, errors, retrieval = map(named_as_meters, (evaluation.recall, evaluation.errors, evaluation.retrieval))
    unit = evaluation.unit
    done = done.dropna(subset=["localized"]) if "localized" in done else done.iloc[:0]
    if len(done):
        small, factor = small_unit(unit)
        names = [name for name in done if name.startswith("recall@")]
        columns = [(name, f"recall @ {threshold_text(name)}", 100.0, "%") for name in names]
        figures["recall"] = draw_matrices(done, columns, "Share of queries localized within the threshold")
        medians = [("median_rotation_deg", "median rotation error", 1.0, "°"),
                   ("median_translation_m", "median translation error", factor, small)]  # fmt: skip
        title = "Median errors over all queries (∞: half of them have no pose)"
        figures["median_errors"] = draw_matrices(done, medians, title)
        figures["error_curves"] = draw_error_curves(errors, evaluation.thresholds, unit)
        if errors["p_correct"].notna().any():
            figures["reliability"] = draw_reliability(errors, unit)
        if _has_deviation(errors).any():
            figures["deviations"] = draw_deviations(errors, unit)
        if evaluation.losses["missed"].sum():
            figures["losses"] = draw_losses(evaluation.losses)
    if len(evaluation.sequences):
        figures["sequence"] = draw_steps(evaluation.sequences)
    if ks := [name for name in retrieval if name.startswith("recall@")]:
        done = retrieval.dropna(subset=ks)
        reach = f"{done['radius_m'].iloc[0]:g} {unit} and {done['angle_deg'].iloc[0]:g}°"
        columns = [(k, f"in the first {k.removeprefix('recall@')}", 100.0, "%") for k in ks]
        columns.append(("in_map", "anywhere in the map", 100.0, "%"))
        figures["retrieval"] = draw_matrices(done, columns, f"Share of queries with a reference within {reach}")
    return figures


@styled
def draw_matrices(table: pd.DataFrame, columns: Sequence[tuple[str, str, float, str]], title: str) -> "Figure":
    """Draw map device x query device matrices side by side: shares, blue where high, or errors, orange where high.

    For each panel, `columns` has the name of a column of the table, its title, factor and unit; % for shares.
    """
    figure = new_figure(3.1 * len(columns) + 0.4, 3.35)
    maps, queries = (in_order(table[c]) for c in ("map_device", "query_device"))
    axes = figure.subplots(1, len(columns), squeeze=False)[0]
    for axis, (column, name, factor, unit) in zip(axes, columns, strict=True):
        values = np.full((len(maps), len(queries)), np.nan)
        for row in table.itertuples():
            i, j = maps.index(row.map_device), queries.index(row.query_device)
            values[i, j] = factor * float(table.at[row.Index, column])
        is_share, finite = unit == "%", values[np.isfinite(values)]
        # At least thrice the median: only values that stand out are dark.
        high = max(float(finite.max()), 3 * float(np.median(finite)), 1e-9) if len(finite) else 1.0
        shade = np.clip(values, 0, 100) / 100 if is_share else np.clip(values, 0, high) / high
        axis.imshow(shade, cmap="Blues" if is_share else "Oranges", vmin=-0.08, vmax=1.25)
        for (i, j), value in np.ndenumerate(values):
            text = percent(value / 100) if is_share else number(value)
            axis.text(j, i, text, ha="center", va="center", fontsize=12,
                      color="white" if shade[i, j] > 0.6 else "black")  # fmt: skip
        for side, devices in ((axis.xaxis, queries), (axis.yaxis, maps)):
            side.set_ticks(range(len(devices)), devices)
            side.set_ticks(np.arange(len(devices) - 1) + 0.5, minor=True)
        axis.set_xlabel("query")
        axis.set_title(f"{name} [{unit}]", fontsize=10)
        axis.tick_params(which="both", length=0)
        axis.grid(which="minor", color="white", lw=2)
        axis.spines[:].set_visible(False)
    axes[0].set_ylabel("map")
    figure.suptitle(title)
    return figure


@styled
def draw_error_curves(errors: pd.DataFrame, thresholds: Sequence[Threshold] = THRESHOLDS, unit: str = "m") -> "Figure":
    """Draw cumulative distributions of the errors: one column per query device, one curve per map device.

    A curve ends at the share of queries that have a pose. Dotted lines are the recall thresholds.
    """
    queries, maps = in_order(errors["query_device"]), in_order(errors["map_device"])
    figure = new_figure(3.6 * len(queries) + 0.8, 6.0)
    axes = figure.subplots(2, len(queries), squeeze=False, sharey=True, sharex="row")
    labels = {"translation_error_m": f"translation error [{unit}]", "rotation_error_deg": "rotation error [°]"}
    for row, (column, label) in enumerate(labels.items()):
        finite = errors[column].to_numpy(float)
        finite = np.maximum(finite[np.isfinite(finite)], 1e-4)
        marks = sorted({threshold[1 - row] for threshold in thresholds})
        low, high = min([*finite, *marks]), max([*finite, *marks])
        for axis, query in zip(axes[row], queries, strict=True):
            for mapped in maps:
                values = errors.loc[(errors.query_device == query) & (errors.map_device == mapped), column]
                if not len(values):
                    continue
                ascending = np.sort(values[np.isfinite(values)].to_numpy(float).clip(1e-4))
                share = 100 * np.arange(len(ascending) + 1) / len(values)
                axis.step([low / 2, *ascending, high * 2], [*share, share[-1]], where="post", lw=1.8,
                          color=color_of(mapped), label=f"{mapped} map")  # fmt: skip
            for mark in marks:
                axis.axvline(mark, color="0.45", lw=0.9, ls=":", label="thresholds" if mark == marks[0] else None)
            axis.set(xscale="log", xlim=(low / 1.5, high * 1.5), ylim=(0, 102), xlabel=label)
            plain_log(axis, "x")
            axis.grid(alpha=0.25)
            if row == 0:
                axis.set_title(f"{query} queries", fontsize=10)
        axes[row, 0].set_ylabel("queries below [%]")
    axes[0, 0].legend(frameon=False, fontsize=9)
    figure.suptitle("How many queries have an error below x")
    return figure


@styled
def draw_reliability(errors: pd.DataFrame, unit: str = "m") -> "Figure":
    """Draw the share of right poses (within `WRONG`) against the probability that the localizer states.

    Bars are 95 % intervals (Wilson, 1927); numbers count the poses.
    """
    errors = errors[errors["p_correct"].notna()]
    right = is_below(errors["rotation_error_deg"].to_numpy(), errors["translation_error_m"].to_numpy(), WRONG)
    stated = errors["p_correct"].to_numpy(float)
    bin_of = np.digitize(stated, RELIABILITY_BINS[1:-1])
    figure = new_figure(5.2, 4.6)
    axis = figure.subplots()
    axis.plot([0, 100], [0, 100], color="0.6", lw=1, ls=":", label="as stated")
    for k in np.unique(bin_of):
        in_bin = bin_of == k
        count, share, x = int(in_bin.sum()), float(right[in_bin].mean()), 100 * stated[in_bin].mean()
        low, high = wilson_interval(share, count)
        reach = [[100 * max(share - low, 0)], [100 * max(high - share, 0)]]
        axis.errorbar(x, 100 * share, reach, fmt="o", color=SKY, capsize=3)
        place: dict[str, Any] = {"xytext": (-6, -10), "ha": "right"} if x > 90 else {"xytext": (6, -10), "ha": "left"}
        axis.annotate(str(count), (x, 100 * share), textcoords="offset points", fontsize=8, color="0.3", **place)
    axis.set(xlim=(-3, 103), ylim=(-3, 103))
    axis.set(xlabel="stated probability of being right [%]", ylabel="poses that are right [%]")
    figure.legend(loc="outside lower center", frameon=False, fontsize=8)
    axis.grid(alpha=0.25)
    right_is = threshold_text(threshold_name(WRONG, unit))
    figure.suptitle(f"Stated and actual probability of being right (right: {right_is})")
    return figure


@styled
def draw_deviations(errors: pd.DataFrame, unit: str = "m") -> "Figure":
    """Draw the position errors against the standard deviations that the localizer states.

    With enough poses, a line joins the medians of tenths of the poses. If the stated deviations are right and errors
    are Gaussian, the medians lie a little below the stated deviation, and hardly any pose is above the upper line.
    """
    errors = errors[_has_deviation(errors)]
    stated, actual = (errors[name].to_numpy(float).clip(1e-5) for name in ("position_std_m", "translation_error_m"))
    ok = (statuses(errors["status"]) == Status.OK).to_numpy(bool)
    figure = new_figure(5.2, 4.6)
    axis = figure.subplots()
    low, high = min(stated.min(), actual.min()) / 1.5, max(stated.max(), actual.max()) * 1.5
    axis.plot([low, high], [low, high], color="0.6", lw=1, ls=":", label="error = stated deviation")
    axis.plot([low, high], [BEYOND * low, BEYOND * high], color="0.6", lw=1, ls="--", label=f"{BEYOND} times that")
    for chosen, name, color in ((ok, "ok", SKY), (~ok, "low confidence", ORANGE)):
        if chosen.any():
            beyond = float(np.mean(actual[chosen] > BEYOND * stated[chosen]))
            label = f"{name}: {chosen.sum()}, {percent(beyond)} % above"
            axis.plot(stated[chosen], actual[chosen], "o", ms=3.5, alpha=0.5, mew=0, color=color, label=label)
    if len(stated) >= MIN_FOR_MEDIANS:
        tenths = np.array_split(np.argsort(stated), 10)
        medians = np.array([(np.median(stated[tenth]), np.median(actual[tenth])) for tenth in tenths])
        axis.plot(*medians.T, color="0.15", lw=1.5, marker="o", ms=3, label="medians of tenths of the poses")
    axis.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    plain_log(axis, "xy")
    axis.set(xlabel=f"stated standard deviation of the position [{unit}]", ylabel=f"position error [{unit}]")
    axis.grid(alpha=0.25)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    figure.suptitle("Stated and actual deviation of the position")
    return figure


def _has_deviation(errors: pd.DataFrame) -> pd.Series:
    """Return which rows have an error and a stated deviation; the latter is infinite if the scale is unknown."""
    return errors["position_std_m"].between(0, np.inf, "neither") & np.isfinite(errors["translation_error_m"])


def wilson_interval(share: float, count: int, z: float = 1.96) -> tuple[float, float]:
    """Return the Wilson interval (1927) of a share observed in `count` trials; `z`: half width, standard deviations."""
    middle = share + z**2 / (2 * count)
    half = z * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return float((middle - half) / (1 + z**2 / count)), float((middle + half) / (1 + z**2 / count))


@styled
def draw_losses(losses: pd.DataFrame) -> "Figure":
    """Draw the share of missed queries of each pair by reason, one panel per threshold."""
    losses = losses.dropna(subset=["threshold"])
    thresholds = list(dict.fromkeys(losses["threshold"]))
    pairs = list(dict.fromkeys(zip(losses["map_device"], losses["query_device"], strict=True)))
    widest = max(10.0, 115 * float((losses["missed"] / losses["queries"]).max()))
    figure = new_figure(3.3 * len(thresholds) + 1.2, 0.3 * len(pairs) + 1.7)
    axes = figure.subplots(1, len(thresholds), squeeze=False, sharey=True, sharex=True)[0]
    for axis, threshold in zip(axes, thresholds, strict=True):
        rows = losses[losses["threshold"] == threshold].set_index(["map_device", "query_device"]).loc[pairs]
        left = np.zeros(len(rows))
        for reason, color in zip(REASONS, (SKY, ORANGE, VERMILLION), strict=True):
            share = 100 * (rows[reason] / rows["queries"]).to_numpy(float)
            axis.barh(range(len(rows)), share, left=left, color=color, label=reason, height=0.72)
            left += share
        for y, value in enumerate(left):
            axis.text(value + 0.012 * widest, y, f"{value:.0f}", va="center", fontsize=8, color="0.3")
        axis.set(xlim=(0, widest), xlabel="queries [%]")
        axis.set_title(f"missed @ {threshold_text(threshold)}", fontsize=10)
        axis.grid(axis="x", alpha=0.25)
    axes[0].set_yticks(range(len(pairs)), [f"{q} in {m} map" for m, q in pairs])
    axes[0].invert_yaxis()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.suptitle("Where accuracy was lost")
    return figure
