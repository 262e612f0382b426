"""Functions that notebooks call, that read their parameters and results, and that execute them.

`start` resolves a notebook's folders, so that each notebook runs alone on the demo capture. `finish` hands the counts
to the pipeline.
"""

import ast
import inspect
import json
import logging
import os
import re
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cached_property
from html import escape
from importlib import import_module
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tqdm.auto
import tqdm.std
from pydantic import BeforeValidator, ConfigDict, Field, NonNegativeInt, ValidationError, create_model

from toolkit import errors
from toolkit.errors import COMMAND, CaptureError, ManifestError, StageError, shortage
from toolkit.files import (
    IMPORTED,
    SceneFiles,
    link_folder,
    older_files,
    project_root,
    read_json,
    relative_url,
    shipped,
    write_text,
)
from toolkit.manifest import (
    OPTIONAL,
    STAGES,
    DemoData,
    EmbedSettings,
    LocalizeSettings,
    Manifest,
    RerankSettings,
    Settings,
    nearest,
)
from toolkit.manifest.settings import explain
from toolkit.runs.folder import LOG_VARIABLE, RECORD, TAKEN, counts_text, log_to
from toolkit.runs.kernel import TEXT_BARS, Kernels, MemoryWatch, kernel_error
from toolkit.runs.pairs import left_out_of

if TYPE_CHECKING:
    import pandas as pd
    from pandas.io.formats.style import Styler
    from papermill.exceptions import PapermillExecutionError

    from toolkit.scene.run import Run

log = logging.getLogger(__name__)

NOTEBOOKS = shipped("notebooks")
Say = Callable[..., None]
"""Function that prints the progress lines of a run; called like `print`."""
COUNTS_MIME = "application/vnd.visual-localization.counts+json"
# The stages whose results each stage reads, besides the capture. If one of them runs again, so does the stage.
UPSTREAM: dict[str, tuple[str, ...]] = {
    "explore": (), "embed": (), "retrieve": ("embed",), "rerank": ("retrieve",), "localize": ("retrieve", "rerank"),
    "sequence": ("localize",), "evaluate": ("retrieve", "rerank", "localize", "sequence"),
    "visualize": ("retrieve", "localize", "sequence"),
}  # fmt: skip

_FILLED = {"rerank": ("features_dir",), "localize": ("features_dir", "map_dir")}
"""Parameters of notebooks that name a cache which their stage adds to."""

# nbconvert's page, without the scripts that it loads from other servers.
_PAGE = """{% extends "lab/index.html.j2" %}
{% block html_head_js %}{% endblock %}
{% block html_head_js_mathjax %}{% endblock %}
{% block html_head_js_mermaidjs %}{% endblock %}
"""

if TEXT_BARS in os.environ:
    # Every stage imports its progress bar from tqdm.auto, after this module.
    tqdm.auto.tqdm = tqdm.std.tqdm


