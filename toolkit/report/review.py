"""What a reviewer asks of a run: its main table, also as CSV and LaTeX, its maps, and its method in words."""

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import pandas as pd

from toolkit.capture.names import in_order
from toolkit.errors import ArtifactError
from toolkit.figures.evaluation import wilson_interval
from toolkit.figures.style import percent
from toolkit.files import SceneFiles, map_record_path, read_map_record, write_csv, write_text
from toolkit.manifest import EmbedSettings, LocalizeSettings, RerankSettings, RetrieveSettings, Settings
from toolkit.pose.base import status_counts
from toolkit.results.pair import load_maps, map_files, pairs_of

AnySettings = TypeVar("AnySettings", bound=Settings)
PAIR = ["map_device", "query_device"]
COUNTS = ["queries", "ok", "low_confidence", "failed"]
NAMES = {
    "vlad": "VLAD of RootSIFT", "megaloc": "MegaLoc", "sift": "SIFT", "aliked": "ALIKED", "superpoint": "SuperPoint",
    "mutual": "mutual nearest neighbors", "lightglue": "LightGlue", "vggt": "VGGT", "vggt-omega": "VGGT-Omega",
    "da3-base": "Depth Anything 3 Base", "da3-small": "Depth Anything 3 Small",
    "simulated": "A simulation that knows the true poses",
}  # fmt: skip
"""What papers call the parts that settings name."""
LATEX = {"°": r"\textdegree{}", "\N{NO-BREAK SPACE}": "~", "–": "--", "∞": r"$\infty$"}
FIT = r"\footnotesize\setlength{\tabcolsep}{3pt}\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{"


class Interval(NamedTuple):
    """A share, 0 to 1, with its 95 % interval."""

    share: float
    low: float
    high: float

    def __str__(self) -> str:
        if math.isnan(self.share):
            return "–"
        return f"{percent(self.share)} [{100 * self.low:.0f}, {100 * self.high:.0f}]"


def main_table(recall: pd.DataFrame, queries: pd.DataFrame, thresholds: Sequence[str]) -> pd.DataFrame:
    """Return a row for each pair: counts, recall, median errors, wrong `ok`, and seconds per query.

    Args:
        recall: `evaluation/recall.csv`; empty without an evaluation: then there are counts and seconds only.
        queries: `map_device`, `query_device`, `status` and `seconds` of every query.
        thresholds: columns of recall. Each gets `<column>_low` and `<column>_high`, the Wilson interval (E. B. Wilson,
            JASA 22, 1927; L. Brown et al., Statistical Science 16, 2001, recommend it), as if queries were independent.
    """
    of_pair = queries.reindex(columns=[*PAIR, "status", "seconds"]).astype({"seconds": float}).groupby(PAIR, sort=False)
    if recall.empty:
        counts = {pair: {"queries": len(rows), **status_counts(rows["status"])} for pair, rows in of_pair}
        recall = pd.DataFrame.from_dict(counts, "index").rename_axis(PAIR).reset_index() if counts else recall
    if recall.empty:
        return recall
    table = recall[PAIR].copy()
    for name in thresholds:
        intervals = [wilson_interval(*row) for row in recall[[name, "queries"]].to_numpy(float)]
        table[name] = recall[name]
        table[[f"{name}_low", f"{name}_high"]] = intervals
    rest = ["median_rotation_deg", "median_translation_m", "ok_wrong"]
    table = table.join(recall[[name for name in rest if name in recall]])
    seconds = {f"seconds_{name}": of_pair["seconds"].quantile(q) for name, q in (("median", 0.5), ("95", 0.95))}
    table = table.join(pd.DataFrame(seconds), on=PAIR)
    return table.join(recall[[name for name in (*COUNTS, "state") if name in recall]])


def readable(table: pd.DataFrame, thresholds: Sequence[str]) -> pd.DataFrame:
    """Return the main table with the columns of a page: recall and its interval in one, none that is empty."""
    shown = table.copy()
    for name in thresholds:
        rows = table[[name, f"{name}_low", f"{name}_high"]].to_numpy(float)
        shown[name] = pd.Series([Interval(*row) for row in rows], table.index, object)
        shown = shown.drop(columns=[f"{name}_low", f"{name}_high"])
    if "state" in shown and (shown["state"] == "evaluated").all():
        shown = shown.drop(columns="state")
    return shown.replace({"state": {"evaluated": ""}}).dropna(axis="columns", how="all")


def write_tables(stem: Path, table: pd.DataFrame, shown: pd.DataFrame, caption: str) -> list[Path]:
    """Write the main table as `<stem>.csv`, and `shown`, its texts, as `<stem>.tex`, no wider than the page."""
    paths = [stem.with_name(f"{stem.name}{ending}") for ending in (".csv", ".tex")]
    if table.empty:
        for path in paths:
            path.unlink(missing_ok=True)
        return []
    style = shown.style.hide(axis="index").format(escape="latex").format_index(_heading, axis="columns")
    columns, label = "ll" + "r" * (len(shown.columns) - 2), re.sub(r"[^\w.:-]", "-", f"tab:{stem.name}")
    text = style.to_latex(
        hrules=True, column_format=columns, caption=_escaped(caption), label=label, environment="table*",
        position_float="centering",
    )  # fmt: skip
    for letter, command in LATEX.items():
        text = text.replace(letter, command)
    text = text.replace(r"\begin{tabular}", f"{FIT}%\n\\begin{{tabular}}").replace(r"\end{tabular}", "\\end{tabular}}")
    write_csv(paths[0], table, float_format="%.6g")
    write_text(paths[1], f"% \\usepackage{{booktabs,graphicx}}\n{text}")
    return paths


