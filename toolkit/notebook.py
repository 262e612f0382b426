"""What the notebooks call, what can be read from them (parameters, folders, counts), and their execution.

`start` resolves a notebook's folders, so that each opens and runs alone on the demo capture; `finish` tells
the pipeline what was done.
"""

import ast
import json
import logging
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tqdm.auto
import tqdm.std

from toolkit import errors
from toolkit.errors import CaptureError, ManifestError, StageError, shortage
from toolkit.files import SceneFiles
from toolkit.manifest import (
    OPTIONAL,
    STAGES,
    DemoData,
    EmbedSettings,
    LocalizeSettings,
    Manifest,
    RerankSettings,
    RetrieveSettings,
    Settings,
    nearest,
)
from toolkit.runs.folder import LOG_VARIABLE, log_to
from toolkit.runs.kernel import TEXT_BARS, Kernels, MemoryWatch, kernel_error
from toolkit.runs.pairs import left_out_of

if TYPE_CHECKING:
    import pandas as pd
    from papermill.exceptions import PapermillExecutionError

log = logging.getLogger(__name__)

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
Say = Callable[..., None]
"""Takes the progress lines of a run; called like `print`."""
COUNTS_MIME = "application/vnd.visual-localization.counts+json"
# What each stage is made from, besides the capture. A stage runs again when one of these has run again.
UPSTREAM: dict[str, tuple[str, ...]] = {
    "explore": (),
    "embed": (),
    "retrieve": ("embed",),
    "rerank": ("retrieve",),
    "localize": ("retrieve", "rerank"),
    "sequence": ("localize",),
    "evaluate": ("retrieve", "rerank", "localize", "sequence"),
    "visualize": ("retrieve", "localize", "sequence"),
}

if TEXT_BARS in os.environ:
    # Every stage takes its bar from tqdm.auto, and imports it after this module.
    tqdm.auto.tqdm = tqdm.std.tqdm


class Folders:
    """The resolved folders of a notebook, as attributes; shown as a table."""

    def __init__(self, folders: dict[str, Path]) -> None:
        self._folders = folders

    def __getattr__(self, name: str) -> Path:
        folders = self.__dict__.get("_folders", {})
        if name not in folders:
            raise AttributeError(f"{name}: not a folder of this notebook. {nearest(name, folders)}")
        path: Path = folders[name]
        return path

    def __repr__(self) -> str:
        width = max(len(name) for name in self._folders)
        return "\n".join(f"{name:<{width}}  {path}" for name, path in self._folders.items())


def start(stage: str, sessions_root: str | None = None, **folders: str | None) -> Folders:
    """Resolve the folders of a notebook. What is None is the demo's, made now if it is not there yet.

    Args:
        stage: name of the stage, one of `toolkit.manifest.STAGES`.
        sessions_root: folder `sessions` of a capture; None: the demo capture, rendered when absent.
        **folders: the notebook's other folders by the names of its parameters; None: below `runs/<scene>/` of
            the repository. What an earlier stage should have left in such a folder is made when absent.

    Raises:
        ManifestError: papermill was given a parameter that the notebook does not have, or one is of a wrong type.
        CaptureError: a device asked for has no such session.
    """
    if run_log := os.environ.get(LOG_VARIABLE):
        logging.captureWarnings(True)
        log_to(Path(run_log))
    check_given(stage)
    sessions, root = sessions_or_demo(sessions_root), _root()
    _check_asked(stage, sessions)
    scene = sessions.parent.name
    files = SceneFiles(root / "runs" / scene, scene)
    defaults = {**stage_folders(files), "out_dir": stage_outputs(files, stage)}
    _make_upstream(
        stage, sessions, files, {defaults[name] for name, given in folders.items() if given is None}
    )
    resolved = {"sessions_root": sessions}
    for name, given in folders.items():
        path = Path(given).expanduser().resolve() if given else defaults[name]
        if path is not None:
            resolved[name] = path
    return Folders(resolved)


def sessions_or_demo(sessions_root: str | None) -> Path:
    """Return a folder `sessions`; None: that of the demo capture, rendered when absent."""
    if sessions_root is not None:
        return Path(sessions_root).expanduser().resolve()
    from toolkit.synthetic import render_capture

    return render_capture(_root() / "data" / "demo", **DemoData().model_dump()) / "sessions"