class Folders(SimpleNamespace):
    """The resolved folders of a notebook, as attributes, and the values that hold for its parameters: those of the
    running notebook as they are now or, for None, `all` and `auto`, those of the run. Displayed as a table and a list.
    """

    def __init__(self, stage: str, manifest: Manifest, finished: Path | None = None, **folders: Path | None) -> None:
        super().__init__(**folders)
        self._stage, self._manifest, self._finished = stage, manifest, finished
        self._checked: tuple[str, Settings | None] = "", None

    @property
    def finished_run(self) -> "Run | None":
        """The finished run whose results are taken, to take one query in the hand; None while a run is being made."""
        if self._finished is None:
            return None
        from toolkit.scene.run import Run  # takes most of a second, which stages do not need

        return Run.open(self._finished)

    @property
    def settings(self) -> Any:
        """The settings model of the stage, validated again only if a parameter has changed."""
        values, known = _user_names(), notebook_parameters(notebook_path(self._stage))
        if (given := repr({name: values.get(name) for name in known})) != self._checked[0]:
            self._checked = given, check_values(self._stage, values, self._manifest.stage(self._stage))
        return self._checked[1]

    @property
    def thresholds(self) -> Any:
        """The run's thresholds of recall, [degrees, meters] each."""
        return self._manifest.evaluate.thresholds

    @property
    def queries(self) -> str:
        """The name of a list of keyframes."""
        return _user_names().get("queries") or self._manifest.queries

    @property
    def pairs(self) -> list[list[str]] | None:
        """The pairs [map device, query device], of the run those with the chosen devices; None: all with these."""
        values = _user_names()
        chosen = [{values.get(name, "all")} - {"all"} for name in ("map_device", "query_device")]
        of_run = [pair for pair in self._selected.get("pairs", ()) if chosen[0] <= {pair[0]} and chosen[1] <= {pair[1]}]
        return values.get("pairs") or of_run or None

    @property
    def device(self) -> str | list[str]:
        """The devices whose images are embedded; auto: all."""
        given = _user_names().get("device", "auto")
        return given if given != "auto" else self._selected.get("device", "auto")

    @cached_property
    def _selected(self) -> dict[str, Any]:
        return selection(self._manifest, self.sessions_root.parent) if self._finished else {}

    @property
    def values(self) -> "pd.DataFrame":
        """Parameters, and settings not at their defaults: the `value`, `from` the notebook, the run or the default."""
        import pandas as pd

        default, of_run = Manifest.defaults(self._stage).flat(), self._manifest.stage(self._stage).flat()
        settings = self.settings.flat()
        now = {"queries": self.queries, "pairs": self.pairs or "all", "device": self.device, **settings}
        run = {"queries": self._manifest.queries, "pairs": "all", "device": "auto", **self._selected, **of_run}
        plain = {"queries": Manifest.model_fields["queries"].default, "pairs": "all", "device": "auto", **default}
        known = [*notebook_parameters(notebook_path(self._stage))]
        names = [name for name in known if name in now]
        absent = object()  # a section that is null is one value, else several
        names += [name for name in settings if name not in known and now[name] != plain.get(name, absent)]
        given = "run" if LOG_VARIABLE in os.environ else "notebook"  # as a run fills its notebooks in
        at = [(now[name], run.get(name, absent), plain.get(name, absent)) for name in names]
        rows = [(str(a), given if a != b else "run" if a != c else "default") for a, b, c in at]
        return pd.DataFrame(rows, names, ["value", "from"])

    def command(self, changes: Mapping[str, Any]) -> str:
        """Return the command that tries changes, values by keys of a manifest, with all queries of the run."""
        file = project_root() / "data_manifests" / f"{Path(_user_names().get('run') or '').name}.yaml"
        words = [COMMAND, "run", str(file) if file.is_file() else "MANIFEST"]
        for key, value in changes.items():
            section, *names = key.split(".")
            before = self.settings if section == self._stage else getattr(self._manifest, section, None)
            for name in names:
                before = getattr(before, name, None)
            words += ["--sweep", f"{key}={_of_manifest(before)},{_of_manifest(value)}"]
        return shlex.join(words)

    def __repr__(self) -> str:
        return f"{self.values.to_string()}\n\n{self._listed()}"

    def _listed(self) -> str:
        shown = {name: path for name, path in vars(self).items() if path and not name.startswith("_")}
        return "\n".join(f"{name:<{max(map(len, shown))}}  {path}" for name, path in shown.items())

    def _repr_html_(self) -> str:
        import pandas as pd

        with pd.option_context("display.max_colwidth", None):
            table = self.values.to_html()
        return f"{table}<details><summary>Folders</summary><pre>{escape(self._listed())}</pre></details>"


def _of_manifest(value: Any) -> str:
    """Return a setting as a manifest has it, in one line."""
    value = getattr(value, value.shorthand) if getattr(value, "shorthand", "") else value
    return value if isinstance(value, str) else json.dumps(value, default=str)


def selection(manifest: Manifest, capture: Path) -> dict[str, Any]:
    """Return the parameters that select `pairs` and `devices` of a capture as the manifest does; {}: all of them."""
    from toolkit.capture import Capture

    content = Capture.open(capture)
    present = content.devices
    devices = present if manifest.devices == "auto" else [key for key in present if key in manifest.devices]
    if manifest.pairs != "all":
        pairs = [list(pair) for pair in manifest.pairs if {*pair} <= {*devices}]
    elif manifest.devices != "auto":
        # Without any map or query session, the stages say what is missing.
        maps, queries = ([d for d in present if f"{d}_{split}" in content] or present for split in ("map", "query"))
        pairs = [[m, q] for m, q in product(maps, queries) if {m, q} <= {*devices}]
    else:
        return {}
    if not pairs:
        text = f"{capture}: `devices` and `pairs` of the manifest select none of its maps with queries."
        raise ManifestError(f"{text} Its sessions: {', '.join(content)}.")
    return {"pairs": pairs, "device": [key for key in present if any(key in pair for pair in pairs)]}


def start(stage: str, sessions_root: str | None = None, run: str | None = None, **folders: str | None) -> Folders:
    """Resolve the folders of a notebook; check its parameters.

    Args:
        stage: name of the stage, one of `toolkit.manifest.STAGES`.
        sessions_root: folder `sessions` of a capture; None: that of the run.
        run: run folder, see `find_run`. If it is absent, and the demo's, the demo capture is rendered.
        **folders: the notebook's other folders by the names of its parameters; None: below `<run>-by-hand/` beside the
            run, or `runs/<scene>-by-hand/` of the repository, see `_take_from_run`. If such a default folder lacks the
            results of an earlier stage, or they are older than those of the stage before it, that stage runs now.
            References are the reranked ones if the run has them, unless they are older than what notebook 03 made.

    Raises:
        ManifestError: a parameter is unknown to the notebook, or has a wrong type; or the folder for the results of a
            notebook that a person runs lies in a finished run, which changes only by its manifest.
        CaptureError: a device or list of queries in the parameters has no session in the capture.
    """
    run_log = os.environ.get(LOG_VARIABLE)
    if run_log:
        logging.captureWarnings(True)
        log_to(Path(run_log))
    check_given(stage)
    sessions, taken_from = sessions_of(run, sessions_root)
    scene = sessions.parent.name
    by_hand = taken_from.with_name(f"{taken_from.name}-by-hand") if taken_from else None
    files = SceneFiles(by_hand or project_root() / "runs" / f"{scene}-by-hand", scene)
    source = None if run_log else taken_from or _finished_run(files.run.parent, scene)
    manifest = _manifest_of(source, sessions)
    found = Folders(stage, manifest, source, sessions_root=sessions)
    _ = found.settings  # checks the parameters
    _check_devices_and_queries(stage, sessions, manifest.queries)
    if run_log is None and None in folders.values():
        _take_from_run(stage, files, source)
    reranked = manifest.rerank is not None and files.reranked_dir.is_dir()
    if reranked and (older := older_files(files.reranked_dir, "rerank")):
        reranked = False
        print(f"{next(iter(older.values()))} Not used: run notebook 03b for it.")
    defaults = files.folders(stage, reranked)
    made = {defaults.get(name) for name, folder in folders.items() if folder is None}
    _make_upstream(stage, sessions, files, made, source)
    for name, folder in folders.items():
        given = Path(folder).expanduser().resolve() if folder else None
        setattr(found, name, given or defaults.get(name))
        written = defaults.get(name) == files.of_stage(stage) or name in _FILLED.get(stage, ())
        if given and run_log is None and written:
            _require_outside_of_runs(name, given)
    return found