def _escaped(text: str) -> str:
    return re.sub(r"([%&#_{}$])", r"\\\1", text)


def _heading(text: str) -> str:
    """Return a heading of a column in LaTeX, in lines that are as short as the numbers below it."""
    lines = [_escaped(line) for line in re.split(r"(?<!°,) (?!%)", text)]
    # In braces, as `\\[1]` is a distance between lines.
    return lines[0] if len(lines) == 1 else "\\shortstack[r]{{" + "}\\\\{".join(lines) + "}}"


def maps_table(files: SceneFiles) -> pd.DataFrame:
    """Return a row for each map: its images, points, and observations of them, and whether its poses fit its images."""
    rows = []
    h5_of = {map_device: path for (map_device, _), path in pairs_of(files.poses_dir, ".h5").items()}
    for device in in_order(h5_of):
        try:
            local_map = load_maps(map_files(files.maps, f"{device}_map", h5_of[device]))
        except ArtifactError:
            local_map = None
        record = read_map_record(map_record_path(files.poses_dir, files.scene, device))
        tables = files.embeddings.glob(f"{device}_map/*/manifest.csv")
        points = [None, None] if local_map is None else [len(local_map.points), len(local_map.obs_point)]
        rows.append((device, sum(map(_rows, tables)) or None, *points, record["verdict"]))
    names = ["map", "images", "points", "observations", "poses and images"]
    return pd.DataFrame(rows, columns=names).astype(dict.fromkeys(names[1:4], float))


def _rows(path: Path) -> int:
    with path.open("rb") as stream:
        return sum(1 for _ in stream) - 1


def method(files: SceneFiles, reranked: bool) -> str:
    """Return how queries were localized, by the settings beside the results, in sentences that can be quoted."""
    said = list[str]()
    embed, retrieve = _settings(files.embeddings, EmbedSettings), _settings(files.retrieval_dir, RetrieveSettings)
    rerank = _settings(files.reranked_dir, RerankSettings) if reranked else None
    if embed and retrieve:
        names = " and ".join(NAMES.get(name, name) for name in embed.models)
        said.append(f"The references of a query image are the {retrieve.topk} map images with the most similar global "
                    f"descriptor ({names}).")  # fmt: skip
        masks = {"rough poses": retrieve.mask.poses, "GPS": retrieve.mask.gps, "radio signals": retrieve.mask.radio}
        if given := [name for name, on in masks.items() if on]:
            said.append(f"The search is limited by {_listed(given)}.")
    if rerank:
        kinds = _listed(NAMES.get(kind, kind) for kind in rerank.features.kinds)
        said.append(f"Of these, it keeps the {rerank.topk} with the most geometrically verified matches ({kinds}).")
    localize = _settings(files.poses_dir, LocalizeSettings)
    return " ".join([*said, *(_localization(localize) if localize else [])])


def _localization(settings: LocalizeSettings) -> list[str]:
    if settings.method == "nearest":
        return ["The pose of a query is that of its first reference."]
    said, pnp, features, network = list[str](), settings.pnp, settings.features, settings.predictor
    matcher = f", by {NAMES.get(settings.matcher.name, settings.matcher.name)}" if settings.matcher.name else ""
    predicted = f"{NAMES.get(network.name, network.name)} predicts the cameras of a query and of " \
                f"{network.num_references} references, which are aligned with the map."  # fmt: skip
    if settings.method == "feed_forward":
        return [predicted]
    kinds = _listed(NAMES.get(kind, kind) for kind in features.kinds)
    said.append(f"{kinds} features of the query are matched with those of its references{matcher}, and so with map "
                "points triangulated from the map images at their given poses"
                f"{', which bundle adjustment refines' if settings.map and settings.map.refine_poses else ''}. "
                f"RANSAC estimates the pose of the camera or rig (PnP, errors up to {pnp.ransac_max_error_deg:g}°); "
                f"least squares refines it with further matches near the projected points (up to "
                f"{pnp.max_error_deg:g}°).")  # fmt: skip
    if settings.method == "hybrid":
        said.append(f"{predicted} Predicted pose and depth guide further matching; the best supported pose wins.")
    if features.escalation:
        kinds = _listed(NAMES.get(kind, kind) for kind in features.escalation)
        said.append(f"A query that is not sure is localized again with {kinds} as well.")
    said.append(f"A pose with at least {pnp.min_inliers} inliers is kept; it is called ok if the estimated probability "
                f"that it is right to within 5° and 0.5 m is {percent(pnp.ok_probability)}\N{NO-BREAK SPACE}% "
                "or more.")  # fmt: skip
    return said


def _settings(folder: Path | None, model: type[AnySettings]) -> AnySettings | None:
    """Return the settings that a stage wrote beside its results; None without results."""
    try:
        return model.read(folder) if folder else None
    except ArtifactError:
        return None


def _listed(names: Iterable[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last