def own_folder(folder: str | None, scene: str, images: str | None = None) -> Path:
    """Return a folder for a capture of one's own images, and for what is made of it.

    Args:
        folder: that folder; None: `<images>-localized`, beside the folder of images.
        scene: without images, the folder is `data/<scene>` of the repository.
    """
    if folder is not None:
        return Path(folder).expanduser().resolve()
    if images is None:
        return _root() / "data" / scene
    beside = Path(images).expanduser().resolve()
    return beside.with_name(f"{beside.name}-localized")


def _root() -> Path:
    return NOTEBOOKS.parent if NOTEBOOKS.is_dir() else Path.cwd()


def readable(table: "pd.DataFrame") -> "pd.DataFrame":
    """Return a stage's table as it fits a page: a row `<query> in <map>`, medians and recall first, no folders.

    Columns are left out where they say nothing: a `reason` that no row has, `localized`, which is `ok` and
    `low_confidence`, the state of pairs that are all evaluated. Names are short where their units tell as much.
    """
    nothing = {"state": "evaluated", "reason": ""}
    dull = [name for name, text in nothing.items() if name in table and (table[name] == text).all()]
    shown = table.drop(columns=["path", "localized", *dull], errors="ignore")
    if "map_device" in shown:
        shown.index = shown.pop("query_device") + " in " + shown.pop("map_device")
    for name in {"still", "recording"} & {*shown}:
        shown[name] = [Path(path).name for path in shown[name]]
    first = [name for word in ("median", "recall@") for name in shown if name.startswith(word)]
    shown = shown[[*first, *(name for name in shown if name not in first)]]
    return shown.rename(columns=_short_column)


def _short_column(name: str) -> str:
    """Return `median_deg` for `median_rotation_deg`, and `recall@1°,0.1m` for `recall@(1deg,0.1m)`."""
    if name.startswith("recall@("):
        return name.replace("deg", "°").replace("(", "").replace(")", "")
    return re.sub(r"(rotation|translation)_(?=\w*(deg|m)$)", "", name)


def finish(table: "pd.DataFrame | None" = None, **counts: Any) -> None:
    """Show what a notebook did and hand it to the pipeline, with the peak memory of this process.

    Args:
        table: of the stage; its rows with a `reason` are what was left out.
        **counts: what was done.
    """
    import resource

    from IPython.display import display

    unit = 2**20 if sys.platform == "darwin" else 2**10  # bytes on macOS, kilobytes elsewhere
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    plain = {name: value.item() if hasattr(value, "item") else value for name, value in counts.items()}
    text = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in plain.items())
    text += f"; peak memory {peak:.0f} MB"
    content = {**plain, "peak_memory_mb": round(peak, 1)}
    if table is not None:
        content |= {"asked": len(table), "left_out": left_out_of(table)}
        text = "\n".join([text, *(f"left out: {one['what']}: {one['reason']}" for one in content["left_out"])])
    display({"text/plain": text, COUNTS_MIME: content}, raw=True)


def notebook_path(stage: str) -> Path:
    """Return the notebook of a stage, `<number>_<stage>.ipynb`."""
    path = next(iter(sorted(NOTEBOOKS.glob(f"[0-9]*_{stage}.ipynb"))), None)
    if path is None:
        raise ManifestError(
            f"{NOTEBOOKS}: no notebook of the stage {stage}. The pipeline runs from a clone of the repository: "
            "install it there with `pip install --editable .`."
        )
    return path


def notebook_parameters(path: Path) -> dict[str, Any]:
    """Return names and defaults of the cell tagged `parameters`.

    Raises:
        ManifestError: no such cell, or something else than plain literals in it.
    """
    # Read as JSON: importing nbformat, for the sake of its validation, takes seconds in each kernel.
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if "parameters" in cell["metadata"].get("tags", []):
            try:
                return _literals("".join(cell["source"]))
            except (SyntaxError, ValueError) as error:
                raise ManifestError(f"{path}: parameters are `name = literal` lines only ({error}).") from None
    raise ManifestError(f"{path}: no cell is tagged `parameters`.")


def check_parameters(path: Path, parameters: Iterable[str], where: str = "") -> None:
    """Refuse parameters that the notebook `path` does not have; papermill would only warn.

    Raises:
        ManifestError: naming the parameter and the nearest known one.
    """
    known = notebook_parameters(path)
    for name in parameters:
        if name not in known:
            raise ManifestError(f"{where}{name}: {path.name} has no such parameter. {nearest(name, known)}")