def find_run(run: str | Path) -> Path:
    """Return a run folder: as given, relative to the notebook, or else relative to the repository."""
    path = Path(run).expanduser()
    return path.resolve() if path.is_absolute() or path.is_dir() else (project_root() / path).resolve()


def is_demo(run: Path) -> bool:
    """Tell whether a folder is that of the demo's run, whether it has run or not."""
    return run == (project_root() / "runs" / "demo").resolve()


def _require_outside_of_runs(name: str, folder: Path) -> None:
    """Refuse a folder of results, the value of the parameter `name`, that belongs to a finished run."""
    run = next((parent for parent in (folder, *folder.parents) if (parent / RECORD).is_file()), None)
    if run is not None:
        found = f"a folder of the run {run}, which changes only by its manifest"
        raise ManifestError.at(name, found, do="Leave it out, or give another folder.")


def sessions_of(run: str | None, sessions_root: str | None) -> tuple[Path, Path | None]:
    """Return the folder `sessions` of a notebook's capture, and the finished run that it is of, if any; see `start`."""
    if sessions_root is None and run is not None:
        stages = read_json((found := find_run(run)) / RECORD).get("stages")
        if stages:
            return Path(stages[0]["parameters"]["sessions_root"]).expanduser().resolve(), found
        if not is_demo(found):
            from toolkit.results.pair import no_such_run  # takes half a second, for an error alone

            raise no_such_run(found, "run")
    if sessions_root is not None:
        return Path(sessions_root).expanduser().resolve(), None
    from toolkit.synthetic import render_capture

    demo = render_capture(project_root() / "data" / "demo", **DemoData(hard=True).model_dump())
    return demo / "sessions", None


def own_folder(folder: str | None, scene: str, images: str | None = None) -> Path:
    """Return the folder for a capture of the user's own images, and for its results: as given, else
    `<images>-localized` beside the folder `images`, or without images `data/<scene>` of the repository.
    """
    if folder is not None:
        given = Path(folder).expanduser().resolve()
        _require_outside_of_runs("out_dir", given)
        return given
    if images is None:
        return project_root() / "data" / scene
    beside = Path(images).expanduser().resolve()
    return beside.with_name(f"{beside.name}-localized")


def readable(table: "pd.DataFrame") -> "pd.DataFrame":
    """Return a stage's table as texts that fit a page: rows `<query> in <map>`, medians and recall first, no folders.

    Columns without information are dropped. Errors of positions in meters are shown in cm, recall in %. Names of
    columns are shortened where the unit implies the quantity.
    """
    from toolkit.results.metrics import small_unit, threshold_text

    trivial = {"state": "evaluated", "reason": ""}
    dropped = [name for name, text in trivial.items() if name in table and (table[name] == text).all()]
    shown = table.drop(columns=["path", "localized", *dropped], errors="ignore")
    if "map_device" in shown:
        between = "\N{NO-BREAK SPACE}in\N{NO-BREAK SPACE}"  # or narrow pages break the name of each row
        shown.index = shown.pop("query_device") + between + shown.pop("map_device")
    for name in {"still", "recording"} & {*shown}:
        shown[name] = [Path(path).name for path in shown[name]]
    if "threshold" in shown:
        shown["threshold"] = shown["threshold"].map(threshold_text, na_action="ignore")
    words = ("step", "threshold", "median", "recall@")
    first = [name for word in words for name in shown if name.startswith(word)]
    shown = shown[[*first, *(name for name in shown if name not in first)]]
    small, factor = small_unit("m")
    for name in [name for name in shown if name.endswith(("translation_m", "translation_error_m"))]:
        shown[name] *= factor
        shown = shown.rename(columns={name: f"{name.removesuffix('m')}{small}"})
    texts = {name: _texts(shown[name]) for name in shown.select_dtypes(float)}
    return shown.assign(**texts).rename(columns=_short_column)


