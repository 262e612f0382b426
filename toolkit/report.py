"""The page a person reads after a run: report.html, one file that needs nothing else."""

import base64
import io
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from toolkit.errors import ArtefactError
from toolkit.files import SceneFiles, sidecar_path, write_text

# All pictures together, before base64 makes them a third larger: the page stays below 15 MB.
PICTURE_BUDGET = 10_000_000
MAX_WIDTH = 1600
# Figures that say more than the page's own tables.
EVALUATION_FIGURES = {
    "error_curves": "Share of queries with an error below x. A curve ends where queries have no pose; "
    "dotted lines are the thresholds of the tables.",
    "losses": "What the misses at each threshold come from. No good reference: retrieval found no map image "
    "near the true camera; no pose: too few matches agreed; wrong pose: beyond the threshold.",
}
REASONS = ("no good reference", "no pose", "wrong pose")


@dataclass
class Picture:
    """A picture in the page."""

    data: str
    """data: URL, or empty where the page has no room left."""
    caption: str
    path: str
    """Relative to the run folder."""


@dataclass
class Cell:
    """A cell of a table: its text and, where it is shaded, how much (0 white to 1 dark)."""

    text: str
    shade: float | None = None

    @property
    def style(self) -> str:
        """CSS of the shading: white to blue, with text that can be read on it."""
        if self.shade is None:
            return ""
        share = min(max(self.shade, 0.0), 1.0)
        red, green, blue = (round(255 + share * (dark - 255)) for dark in (20, 98, 160))
        return f"background:rgb({red},{green},{blue});color:{'#fff' if share > 0.55 else '#111'}"


@dataclass
class Matrix:
    """A table of map devices (rows) by query devices (columns)."""

    title: str
    queries: list[str]
    rows: list[tuple[str, list[Cell]]]


@dataclass
class Table:
    """A plain table."""

    columns: list[str]
    rows: list[list[Cell]]


@dataclass
class Scene:
    """What the page shows of one scene."""

    name: str
    headlines: list[tuple[str, str]] = field(default_factory=list)
    recall: list[Matrix] = field(default_factory=list)
    medians: list[Matrix] = field(default_factory=list)
    pairs: Table | None = None
    losses: Table | None = None
    missed: int = 0
    retrieval: list[Matrix] = field(default_factory=list)
    retrieval_note: str = ""
    messages: list[str] = field(default_factory=list)
    figures: list[Picture] = field(default_factory=list)
    maps: list[Picture] = field(default_factory=list)
    samples: list[Picture] = field(default_factory=list)
    recordings: list[str] = field(default_factory=list)