def stage_folders(files: SceneFiles) -> dict[str, Path]:
    """Return where the stages meet, by the names of the notebooks' parameters."""
    return {
        "map_feats_root": files.embeddings,
        "out_jsonl": files.retrieval_dir,
        "retrieval_dir": files.retrieval_dir,
        "features_dir": files.features,
        "map_dir": files.maps,
        "poses_dir": files.poses_dir,
        "evaluation_dir": files.evaluation,
    }


def stage_outputs(files: SceneFiles, stage: str) -> Path | None:
    """Return the folder of a stage's results; None for one that has only its notebook to show."""
    return {
        "embed": files.embeddings,
        "retrieve": files.retrieval_dir,
        "rerank": files.reranked_dir,
        "localize": files.poses_dir,
        "sequence": files.poses_dir,
        "evaluate": files.evaluation,
        "visualize": files.visualization,
    }.get(stage)


def _make_upstream(stage: str, sessions: Path, files: SceneFiles, wanted: set[Path | None]) -> None:
    """Make what earlier stages should have left in the folders `wanted`, where they are empty or absent."""
    for name in UPSTREAM[stage]:
        folder = stage_outputs(files, name)
        if folder is None or name in OPTIONAL or folder not in wanted or (folder.is_dir() and any(folder.iterdir())):
            continue
        _make_upstream(name, sessions, files, {stage_outputs(files, earlier) for earlier in UPSTREAM[name]})
        print(f"{name}: not there yet, made now in {folder}")
        _run_stage(name, sessions, files)


def _run_stage(stage: str, sessions: Path, files: SceneFiles) -> None:
    """Run a stage that others build on, with its defaults."""
    if stage == "embed":
        from toolkit.embed import embed_sessions

        embed_sessions(sessions, files.embeddings)
    elif stage == "retrieve":
        from toolkit.retrieve import retrieve_pairs

        retrieve_pairs(sessions, files.embeddings, out_jsonl=files.retrieval_dir)
    else:
        from toolkit.localize import localize_pairs

        localize_pairs(sessions, files.retrieval_dir, files.poses_dir, files.features, files.maps)