def _texts(column: "pd.Series[float]") -> "pd.Series[str]":
    """Return numbers with about three significant digits; recall in %."""
    from toolkit.figures.style import number, percent

    if str(column.name).startswith("recall@"):
        return column.map(percent)
    return column.map(lambda value: f"{value:.0f}" if float(value).is_integer() else number(value))


def linked(table: "pd.DataFrame", sessions_root: Path | None = None) -> "Styler":
    """Return a table of queries whose column `image` links to the image files, as a notebook shows it.

    It has an index or a column `pair`, `<query device> in <map device>`, and the user's names of images joined by `;`.
    `sessions_root` is `<capture>/sessions`; None: the column `sessions_root`, a folder or None for each query.
    """
    from toolkit.figures.query_images import MAX_LETTERS, shown_name
    from toolkit.pose.base import short_status

    def links(pair: str, names: str, root: Path | None) -> str:
        raw_data = (root or Path()).resolve() / f"{pair.split()[0]}_query" / "raw_data"
        shown = []
        for name in filter(None, names.split(";")):
            path = next((path for path in (raw_data / name, raw_data / IMPORTED / name) if path.is_file()), None)
            text, link = escape(shown_name(name, MAX_LETTERS)), f"target='_blank' title='{escape(name)}'"
            shown.append(f"<a href='{relative_url(path)}' {link}>{text}</a>" if root and path else text)
        return " ".join(shown)

    table = table.drop(columns=["timestamp", "device_id"], errors="ignore")  # as the image's name tells
    # A Styler needs unique names of rows.
    table = table.reset_index(names="pair", drop=table.index.inferred_type != "string")
    roots = table.pop("sessions_root") if "sessions_root" in table else [sessions_root] * len(table)
    rows = zip(table["pair"], table["image"].fillna(""), roots, strict=True)
    table["image"] = [links(*row) for row in rows]
    texts = {name: _texts(table[name]) for name in table.select_dtypes(float)}
    texts |= {name: table[name].map(short_status) for name in {"status"} & {*table}}
    shown = table.assign(**texts).style.set_properties(**{"text-align": "left"}).hide(axis="index")
    shown = shown.set_properties(subset=["pair"], **{"white-space": "nowrap"})
    shown = shown.set_properties(subset=["image"], **{"overflow-wrap": "anywhere", "min-width": "12em"})
    shown = shown.set_table_styles([{"selector": "th", "props": "text-align: left"}])
    return shown.format(escape="html", subset=[name for name in table.columns if name != "image"])


def _short_column(name: str) -> str:
    """Return `median_deg` for `median_rotation_deg`, and `recall 1°, 0.1 m [%]` for `recall@(1deg,0.1m)`."""
    from toolkit.results.metrics import threshold_text

    if name.startswith("recall@"):
        return f"{f'recall {threshold_text(name)}' if '(' in name else name} [%]"
    return re.sub(r"(rotation|translation)_(?=\w*(deg|m|L)$)", "", name)


def choose_photograph(scene_map: Any) -> None:
    """Show a file chooser that localizes photographs of one's own in an open `Map`; nothing without a live notebook."""
    from IPython.display import display

    if TEXT_BARS in os.environ:
        return
    import ipywidgets

    from toolkit.localize import localize_image
    from toolkit.scene.query import guessed_camera, with_focal

    chooser = ipywidgets.FileUpload(description="photograph", accept="image/*")
    focal = ipywidgets.FloatText(description="focal [px]", tooltip="0: from EXIF, or estimated")
    out = ipywidgets.Output()

    def localize(_: Any) -> None:
        out.clear_output()
        with out, TemporaryDirectory() as folder:
            (chosen,) = chooser.value
            file = Path(folder) / Path(chosen["name"]).name
            file.write_bytes(chosen["content"])
            try:
                camera = with_focal(guessed_camera(file).camera, focal.value) if focal.value > 0 else None
                result = localize_image(scene_map, file, camera)
                display(result, result.show(), result.show_3d())
            except errors.ToolkitError as error:
                print(error)

    chooser.observe(localize, "value")
    display(ipywidgets.HBox([chooser, focal]), out)


_STATUSES = ("ok", "low_confidence", "failed")
_BALANCES = {"images": ("embedded", "unreadable"), "queries": _STATUSES, "frames": _STATUSES}
"""Counts that are the sums of others: what a stage was asked for, and what became of it."""


def finish(table: "pd.DataFrame | None" = None, **counts: Any) -> None:
    """Display a notebook's counts, e.g. `images=120`, and hand them to the pipeline, with this process's peak memory.

    Rows of the stage's table with a `reason` count as left out. Raise AssertionError if counts that belong together,
    see `_BALANCES`, do not balance.
    """
    import resource

    from IPython.display import display

    unit = 2**20 if sys.platform == "darwin" else 2**10  # bytes on macOS, kilobytes elsewhere
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    plain = {name: value.item() if hasattr(value, "item") else value for name, value in counts.items()}
    for total, parts in _BALANCES.items():
        if {total, *parts} <= plain.keys():
            done = sum(plain[name] for name in parts)
            assert plain[total] == done, f"{total} were lost: {done} of {plain[total]} have a result"
    text = f"{counts_text(plain)}; peak memory {peak:.0f} MB"
    content = {**plain, "peak_memory_mb": round(peak, 1)}
    if table is not None:
        content |= {"asked": len(table), "left_out": left_out_of(table)}
        text = "\n".join([text, *(f"left out: {one['what']}: {one['reason']}" for one in content["left_out"])])
    display({"text/plain": text, COUNTS_MIME: content}, raw=True)


