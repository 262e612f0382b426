"""Compare runs: recall with intervals, queries won and lost, time, memory, and settings that differ.

Everything is read from the files of the runs; no query is localized again.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture
from toolkit.capture.names import allow_outside, extra_devices
from toolkit.errors import COMMAND, ArtifactError, ToolkitError
from toolkit.figures.query_images import MAX_LETTERS, draw_localization, shown_name
from toolkit.figures.style import BLUE, GREEN, ORANGE, SKY, VERMILLION, new_figure, number, percent, styled
from toolkit.files import SceneFiles, require_current, require_whole
from toolkit.geometry import Floats, Ints
from toolkit.report.page import off_by, read_run, seconds_text
from toolkit.results.localized import LocalizedPair
from toolkit.results.metrics import is_below, named_as_meters, named_by_unit, parse_threshold, threshold_text, unit_of
from toolkit.results.pair import SESSIONS_ROOT, how_localized

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESAMPLES, SEED = 2000, 0
INTERVAL = (2.5, 97.5)
"""Percentiles of the resamples that bound an interval."""
ALL = "all"
"""Value of the scene and device columns in rows that sum over all pairs."""
MAX_ROWS = 20
"""Queries won or lost that are listed."""
QUERY = ["scene", "map_device", "query_device", "timestamp", "device_id"]
_PAIR = QUERY[:3]
_ERRORS = ["rotation_error_deg", "translation_error_m"]
_RESULT = ["status", *_ERRORS]
# Manifest keys that differ between any two runs, so they are not compared.
_NAMES = ["name", "description", "output_root"]
_COLORS = (VERMILLION, BLUE, GREEN, ORANGE, SKY)


@dataclass(frozen=True)
class Comparison:
    """Runs compared on the queries that all of them evaluated; the first run is the baseline."""

    folders: Sequence[Path]
    names: Sequence[str]
    """Of the runs; each is different."""
    records: Sequence[Mapping[str, Any]]
    """Content of each `run.json`."""
    thresholds: Sequence[str]
    """Names, such as `(1deg,0.1m)`."""
    queries: pd.DataFrame
    """One row per common query and pair. Columns `QUERY`; `image`, the image name; `status_<i>`,
    `rotation_error_deg_<i>` and `translation_error_m_<i>` of each run i, or `_L_<i>` if the unit is unknown."""
    recall: pd.DataFrame
    """One row per pair, threshold and run, and the same for all pairs together: recall and its difference to the first
    run (0 to 1), each with the `_low` and `_high` of its interval; numbers of queries, won and lost."""
    changes: pd.DataFrame
    """The rows of `queries` that a run won or lost, with the columns run, change, at (thresholds)."""
    settings: pd.DataFrame
    """Settings that differ, by their key; one column per run."""
    resources: pd.DataFrame
    """seconds and memory_mb, by stage and run; the last stage is all of them."""
    messages: Sequence[str]

    def text(self) -> str:
        """Return a short table of all pairs together, with the numbers of queries won and lost."""
        tables, pairs = readable(self), self.queries.groupby(_PAIR).ngroups
        recall = tables["recall"].xs((ALL, ALL), level=["map", "query"]).drop(columns="queries")
        resources = tables["resources"].loc[ALL]
        parts = [f"{len(self.queries)} queries in {pairs} pairs, recall in % [95 %]", recall.to_string()]
        parts += ["time and peak memory; reused results, also those of another run, count as none"]
        parts += [resources.to_string()] + ([self.settings.to_string()] if len(self.settings) else [])
        return "\n".join([*parts, *(f"Note: {message}" for message in self.messages)])

    def _repr_html_(self) -> str:
        tables = readable(self)
        return "".join(tables[name].to_html() for name in ("recall", "settings") if len(tables[name]))

    def summary(self) -> dict[str, Any]:
        """Return the comparison as plain values for scripts, with every pair and every query won or lost."""

        def plain(table: pd.DataFrame) -> list[dict[str, Any]]:  # JSON has neither infinity nor NaN
            return list(json.loads(table.to_json(orient="records", double_precision=15)))

        stages = self.resources.groupby("stage", sort=False)
        return {
            "runs": dict(zip(self.names, map(str, self.folders), strict=True)),
            "queries": len(self.queries),
            "recall": plain(self.recall),
            "changes": plain(self.changes),
            "settings": self.settings.to_dict("index"),
            "resources": {stage: dict(zip(self.names, plain(rows), strict=True)) for stage, rows in stages},
            "messages": list(self.messages),
        }


def compare_runs(run_dirs: Sequence[str | Path], seed: int = SEED, resamples: int = RESAMPLES) -> Comparison:
    """Compare runs with the first of them, on the queries of each pair that all of them evaluated.

    A run wins a query at a threshold if it is within the threshold and the first run is not; it loses a query if the
    first run is within the threshold and it is not. Intervals are paired 95 % percentile bootstrap intervals (Efron
    and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13): every resample takes the same queries from all
    runs. Resamples draw a query that was localized in several maps as one unit, because its poses are not independent.
    If all or none of the queries are within a threshold, the interval has no width; this proves nothing about other
    queries.

    Args:
        run_dirs: run folders, two or more.
        seed: seed of the resamples.
        resamples: number of resamples.

    Raises:
        ArtifactError: a folder is not a run, is not evaluated, has a torn table or no query with ground truth; or the
            runs have no query in common, or their lengths have different units.
    """
    if isinstance(run_dirs, str) or len(run_dirs) < 2:
        raise ArtifactError(f"compare: found {run_dirs!r}, expected a list of two or more run folders.")
    folders, messages = list(map(Path, run_dirs)), list[str]()
    records = [read_run(folder / "run.json") for folder in folders]
    tables = [_read_errors(folder, record) for folder, record in zip(folders, records, strict=True)]
    names = [folder.resolve().name for folder in folders]
    names = [f"{name} ({i})" if names.count(name) > 1 else name for i, name in enumerate(names, 1)]
    limits = [[name.removeprefix("loss@") for name in table if name.startswith("loss@")] for table in tables]
    keys = [*QUERY, *(["sensor_id"] if all("sensor_id" in table for table in tables) else [])]
    unit = unit_of(*limits[0])
    for folder, record, table, limit in zip(folders, records, tables, limits, strict=True):
        if unit_of(*limit) != unit:
            do = "Set the same `unit` for both, and run them again."
            raise ArtifactError.at(folder, f"errors in {unit_of(*limit)}", f"{unit} as in {folders[0]}", do)
        if table.duplicated(keys).any():
            do = "If `at` differs (each camera, each device), evaluate it with the same `at` as the others."
            raise ArtifactError(f"{folder}: evaluation/errors.csv has a query twice, expected one row each. {do}")
        if record["status"] not in ("done", ""):
            messages.append(f"{folder.name} is {record['status']}: {record['error'] or 'it has not ended'}")
        if limit != limits[0]:
            messages.append(f"{folder.name} was evaluated at other thresholds; those of {names[0]} are used.")
    results = [table.set_index(keys)[_RESULT].add_suffix(f"_{i}") for i, table in enumerate(tables)]
    images = tables[0].set_index(keys)[["image"]]
    queries = pd.concat([images, *results], axis="columns", join="inner").reset_index()
    counts = ", ".join(f"{name} {len(table)}" for name, table in zip(names, tables, strict=True))
    if queries.empty:
        do = "Compare runs of the same capture, pairs and queries."
        raise ArtifactError(f"The runs have no query in common ({counts}). {do}")
    if any(len(table) > len(queries) for table in tables):
        messages.append(f"The runs have different queries ({counts}); only the {len(queries)} in common are compared.")
    for scene in queries["scene"].unique():
        if len({str(record["inputs"].get(scene)) for record in records}) > 1:
            messages.append(f"{scene}: its files were changed, moved or copied between the runs.")
    hits = np.zeros((len(queries), len(tables), len(limits[0])), bool)
    for i, k in np.ndindex(hits.shape[1:]):
        turned, moved = queries[[f"{name}_{i}" for name in _ERRORS]].to_numpy(float).T
        hits[:, i, k] = is_below(turned, moved, parse_threshold(limits[0][k]))
    recall, queries = _recall(queries, hits, names, limits[0], seed, resamples), named_by_unit(queries, unit)
    return Comparison(
        *(folders, names, records, limits[0], queries, recall),
        _changes(queries, hits, names, limits[0]),
        _settings({name: record["manifest"] for name, record in zip(names, records, strict=True)}),
        _resources({name: record["stages"] for name, record in zip(names, records, strict=True)}),
        messages,
    )


def bootstrap(
    hits: NDArray[np.bool_], unit: Ints, seed: int = SEED, resamples: int = RESAMPLES
) -> tuple[Floats, Floats]:
    """Return intervals of each run's recall and of its difference to the first run; each (2, R, T), 0 to 1.

    `hits` (Q, R, T) tells whether each query is within each threshold in each run; queries with the same number `unit`
    (Q,) are drawn together.
    """
    count = np.bincount(unit)
    sums = np.zeros((len(count), *hits.shape[1:]))
    np.add.at(sums, unit, hits)
    rng, shares = np.random.default_rng(seed), []
    # In blocks: each resample has a weight for every unit, which takes memory.
    steps = [*range(0, resamples, max(1, 2_000_000 // len(count))), resamples]
    for start, end in pairwise(steps):
        weights = rng.multinomial(len(count), np.full(len(count), 1 / len(count)), size=end - start)
        shares.append(np.tensordot(weights, sums, 1) / (weights @ count)[:, None, None])
    drawn = np.concatenate(shares)
    recall, difference = (np.percentile(shares, INTERVAL, axis=0) for shares in (drawn, drawn - drawn[:, :1]))
    return recall, difference


# Reading


def _read_errors(folder: Path, record: Mapping[str, Any]) -> pd.DataFrame:
    """Return the errors of all queries with ground truth of all scenes of a run, with a column `scene`."""
    paths = {scene: SceneFiles(folder, scene).evaluation / "errors.csv" for scene in map(str, record["scenes"])}
    tables, types = [], {"timestamp": np.int64, "device_id": str, "sensor_id": str, "status": str}
    for scene, path in paths.items():
        if not path.is_file():
            continue
        require_whole(path, of=path.with_name("recall.csv"))
        require_current(path.with_name("recall.csv"), "evaluate")
        try:
            table = named_as_meters(pd.read_csv(path, dtype={**types, **dict.fromkeys(_ERRORS, float)}))
        except (OSError, ValueError, OverflowError) as error:
            raise ArtifactError(f"{path}: not a table of errors ({error}). Run its stage evaluate again.") from None
        lacking = [name for name in (*QUERY[1:], "image", *_RESULT) if name not in table]
        has_losses = any(name.startswith("loss@") for name in table)
        if not lacking and not has_losses and table[_ERRORS].notna().any(axis=None):
            lacking = ["loss@<threshold>"]
        if lacking:
            raise ArtifactError(f"{path}: column {lacking[0]!r} is missing. Run its stage evaluate again.")
        tables.append(table.assign(scene=scene))
    if not tables:
        missing = f"{next(iter(paths.values()))} is missing" if paths else "its run.json names no scene"
        raise ArtifactError(f"{folder}: not evaluated ({missing}). Finish the run: {COMMAND} run MANIFEST.")
    errors = pd.concat(tables, ignore_index=True).dropna(subset=_ERRORS)
    if errors.empty:
        do = "Add ground truth to the query sessions and evaluate again."
        raise ArtifactError.at(folder, "no query with ground truth", "at least one: recall needs true poses", do)
    return errors


# Counting


def _recall(
    queries: pd.DataFrame,
    hits: NDArray[np.bool_],
    names: Sequence[str],
    thresholds: Sequence[str],
    seed: int,
    resamples: int,
) -> pd.DataFrame:
    groups = {**queries.groupby(_PAIR, sort=False).indices, (ALL, ALL, ALL): np.arange(len(queries))}
    index = pd.MultiIndex.from_product([thresholds, names], names=["threshold", "run"])
    tables = {}
    for pair, chosen in groups.items():
        within, first = hits[chosen], hits[chosen][:, :1]
        unit = queries.iloc[chosen].groupby(["scene", "timestamp", "device_id"], sort=False).ngroup().to_numpy()
        recall, difference = bootstrap(within, unit, seed, resamples)
        shares = within.mean(axis=0)
        of_runs = {
            "recall": shares, "recall_low": recall[0], "recall_high": recall[1],
            "difference": shares - shares[0], "difference_low": difference[0], "difference_high": difference[1],
            "won": (within & ~first).sum(axis=0), "lost": (first & ~within).sum(axis=0),
        }  # fmt: skip
        columns = {name: values.T.ravel() for name, values in of_runs.items()}
        tables[pair] = pd.DataFrame({"queries": len(chosen), **columns}, index)
    return pd.concat(tables, names=_PAIR).reset_index()


def _changes(
    queries: pd.DataFrame, hits: NDArray[np.bool_], names: Sequence[str], thresholds: Sequence[str]
) -> pd.DataFrame:
    """List for each run the queries lost, then those won; those that changed at the most thresholds first."""
    parts = []
    for run, name in enumerate(names[1:], 1):
        for change, changed in (("lost", hits[:, 0] & ~hits[:, run]), ("won", ~hits[:, 0] & hits[:, run])):
            order = np.argsort(-changed.sum(axis=1), kind="stable")
            chosen = order[changed[order].any(axis=1)]
            at = ["; ".join(np.array(thresholds)[changed[k]]) for k in chosen]
            parts.append(queries.iloc[chosen].assign(run=name, change=change, at=at))
    return pd.concat(parts, ignore_index=True)


def _settings(manifests: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    """Return the settings that differ between runs, as texts."""
    columns = {name: pd.json_normalize(dict(manifest)).T.astype(str) for name, manifest in manifests.items()}
    table = pd.concat(columns, axis="columns").droplevel(1, axis="columns").drop(_NAMES, errors="ignore").fillna("–")
    if len({bool(manifest.get("demo_data")) for manifest in manifests.values()}) > 1:  # a sweep has rendered the demo
        table = table[~table.index.str.startswith(("captures", "demo_data"))]
    return table[table.nunique(axis="columns") > 1]


def _resources(stages: Mapping[str, Sequence[Mapping[str, Any]]]) -> pd.DataFrame:
    rows = [
        (stage, name, row.get("seconds") or 0.0, row.get("peak_memory_mb") or 0.0)
        for name, of_run in stages.items()
        for row in of_run
        for stage in (str(row.get("stage")), ALL)
    ]
    table = pd.DataFrame(rows, columns=["stage", "run", "seconds", "memory_mb"])
    all_stages = [*(name for name in table["stage"].unique() if name != ALL), ALL]
    every = pd.MultiIndex.from_product([all_stages, stages], names=["stage", "run"])
    return table.groupby(["stage", "run"]).agg({"seconds": "sum", "memory_mb": "max"}).reindex(every)


# Showing


@styled
def draw_differences(comparison: Comparison) -> "Figure":
    """Draw for each pair the difference of recall to the first run, with its interval."""
    others, table = comparison.names[1:], comparison.recall
    pairs = list(table.groupby(_PAIR, sort=False).groups)
    several = table["scene"].nunique() > 2
    labels = ["all pairs" if m == ALL else f"{f'{scene}: ' * several}{q} in {m} map" for scene, m, q in pairs]
    figure = new_figure(3.6 * len(comparison.thresholds) + 1.5, 0.24 * len(pairs) * max(2, len(others)) + 1.4)
    panels = figure.subplots(1, len(comparison.thresholds), sharey=True, sharex=True, squeeze=False)[0]
    for panel, threshold in zip(panels, comparison.thresholds, strict=True):
        for k, run in enumerate(others):
            rows = table[(table["run"] == run) & (table["threshold"] == threshold)]
            middle, low, high = 100 * rows[["difference", "difference_low", "difference_high"]].to_numpy(float).T
            y = np.arange(len(pairs)) + 0.6 * ((k + 1) / (len(others) + 1) - 0.5)
            color = _COLORS[k % len(_COLORS)]
            panel.hlines(y, low, high, color=color, lw=2)
            panel.plot(middle, y, "o", color=color, ms=5, label=run)
        panel.axvline(0, color="0.4", lw=0.8)
        panel.set(title=f"at {threshold_text(threshold)}", xlabel="difference of recall [percentage points]")
        panel.set_yticks(range(len(pairs)), labels)
    panels[0].invert_yaxis()
    lowest, highest = panels[0].get_xlim()
    panels[0].set_xlim(min(lowest, -5), max(highest, 5))  # small differences should look small
    figure.suptitle(f"Recall minus that of {comparison.names[0]}, with intervals of 95 %")
    figure.set_label("Differences of recall, with intervals")
    if len(others) > 1:
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def readable(comparison: Comparison) -> dict[str, pd.DataFrame]:
    """Return the tables as texts: `recall`, `changes`, `resources`, `settings` and `origins`; some may be empty."""
    origins = {
        name: {"folder": str(folder), "created": record["created"], "code": record["code"] or "not known",
               "commit": record["commit"], **record["machine"], **record["versions"]}
        for name, folder, record in zip(comparison.names, comparison.folders, comparison.records, strict=True)
    }  # fmt: skip
    seconds, memory_mb = comparison.resources["seconds"], comparison.resources["memory_mb"]
    return {
        "recall": _readable_recall(comparison),
        "changes": _readable_changes(comparison),
        "resources": pd.DataFrame({"time": seconds.map(seconds_text), "peak memory": memory_mb.map(_memory)}),
        "settings": comparison.settings,
        "origins": pd.DataFrame(origins).fillna("–"),
    }


def _readable_recall(comparison: Comparison) -> pd.DataFrame:
    """List recall in %, with its interval, and the differences in percentage points, one threshold after the other."""
    table = pd.concat(of_limit for _, of_limit in comparison.recall.groupby("threshold", sort=False))
    rows, changes = table.to_dict("records"), ["difference", "won", "lost"]
    table = table.assign(
        at=table["threshold"].map(threshold_text),
        recall=[_interval(row, "recall", percent) for row in rows],
        difference=[_interval(row, "difference", _signed) for row in rows],
    )
    # The first run is compared with itself.
    table[changes] = table[changes].astype(object).where(table["run"] != comparison.names[0], "")
    index = ["at", *(["scene"] if table["scene"].nunique() > 2 else []), "map", "query", "run"]
    table = table.rename(columns={"map_device": "map", "query_device": "query"}).set_index(index)
    return table[["queries", "recall", *changes]]


def _readable_changes(comparison: Comparison) -> pd.DataFrame:
    """List the queries won and lost, or a regular sample of `MAX_ROWS` of them, with the folders of their captures."""
    table, unit = comparison.changes, unit_of(*comparison.thresholds)
    columns = [
        *("run", "change", "at", "pair", f"off in {comparison.names[0]}", "off in the run", "status", "image"),
        "sessions_root",
    ]
    stages = comparison.records[0]["stages"]
    roots = {stage.get("scene"): stage.get("parameters", {}).get("sessions_root") for stage in stages}
    rows = []
    for row in table.loc[_spread(range(len(table)), MAX_ROWS)].to_dict("records"):
        i, pair = comparison.names.index(row["run"]), f"{row['query_device']} in {row['map_device']}"
        off = (off_by(row, after=f"_{k}", unit=unit) for k in (0, i))
        status, at = row[f"status_{i}"].replace("_", " "), _limits(comparison, row["at"])
        root = roots.get(row["scene"])
        rows.append((row["run"], row["change"], at, pair, *off, status, row["image"], root and Path(root)))
    return pd.DataFrame(rows, columns=columns)


def draw_changes(comparison: Comparison, most: int) -> "Iterator[tuple[str, list[tuple[str, Figure]]]]":
    """Draw a regular sample of the queries won and lost; yield a title, and the titles and figures of both runs.

    Without figures, the title says why that query cannot be drawn: the capture has moved, or a run has not kept the
    correspondences. Of each run, there are at most `most`, half of them lost and half won, if there are enough of both.
    """
    table, first = comparison.changes, comparison.names[0]
    for run in comparison.names[1:]:
        lost, won = (table.index[(table["run"] == run) & (table["change"] == change)] for change in ("lost", "won"))
        lost_rows = _spread(lost, max(most // 2, most - len(won)))
        for row in [*lost_rows, *_spread(won, most - len(lost_rows))]:
            change = table.loc[row].to_dict()
            query = f"{change['query_device']} query {shown_name(str(change['image']), MAX_LETTERS)}"
            outcome = f"{change['change']} by {run} at {_limits(comparison, change['at'])}"
            try:
                drawn = [_draw_query(comparison, change, name) for name in (first, run)]
                yield f"{query} in the {change['map_device']} map: {outcome}", drawn
            except (ToolkitError, OSError) as error:
                yield f"No picture of {query}: {error}", []


def _draw_query(comparison: Comparison, query: Mapping[str, Any], run: str) -> "tuple[str, Figure]":
    """Draw a query as a run has localized it, from stored correspondences; return also a title."""
    i = comparison.names.index(run)
    manifest, files = comparison.records[i]["manifest"], SceneFiles(comparison.folders[i], query["scene"])
    with extra_devices(manifest.get("extra_devices", [])), allow_outside(manifest.get("allow_outside", False)):
        devices = query["map_device"], query["query_device"]
        attributes = how_localized(files.poses_csv(*devices).with_suffix(".h5"))[1]
        capture = Capture.from_sessions_root(attributes[SESSIONS_ROOT])
        pair = LocalizedPair.open(capture, *devices, files.poses_dir, files.maps)
        number = pair.results.number((query["timestamp"], query["device_id"]))
        title = f"{run}: {pair.results.table['status_text'].iloc[number]}"
        figure = draw_localization(pair.details(number), title=title, unit=pair.results.unit)
        figure.set_label(f"query {query['timestamp']}, {title}")
        return title, figure


def _spread(rows: Sequence[int], most: int) -> list[int]:
    """Return a regular sample of the rows: neighboring rows belong to one pair and look alike."""
    return [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int))]


def _limits(comparison: Comparison, at: str) -> str:
    names = at.split("; ")
    if len(names) == len(comparison.thresholds) > 1:
        return "every threshold"
    return "; ".join(map(threshold_text, names))


def _signed(share: float) -> str:
    return f"{'+' if share > 0 else '−' if share < 0 else ''}{percent(abs(share))}"


def _interval(row: Mapping[Any, Any], name: str, write: Callable[[float], str]) -> str:
    return f"{write(row[name])} [{write(row[f'{name}_low'])}, {write(row[f'{name}_high'])}]"


def _memory(megabytes: float) -> str:
    return f"{number(megabytes)} MB" if megabytes > 0 else "–"