def _user_names() -> dict[str, Any]:
    """Return the variables of the running notebook; none outside of one."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython else None
    return shell.user_ns if shell else {}


def check_given(name: str, **words: Iterable[str]) -> None:
    """Refuse parameters of the running notebook that do not fit, and unknown ones that papermill has injected.

    Args:
        name: of the notebook, `<number>_<name>.ipynb`.
        **words: what a parameter may be, where that is one of some words.

    Raises:
        ManifestError: naming the parameter, what was found and what was expected.
    """
    values = _user_names()
    for source in values.get("In", []):
        if source.startswith("# Parameters\n"):
            check_parameters(notebook_path(name), _literals(source))
    check_values(name, values)
    for key, known in words.items():
        if key in values and values[key] not in known:
            raise ManifestError(f"{key}: found {values[key]!r}. {nearest(values[key], known)}")


def _check_asked(stage: str, sessions: Path) -> None:
    """Refuse what the running notebook asks for and its capture does not have, before earlier stages are made."""
    from toolkit.capture import Capture

    values, known = _user_names(), notebook_parameters(notebook_path(stage))
    if "queries" in values and "queries" in known:
        capture = Capture.from_sessions_root(sessions)
        lists = {name for session in capture.usable("query") for name in session.keyframe_files}
        short = str(values["queries"]).removesuffix(".txt").removeprefix("keyframes_")
        if lists and short not in lists | {"all"}:
            names = ["all", *(name if name == "queries" else f"keyframes_{name}" for name in lists)]
            found = f"queries: found {values['queries']!r}, which no query session in {capture.path} has."
            raise CaptureError(f"{found} {nearest(str(values['queries']), names)}")
    for name, split in (("map_device", "map"), ("query_device", "query")):
        if name not in values or name not in known:
            continue
        capture = Capture.from_sessions_root(sessions)
        present = [device for device in capture.devices if f"{device}_{split}" in capture]
        if values[name] not in (*present, "all", "auto"):
            found = f"{name}: found {values[name]!r}, which has no {split} session in {capture.path}."
            raise CaptureError(f"{found} {nearest(values[name], [*present, 'all'])}")


def check_names(settings: Settings) -> None:
    """Refuse embedders, local features, matchers and indices that there are none of, which are texts in the settings.

    Raises:
        ManifestError: naming it, the nearest known one, and all.
    """
    if isinstance(settings, EmbedSettings):
        from toolkit.embedders import resolve_name

        for name in settings.models:
            if name != "auto":  # what that stands for is found out when it is needed
                resolve_name(name)
    elif isinstance(settings, LocalizeSettings | RerankSettings):
        from toolkit.features.matching import matchers_of

        kinds = [kind for kind in (*settings.features.kinds, *settings.features.escalation) if kind != "auto"]
        matchers_of(kinds or ["sift", "aliked"], settings.matcher.name)
    elif isinstance(settings, RetrieveSettings) and settings.index != "Flat":
        from toolkit.embedders.index import check_factory

        check_factory(settings.index)


def check_values(name: str, values: Mapping[str, Any]) -> None:
    """Refuse parameters of a wrong type or value, before any work.

    Args:
        name: of the notebook, `<number>_<name>.ipynb`; a stage's have settings among them.
        values: of the notebook's parameters, by their names; others are passed over.

    Raises:
        ManifestError: naming the parameter, what was found and what was expected.
    """
    path = notebook_path(name)
    given = {key: (default, values[key]) for key, default in notebook_parameters(path).items() if key in values}
    if name in STAGES:
        section = type(Manifest(name="x", captures=["x"]).stage(name))
        settings = given.pop("settings", ({}, {}))[1]
        named = {key: given.pop(key)[1] for key in list(given) if key in section.model_fields}
        check_names(section.of(named, settings))
    for key, (default, value) in given.items():
        if key == "pairs":
            pairs = value if isinstance(value, list | tuple) else [value]
            fits = value is None or all(isinstance(pair, list | tuple) and len(pair) == 2 for pair in pairs)
            wanted = 'None or a list such as [["ios", "hl"]]'
        elif key == "runs":
            listed = isinstance(value, list | tuple) and all(isinstance(run, str | Path) for run in value)
            fits = value is None or listed
            wanted = 'None or a list of run folders such as ["../runs/a", "../runs/b"]'
        elif key == "inspect":
            fits, wanted = isinstance(value, int | str), "the number of a query, or the name of an image of it"
        elif default is None:
            fits, wanted = value is None or isinstance(value, str | Path), "None or the path of a folder, a text"
        elif type(default) is int:
            fits, wanted = type(value) is int and value >= 0, f"a whole number, 0 or more, such as {default}"
        else:
            fits, wanted = isinstance(value, type(default)), f"a {type(default).__name__} such as {default!r}"
        if not fits:
            raise ManifestError(f"{key}: found {value!r}, expected {wanted}. It is a parameter of {path.name}.")


def _literals(source: str) -> dict[str, Any]:
    """Return the `name = literal` lines of a cell."""
    values = {}
    for node in ast.parse(source).body:
        target = node.targets[0] if isinstance(node, ast.Assign) and len(node.targets) == 1 else None
        if not (isinstance(node, ast.Assign) and isinstance(target, ast.Name)):
            raise ValueError(f"line {node.lineno}: {ast.unparse(node)}")
        values[target.id] = ast.literal_eval(node.value)
    return values


class StatusLine:
    """The line of a running stage; on a terminal it ends in the stage's own progress bar, which it is fed."""

    def __init__(self, head: str, say: Say) -> None:
        self.head, self.say = head, say
        # Elsewhere, and for a caller with a `say` of its own, the line is written once.
        self.live = say is print and sys.stdout.isatty()
        say(f"{head} ...", end="", flush=True)
        log.info("%s ...", head)

    def write(self, text: str) -> None:
        """Take what the kernel writes to stderr; the last line of it is shown."""
        shown = [part for part in re.split(r"[\r\n]", text) if part.strip()]
        if self.live and shown:
            width = shutil.get_terminal_size().columns - 1
            self.say(f"\r{f'{self.head} ... {shown[-1].strip()}'[:width]}\033[K", end="", flush=True)

    def flush(self) -> None:
        """Do nothing: every write is shown at once."""

    def end(self, text: str) -> None:
        """Replace the progress by what came of it."""
        self.say(f"\r{self.head}  {text}\033[K" if self.live else f"  {text}")
        log.info("%s  %s", self.head, text)