def write_report(run_dir: str | Path) -> Path:
    """Write `report.html` of a run from `run.json`, tables and pictures in its folder, and return its path.

    Pictures are embedded, so that the one file can be mailed; what is missing is left out. In the folder
    `visualization`, pictures named `localization*` are shown as samples, others as maps; a caption is the
    PNG's `Description` or `Title`.

    Raises:
        ArtefactError: there is no `run.json`, or it is torn.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    run_dir = Path(run_dir)
    run = _read_run(run_dir / "run.json")
    album = _Album(run_dir)
    scenes = [_scene(SceneFiles(run_dir, str(name)), album) for name in run["scenes"]]
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("report.html.j2").render(
        run=run,
        scenes=scenes,
        stages=_stages(run),
        summary=_summary(run),
        manifest=json.dumps(run["manifest"], indent=2, ensure_ascii=False),
        left_out=album.left_out,
    )
    write_text(run_dir / "report.html", page)
    return run_dir / "report.html"


def _read_run(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ArtefactError(
            f"No run at {path.parent}: {path.name} is missing. Run a manifest first."
        ) from None
    except ValueError as error:
        raise ArtefactError(f"{path} is not whole JSON ({error}). Run the manifest again.") from None
    if not isinstance(content, dict):
        raise ArtefactError(f"{path}: expected a JSON object, found a {type(content).__name__}.")
    empty = {"name": path.parent.name, "created": "", "status": "", "error": None, "total_seconds": None}
    lists: dict[str, Any] = {"manifest": {}, "versions": {}, "machine": {}, "scenes": [], "stages": []}
    run = {**empty, "peak_memory_mb": None, "work_seconds": None, **lists, **content}
    run["scenes"] = run["scenes"] or list(
        dict.fromkeys(row["scene"] for row in run["stages"] if row.get("scene"))
    )
    return run


def _summary(run: dict[str, Any]) -> list[tuple[str, str]]:
    parts = [("started", str(run["created"]).replace("T", " ").replace("+00:00", " UTC"))]
    if run["total_seconds"] is not None:
        work = run["work_seconds"]
        detail = f" ({_seconds(work)} of work besides the notebooks' start-up)" if work is not None else ""
        parts.append(("time", _seconds(run["total_seconds"]) + detail))
    if run["peak_memory_mb"]:
        parts.append(("peak memory", f"{run['peak_memory_mb'] / 1000:.2f} GB"))
    # Python's version stands among the versions.
    known = [(key, value) for key, value in run["machine"].items() if key != "python"]
    machine = ", ".join(f"{value} {key}" if key == "cores" else str(value) for key, value in known)
    return [*parts, ("machine", machine)] if machine else parts


def _stages(run: dict[str, Any]) -> Table:
    rows = []
    longest = max((float(row.get("seconds") or 0) for row in run["stages"]), default=0.0)
    for row in run["stages"]:
        seconds, work = row.get("seconds"), row.get("work_seconds", row.get("kernel_seconds"))
        counts = ", ".join(
            f"{value} {key.replace('_', ' ')}" for key, value in (row.get("counts") or {}).items()
        )
        memory = row.get("peak_memory_mb")
        name = " ".join(str(part) for part in (row.get("stage", ""), row.get("part")) if part)
        shade = 0.4 * float(seconds) / longest if seconds and longest else None
        texts = [str(row.get("scene") or ""), name, str(row.get("status", ""))]
        times = [
            Cell(_seconds(seconds), shade),
            Cell(_seconds(work)),
            Cell(f"{memory:.0f} MB" if memory else "–"),
        ]
        rows.append([*map(Cell, texts), *times, Cell(counts)])
    return Table(["scene", "stage", "status", "time", "of it work", "peak memory", "counts"], rows)


def _scene(files: SceneFiles, album: "_Album") -> Scene:
    scene = Scene(files.scene)
    recall = _read_table(files.evaluation / "recall.csv")
    thresholds = [column for column in recall.columns if column.startswith("recall@")]
    if thresholds:
        done = recall.dropna(subset=thresholds)
        for column in thresholds:
            name = _threshold(column.removeprefix("recall@"))
            scene.headlines.append((f"{_percent(done[column].mean())} %", f"mean recall at {name}"))
            scene.recall.append(_matrix(recall, column, f"Recall at {name} [%]", _percent, lambda v: 0.9 * v))
        for column, title, factor in (
            ("median_rotation_deg", "Median rotation error [°]", 1.0),
            ("median_translation_m", "Median translation error [cm]", 100.0),
        ):
            scene.medians.append(_matrix(recall, column, title, lambda v, f=factor: _error(v * f)))
        if "ok_wrong" in done:
            scene.headlines.append(
                (f"{_percent(_weighted(done, 'ok_wrong'))} %", "called ok, but beyond 5°, 0.5 m")
            )
    if len(recall):
        scene.pairs = _pairs(recall, thresholds)
        scene.messages = _messages(files.evaluation / "recall.csv")
    losses = _read_table(files.evaluation / "losses.csv")
    scene.losses, scene.missed = _losses(losses), int(losses.get("missed", pd.Series(dtype=float)).sum())
    scene.retrieval, scene.retrieval_note = _retrieval(_read_table(files.evaluation / "retrieval.csv"))
    for name, caption in EVALUATION_FIGURES.items():
        if (path := files.evaluation / f"{name}.png").is_file():
            scene.figures.append(album.picture(path, caption))
    stills = sorted(files.visualization.glob("*.png"))
    samples = [path for path in stills if path.name.startswith("localization")]
    scene.maps = [album.picture(path) for path in stills if path not in samples]
    scene.samples = [album.picture(path) for path in samples]
    scene.recordings = [
        str(path.relative_to(files.run)) for path in sorted(files.visualization.glob("*.rrd"))
    ]
    return scene


def _read_table(path: Path) -> pd.DataFrame:
    try:
        return pd.read_csv(path)
    except (FileNotFoundError, pd.errors.EmptyDataError):
        return pd.DataFrame()


def _messages(table: Path) -> list[str]:
    try:
        settings = json.loads(sidecar_path(table).read_text(encoding="utf-8"))["settings"]
    except (OSError, ValueError, KeyError):
        return []
    return list(settings.get("messages", []))


def _matrix(
    table: pd.DataFrame, column: str, title: str, text: Any, shade: Any = lambda value: None
) -> Matrix:
    queries = list(dict.fromkeys(table["query_device"]))
    values = table.set_index(["map_device", "query_device"])[column].to_dict()
    rows = []
    for map_ in dict.fromkeys(table["map_device"]):
        cells = [values.get((map_, query), math.nan) for query in queries]
        rows.append((map_, [Cell("–") if math.isnan(v) else Cell(text(v), shade(v)) for v in cells]))
    return Matrix(title, queries, rows)


def _pairs(recall: pd.DataFrame, thresholds: list[str]) -> Table:
    counts = [c for c in ("queries", "localized", "ok", "low_confidence", "failed") if c in recall]
    columns = ["map", "query", *(c.replace("_", " ") for c in counts)]
    columns += [f"recall {_threshold(c.removeprefix('recall@'))}" for c in thresholds]
    titles = {
        "median_rotation_deg": "median °",
        "median_translation_m": "median cm",
        "ok_wrong": "ok but wrong",
    }
    errors = [c for c in titles if c in recall]
    columns += [titles[c] for c in errors]
    factors = {"median_rotation_deg": 1.0, "median_translation_m": 100.0}
    rows = []
    for row in recall.to_dict("records"):
        cells = [Cell(str(row["map_device"])), Cell(str(row["query_device"]))]
        cells += [Cell("–" if pd.isna(row[c]) else f"{row[c]:.0f}") for c in counts]
        cells += [_share(row[c]) for c in thresholds]
        cells += [
            Cell(_error(row[c] * factors[c])) if c in factors else Cell(_share(row[c]).text) for c in errors
        ]
        state = str(row.get("state", "evaluated"))
        rows.append([*cells, Cell("" if state == "evaluated" else state)])
    return Table([*columns, "note"], rows)


def _losses(losses: pd.DataFrame) -> Table | None:
    """Sum over the pairs of each map device, and of all."""
    if "threshold" not in losses or losses["threshold"].isna().all():
        return None
    known = losses.dropna(subset=["threshold"])
    rows = []
    for threshold, group in known.groupby("threshold", sort=False):
        parts = [(str(m), part) for m, part in group.groupby("map_device", sort=False)]
        for name, part in [*parts, ("all", group)]:
            queries = part["queries"].sum()
            shares = [part[reason].sum() / queries for reason in REASONS]
            label = _threshold(str(threshold)) if name == parts[0][0] else ""
            cells = [Cell(label), Cell(name), Cell(f"{queries:.0f}"), Cell(f"{part['missed'].sum():.0f}")]
            rows.append(cells + [Cell(f"{_percent(share)} %", 1.2 * share) for share in shares])
    return Table(["threshold", "map", "queries", "missed", *REASONS], rows)


def _retrieval(retrieval: pd.DataFrame) -> tuple[list[Matrix], str]:
    ks = [column for column in retrieval.columns if column.startswith("recall@")]
    known = retrieval.dropna(subset=ks) if ks else retrieval.iloc[:0]
    if not len(known):
        return [], ""
    titles = {k: f"In the first {k.removeprefix('recall@')} [%]" for k in ks}
    titles["in_map"] = "Anywhere in the map [%]"
    matrices = [_matrix(retrieval, c, titles[c], _percent, lambda v: 0.9 * v) for c in titles if c in known]
    radius_m, angle_deg = known["radius_m"].iloc[0], known["angle_deg"].iloc[0]
    note = f"A good reference stands within {radius_m:g} m of the query's true camera and looks the same way "
    return matrices, f"{note}to within {angle_deg:g}°."


def _weighted(table: pd.DataFrame, column: str) -> float:
    return float((table[column] * table["queries"]).sum() / table["queries"].sum())


def _share(share: float) -> Cell:
    return Cell("–") if math.isnan(share) else Cell(f"{_percent(share)} %", 0.9 * share)


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.1f}".removesuffix(".0")


def _error(value: float) -> str:
    if not math.isfinite(value):
        return "∞" if math.isinf(value) else "–"
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def _seconds(seconds: float | None) -> str:
    if seconds is None:
        return "–"
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{int(seconds) // 60} min {int(seconds) % 60} s"


def _threshold(name: str) -> str:
    degrees, _, metres = name.strip("()").partition(",")
    return f"{degrees.removesuffix('deg')}°, {metres.removesuffix('m')} m"


class _Album:
    """Turns picture files into data URLs until the page has no room left."""

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self.left_out: list[str] = []
        self._room = PICTURE_BUDGET

    def picture(self, path: Path, caption: str = "") -> Picture:
        """Return a picture for the page; the caption is the file's own where none is given."""
        from PIL import Image

        name = str(path.relative_to(self.run_dir))
        try:
            with Image.open(path) as image:
                info = getattr(image, "text", {})
                caption = (
                    caption or info.get("Description") or info.get("Title") or path.stem.replace("_", " ")
                )
                data, kind = path.read_bytes(), "png"
                if image.width > MAX_WIDTH or len(data) > 150_000:
                    small = image.convert("RGB")
                    small.thumbnail((MAX_WIDTH, 10 * MAX_WIDTH))
                    stream = io.BytesIO()
                    small.save(stream, "JPEG", quality=85, optimize=True)
                    # Plots are often smaller as they are.
                    if stream.tell() < len(data):
                        data, kind = stream.getvalue(), "jpeg"
        except OSError as error:
            return Picture("", f"{name} cannot be read: {error}", name)
        if len(data) > self._room:
            self.left_out.append(name)
            return Picture("", caption, name)
        self._room -= len(data)
        return Picture(f"data:image/{kind};base64,{base64.b64encode(data).decode()}", caption, name)
