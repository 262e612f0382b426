"""Write the report of a run: report.html, one self-contained file."""

import base64
import glob
import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote
from zlib import crc32

import pandas as pd
from markupsafe import Markup, escape

from toolkit.capture.tables import POSES_UNIT
from toolkit.errors import ArtifactError
from toolkit.figures.evaluation import CHANGES
from toolkit.figures.query_images import MAX_LETTERS, shown_name
from toolkit.figures.style import SHOWN_DPI, STORED_DPI, as_jpeg, number, percent
from toolkit.files import (
    SceneFiles,
    of_sequence,
    older_files,
    read_json,
    read_map_record,
    sidecar_path,
    write_sidecar,
    write_text,
)
from toolkit.pose.base import Status, short_status, split_status, status_counts, statuses
from toolkit.report import review
from toolkit.report.review import Interval
from toolkit.results import metrics
from toolkit.results.pair import PairResults, pairs_of
from toolkit.runs.folder import counted, counts_text

Write = Callable[[Any], str]
"""Function that writes a number of a table."""
PICTURE_BUDGET = 7_000_000
"""Bytes of all pictures of a page. Base64 makes them a third larger, so the page stays below 10 MB."""
MAX_WIDTH = 1600
"""Width of an embedded picture, pixels, at most."""
WORST, MAX_REASONS = 10, 12
"""Rows listed for a scene: the worst queries, and the reasons why queries have no pose."""
OK_WRONG = "ok but wrong"
CAPTION = "Every pair: recall with its 95 % interval, median errors, and time per query"
LONG = 30
"""Letters from which the text of a table is wrapped."""
LINKED = {
    "Recordings in 3D, opened by .venv/bin/rerun FILE": "visualization/*.rrd",
    "Tables of the evaluation": "evaluation/*.csv",
    "Poses, device to world": "poses/*.txt",
    "Statuses, a row for each query": "poses/*.csv",
    "References, a line for each image": "retrieval/*.jsonl",
}
STATUS_COLUMNS = [
    "timestamp", "device_id", "image", "reason", "status", "status_text", "num_inliers", "position_std_m",
    "seconds", "first_status", "first_seconds",
]  # fmt: skip
# Figures that say more than the page's tables: a heading, and how to read each.
EVALUATION_FIGURES = {
    "error_curves": (
        "Error curves",
        "Share of queries [%] with a position error (top) and a rotation error (bottom) below x. A curve ends at the "
        "share of queries that have a pose; dotted lines are the thresholds of the tables.",
    ),
    "reliability": (
        "Reliability",
        "Share of poses that are right against the stated probability (p_correct), with 95 % intervals and "
        "the number of poses. On the dotted line both agree; ok means 99 % or more.",
    ),
    "deviations": (
        "Stated and actual deviation",
        "Position error of each pose against its stated standard deviation ({column} in poses/*.csv). With 30 "
        "poses or more, a line joins the median of each tenth. Poses above the dashed line are off by more than five "
        "deviations.",
    ),
    "losses": (
        "Where accuracy was lost",
        "Causes of the misses at each threshold, in % of the queries. No good reference: retrieval found no map "
        "image near the true camera; no pose: too few matches agreed; wrong pose: beyond the threshold.",
    ),
}