def notebook_path(stage: str) -> Path:
    """Return the notebook of a stage, `<number>_<stage>.ipynb`, or `start.ipynb`."""
    path = next(iter(sorted([*NOTEBOOKS.glob(f"[0-9]*_{stage}.ipynb"), *NOTEBOOKS.glob(f"{stage}.ipynb")])), None)
    if path is None:
        raise ManifestError.at(NOTEBOOKS, f"no notebook for the stage {stage}", do="Install the toolkit again.")
    return path


def copy_notebooks(folder: Path) -> list[str]:
    """Copy the notebooks into a folder for a person to change; return a sentence per newer one of a changed copy."""
    before = folder / ".from"
    before.mkdir(parents=True, exist_ok=True)
    kept = []
    for new in sorted(NOTEBOOKS.glob("*.ipynb")):
        mine, earlier = folder / new.name, before / new.name
        if not mine.exists() or (earlier.exists() and mine.read_bytes() == earlier.read_bytes()):
            shutil.copyfile(new, mine)
            shutil.copyfile(new, earlier)
        elif earlier.exists() and earlier.read_bytes() != new.read_bytes():
            kept.append(f"{new} is newer than {mine}, which you have changed: delete yours to take it.")
    return kept


def notebook_parameters(path: Path) -> dict[str, Any]:
    """Return names and defaults from the cell tagged `parameters`; raise ManifestError if it has more than literals."""
    try:
        return _literals(_listing(path))
    except (SyntaxError, ValueError) as error:
        raise ManifestError(f"{path}: parameters must be `name = literal` lines only ({error}).") from None


def _listing(path: Path) -> str:
    """Return the cell tagged `parameters` of a notebook."""
    # Read as JSON, because importing nbformat takes seconds in each kernel.
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if "parameters" in cell["metadata"].get("tags", []):
            return "".join(cell["source"])
    raise ManifestError(f"{path}: no cell is tagged `parameters`.")


def check_parameters(path: Path, parameters: Iterable[str]) -> None:
    """Raise ManifestError for parameters that the notebook `path` does not have; papermill would only warn."""
    known = notebook_parameters(path)
    for name in parameters:
        if name not in known:
            raise ManifestError(f"{name}: {path.name} has no such parameter. {nearest(name, known)}")


def _take_from_run(stage: str, files: SceneFiles, run: Path | None) -> None:
    """Link the results of a finished run, new ones if that changes, where no notebook by hand has made its own. Caches
    are taken once, as stages find in them what still fits.
    """
    record, made_here = files.root / ".taken.json", files.of_stage(stage)
    taken = read_json(record)
    if made_here is not None:
        taken.pop(made_here.name, None)  # the links stay until the stage replaces them; from now on they are its own
    results = {folder for stage in TAKEN if (folder := files.of_stage(stage))}
    for target in (*sorted(results), *files.caches):
        name = target.name
        if run is None or target == made_here or (target.exists() and name not in taken):
            continue
        source, state = run / files.scene / name, f"{run}, {read_json(run / RECORD).get('created')}"
        if source.is_dir() and taken.get(name) != state:
            shutil.rmtree(target, ignore_errors=True)
            link_folder(source, target)
            taken |= {name: state} if target in results else {}
            print(f"{name}: taken from {run}")
    if taken or record.exists():
        write_text(record, json.dumps(taken) + "\n")


def _finished_run(runs: Path, scene: str) -> Path | None:
    """Return the run called `<scene>`, or else the latest finished run of the scene; None if there is none."""
    records = {path.parent: read_json(path) for path in sorted(runs.glob(f"*/{RECORD}"))}
    with_scene = [run for run, record in records.items() if scene in record.get("scenes", ())]
    return max(with_scene, key=lambda run: (run.name == scene, str(records[run].get("created"))), default=None)


def _make_upstream(stage: str, sessions: Path, files: SceneFiles, folders: set[Path | None], run: Path | None) -> None:
    """Run the earlier stages whose results `stage` needs and whose folder is in `folders` and empty or absent."""
    for name in UPSTREAM[stage]:
        folder = files.of_stage(name)
        if folder is None or name in OPTIONAL or folder not in folders:
            continue
        _make_upstream(name, sessions, files, {files.of_stage(earlier) for earlier in UPSTREAM[name]}, run)
        if not (folder.is_dir() and any(folder.iterdir())):
            print(f"{name}: no results yet, running it now into {folder}")
        elif older := older_files(folder, name):
            print(f"{next(iter(older.values()))} Running it now.")
        else:
            continue
        _run_stage(name, sessions, files, run)


