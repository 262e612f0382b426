"""Compare runs: recall with intervals, queries won and lost, time, memory, and settings that differ.

Everything is read from the files of the runs; no query is localized again.
"""

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from toolkit.capture import Capture
from toolkit.capture.devices import extra_devices
from toolkit.capture.names import allow_outside
from toolkit.errors import ArtifactError, ToolkitError
from toolkit.files import SceneFiles, require_current, require_whole, write_text
from toolkit.geometry import Floats, Ints
from toolkit.show.figures import BLUE, GREEN, ORANGE, SKY, VERMILLION, new_figure, number, percent, save_figure, styled
from toolkit.show.localized import LocalizedPair
from toolkit.show.metrics import is_below, named_as_meters, parse_threshold, unit_of
from toolkit.show.report import (
    PICTURE_BUDGET,
    Album,
    Cell,
    Picture,
    Table,
    off_by,
    page_template,
    read_run,
    seconds_text,
    threshold_text,
)
from toolkit.show.stills import draw_localization

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESAMPLES, SEED = 2000, 0
INTERVAL = (2.5, 97.5)
"""Percentiles of the resamples that bound an interval."""
ALL = "all"
"""Value of the scene and device columns in rows that sum over all pairs."""
MOST_PICTURES, MOST_ROWS = 4, 20
"""Queries won or lost that the page draws, and that it lists."""
MOST_LETTERS = 32
"""Length of an image name beyond which the page shows only the file name."""
QUERY = ["scene", "map_device", "query_device", "timestamp", "device_id"]
_PAIR = QUERY[:3]
_ERRORS = ["rotation_error_deg", "translation_error_m"]
_NEEDED = [*QUERY[1:], "status", *_ERRORS]
# Manifest keys that differ between any two runs, so they are not compared.
_NAMES = ("name", "description", "output_root")
_COLORS = (VERMILLION, BLUE, GREEN, ORANGE, SKY)