def execute(
    path: Path,
    output: Path,
    parameters: dict[str, Any],
    progress: StatusLine | None = None,
    kernels: Kernels | None = None,
) -> tuple[Any, float]:
    """Execute the notebook `path` in a fresh kernel and write the executed copy to `output`.

    Args:
        path: the notebook.
        output: where the executed copy goes, also of a notebook that failed.
        parameters: replacing those of its parameters cell.
        progress: shows what the kernel writes to stderr.
        kernels: gives the kernel; None: one is started for this notebook.

    Returns:
        The executed notebook, and the highest memory (MB) of this process and the kernel's together.

    Raises:
        ManifestError: a parameter that the notebook does not have.
        StageError: a cell failed, or the kernel died; `output` shows where.
    """
    check_parameters(path, parameters)
    if kernels is None:
        with Kernels(output.parent) as own:
            return execute(path, output, parameters, progress, own)
    output.parent.mkdir(parents=True, exist_ok=True)
    memory, kernel = MemoryWatch(), kernels.take()  # it starts meanwhile
    # papermill takes seconds to import, and a run that reuses everything does not need it.
    import papermill
    from jupyter_client.kernelspec import NoSuchKernel
    from nbclient.exceptions import DeadKernelError
    from nbformat.reader import NotJSONError
    from papermill.exceptions import PapermillExecutionError

    partial = output.with_name(f".{output.stem}.partial.ipynb")
    answers = False
    try:
        kernel.started.result()
        notebook = papermill.execute_notebook(
            # papermill formats paths with the parameters, so braces in them need escaping.
            *(str(file).replace("{", "{{").replace("}", "}}") for file in (path, partial)),
            parameters=parameters,
            kernel_name="python3",
            progress_bar=False,
            stderr_file=progress,
            km=kernel.manager,
        )
        answers = True
    except PapermillExecutionError as error:
        answers = True
        raise _cell_error(error, output) from None
    except (DeadKernelError, RuntimeError, NoSuchKernel) as error:
        raise kernel_error(error, kernel.ended_by, memory.stop(), output) from error
    except KeyboardInterrupt:
        # Of the tasks that are left behind asyncio would print tracebacks.
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        raise
    finally:
        kernels.end(kernel, by_force=not answers)
        memory.stop()
        if partial.exists():
            try:
                _tidy_streams(partial)
                partial.replace(output)
            except NotJSONError:  # cut short by what is being raised, as a full disk does
                partial.unlink()
    return notebook, memory.stop()


def _cell_error(error: "PapermillExecutionError", output: Path) -> StageError:
    """Return what to tell of a failing cell; its traceback goes to the log."""
    trace = re.sub(r"\x1b\[[0-9;]*m", "", "\n".join(error.traceback))
    log.debug("The failing cell:\n%s", trace)
    where = f"\nThe executed notebook shows where: {output}"
    kind = getattr(errors, error.ename, None)
    if isinstance(kind, type) and issubclass(kind, errors.ToolkitError):
        return StageError(f"{error.evalue}{where}", of_the_data=issubclass(kind, errors.OF_THE_DATA))
    if text := shortage(error.ename, error.evalue) or shortage("", "\n".join(re.findall(r"errno.*", trace, re.I))):
        return StageError(f"{text}{where}")
    return StageError(f"{errors.BUG}{error.ename}: {error.evalue}. This is a bug.{where}", internal=True)


def _tidy_streams(path: Path) -> None:
    """Join the pieces of each stream of an executed notebook; keep what a terminal would show in the end."""
    import nbformat

    content = nbformat.read(path, as_version=4)
    for cell in content.cells:
        outputs: list[Any] = []
        for output in cell.get("outputs", []):
            joins = output.output_type == "stream" and outputs and outputs[-1].get("name") == output.name
            if joins:
                outputs[-1].text += output.text
            else:
                outputs.append(output)
        for output in outputs:
            if output.output_type == "stream":
                lines = output.text.split("\n")
                output.text = "\n".join(line.rstrip("\r").rpartition("\r")[2] for line in lines)
        if "outputs" in cell:
            cell.outputs = outputs
    nbformat.write(content, path)


def work_seconds(notebook: Any) -> float:
    """Return the seconds in cells after the one tagged `setup`, which imports and resolves."""
    cells = list(notebook.cells)
    setup = [i for i, cell in enumerate(cells) if "setup" in cell.metadata.get("tags", [])]
    later = cells[setup[-1] + 1 :] if setup else cells
    return sum((cell.metadata.get("papermill", {}).get("duration") or 0.0) for cell in later)


def handed_counts(notebook: Any) -> dict[str, Any]:
    """Return what the notebook handed to `toolkit.notebook.finish`."""
    for cell in reversed(notebook.cells):
        for output in cell.get("outputs", []):
            if COUNTS_MIME in output.get("data", {}):
                return dict(output["data"][COUNTS_MIME])
    return {}