def _manifest_of(run: Path | None, sessions: Path) -> Manifest:
    """Return the manifest of a finished run, or the default one for a capture."""
    content = read_json(run / RECORD).get("manifest") if run else None
    return Manifest.of(content or {"name": "by-hand", "captures": [str(sessions.parent)]})


def _run_stage(stage: str, sessions: Path, files: SceneFiles, run: Path | None) -> None:
    """Run `embed`, `retrieve` or `localize` with the settings of the run that results are taken from, or defaults."""
    manifest, name = _manifest_of(run, sessions), "embed_sessions" if stage == "embed" else f"{stage}_pairs"
    values = {"queries": manifest.queries, **selection(manifest, sessions.parent), **files.folders(stage)}
    run_stage = getattr(import_module(f"toolkit.{stage}"), name)
    known = values.keys() & inspect.signature(run_stage).parameters.keys()
    run_stage(sessions, settings=manifest.stage(stage), **{key: values[key] for key in known})


def _user_names() -> dict[str, Any]:
    """Return the variables of the running notebook; {} outside a notebook."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return shell.user_ns if shell else {}


def check_given(name: str) -> None:
    """Refuse, by a ManifestError that names them, wrong parameter values in the running notebook, but for settings of
    a stage, and unknown parameters that papermill has injected.
    """
    values = _user_names()
    for source in values.get("In", []):
        if source.startswith("# Parameters\n"):
            check_parameters(notebook_path(name), _literals(source))
    check_values(name, {key: value for key, value in values.items() if key not in _of_stage(name)})


_OWN = ("photographs", "map_images", "query_images")
_NEEDS = {"map_table": ("map_images",), "query_table": ("query_images",), "camera": _OWN, "hold_out": ("photographs",),
          "poses_are": _OWN[1:], "unit_m": _OWN[1:]}  # fmt: skip
"""Of notebook 00: parameters that have an effect only if one of these is given, too."""
_EXCLUDES = {"photographs": ("map_images",), "run": (*_OWN, "sessions_root"), "sessions_root": _OWN,
             "hold_out": ("query_images",)}  # fmt: skip
"""Of notebook 00: parameters that have no effect if one of these is given."""


def _check_own_images(given: Mapping[str, Any]) -> None:
    """Refuse parameters of notebook 00 that would have no effect, and files that are not there."""
    for name, found in given.items():
        if name in (*_OWN, "map_table", "query_table", "sessions_root") and not Path(found).expanduser().exists():
            raise ManifestError(f"{name}: found {str(found)!r}, which does not exist.")
        if name in _NEEDS and not {*_NEEDS[name]} & given.keys():
            raise ManifestError(f"{name}: found {found!r}, which has no effect without {' or '.join(_NEEDS[name])}.")
        if other := next((other for other in _EXCLUDES.get(name, ()) if other in given), None):
            raise ManifestError(f"{name}: found {found!r}, which has no effect with {other}. Give one of them.")
    if "map_images" in given and "map_table" not in given:
        do = "Give a table, or name the folder in photographs instead: then the poses are estimated"
        raise ManifestError(f"map_table: found None, but a map needs poses. {do}.")
    if "query_images" in given and not given.keys() & {*_OWN[:2]}:
        raise ManifestError("map_images: found None, expected the folder of your map, with query_images.")
    if given.get("hold_out", 2) < 2:
        raise ManifestError(f"hold_out: found {given['hold_out']}, expected 2 or more, for some queries.")
    if "map_images" in given and "query_images" not in given:
        raise ManifestError("query_images: found None, expected the folder of your queries, with map_images.")


def _check_devices_and_queries(stage: str, sessions: Path, queries: str) -> None:
    """Refuse parameters of the running notebook that name devices or query lists, by default the list `queries`, which
    the capture does not have.
    """
    from toolkit.capture import Capture

    values, known = _user_names(), notebook_parameters(notebook_path(stage))
    asked = {name: values[name] for name in known if name in values}
    if "queries" in asked:
        asked["queries"] = asked["queries"] or queries
    if not asked:
        return
    name = "sessions_root"
    try:
        capture = Capture.from_sessions_root(sessions)
        for pair in asked.get("pairs") or ():
            if not {*pair} <= {*capture.devices}:
                expected = f"[map device, query device] of {', '.join(capture.devices)}"
                raise ManifestError.at("pairs", f"{pair}", expected)
        for name, split in (("map_device", "map"), ("query_device", "query")):
            if name in asked:
                capture.devices_with(split, asked[name])
        name = "queries"
        if asked.get(name, "all") != "all" and (recorded := capture.usable("query")):
            short = str(asked[name]).removesuffix(".txt").removeprefix("keyframes_")
            if not any(short in session.keyframe_files for session in recorded):
                recorded[0].keyframes(asked[name])  # raises the error
    except CaptureError as error:
        raise CaptureError(f"{name}: {error}") from None


def stage_settings(stage: str, values: Mapping[str, Any], of_run: Settings | None = None) -> Settings:
    """Return the settings of a stage: those of a run, or the defaults, overridden by the parameters of its notebook
    that are not None, and these by its dict `settings`; raise ManifestError that names a wrong one.
    """
    section = type(Manifest.defaults(stage))
    known = notebook_parameters(notebook_path(stage)).keys() & section.model_fields.keys()
    given = {key: value for key, value in values.items() if key in known and value is not None}
    settings = section.of(of_run, given, values.get("settings"))
    check_names(settings)
    return settings


def _of_stage(name: str) -> set[str]:
    """Return the names of parameters that are settings, for the notebook of a stage."""
    return {"settings", *type(Manifest.defaults(name)).model_fields} if name in STAGES else set()


def check_names(settings: Settings) -> None:
    """Raise ManifestError for unknown names of embedders, local features, matchers and indices."""
    if isinstance(settings, EmbedSettings):
        from toolkit.embedders import resolve_name

        for name in settings.models:
            if name != "auto":  # resolved later, see `resolve_model`
                resolve_name(name)
    elif isinstance(settings, LocalizeSettings | RerankSettings):
        from toolkit.features.matching import matchers_of

        kinds = [kind for kind in (*settings.features.kinds, *settings.features.escalation) if kind != "auto"]
        matchers_of(kinds or ["sift", "aliked"], settings.matcher.name)


def check_values(name: str, values: Mapping[str, Any], of_run: Settings | None = None) -> Settings | None:
    """Return a stage's settings, see `stage_settings`. Refuse, by a ManifestError that names the first one, parameters
    of the notebook `<number>_<name>.ipynb` of a wrong type or value, settings too; other names are ignored.
    """
    path, given, settings = notebook_path(name), dict[str, Any](), of_run
    defaults, meanings = notebook_parameters(path), dict(re.findall(r"^(\w+) = .*  # (.+)", _listing(path), re.M))
    if (of_stage := _of_stage(name)) & values.keys():
        with suppress(ManifestError):  # together, as one that fits the others need not fit their defaults
            settings = stage_settings(name, values, of_run)
            values = {key: value for key, value in values.items() if key not in of_stage}
    for key in [key for key in defaults if key in values]:
        given[key] = values[key]
        try:
            if key in of_stage:  # with those before it, because a matcher must fit the features
                stage_settings(name, given, of_run)
                continue
            type_of_key, meaning = _TYPES.get(key, _type_of(defaults[key])), f"{meanings.get(key)}."
            fields: dict[str, Any] = {key: (type_of_key, Field(description=meaning))}
            model = create_model(path.stem, __config__=ConfigDict(strict=True), **fields)
            model.model_validate({key: values[key]})
        except ValidationError as error:
            raise _of_parameter(key, explain(error, model, path.name)) from None
        except ManifestError as error:
            raise _of_parameter(key, str(error)) from None
    if (photo := given.get("photo")) and not Path(photo).expanduser().is_file():
        raise ManifestError(f"photo: found {str(photo)!r}, which does not exist.")
    if name == "own_images":
        _check_own_images({key: value for key, value in given.items() if value != defaults[key]})
    return settings


def _of_parameter(key: str, text: str) -> ManifestError:
    """Return an error that names the parameter of a notebook, without the class and the path of its setting."""
    lines = [re.sub(rf"^(\w+Settings|{key}[\w.]*): ", "", line) for line in text.split("\n  ")]
    return ManifestError(f"{key}: " + "\n  ".join(lines[1:] or lines))


Folder = Annotated[str, BeforeValidator(lambda path: str(path) if isinstance(path, Path) else path)]
Pair = Annotated[list[str], Field(min_length=2, max_length=2, strict=False)]  # or a tuple
_TYPES: dict[str, Any] = {
    "device": str | list[str],
    "inspect": int | str,
    "pairs": Annotated[list[Pair], Field(strict=False)] | None,
    "poses_are": Literal["world_from_cam", "cam_from_world", "rotation_of_cam_from_world"],
    "others": Annotated[list[Folder], Field(strict=False)] | None,
    "unit_m": float | None,
}
"""Types of parameters that are not those of their defaults."""


def _type_of(default: Any) -> Any:
    """Return the type of a parameter, by its default: a folder if that is None; numbers are not negative."""
    return Folder | None if default is None else NonNegativeInt if type(default) is int else type(default)


def _literals(source: str) -> dict[str, Any]:
    """Return names and values of the `name = literal` lines of a cell; raise ValueError for any other line."""
    values = {}
    for node in ast.parse(source).body:
        target = node.targets[0] if isinstance(node, ast.Assign) and len(node.targets) == 1 else None
        if not (isinstance(node, ast.Assign) and isinstance(target, ast.Name)):
            raise ValueError(f"line {node.lineno}: {ast.unparse(node)}")
        values[target.id] = ast.literal_eval(node.value)
    return values


class StatusLine:
    """The progress of a running stage: on a terminal, the progress bar of the kernel; in a log, a line now and then."""

    def __init__(self, head: str, say: Say) -> None:
        self.head, self.say = head, say
        self.live = say is print and sys.stdout.isatty()
        self.said = time.monotonic()
        say(f"{head} ...", end="", flush=True)
        log.info("%s ...", head)

    def write(self, text: str) -> None:
        lines = [line for line in re.split(r"[\r\n]", text) if line.strip()]
        if self.live and lines:
            width = shutil.get_terminal_size().columns - 1
            self.say(f"\r{f'{self.head} ... {lines[-1].strip()}'[:width]}\033[K", end="", flush=True)
        elif lines and "%|" in lines[-1] and time.monotonic() - self.said > 30:  # seconds
            share = re.sub(r"\|[^|]*\|", "", lines[-1].strip())  # without the bar itself
            self.say(f"\n  {share}", end="", flush=True)
            log.info("%s  %s", self.head, share)
            self.said = time.monotonic()

    def flush(self) -> None:
        """Do nothing: `write` shows its text at once."""

    def end(self, text: str) -> None:
        """Replace the progress by the stage's result."""
        self.say(f"\r{self.head}  {text}\033[K" if self.live else f"  {text}", flush=True)
        log.info("%s  %s", self.head, text)