@dataclass(frozen=True)
class Comparison:
    """Runs compared on the queries that all of them evaluated; the first run is the baseline."""

    folders: Sequence[Path]
    names: Sequence[str]
    records: Sequence[Mapping[str, Any]]
    """Content of each `run.json`."""
    thresholds: Sequence[str]
    """Names, such as `(1deg,0.1m)`."""
    queries: pd.DataFrame
    """One row per common query and pair. Columns `QUERY`; `status_<i>`, `rotation_error_deg_<i>` and
    `translation_error_m_<i>` of each run i; `image`, the image name, unless the runs are too old to have it."""
    recall: pd.DataFrame
    """One row per pair, threshold and run, and the same for all pairs together: recall and its difference to the first
    run (0 to 1), each with the `_low` and `_high` of its interval; numbers of queries, won and lost."""
    changes: pd.DataFrame
    """One row per query that a run won or lost. Columns `QUERY`; run (its number), change, at (thresholds)."""
    settings: pd.DataFrame
    """Settings that differ: key, and one column per run."""
    resources: pd.DataFrame
    """One row per stage, and one for all stages: stage; `seconds_<i>` and `memory_mb_<i>` of each run i."""
    messages: Sequence[str] = field(default_factory=list)

    def text(self) -> str:
        """Return a short table of all pairs together, with the numbers of queries won and lost."""
        rows = self.recall[self.recall["scene"] == ALL]
        width = max(map(len, self.names))
        lines = [f"{len(self.queries)} queries in {self.queries.groupby(_PAIR).ngroups} pairs, recall in % [95 %]"]
        for threshold, group in rows.groupby("threshold", sort=False):
            lines.append(f"at {threshold_text(str(threshold))}")
            for row in group.to_dict("records"):
                line = f"  {self.names[row['run']]:<{width}}  {_interval(row, 'recall')}"
                if row["run"]:
                    line += f"   {_interval(row, 'difference')}   {row['won']} won, {row['lost']} lost"
                lines.append(line)
        lines.append("time and peak memory; reused results, also those of another run, count as none")
        total = self.resources.iloc[-1]
        for i, name in enumerate(self.names):
            seconds, memory = seconds_text(total[f"seconds_{i}"]), _memory(total[f"memory_mb_{i}"])
            lines.append(f"  {name:<{width}}  {seconds}, {memory}")
        for row in self.settings.to_dict("records"):
            lines.append(f"{row['key']}: " + " | ".join(row[f"run_{i}"] for i in range(len(self.names))))
        return "\n".join([*lines, *(f"Note: {message}" for message in self.messages)])

    def summary(self) -> dict[str, Any]:
        """Return the comparison as plain values for scripts, with every pair and every query won or lost."""
        changes = self.changes.assign(run=[self.names[i] for i in self.changes["run"]])
        recall = self.recall.assign(run=[self.names[i] for i in self.recall["run"]])
        tables = {"recall": recall, "changes": changes, "resources": self.resources}
        finite = {name: table.replace(np.inf, np.nan) for name, table in tables.items()}  # JSON has no infinity
        plain = {name: table.astype(object).where(table.notna(), None) for name, table in finite.items()}
        return {
            "runs": dict(zip(self.names, map(str, self.folders), strict=True)),
            "queries": len(self.queries),
            **{name: plain[name].to_dict("records") for name in ("recall", "changes")},
            "settings": self.settings.set_index("key").set_axis(self.names, axis="columns").to_dict("index"),
            "resources": {
                row["stage"]: {
                    name: {column: row[f"{column}_{i}"] for column in ("seconds", "memory_mb")}
                    for i, name in enumerate(self.names)
                }
                for row in plain["resources"].to_dict("records")
            },
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
    folders = [] if isinstance(run_dirs, str) else list(map(Path, run_dirs))
    if len(folders) < 2:
        given = run_dirs if isinstance(run_dirs, str) else [str(folder) for folder in folders]
        raise ArtifactError(f"compare: found {given!r}, expected a list of two or more run folders.")
    records = [read_run(folder / "run.json") for folder in folders]
    tables = [_read_errors(folder, record) for folder, record in zip(folders, records, strict=True)]
    names, messages = _names(folders), list[str]()
    limits = [_thresholds(table) for table in tables]
    units = [unit_of(*names_of) for names_of in limits]
    for folder, record, unit, limit in zip(folders, records, units, limits, strict=True):
        if unit != units[0]:
            raise ArtifactError(
                f"{folder}: found errors in {unit}, expected {units[0]} as in {folders[0]}. Set the same `unit` for "
                "both, and run them again."
            )
        if record["status"] not in ("done", ""):
            messages.append(f"{folder.name} is {record['status']}: {record['error'] or 'it has not ended'}")
        if limit != limits[0]:
            messages.append(f"{folder.name} was evaluated at other thresholds; those of {names[0]} are used.")
    keys = [*QUERY, *(["sensor_id"] if all("sensor_id" in table for table in tables) else [])]
    for folder, table in zip(folders, tables, strict=True):
        if table.duplicated(keys).any():
            raise ArtifactError(
                f"{folder}: evaluation/errors.csv has a query twice, expected one row each. Perhaps this run was "
                "evaluated at each camera and the others at each device; evaluate it with the same `at` as the others."
            )
    queries = tables[0][[*keys, *({"image"} & {*tables[0]})]]
    for table in tables[1:]:
        queries = queries.merge(table[keys], on=keys)
    counts = ", ".join(f"{name} {len(table)}" for name, table in zip(names, tables, strict=True))
    if queries.empty:
        raise ArtifactError(
            f"The runs have no query in common ({counts}). Compare runs of the same capture, pairs and queries."
        )
    if any(len(table) > len(queries) for table in tables):
        messages.append(f"The runs have different queries ({counts}); only the {len(queries)} in common are compared.")
    for scene in queries["scene"].unique():
        if len({str(record["inputs"].get(scene)) for record in records}) > 1:
            messages.append(f"{scene}: its files were changed, moved or copied between the runs.")
    for i, table in enumerate(tables):
        columns = {name: f"{name}_{i}" for name in ("status", *_ERRORS)}
        queries = queries.merge(table[[*keys, *columns]].rename(columns=columns), on=keys)
    hits = _hits(queries, len(tables), limits[0])
    return Comparison(
        *(folders, names, records, limits[0], queries),
        _recall(queries, hits, limits[0], seed, resamples),
        _changes(queries, hits, limits[0]),
        _settings([record["manifest"] for record in records]),
        _resources([record["stages"] for record in records]),
        messages,
    )


def bootstrap(
    hits: NDArray[np.bool_], unit: Ints, seed: int = SEED, resamples: int = RESAMPLES
) -> tuple[Floats, Floats]:
    """Return intervals of each run's recall and of its difference to the first run; each (2, R, T), 0 to 1.

    Args:
        hits: (Q, R, T), whether each query is within each threshold in each run.
        unit: (Q,) numbers from 0; queries of the same number are drawn together.
        seed: seed of the resamples.
        resamples: number of resamples.
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
    tables, missing = [], []
    for scene in map(str, record["scenes"]):
        path = SceneFiles(folder, scene).evaluation / "errors.csv"
        if not path.is_file():
            missing.append(str(path))
            continue
        require_whole(path, of=path.with_name("recall.csv"))
        require_current(path.with_name("recall.csv"), "evaluate")
        try:
            types = {"timestamp": np.int64, "device_id": str, "sensor_id": str, "status": str}
            table = pd.read_csv(path, dtype={**types, **dict.fromkeys(_ERRORS, float)})
        except (OSError, ValueError, OverflowError) as error:
            raise ArtifactError(f"{path}: not a table of errors ({error}). Run its stage evaluate again.") from None
        table = named_as_meters(table)
        if lacking := [name for name in _NEEDED if name not in table]:
            raise ArtifactError(f"{path}: column {lacking[0]!r} is missing. Run its stage evaluate again.")
        tables.append(table.assign(scene=scene))
    if not tables:
        raise ArtifactError(
            f"{folder}: not evaluated ({missing[0]} is missing). Finish the run: python -m toolkit run MANIFEST."
            if missing
            else f"{folder}: found no scene in run.json, expected the scenes of a run. Run its manifest again."
        )
    errors = pd.concat(tables, ignore_index=True)
    errors = errors[errors[_ERRORS].notna().all(axis=1)]
    if errors.empty:
        raise ArtifactError(
            f"{folder}: found no query with ground truth, expected at least one: recall needs true poses. Add ground "
            "truth to the query sessions and evaluate again."
        )
    return errors


def _thresholds(table: pd.DataFrame) -> list[str]:
    thresholds = [name.removeprefix("loss@") for name in table.columns if name.startswith("loss@")]
    if not thresholds:
        raise ArtifactError("errors.csv: a column `loss@...`, which names a threshold, is missing. Evaluate again.")
    return thresholds


def _names(folders: Sequence[Path]) -> list[str]:
    """Return a short, unique name for each run."""
    paths = [folder.resolve() for folder in folders]
    ambiguous = {path.name for path in paths if len({other for other in paths if other.name == path.name}) > 1}
    names = [f"{path.parent.name}/{path.name}" if path.name in ambiguous else path.name for path in paths]
    return [f"{name} ({names[:i].count(name) + 1})" if name in names[:i] else name for i, name in enumerate(names)]


# Counting


def _hits(queries: pd.DataFrame, runs: int, thresholds: Sequence[str]) -> NDArray[np.bool_]:
    """Return whether each query is within each threshold in each run, (Q, R, T)."""
    errors = [[queries[f"{name}_{i}"].to_numpy(float) for name in _ERRORS] for i in range(runs)]
    hits = [[is_below(degrees, meters, parse_threshold(name)) for name in thresholds] for degrees, meters in errors]
    return np.asarray(np.moveaxis(np.array(hits, bool), 2, 0))


def _recall(
    queries: pd.DataFrame, hits: NDArray[np.bool_], thresholds: Sequence[str], seed: int, resamples: int
) -> pd.DataFrame:
    rows_of_pair = queries.groupby(_PAIR, sort=False).indices
    everything = np.arange(len(queries))
    rows: list[dict[str, Any]] = []
    for pair, chosen in [*rows_of_pair.items(), ((ALL, ALL, ALL), everything)]:
        within, first = hits[chosen], hits[chosen][:, :1]
        unit = queries.iloc[chosen].groupby(["scene", "timestamp", "device_id"], sort=False).ngroup().to_numpy()
        recall, difference = bootstrap(within, unit, seed, resamples)
        shares = within.mean(axis=0)
        won, lost = (within & ~first).sum(axis=0), (first & ~within).sum(axis=0)
        rows += [
            {
                **dict(zip(_PAIR, pair, strict=True)),
                "threshold": threshold,
                "run": run,
                "queries": len(chosen),
                "recall": shares[run, t],
                "recall_low": recall[0, run, t],
                "recall_high": recall[1, run, t],
                "difference": shares[run, t] - shares[0, t],
                "difference_low": difference[0, run, t],
                "difference_high": difference[1, run, t],
                "won": int(won[run, t]),
                "lost": int(lost[run, t]),
            }
            for t, threshold in enumerate(thresholds)
            for run in range(hits.shape[1])
        ]
    return pd.DataFrame(rows)


def _changes(queries: pd.DataFrame, hits: NDArray[np.bool_], thresholds: Sequence[str]) -> pd.DataFrame:
    """List for each run the queries lost, then those won; those that changed at the most thresholds first."""
    parts = []
    for run in range(1, hits.shape[1]):
        for change, changed in (("lost", hits[:, 0] & ~hits[:, run]), ("won", ~hits[:, 0] & hits[:, run])):
            order = np.argsort(-changed.sum(axis=1), kind="stable")
            chosen = order[changed[order].any(axis=1)]
            at = ["; ".join(name for name, yes in zip(thresholds, changed[k], strict=True) if yes) for k in chosen]
            parts.append(queries.iloc[chosen].assign(run=run, change=change, at=at))
    return pd.concat(parts, ignore_index=True)


def _settings(manifests: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the settings that differ between runs."""
    flat = [dict(_leaves(manifest)) for manifest in manifests]
    keys = [key for key in dict.fromkeys(key for leaves in flat for key in leaves) if key not in _NAMES]
    texts = [[str(leaves[key]) if key in leaves else "–" for leaves in flat] for key in keys]
    rows = [[key, *values] for key, values in zip(keys, texts, strict=True) if len(set(values)) > 1]
    return pd.DataFrame(rows, columns=["key", *(f"run_{i}" for i in range(len(manifests)))])


def _leaves(tree: Mapping[str, Any], above: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _resources(stages: Sequence[Sequence[Mapping[str, Any]]]) -> pd.DataFrame:
    names = dict.fromkeys(str(row.get("stage")) for rows in stages for row in rows)
    table = []
    for name in (*names, ALL):
        line: dict[str, Any] = {"stage": name}
        for i, rows in enumerate(stages):
            stage_rows = [row for row in rows if name in (ALL, row.get("stage"))]
            line[f"seconds_{i}"] = sum(_measured(row, "seconds") for row in stage_rows) if stage_rows else math.nan
            line[f"memory_mb_{i}"] = max((_measured(row, "peak_memory_mb") for row in stage_rows), default=math.nan)
        table.append(line)
    return pd.DataFrame(table)


def _measured(row: Mapping[str, Any], name: str) -> float:
    """Return a number from a stage's row; 0 if it has none."""
    value = row.get(name)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else 0.0


# Showing


@styled
def draw_differences(comparison: Comparison) -> "Figure":
    """Draw for each pair the difference of recall to the first run, with its interval."""
    table = comparison.recall[comparison.recall["run"] > 0]
    pairs = list(dict.fromkeys(map(tuple, table[_PAIR].to_numpy())))
    several = table["scene"].nunique() > 2
    labels = [
        "all pairs" if pair[0] == ALL else f"{f'{pair[0]}: ' * several}{pair[2]} in {pair[1]} map" for pair in pairs
    ]
    runs = range(1, len(comparison.names))
    figure = new_figure(3.6 * len(comparison.thresholds) + 1.5, 0.24 * len(pairs) * max(2, len(runs)) + 1.4)
    panels = np.ravel(figure.subplots(1, len(comparison.thresholds), sharey=True, sharex=True, squeeze=False))
    for panel, threshold in zip(panels, comparison.thresholds, strict=True):
        for run in runs:
            rows = table[(table["run"] == run) & (table["threshold"] == threshold)]
            middle, low, high = (
                100 * rows[name].to_numpy(float) for name in ("difference", "difference_low", "difference_high")
            )
            y = np.arange(len(pairs)) + 0.6 * (run / (len(comparison.names)) - 0.5)
            color = _COLORS[(run - 1) % len(_COLORS)]
            panel.hlines(y, low, high, color=color, lw=2)
            panel.plot(middle, y, "o", color=color, ms=5, label=comparison.names[run])
        panel.axvline(0, color="0.4", lw=0.8)
        panel.set(title=f"at {threshold_text(threshold)}", xlabel="difference of recall [percentage points]")
        panel.set_yticks(range(len(pairs)), labels)
    panels[0].invert_yaxis()
    lowest, highest = panels[0].get_xlim()
    panels[0].set_xlim(min(lowest, -5), max(highest, 5))  # small differences should look small
    figure.suptitle(f"Recall minus that of {comparison.names[0]}, with intervals of 95 %")
    if len(runs) > 1:
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def readable(comparison: Comparison) -> dict[str, pd.DataFrame]:
    """Return the tables of the page as text: `recall`, `changes`, `resources` and `settings`; some may be empty."""
    recall = {threshold_text(name): _frame(_recall_table(comparison, name)) for name in comparison.thresholds}
    makers = {"changes": _changes_table, "resources": _resources_table, "settings": _settings_table}
    tables = {name: _frame(make(comparison)) for name, make in makers.items()}
    return {"recall": pd.concat(recall, names=["at"]), **tables}


def _frame(table: Table | None) -> pd.DataFrame:
    if table is None:
        return pd.DataFrame()
    frame = pd.DataFrame([[cell.text for cell in row] for row in table.rows], columns=table.columns)
    return frame.set_index(table.columns[0])


def draw_change(comparison: Comparison, row: int) -> "list[tuple[str, Figure]]":
    """Draw a query that was won or lost, as localized by the first run and by the other, from stored correspondences.

    Args:
        row: row of `comparison.changes`.

    Returns:
        A title and a figure for each of the two runs.

    Raises:
        ToolkitError: the capture has moved, or a run has not kept the correspondences.
    """
    change = comparison.changes.iloc[row]
    drawn = []
    for i in (0, int(change["run"])):
        record, files = comparison.records[i], SceneFiles(comparison.folders[i], change["scene"])
        manifest = record["manifest"]
        with extra_devices(manifest.get("extra_devices", [])), allow_outside(manifest.get("allow_outside", False)):
            capture = Capture.open(_capture_of(record, change["scene"], comparison.folders[i]))
            devices = change["map_device"], change["query_device"]
            pair = LocalizedPair.open(capture, *devices, files.poses_dir, files.maps)
            with closing(pair.queries):
                same = (pair.table[["timestamp", "device_id"]] == change[["timestamp", "device_id"]]).all(axis=1)
                if not same.any():
                    raise ArtifactError(f"{files.poses_dir / pair.name}.csv: no row of query {change['timestamp']}.")
                k = int(np.flatnonzero(same)[0])
                title = f"{comparison.names[i]}: {pair.table['status'].iloc[k]}"
                drawn.append((title, draw_localization(pair.details(k), title=title, unit=pair.unit)))
    return drawn


def _capture_of(record: Mapping[str, Any], scene: str, folder: Path) -> Path:
    """Return the folder of a scene's capture from the record of a run."""
    for row in record["stages"]:
        root = (row.get("parameters") or {}).get("sessions_root")
        if row.get("scene") == scene and root and Path(root).is_dir():
            return Path(root).parent
    raise ArtifactError(f"{folder}: the capture {scene} is no longer where the run read it, so no query can be drawn.")


def write_comparison(comparison: Comparison, path: str | Path | None = None, pictures: int = MOST_PICTURES) -> Path:
    """Write the page of a comparison, one self-contained file, and return its path.

    Args:
        path: HTML file; None: `compare_<names>.html` beside the first run.
        pictures: number of queries won or lost to draw for each run; 0 draws none.
    """
    if path is None:
        stem = "_".join(name.replace("/", "-") for name in comparison.names)
        if len(stem) > 100:
            stem = f"{comparison.names[0].replace('/', '-')}_and_{len(comparison.names) - 1}_more"
        path = comparison.folders[0].resolve().parent / f"compare_{stem}.html"
    names, messages, looks = comparison.names, list(comparison.messages), list[tuple[str, list[Picture]]]()
    with tempfile.TemporaryDirectory() as folder:
        album = Album(Path(folder), PICTURE_BUDGET, [])

        def picture(drawn: "Figure", title: str, caption: str = "") -> Picture:
            path = save_figure(drawn, Path(folder) / "picture.png")
            return replace(album.picture(path, title, caption), path="")  # the file is temporary

        caption = "Right of the line a run is better than the first; an interval that crosses it may be chance."
        figure = picture(draw_differences(comparison), "Differences", caption)
        for title, drawn in draw_changes(comparison, pictures):
            shown = [picture(of_run, name) for name, of_run in drawn]
            if not drawn:
                messages.append(title)
            elif all(one.data for one in shown):
                looks.append((title, shown))
    page = page_template("comparison.html.j2").render(
        run={"name": f"{names[1] if len(names) == 2 else f'{len(names) - 1} runs'} against {names[0]}"},
        folders=list(zip(names, map(str, comparison.folders), comparison.records, strict=True)),
        messages=messages,
        tiles=_tiles(comparison),
        recall=[_recall_table(comparison, name) for name in comparison.thresholds],
        figure=figure,
        changes=_changes_table(comparison),
        looks=looks,
        resources=_resources_table(comparison),
        settings=_settings_table(comparison),
    )
    write_text(path, page)
    return Path(path)


def draw_changes(
    comparison: Comparison, most: int = MOST_PICTURES
) -> "Iterator[tuple[str, list[tuple[str, Figure]]]]":
    """Draw a regular sample of the queries won and lost; yield a title, and the titles and figures of both runs.

    Without figures, the title says why that query cannot be drawn.

    Args:
        most: number of queries of each run; half of them lost and half won, if there are enough of both.
    """
    table = comparison.changes
    for run in range(1, len(comparison.names)):
        rows = [table.index[(table["run"] == run) & (table["change"] == change)].tolist() for change in ("lost", "won")]
        half = max(most // 2, most - len(rows[1]))
        lost = _spread(rows[0], half)
        for row in [*lost, *_spread(rows[1], most - len(lost))]:
            change = table.loc[row]
            query = f"{change['query_device']} query {_name(change)}"
            outcome = f"{change['change']} by {comparison.names[run]} at {_limits(comparison, change['at'])}"
            try:
                yield f"{query} in the {change['map_device']} map: {outcome}", draw_change(comparison, row)
            except (ToolkitError, OSError) as error:
                yield f"No picture of {query}: {error}", []


def _name(change: "pd.Series[Any] | Mapping[str, Any]") -> str:
    """Return the name of a query: its image name, shortened to the file name if long; else its timestamp."""
    image = change.get("image")
    name = image if isinstance(image, str) else str(change["timestamp"])
    return name if len(name) <= MOST_LETTERS else f"…/{name.rpartition('/')[2]}"


def _spread(rows: Sequence[int], most: int) -> list[int]:
    """Return a regular sample of the rows: neighboring rows belong to one pair and look alike."""
    return [rows[k] for k in np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int))]


def _limits(comparison: Comparison, at: str) -> str:
    names = at.split("; ")
    if len(names) == len(comparison.thresholds) > 1:
        return "every threshold"
    return "; ".join(map(threshold_text, names))


def _tiles(comparison: Comparison) -> list[tuple[str, str]]:
    rows = comparison.recall[(comparison.recall["scene"] == ALL) & (comparison.recall["run"] > 0)]
    tiles = []
    shown = comparison.thresholds if len(comparison.names) == 2 else comparison.thresholds[:1]
    for row in rows[rows["threshold"].isin(shown)].to_dict("records"):
        where = f"{comparison.names[row['run']]} at {threshold_text(row['threshold'])}"
        text = f"points of recall [{_bounds(row, 'difference')}], {row['won']} won and {row['lost']} lost: {where}"
        tiles.append((_signed(row["difference"]), text))
    return tiles


def _recall_table(comparison: Comparison, threshold: str) -> Table:
    """List the recall of two runs side by side, or of more runs in one row each, so that any number fits the page."""
    row_per_run = len(comparison.names) > 2
    columns = ["map", "query", "queries", *(["run", "recall"] if row_per_run else comparison.names)]
    columns += ["difference", "won", "lost"]
    rows = []
    chosen = comparison.recall[comparison.recall["threshold"] == threshold]
    for pair, group in chosen.groupby(_PAIR, sort=False):
        by_run = group.to_dict("records")
        several = chosen["scene"].nunique() > 2 and pair[0] != ALL
        cells = [f"{pair[0]} {pair[1]}" if several else pair[1], pair[2], by_run[0]["queries"]]
        recalls = [Cell(_interval(row, "recall"), 0.9 * row["recall"]) for row in by_run]
        changes = [[_interval(row, "difference"), row["won"], row["lost"]] for row in by_run]
        changes[0] = [""] * 3  # the first run is compared with itself
        if row_per_run:
            named = zip(comparison.names, recalls, changes, strict=True)
            rows += [[*cells, name, recall, *change] for name, recall, change in named]
        else:
            rows.append([*cells, *recalls, *changes[1]])
    caption = f"Recall at {threshold_text(threshold)} in %, and its differences in percentage points"
    return Table(caption, columns, rows)


def _changes_table(comparison: Comparison) -> Table | None:
    """List the queries won and lost; None if there are none."""
    table, unit = comparison.changes, unit_of(*comparison.thresholds)
    if table.empty:
        return None
    rows = []
    several = len(comparison.names) > 2
    for row in table.loc[_spread(range(len(table)), MOST_ROWS)].to_dict("records"):
        i = row["run"]
        texts = [comparison.names[i]] if several else []
        texts += [row["change"], _limits(comparison, row["at"]), f"{row['query_device']} in {row['map_device']} map"]
        texts += [off_by(row, after=f"_{j}", unit=unit) for j in (0, i)]
        rows.append([*texts, row[f"status_{i}"].replace("_", " "), _name(row)])
    rest = f"; {MOST_ROWS} of them, all with --json" if len(table) > MOST_ROWS else ""
    counts = table["change"].value_counts()
    caption = f"Queries within a threshold in one run only: {counts.get('won', 0)} won, {counts.get('lost', 0)} lost"
    columns = ["run"] if several else []
    columns += ["change", "at", "query", f"off in {comparison.names[0]}"]
    columns += ["off in the run" if several else f"off in {comparison.names[1]}", "status", "image"]
    return Table(caption + rest, columns, rows)


def _resources_table(comparison: Comparison) -> Table:
    columns, rows = ["stage"], []
    for name in comparison.names:
        columns += [f"{name}: time", "peak memory"]
    longest = comparison.resources.filter(like="seconds_").iloc[:-1].max(axis=None)
    for row in comparison.resources.to_dict("records"):
        cells = [row["stage"]]
        for i in range(len(comparison.names)):
            seconds = row[f"seconds_{i}"]
            bar = seconds / longest if row["stage"] != ALL and seconds > 0 else None
            cells += [Cell(seconds_text(seconds), bar=bar), _memory(row[f"memory_mb_{i}"])]
        rows.append(cells)
    return Table("Time and peak memory of every stage, including the start-up of its notebook", columns, rows)


def _settings_table(comparison: Comparison) -> Table | None:
    if comparison.settings.empty:
        return None
    return Table("Settings that differ", ["setting", *comparison.names], comparison.settings.to_numpy().tolist())


def _signed(share: float) -> str:
    return f"{'+' if share > 0 else '−' if share < 0 else ''}{percent(abs(share))}"


def _bounds(row: Mapping[str, Any], name: str) -> str:
    write = _signed if name == "difference" else percent
    return f"{write(row[f'{name}_low'])}, {write(row[f'{name}_high'])}"


def _interval(row: Mapping[str, Any], name: str) -> str:
    return f"{(_signed if name == 'difference' else percent)(row[name])} [{_bounds(row, name)}]"


def _memory(megabytes: float) -> str:
    return f"{number(megabytes)} MB" if megabytes > 0 else "–"