def write_report(run_dir: str | Path) -> Path:
    """Write `report.html` from the `run.json`, tables and pictures of a run folder, and return its path.

    The main table of each scene is also written, as `report-<scene>.csv` and `.tex`. Pictures are embedded, so the file
    can be mailed alone. Links to tables, poses, notebooks and recordings are relative to the run folder. The report
    leaves out missing files and names unreadable ones. It shows the pictures in the folder `visualization` by name:
    `worst*` with the worst queries, `localization*` as samples, `<pair>_sequence*` with the sequences, all remaining
    ones as maps. A picture's title is the PNG's `Title` or `Description`. Raise ArtifactError if `run.json` is missing
    or torn.
    """
    from jinja2 import StrictUndefined, Template

    run_dir = Path(run_dir)
    run = read_run(run_dir / "run.json")
    left_out: list[str] = []
    scenes = []
    for name in map(str, run["scenes"]):
        # Every scene gets an equal share, or the first scenes would leave no room for the last.
        album = Album(run_dir, PICTURE_BUDGET // len(run["scenes"]), left_out)
        scenes.append(_scene(SceneFiles(run_dir, name), run, album))
    source = Path(__file__).with_suffix(".html.j2").read_text(encoding="utf-8")
    template = Template(source, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = template.render(
        run=run,
        scenes=scenes,
        stages=_stages(run, run_dir),
        stopped=[row for row in run["stages"] if row.get("status") in ("failed", "interrupted", "skipped")],
        not_done=_not_done(run),
        summary=_summary(run),
        manifest=_json(run["manifest"]),
        parameters=[(_stage_name(row), _json(row["parameters"])) for row in run["stages"] if row.get("parameters")],
        left_out=left_out,
    )
    path = run_dir / "report.html"
    write_text(path, page)
    shown = [*run_dir.glob("*/evaluation/*.csv"), *run_dir.glob("*/poses/*.csv"), run_dir / "run.json"]
    write_sidecar(path, {}, made_from=sorted(shown))
    return path


def read_run(path: Path) -> dict[str, Any]:
    """Return the content of a `run.json`, with empty values for missing keys; raise ArtifactError if it is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ArtifactError(f"No run at {path.parent}: {path.name} is missing. Run a manifest first.") from None
    except ValueError as error:
        raise ArtifactError(f"{path} is not valid JSON ({error}). Run the manifest again.") from None
    if not isinstance(content, dict):
        raise ArtifactError(f"{path}: expected a JSON object, found a {type(content).__name__}.")
    empty = {"name": path.parent.name, "created": "", "status": "", "error": None, "total_seconds": None}
    lists: dict[str, Any] = {"manifest": {}, "versions": {}, "machine": {}, "inputs": {}, "scenes": [], "stages": []}
    run = {**empty, "peak_memory_mb": None, "work_seconds": None, "code": "", "commit": "", **lists, **content}
    wrong = [key for key, value in lists.items() if not isinstance(run[key], type(value))]
    wrong += [] if wrong or all(isinstance(row, dict) for row in run["stages"]) else ["stages"]
    if wrong:
        raise ArtifactError(f"{path}: {wrong[0]!r} is not as a run writes it. Run the manifest again.")
    run["scenes"] = run["scenes"] or list(dict.fromkeys(row["scene"] for row in run["stages"] if row.get("scene")))
    return run


def _json(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False)


# The run: time, memory, machine


def _summary(run: dict[str, Any]) -> list[tuple[str, str]]:
    parts = [("started", str(run["created"]).replace("T", " ").replace("+00:00", " UTC"))]
    if run["total_seconds"] is not None:
        work = f" ({seconds_text(run['work_seconds'])} of work besides the notebooks' start-up)"
        parts.append(("time", seconds_text(run["total_seconds"]) + (work if run["work_seconds"] is not None else "")))
    if run["peak_memory_mb"]:
        parts.append(("peak memory", f"{run['peak_memory_mb'] / 1000:.2f} GB"))
    # The page lists Python's version with the other versions.
    machine = {key: value for key, value in run["machine"].items() if key != "python"}
    texts = {"cores": "{} cores", "memory_gb": "{} GB of memory", "gpu": "GPU: {}"}
    shown = ", ".join(texts.get(key, "{}").format(value) for key, value in machine.items())
    return [*parts, ("machine", shown), ("git commit", run["commit"])]


def _stage_name(row: dict[str, Any]) -> str:
    return " ".join(str(part) for part in (row.get("scene"), row.get("stage"), row.get("part")) if part)


def _stages(run: dict[str, Any], run_dir: Path) -> Markup:
    rows = []
    for row in run["stages"]:
        rows.append({
            "scene": row.get("scene") or "",
            "stage": _anchor(_stage_name({**row, "scene": ""}), run_dir, run_dir / str(row.get("notebook") or "")),
            "status": row.get("status", ""),
            "time": row.get("seconds"),
            "of it work": row.get("work_seconds", row.get("kernel_seconds")),
            "peak memory": row.get("peak_memory_mb") or None,
            "counts": counts_text(row.get("counts") or {}),
        })  # fmt: skip
    numbers: dict[str, Write] = {"time": seconds_text, "of it work": seconds_text, "peak memory": "{:.0f} MB".format}
    # As objects, or pandas would turn links into plain text.
    frame = pd.DataFrame(rows, dtype=object).astype(dict.fromkeys(numbers if rows else (), float))
    caption = "Time and peak memory of every stage; names link to the executed notebooks"
    return _table(frame, caption, numbers, ["time", "peak memory"])


def _not_done(run: dict[str, Any]) -> Markup:
    items = [(row, item) for row in run["stages"] for item in row.get("left_out") or ()]
    columns = ["scene", "what", "reason", "stages"]
    rows = [(row.get("scene"), item.get("what"), item.get("reason"), row.get("stage")) for row, item in items]
    table = pd.DataFrame(rows, columns=columns).fillna("").astype(str).drop_duplicates()
    stages = table.groupby(columns[:3], sort=False)["stages"].agg(", ".join)
    return _table(stages.reset_index(), "Left out, and why")


# A scene


def _scene(files: SceneFiles, run: Mapping[str, Any], album: "Album") -> dict[str, Any]:
    """Return the template variables of one scene."""
    messages: list[str] = []
    older, older_images = older_files(files.evaluation, "evaluate"), older_files(files.visualization, "visualize")
    recall, errors, losses, retrieval, sequences, changes = (
        pd.DataFrame() if f"{name}.csv" in older else _read_table(files.evaluation / f"{name}.csv", messages)
        for name in ("recall", "errors", "losses", "retrieval", "sequence", "changes")
    )
    thresholds = [column for column in recall.columns if column.startswith("recall@")]
    queries = _read_statuses(files, messages)
    messages += [f"Not shown: {why}" for why in dict.fromkeys(older.values())]
    for why in list(older_images.values())[:1]:
        messages.append(f"Not shown: {len(older_images)} pictures and recordings. {why}")
    older |= older_images
    made = {"localize": files.poses_dir, "rerank": files.reranked_dir, "retrieve": files.retrieval_dir}
    for stage, folder in made.items():
        messages += list(older_files(folder, stage).values())[:1]
    if len(recall):
        messages += read_json(sidecar_path(files.evaluation / "recall.csv")).get("settings", {}).get("messages", [])
    unit = metrics.unit_of(*thresholds)
    remarks, lengths = list[str](), list[str]()
    for path in sorted(files.poses_dir.glob(f"{glob.escape(files.scene)}_map_*.json")):
        record = read_map_record(path)
        remarks += [f"{path.stem}: {record['text']}"] if record["text"] else []
        lengths += [f"{metrics.length_unit(record)[1]:.3g} in {path.stem}"] if record["depth"] else []
    if unit != "m":
        depth = f"a tenth of the median scene depth of a map{': ' if lengths else ''}{', '.join(lengths)}"
        remarks.append(f"The unit of the poses is not known: {metrics.UNKNOWN_UNIT} is {depth}.")
    verdict, headlines = _verdict(recall, errors, queries, thresholds)
    found, note = _retrieval(retrieval, headlines, unit)
    table, links = _main_table(files, recall, queries, thresholds)
    stills = sorted((path for path in files.visualization.glob("*.png") if path.name not in older), key=_natural)
    worst = [path for path in stills if path.name.startswith("worst")]
    samples = [path for path in stills if path.name.startswith("localization")]
    recordings = [path for path in stills if of_sequence(path.name)]
    maps = [path for path in stills if path not in (*worst, *samples, *recordings)]
    column = "position_std_m" if unit == "m" else "position_std"
    figures = {
        files.evaluation / f"{name}.png": (title, text.format(column=column))
        for name, (title, text) in EVALUATION_FIGURES.items()
    }
    return {
        "name": files.scene,
        "fingerprint": str(run["inputs"].get(files.scene, "")),
        "verdict": verdict,
        "wrong_ok": _wrong_ok(errors, unit),
        "headlines": headlines,
        "messages": messages,
        "remarks": remarks,
        "method": review.method(files, "rerank" in run["manifest"]),
        "table": table,
        "table_links": links,
        "evaluated": bool(thresholds),
        "map_table": _table(review.maps_table(files), "Images and triangulated points of each map"),
        "losses": _losses(losses),
        "missed": int(losses["missed"].sum()) if "missed" in losses else 0,
        "failures": _failures(queries),
        "worst": _worst(errors if len(errors) else queries, thresholds),
        "retrieval": found,
        "retrieval_note": note,
        # Pictures of failures come first, while there is room: they are the hardest to understand from tables alone.
        "worst_pictures": [album.picture(path) for path in worst],
        "figures": [
            album.picture(path, *texts) for path, texts in figures.items() if path.is_file() and path.name not in older
        ],
        "steps": _steps(sequences, thresholds),
        "changes": _changes(changes, unit),
        "sequences": [album.picture(path) for path in recordings],
        "maps": [album.picture(path) for path in maps],
        "samples": [album.picture(path) for path in samples],
        "links": _links(files, older),
    }


def _read_table(path: Path, messages: list[str]) -> pd.DataFrame:
    """Read a table; empty if the file is missing. An unreadable file adds a line to `messages`."""
    try:
        table = metrics.named_as_meters(pd.read_csv(path, dtype={"device_id": str}).rename(columns=POSES_UNIT))
        return split_status(table) if "status" in table else table
    except (FileNotFoundError, pd.errors.EmptyDataError):
        pass
    except (OSError, ValueError) as error:
        messages.append(f"{path.name} cannot be read ({error}). Run its stage again.")
    return pd.DataFrame()


def _read_statuses(files: SceneFiles, messages: list[str]) -> pd.DataFrame:
    """Return `STATUS_COLUMNS` of every query of every pair, with or without ground truth."""
    tables = [pd.DataFrame()]
    for devices, path in pairs_of(files.poses_dir).items():
        try:
            table = PairResults.open(path).table.rename(columns=POSES_UNIT).reindex(columns=STATUS_COLUMNS)
            tables.append(table.assign(**dict(zip(review.PAIR, devices, strict=True))))
        except ArtifactError:
            messages.append(f"{path.name} cannot be read")
    return pd.concat(tables, ignore_index=True)


def _verdict(
    recall: pd.DataFrame, errors: pd.DataFrame, queries: pd.DataFrame, thresholds: list[str]
) -> tuple[list[str], list[tuple[str, str]]]:
    """Summarize the quality of the poses in sentences, and in headlines: a number and its meaning."""
    verdict, headlines = list[str](), list[tuple[str, str]]()
    if len(queries):
        pairs = counted(len(queries[review.PAIR].drop_duplicates()), "pairs of devices")
        counts = counts_text(status_counts(queries["status"]))
        verdict.append(f"{counted(len(queries), 'queries')} in {pairs}: {counts}.")
        verdict += _escalation(queries)
    done = recall.dropna(subset=thresholds) if thresholds else recall.iloc[:0]
    if not len(done):
        return verdict, headlines
    for column in thresholds:
        headlines.append((_share(done[column].mean()), f"mean recall at {metrics.threshold_text(column)}"))
    if len(errors):
        rotation_deg, translation_m = errors[["rotation_error_deg", "translation_error_m"]].median()
        length = _length(translation_m, metrics.unit_of(thresholds[0]))
        headlines.append((length, f"median position error; rotation {number(rotation_deg)}°"))
    strict, limit = thresholds[0], metrics.threshold_text(thresholds[0])
    weakest = done.loc[done[strict].idxmin()]
    if weakest[strict] == done[strict].max():
        verdict.append(f"Every pair has {_share(weakest[strict])} at {limit}.")
    else:
        pair = f"{weakest['query_device']} queries in the {weakest['map_device']} map"
        verdict.append(f"Weakest pair at {limit}: {pair}, {_share(weakest[strict])}.")
    if "ok_wrong" in done:
        wrong = float((done["ok_wrong"] * done["queries"]).sum() / done["queries"].sum())
        what = f"called ok, but beyond {metrics.WRONG[0]:g}°, {metrics.WRONG[1]:g} {metrics.unit_of(strict)}"
        headlines.append((_share(wrong), what))
    return verdict, headlines


def _escalation(queries: pd.DataFrame) -> list[str]:
    """Say in a sentence what the fallback features gained and cost; empty without any."""
    escalated = queries[queries["first_status"].notna()]
    if not len(escalated):
        return []
    before, after = statuses(escalated["first_status"]), escalated["status"]
    posed = ((before == Status.FAILED) & (after != Status.FAILED)).sum()
    seconds = (escalated["seconds"] - escalated["first_seconds"]).sum()
    gained = f", {posed} with a first pose" if posed else ""
    return [
        f"{counted(len(escalated), 'queries')} localized with the fallback features too, because not sure: "
        f"{(after == Status.OK).sum()} now ok{gained}. That took {number(seconds)} s, "
        f"{number(seconds / len(escalated))} s per query."
    ]


# Tables


def _table(frame: pd.DataFrame, caption: str, formats: Mapping[str, Write] = {}, bars: Sequence[str] = ()) -> Markup:
    """Return a table as HTML, in a region that scrolls; empty if it has no rows.

    Without one of the `formats`, a number has no decimals; recall and `percent` are shaded. Columns `bars` have bars.
    """
    from pandas.io.formats.style import Styler

    if not len(frame):
        return Markup()
    # An identifier made from the content: equal runs should have equal pages.
    style = Styler(frame, uuid=f"{crc32((caption + frame.to_csv()).encode()):x}", cell_ids=False)
    style.format(lambda value: f"{value:.0f}" if isinstance(value, float) else escape(value), na_rep="–")
    for name in frame.columns.intersection([*formats]):
        style.format(formats[name], subset=[name], na_rep="–")
    style.map(_shade, subset=[name for name in frame if formats.get(name) in (percent, _recall)])
    style.map(lambda share: "color: var(--alarm)" if share > 0 else "", subset=frame.columns.intersection([OK_WRONG]))
    style.bar(subset=[name for name in bars if frame[name].max() > 0], color="#14629f40", vmin=0)
    texts = frame.drop(columns=[*formats], errors="ignore").select_dtypes(exclude="number").astype(str)
    long = [name for name in texts if texts[name].str.len().max() > LONG]
    style.set_table_styles({name: [{"selector": "", "props": "text-align: left"}] for name in texts})
    style.set_td_classes(pd.DataFrame("long", frame.index, long))
    style.hide(axis="index").format_index(escape, axis="columns")
    style.set_caption(Markup("<span>{}</span>").format(caption))
    html = re.sub(r'class="(col|row)_heading', r'scope="\1" class="\1_heading', style.to_html())  # for screen readers
    region = Markup('<div class="scroll" role="region" tabindex="0" aria-label="{}">{}</div>')
    return region.format(caption, Markup(html))


def _shade(value: float | Interval) -> str:
    share = value.share if isinstance(value, Interval) else value
    if math.isnan(share):
        return ""
    return f"background: rgb(20 98 159 / {90 * share:.0f}%)" + ("; color: #fff" if share > 0.6 else "")


def _recall(value: float | Interval) -> str:
    return str(value) if isinstance(value, Interval) else percent(value)


def _named(table: pd.DataFrame, thresholds: list[str]) -> tuple[pd.DataFrame, dict[str, Write]]:
    """Return a table with columns of recall and median errors under names for a page, and functions that write them."""
    small, factor = metrics.small_unit(metrics.unit_of(*thresholds))
    shares = {name: f"recall {metrics.threshold_text(name)} [%]" for name in thresholds} | {"ok_wrong": OK_WRONG}
    names = {"map_device": "map", "query_device": "query", "low_confidence": "low confidence", "state": "note"}
    names |= {"median_rotation_deg": "median error [°]", "median_translation_m": f"median error [{small}]", **shares}
    names |= {"seconds_median": "time, median [s]", "seconds_95": "time, 95 % [s]"}
    formats: dict[str, Write] = {"median error [°]": number}
    formats |= {f"median error [{small}]": lambda length: number(factor * length)}
    formats |= dict.fromkeys(shares.values(), _recall)
    formats |= {OK_WRONG: _share, **dict.fromkeys(["time, median [s]", "time, 95 % [s]"], number)}
    return table.rename(columns=names), formats


def _main_table(
    files: SceneFiles, recall: pd.DataFrame, queries: pd.DataFrame, thresholds: list[str]
) -> tuple[Markup, list[Markup]]:
    """Return the table of all pairs, and links to the same as CSV and LaTeX, which are written."""
    table = review.main_table(recall, queries, thresholds)
    shown, formats = _named(review.readable(table, thresholds), thresholds)
    texts = shown.apply(lambda column: column.map(formats.get(column.name, _plain)))
    stem = files.run / f"report-{files.scene}"
    paths = review.write_tables(stem, metrics.named_by_unit(table, metrics.unit_of(*thresholds)), texts, CAPTION)
    return _table(shown, CAPTION, formats), [Markup(_anchor(path.name, files.run, path)) for path in paths]


def _plain(value: Any) -> str:
    return ("–" if math.isnan(value) else f"{value:.0f}") if isinstance(value, float) else str(value)


def _steps(sequences: pd.DataFrame, thresholds: list[str]) -> Markup:
    """List recall and median errors after each step of the sequence stage, over all pairs."""
    if not len(sequences):
        return Markup()
    medians = dict.fromkeys(["median_rotation_deg", "median_translation_m"], "median")
    over_pairs = {"queries": "sum", **dict.fromkeys(thresholds, "mean"), **medians, **dict.fromkeys(CHANGES, "sum")}
    caption = "Queries after each step of the sequence stage: mean recall and median error of the pairs"
    table, formats = _named(sequences.groupby("step", sort=False).agg(over_pairs).reset_index(), thresholds)
    return _table(table, caption, formats)


def _changes(changes: pd.DataFrame, unit: str) -> Markup:
    if not len(changes):
        return Markup()
    shown = changes.sort_values("change", kind="stable")[:WORST]
    rows = shown.to_dict("records")
    table = pd.DataFrame({
        "query": _queries(shown), "change": shown["change"],
        "single": [off_by(row, "single_", unit=unit) for row in rows],
        "sequence": [off_by(row, unit=unit) for row in rows],
        "device": shown["device_id"], "timestamp [µs]": shown["timestamp"],
    })  # fmt: skip
    caption = ", ".join(f"{(changes['change'] == name).sum()} {name}" for name in CHANGES)
    return _table(table, f"Queries within the last threshold only with or only without their sequence: {caption}")


def _losses(losses: pd.DataFrame) -> Markup:
    """List the losses by reason: the sum over the pairs of each map device, and over all pairs."""
    if "threshold" not in losses or losses["threshold"].isna().all():
        return Markup()
    sums = {
        metrics.threshold_text(threshold): pd.concat([pairs, pairs.assign(map_device="all")])
        .groupby("map_device", sort=False)[["queries", "missed", *metrics.REASONS]]
        .sum()
        for threshold, pairs in losses.groupby("threshold", sort=False)
    }
    table = pd.concat(sums, names=["threshold", "map"]).reset_index()
    table[[*metrics.REASONS]] = table[[*metrics.REASONS]].div(table["queries"], axis="index")
    caption = "Queries missed at each threshold, and the share of all queries lost for each reason [%]"
    return _table(table, caption, dict.fromkeys(metrics.REASONS, percent))


def _failures(queries: pd.DataFrame) -> Markup:
    failed = queries[queries["status"] == Status.FAILED] if len(queries) else queries
    if not len(failed):
        return Markup()
    # Drop details in parentheses: they differ from query to query for the same reason.
    reasons = failed["status_text"].map(lambda text: re.sub(r" \(.*", "", Status.parse(text)[1]))
    groups = _queries(failed).groupby(reasons.rename("reason"))
    where = groups.agg(lambda pairs: ", ".join(f"{pair} {count}" for pair, count in pairs.value_counts().items()))
    table = pd.DataFrame({"queries": groups.size(), "where": where})
    table = table.sort_values("queries", ascending=False, kind="stable").reset_index()
    rest = table["queries"][MAX_REASONS:].sum()
    caption = "Queries without a pose, by reason" + (f"; {rest} more have other reasons" if rest else "")
    return _table(table[:MAX_REASONS], caption)


def _wrong_ok(errors: pd.DataFrame, unit: str) -> Markup:
    if not len(errors):
        return Markup()
    called_ok = errors[errors["status"] == Status.OK]
    turned, moved = called_ok[["rotation_error_deg", "translation_error_m"]].to_numpy(float).T
    wrong = called_ok[~metrics.is_below(turned, moved, metrics.WRONG)]
    wrong = wrong.sort_values("translation_error_m", ascending=False)
    limit = f"{metrics.WRONG[0]:g}°, {metrics.WRONG[1]:g} {unit}"
    caption = f"Called ok, but wrong (beyond {limit}): {len(wrong)} of {counted(len(called_ok), 'poses')}."
    if len(wrong) > WORST:
        caption += f" The {WORST} worst of them; evaluation/errors.csv has all."
    return _listed(wrong[:WORST], caption, unit)


def _worst(queries: pd.DataFrame, thresholds: list[str]) -> Markup:
    """List the queries with the largest errors or, without ground truth, with the least support."""
    if not len(queries):
        return Markup()
    threshold = metrics.parse_threshold(thresholds[0]) if thresholds else metrics.THRESHOLDS[0]
    unit = metrics.unit_of(*thresholds)
    worst = queries.iloc[metrics.worst_of_each(queries, WORST, threshold)]
    many = f"{len(worst)} " if len(worst) > 1 else ""
    where = ", each in the map in which it went worst" if queries["map_device"].nunique() > 1 else ""
    caption = f"The {many}least supported; there is no ground truth to compare with"
    if "rotation_error_deg" in queries:
        caption = f"The {many}worst, by the larger of rotation error / {threshold[0]:g}° and "
        caption += f"translation error / {threshold[1]:g} {unit}"
    return _listed(worst, caption + where, unit)


def _listed(queries: pd.DataFrame, caption: str, unit: str) -> Markup:
    """Return a table with a row for each query."""
    table, names = pd.DataFrame({"query": _queries(queries)}), {"reason": "why"}
    if "rotation_error_deg" in queries:
        rows, names = queries.to_dict("records"), {}
        table["off by"] = [off_by(row, unit=unit) for row in rows]
        table["why"] = [_why(row) for row in rows]
    table["status"] = queries["status_text"].map(short_status).str.replace("low_confidence", "low confidence")
    table["inliers"] = queries["num_inliers"]
    names |= {"p_correct": "stated to be right", "rival_support": "support of a rival"}
    known = queries.filter([*names]).dropna(axis="columns", how="all").rename(columns=names)
    formats: dict[str, Write] = dict.fromkeys(["stated to be right", "support of a rival"], _share)
    listed = queries["image"].fillna("").str.split(";")
    images = [shown_name(first, MAX_LETTERS) + (f" and {len(more)} more" if more else "") for first, *more in listed]
    return _table(table.join(known).assign(image=images), caption, formats)


def _queries(table: pd.DataFrame) -> "pd.Series[str]":
    return table["query_device"] + " in " + table["map_device"] + " map"


def _why(row: dict[str, Any]) -> str:
    """Return the reason of the loss at the widest threshold that a query misses."""
    losses = {name: row[name] for name in row if name.startswith("loss@")}
    missed = [name for name in losses if losses[name] in metrics.REASONS]
    if missed:
        return f"{losses[missed[-1]]} at {metrics.threshold_text(missed[-1])}"
    return "within every threshold" if losses else ""


def _retrieval(retrieval: pd.DataFrame, headlines: list[tuple[str, str]], unit: str) -> tuple[Markup, str]:
    """Return the shares of queries with a good reference as a table, empty if all pairs are alike; and a note."""
    ks = [column for column in retrieval.columns if column.startswith("recall@")]
    done = retrieval.dropna(subset=ks) if ks else retrieval.iloc[:0]
    if not len(done):
        return Markup(), ""
    first = ks[-1].removeprefix("recall@")
    headlines.append((_share(done[ks[-1]].mean()), f"have a good reference in the first {first}"))
    names = {k: f"in the first {k.removeprefix('recall@')}" for k in ks} | {"in_map": "anywhere in the map"}
    note = f"A good reference stands within {done['radius_m'].iloc[0]:g} {unit} of the query's true camera and looks "
    note += f"the same way to within {done['angle_deg'].iloc[0]:g}°."
    shown = done.filter([*names])
    if (shown.nunique() == 1).all():
        alike = ", ".join(f"{_share(share)} {names[str(name)]}" for name, share in shown.iloc[0].items())
        return Markup(), f"Queries with a good reference, in every pair: {alike}. {note}"
    table = retrieval[[*review.PAIR, *shown]].rename(columns={"map_device": "map", "query_device": "query", **names})
    return _table(table, "Queries with a good reference [%]", dict.fromkeys(names.values(), percent)), note


def _links(files: SceneFiles, older: Collection[str]) -> dict[str, Markup]:
    """Link the files of a scene, except for those named `older`, by what they are."""
    found = {
        kind: [_anchor(path.name, files.run, path) for path in sorted(files.root.glob(name)) if path.name not in older]
        for kind, name in LINKED.items()
    }
    return {kind: Markup(" ").join(links) for kind, links in found.items() if links}


# Text


def _link(run_dir: Path, path: Path) -> str:
    """Return the URL of a file, relative to the page."""
    return quote(path.relative_to(run_dir).as_posix())


def _anchor(text: str, run_dir: Path, path: Path) -> str:
    """Return a link to a file as HTML; only the text if there is no such file."""
    return Markup('<a href="{}">{}</a>').format(_link(run_dir, path), text) if path.is_file() else text


def _natural(path: Path) -> list[Any]:
    """Natural sort key: 10 comes after 9."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _share(share: float) -> str:
    return f"{percent(share)}\N{NO-BREAK SPACE}%"


def _length(length: float, unit: str) -> str:
    if unit == "m" and length < 1:
        return f"{number(100 * length)} cm"
    return f"{number(length)} {unit}" if length < math.inf else "∞"


def off_by(row: Mapping[Any, Any], before: str = "", after: str = "", *, unit: str) -> str:
    """Return the errors of a query as text; `before` and `after` complete the names of their columns."""
    of_length = (name for name in row if name.startswith(f"{before}translation_error") and name.endswith(after))
    angle, length = row[f"{before}rotation_error_deg{after}"], row[next(of_length)]
    return f"{number(angle)}°, {_length(length, unit)}" if math.isfinite(angle) else "no pose"


def seconds_text(seconds: float | None) -> str:
    if seconds is None or math.isnan(seconds):
        return "–"
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{int(seconds) // 60} min {int(seconds) % 60} s"


class Album:
    """Turns PNG files into data URLs until `room` bytes are used up."""

    def __init__(self, run_dir: Path, room: int, left_out: list[str]) -> None:
        self.run_dir, self.room, self.left_out = run_dir, room, left_out

    def picture(self, path: Path, title: str = "", caption: str = "") -> dict[str, Any]:
        """Return a picture for the page, without data if there is no room left; its default title is in the file.

        It is as wide, in pixels, as makes letters equally large in all pictures.
        """
        from PIL import Image

        name, shown = str(path.relative_to(self.run_dir)), {"data": "", "path": _link(self.run_dir, path)}
        try:
            with Image.open(path) as image:
                info = getattr(image, "text", {})
                width = round(image.width * SHOWN_DPI / STORED_DPI)
                title = title or info.get("Title") or info.get("Description") or path.stem.replace("_", " ")
                data, kind = path.read_bytes(), "png"
                if image.width > MAX_WIDTH or len(data) > 150_000:
                    small = as_jpeg(image, MAX_WIDTH)
                    if len(small) < len(data):  # plots are often smaller as PNG
                        data, kind = small, "jpeg"
        except (OSError, ValueError, SyntaxError) as error:  # Pillow raises the latter two for some torn PNGs
            return shown | {"title": f"{name} cannot be read: {error}", "caption": ""}
        if len(data) > self.room:
            self.left_out.append(name)
            return shown | {"title": title, "caption": caption}
        self.room -= len(data)
        url = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
        return shown | {"title": title, "caption": caption, "data": url, "width": width}