def execute(
    path: Path, output: Path, parameters: dict[str, Any], progress: StatusLine | None = None,
    kernels: Kernels | None = None,
) -> tuple[Any, float]:  # fmt: skip
    """Execute the notebook `path` in a fresh kernel and write the executed copy to `output`.

    `progress` shows what the kernel, of `kernels` or a new one, writes to stderr. Return the executed notebook, and the
    peak memory (MB) of this process and its descendants, the kernel included.

    Raises:
        ManifestError: the notebook does not have one of the parameters.
        StageError: a cell failed, or the kernel died; `output` shows where.
    """
    check_parameters(path, parameters)
    if kernels is None:
        with Kernels(output.parent) as own:
            return execute(path, output, parameters, progress, own)
    kernel, memory, partial = kernels.take(), MemoryWatch(), output.with_name(f".{output.stem}.partial.ipynb")
    # Imported here because that takes a second, which a run that reuses everything does not need. Another second is
    # saved by hiding the grammar of IRIs, which jsonschema would read for nbformat: no notebook has an IRI.
    modules: dict[str, Any] = sys.modules
    modules.setdefault("rfc3987_syntax", None)
    import papermill
    from papermill.exceptions import PapermillExecutionError

    try:
        notebook = papermill.execute_notebook(
            # papermill formats paths with the parameters, so braces in them need escaping.
            *(str(file).replace("{", "{{").replace("}", "}}") for file in (path, partial)),
            parameters=parameters, kernel_name="python3", progress_bar=False, stderr_file=progress, km=kernel.manager,
            coalesce_streams=True,
        )  # fmt: skip
    except PapermillExecutionError as error:
        raise _cell_error(error, output) from None
    except RuntimeError as error:  # also nbclient's `DeadKernelError`
        raise kernel_error(error, kernel.ended_by, memory.stop(), output) from error
    except KeyboardInterrupt:
        # Otherwise asyncio prints tracebacks for the tasks that are left behind.
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        raise
    finally:
        kernels.end(kernel)
        memory.stop()
        if read_json(partial):
            partial.replace(output)
        partial.unlink(missing_ok=True)  # cut short by the error that is being raised, e.g. a full disk
    return notebook, memory.stop()


def write_page(notebook: Any, page: Path) -> None:
    """Write an executed notebook without its code as an HTML file, which needs no other file and no network."""
    from nbconvert import HTMLExporter

    hidden = {"exclude_input": True, "exclude_input_prompt": True, "exclude_output_prompt": True}
    exporter = HTMLExporter(raw_template=_PAGE, **hidden)
    write_text(page, exporter.from_notebook_node(notebook, {"metadata": {"name": page.stem}})[0])


def _cell_error(error: "PapermillExecutionError", output: Path) -> StageError:
    """Return the error for a failing cell, and log its traceback."""
    trace = re.sub(r"\x1b\[[0-9;]*m", "", "\n".join(error.traceback))
    log.debug("The failing cell:\n%s", trace)
    where = f"\nThe executed notebook shows where: {output}"
    kind = getattr(errors, error.ename, None)
    if isinstance(kind, type) and issubclass(kind, errors.ToolkitError):
        return StageError(f"{error.evalue}{where}", of_the_data=issubclass(kind, errors.OF_THE_DATA))
    if text := shortage(error.ename, error.evalue) or shortage("", "\n".join(re.findall(r"errno.*", trace, re.I))):
        return StageError(f"{text}{where}")
    return StageError(f"{errors.BUG}{error.ename}: {error.evalue}. This is a bug.{where}", internal=True)


def work_seconds(notebook: Any) -> float:
    """Return the seconds spent in cells after the one tagged `setup`, which imports modules and resolves folders."""
    cells = list(notebook.cells)
    setup = [i for i, cell in enumerate(cells) if "setup" in cell.metadata.get("tags", [])]
    later = cells[setup[-1] + 1 :] if setup else cells
    return sum((cell.metadata.get("papermill", {}).get("duration") or 0.0) for cell in later)


def handed_counts(notebook: Any) -> dict[str, Any]:
    """Return the counts that an executed notebook handed to `finish`; {} without a call."""
    for cell in reversed(notebook.cells):
        for output in cell.get("outputs", []):
            if COUNTS_MIME in output.get("data", {}):
                return dict(output["data"][COUNTS_MIME])
    return {}
