"""Run the notebooks of a manifest in order, resumable, with a record in `run.json`.

Each notebook is one stage; papermill executes it in a kernel of its own. A stage is skipped (`reused`) if its settings,
inputs, code and outputs match its record under `RUN/SCENE/.stages/`. A stage that does run still reuses the finished
work that it finds.
"""

import hashlib
import json
import logging
import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from toolkit.capture.names import allow_outside, extra_devices, table_record
from toolkit.datasets.download import is_unfinished
from toolkit.embedders import WEIGHTS as EMBEDDER_WEIGHTS
from toolkit.embedders import resolve_model
from toolkit.errors import (
    COMMAND,
    ArtifactError,
    ManifestError,
    StageError,
    ToolkitError,
    exit_code,
    require_packages,
    sentence,
)
from toolkit.features.matching import local_weights, resolve_auto
from toolkit.files import (
    SceneFiles,
    checksum,
    files_fingerprint,
    fingerprint,
    of_sequence,
    older_files,
    project_root,
    read_json,
    write_text,
)
from toolkit.manifest import (
    STAGES,
    EmbedSettings,
    LocalizeSettings,
    Manifest,
    RerankSettings,
    RetrieveSettings,
    Settings,
    find_manifest,
    load_manifest,
    nearest,
)
from toolkit.models.weights import WeightsSource, check_weights, find_weights, resolve_weights
from toolkit.notebook import (
    UPSTREAM,
    Say,
    StatusLine,
    check_given,
    check_names,
    execute,
    find_run,
    handed_counts,
    is_demo,
    notebook_parameters,
    notebook_path,
    selection,
    work_seconds,
)
from toolkit.prediction.interface import ARCHITECTURES
from toolkit.runs.cluster import open_cluster
from toolkit.runs.folder import (
    LOG,
    OLDER,
    RECORD,
    RunLog,
    changed_keys,
    counts_text,
    failures,
    held,
    swept_runs,
    take_over,
    variant_name,
    warnings_of_kernels,
)
from toolkit.runs.kernel import Kernels

if TYPE_CHECKING:
    from toolkit.scene.run import Run

log = logging.getLogger(__name__)

MAP = "map"
"""In place of a stage: build the maps for queries to come."""
_FOR_MAP = ("embed", "retrieve", "localize")
MAX_WARNINGS = 5
"""Limit of warnings per stage on the terminal; `run.log` has all of them."""


@dataclass(frozen=True)
class Job:
    """One execution of one notebook, for one capture."""

    stage: str
    files: SceneFiles
    settings: Settings
    parameters: dict[str, Any]

    @property
    def notebook(self) -> Path:
        return self.files.run / "notebooks" / f"{self.files.scene}_{notebook_path(self.stage).name}"

    @property
    def record(self) -> Path:
        return self.files.root / ".stages" / f"{self.stage}.json"

    def made(self) -> list[Path]:
        """Return the files that the stage has made."""
        folder = self.files.of_stage(self.stage)
        paths = [path for path in folder.rglob("*") if path.is_file()] if folder else []
        if self.stage in ("localize", "sequence"):  # in one folder
            paths = [path for path in paths if of_sequence(path.name) == (self.stage == "sequence")]
        beside = {"retrieve": (self.files.index, "*_map*.faiss"), "localize": (self.files.maps, "*_map*.npz")}
        folder, pattern = beside.get(self.stage, (None, ""))
        return sorted([*paths, *(folder.glob(pattern) if folder else ())])

    def outputs(self) -> str:
        """Return a fingerprint of the files that the stage has made; empty if one of them is unfinished."""
        made = self.made()
        if any(path.name.endswith(".meta.json") and read_json(path).get("unfinished") for path in made):
            return ""
        return fingerprint([[path.relative_to(self.files.root), checksum(path)] for path in made])

    def earlier_row(self) -> dict[str, Any] | None:
        """Return the row of the last execution, for a run that leaves the stage out; None without one."""
        row = read_json(self.record).get("row")
        folder = self.files.of_stage(self.stage)
        older = older_files(folder, self.stage) if row and folder else {}
        status = {"status": OLDER, "reason": next(iter(older.values()))} if older else {"status": "reused"}
        return {**row, **status} if row else None


def open_run(folder: str | Path, notebook: str = "start") -> "Run":
    """Open a run for a notebook, whose parameters are checked; see `notebook.find_run`. The demo is run first if need
    be.

    Raises:
        ArtifactError: there is no such run; the message lists runs beside it.
        ManifestError: a parameter of the notebook is wrong.
    """
    from toolkit.scene.run import Run  # takes most of a second, which `run` does not need

    check_given(notebook)
    path = find_run(folder)
    if not (path / RECORD).is_file() and is_demo(path):
        run(find_manifest("demo", project_root()))
    return Run.open(_existing(path, "run"))


def _existing(path: Path, parameter: str) -> Path:
    if (path / RECORD).is_file():
        return path
    from toolkit.results.pair import no_such_run  # takes half a second, for an error alone

    raise no_such_run(path, parameter)


def runs_to_compare(folder: str | Path, others: Sequence[str | Path] | None = None) -> list[Path]:
    """Return a run and those to compare it with, for a notebook; by default, the runs beside it whose names begin with
    its name, as a sweep makes them. If the demo has none, it is run with SIFT features alone.

    Raise ArtifactError if a folder is no run, or there is nothing to compare with.
    """
    first = open_run(folder, "compare").path
    if others is not None:
        return [first, *(_existing(find_run(other), "others") for other in others)]

    def beside() -> list[Path]:
        return sorted(record.parent for record in first.parent.glob(f"{first.name}-*/{RECORD}"))

    if not beside() and is_demo(first):
        demo = find_manifest("demo", project_root())
        _, failed = sweep(demo, ["localize.features=sift"], ["name=demo", "visualize.recordings=false"])
        for error in failed:
            raise error
    if not beside():
        do = f"Name runs, or make one: {COMMAND} run MANIFEST --sweep key=a,b makes {first.name}-key-a."
        raise ArtifactError.at("others", f"no run beside {first}", "runs to compare with it", do)
    return [first, *beside()]


def run(
    manifest_path: str | Path,
    only: str | None = None,
    force: bool = False,
    overrides: Iterable[str] = (),
    say: Say = print,
    cluster: str | None = None,
    name: str | None = None,
    in_place: bool = False,
    donors: Sequence[Path] = (),
) -> Path:
    """Run a manifest and return its run folder, with `run.json` and `report.html` in it.

    With `overrides` that change a result, the run has a folder of its own, `<output_root>/<name>-<key>-<value>`, and
    takes over from the run of the manifest itself what they leave as it is. So a finished run changes only by its
    manifest.

    Args:
        manifest_path: YAML file, see `toolkit.manifest`.
        only: run only this stage, or these, separated by commas, on the results of earlier stages; or `map`: build the
            maps without queries.
        force: also execute stages that are up to date, without reuse of their own results.
        overrides: `key=value` or `stage.key=value`, replace values of the manifest.
        say: prints progress lines; called like `print`.
        cluster: cluster whose workers the stages use, see `runs.cluster.open_cluster`.
        name: name of the run folder; None: as above.
        in_place: write into the folder of the manifest, whatever the overrides are.
        donors: folders of further runs to take results from.

    Raises:
        ManifestError: the manifest or an argument is wrong; nothing has run.
        StageError: a notebook failed; `run.json` then says `"status": "failed"`.
    """
    if in_place and name:
        raise ManifestError("--in-place and --name exclude each other: give one of them.")
    overrides = list(overrides)
    manifest = load_manifest(manifest_path, overrides)
    _check(manifest, manifest_path, only)
    plain, own = run_name(manifest_path, manifest, overrides, name)
    manifest, root = _name_embedder(manifest, say), Path(manifest.output_root)
    if not in_place and {own} != {plain.name, manifest.name}:
        if manifest.demo_data and manifest.demo_data == plain.demo_data:  # rendered once for all runs of a manifest
            captures = _captures(manifest.model_copy(update={"name": plain.name}))
            manifest = manifest.model_copy(update={"demo_data": None, "captures": list(map(str, captures))})
        manifest = manifest.model_copy(update={"name": own})
        take_over([root / plain.name, *donors], manifest)
        say(f"Run folder: {root / own}")
    devices = [device.model_dump(exclude_none=True) for device in manifest.extra_devices]
    with extra_devices(devices), allow_outside(manifest.allow_outside):
        return _run(manifest, only, force, say, cluster)


def run_name(
    manifest_path: str | Path, manifest: Manifest, overrides: Sequence[str], name: str | None = None
) -> tuple[Manifest, str]:
    """Return a manifest, of `manifest_path`, without its overrides, and the name of the run with them: the one that the
    user chose, else named after the overrides that change a result.
    """
    try:
        plain = load_manifest(manifest_path) if overrides else manifest
    except ManifestError:  # it needs the overrides, so there is no run without them
        return manifest, name or manifest.name
    if any(override.partition("=")[0].strip() == "name" for override in overrides):
        return plain, name or manifest.name
    return plain, name or variant_name(plain.name, changed_keys(plain, manifest, overrides))


def _check(manifest: Manifest, manifest_path: str | Path, only: str | None) -> None:
    """Raise ManifestError for what can be seen to fail before anything runs."""
    for stage in _stages(only):
        if stage not in STAGES and only != MAP:
            raise ManifestError(f"--only {only}: no such stage. {nearest(stage, (*STAGES, MAP))}")
        if stage not in manifest.stages and only != MAP:
            raise ManifestError(f"--only {only}: {manifest_path} has no section `{stage}`, so the stage is off.")
    fetch = f"{COMMAND} download {manifest_path}"
    for capture in map(Path, manifest.captures):
        if is_unfinished(capture):
            raise ManifestError(f"{capture}: its download is not complete. Continue it first: {fetch}")
        if manifest.dataset and capture.name in manifest.dataset.sources and not (capture / "sessions").is_dir():
            text = f"{capture}: no such capture. Download it first: {fetch}"
            raise ManifestError(f"{text}\nIf you already have it, name its folder in `captures`.")
    for stage in STAGES:
        try:
            check_names(manifest.stage(stage))
        except ManifestError as error:
            raise ManifestError(f"{manifest_path}: {stage}: {error}") from None


def _stages(only: str | None) -> list[str]:
    return [] if only is None else [stage.strip() for stage in only.split(",")]


def sweep(
    manifest_path: str | Path,
    sweeps: Sequence[str],
    overrides: Sequence[str] = (),
    say: Say = print,
    only: str | None = None,
    force: bool = False,
    cluster: str | None = None,
) -> tuple[list[Path], list[ToolkitError]]:
    """Run a manifest once per swept value, in folders `<output_root>/<name>-<key>-<value>`.

    Each run takes over what does not depend on the differing settings, from the run that shares most with it: that of
    the manifest itself or an earlier one of the sweep, even if it failed. A demo capture is rendered once for all runs.
    If a run fails, the next ones still run.

    Args:
        sweeps: `key=a,b,c` each, see `runs.folder.swept_runs`; several keys give all combinations of their values.
        manifest_path, overrides, say, only, force, cluster: as for `run`.

    Returns:
        The folders of the runs that succeeded, and the errors of the runs that failed.

    Raises:
        ManifestError: the manifest or a swept value is wrong; nothing has run.
    """
    manifest = load_manifest(manifest_path, overrides)
    name = run_name(manifest_path, manifest, overrides)[1]
    runs = swept_runs(name, sweeps)
    for swept in runs.values():  # find mistakes before hours of work
        _check(load_manifest(manifest_path, [*overrides, *swept]), manifest_path, only)
    folders = [Path(manifest.output_root) / one for one in (name, *runs)]
    done, failed = list[Path](), list[ToolkitError]()
    for number, (name, swept) in enumerate(runs.items(), 1):
        say(f"{name} ({number} of {len(runs)}): {', '.join(swept)}")
        settings = [*overrides, *swept]
        try:
            done.append(run(manifest_path, only, force, settings, say, cluster, name, donors=folders[:number]))
        except ToolkitError as error:
            say(f"{name}: {sentence(error)}")
            failed.append(error)
    return done, failed


def _run(manifest: Manifest, only: str | None, force: bool, say: Say, cluster: str | None) -> Path:
    run_dir = Path(manifest.output_root) / manifest.name
    chosen = _FOR_MAP if only == MAP else _stages(only) or manifest.stages
    stages = [one for one in STAGES if one in chosen]
    needed = {"sequence": "gtsam", "visualize": "rerun"}
    require_packages(*([] if only == MAP else ["papermill"]), *(needed[one] for one in stages if one in needed))
    for stage in stages:
        if not any(run_dir.glob(f"*/.stages/{stage}.json")):
            _require_weights(stage, manifest.stage(stage))
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ManifestError(f"output_root: {run_dir} cannot be made ({error.strerror}). Choose another.") from None
    with held(run_dir), open_cluster(cluster, say), Kernels(run_dir / "notebooks") as kernels:
        try:
            if only == MAP:
                _build_maps(manifest, run_dir, say)
            else:
                _run_stages(manifest, stages, run_dir, force, say, kernels)
        except BaseException as error:
            log.debug("stopped", exc_info=error)
            if exit_code(error) != 3 or isinstance(error, StageError):
                raise
            text = f"{sentence(error)} The traceback is in {run_dir / LOG}."
            raise StageError(text, internal=True) from error
    return run_dir


def _jobs(
    manifest: Manifest, captures: list[Path], stages: list[str], run_dir: Path, force: bool
) -> tuple[list[Job], RunLog]:
    """Return the jobs of the stages, and the record of the run, with earlier rows of the manifest's other stages."""
    every = [
        _job(manifest, stage, capture, SceneFiles(run_dir, capture.name), force)
        for capture, stage in product(captures, manifest.stages)
    ]
    left = [job for job in every if job.stage not in stages]
    inputs = {capture.name: tree_fingerprint(capture / "sessions") for capture in captures}
    record = RunLog(
        run_dir, manifest, inputs, _code_fingerprint(), lambda: [row for job in left if (row := job.earlier_row())]
    )
    return [job for job in every if job.stage in stages], record


def _run_stages(manifest: Manifest, stages: list[str], run_dir: Path, force: bool, say: Say, kernels: Kernels) -> None:
    if manifest.demo_data is not None and not _demo_folder(manifest).exists():
        kernels.prepare()  # while the capture is rendered
    jobs, record = _jobs(manifest, _captures(manifest), stages, run_dir, force)
    for job in jobs:
        # Weights first, because `_reusable` reads all output files of the job.
        if _weights_needed(job.stage, job.settings) and (
            force or not _reusable(job, _inputs_of(job, record.inputs[job.files.scene]))
        ):
            _require_weights(job.stage, job.settings)
    failed: list[tuple[Job, StageError]] = []
    lost = set[tuple[str, str]]()
    try:
        record.write()
        for i, job in enumerate(jobs, 1):
            kernels.left = len(jobs) - i + 1
            head = f"[{i}/{len(jobs)}] {job.stage:<9} {job.files.scene}"
            scene, job_inputs = job.files.scene, _inputs_of(job, record.inputs[job.files.scene])
            if cause := next((stage for stage in UPSTREAM[job.stage] if (scene, stage) in lost), None):
                message = f"skipped: {cause} has failed"
                row = {"stage": job.stage, "scene": scene, "status": "skipped", "error": message}
                lost.add((scene, job.stage))
            elif not force and (reusable := _reusable(job, job_inputs)):
                row, message = reusable, "reused"
            else:
                try:
                    record.add(_run_job(job, job_inputs, head, record, say, kernels))
                except StageError as error:
                    if not error.of_the_data:
                        raise
                    failed.append((job, error))  # other captures may succeed
                    lost.add((scene, job.stage))
                continue
            say(f"{head}  {message}")
            log.info("%s  %s", head, message)
            record.add(row)
        for row in record.all_rows():
            if row["status"] == OLDER:
                say(f"{row['stage']} {row['scene']} was not run again: {row['reason']}")
        last = [row["status"] for row in record.rows if row["stage"] == stages[-1]]
        if failed and not {"done", "reused"} & set(last):
            raise failed[0][1]
        record.end(incomplete=_not_tolerated(manifest, failed, record))
        _write_report(run_dir)
    except BaseException as error:
        record.end(error)
        try:
            # Replace the report of an earlier run, which may say that all is well.
            _write_report(run_dir)
        except Exception as other:
            log.warning("The report of the stopped run could not be written: %s", sentence(other))
            log.debug("the report", exc_info=other)
        raise


def _build_maps(manifest: Manifest, run_dir: Path, say: Say) -> None:
    """Build features, descriptors and points of the maps as the stages would, which then find them."""
    from toolkit.capture import Capture
    from toolkit.embed import embed_sessions
    from toolkit.localize import build_maps
    from toolkit.retrieve import index_maps

    captures = _captures(manifest)
    _, record = _jobs(manifest, captures, [], run_dir, False)
    if manifest.rerank is not None:
        say("rerank: not used for images that are localized in a map by itself")
        manifest = manifest.model_copy(update={"rerank": None})
    embed = EmbedSettings.of(manifest.stage("embed"))
    retrieve = RetrieveSettings.of(manifest.stage("retrieve"))
    localize = LocalizeSettings.of(manifest.stage("localize"))
    try:
        record.write()
        for capture in captures:
            files, sessions = SceneFiles(run_dir, capture.name), capture / "sessions"
            pairs = selection(manifest, capture).get("pairs", ())
            devices = list(dict.fromkeys(of_map for of_map, _ in pairs)) or Capture.open(capture).devices_with("map")
            embed_sessions(sessions, files.embeddings, embed, device=devices)
            index_maps(sessions, files.embeddings, files.retrieval_dir, retrieve, devices)
            folders = files.retrieval_dir, files.poses_dir, files.features, files.maps
            for scene_map in build_maps(sessions, *folders, localize, devices):
                points = 0 if scene_map.points is None else len(scene_map.points.points)
                say(f"map of {scene_map.device} in {capture.name}: {len(scene_map.session)} images, {points} points. "
                    f"{scene_map.remarks}".strip())  # fmt: skip
        record.end()
        _write_report(run_dir)
    except BaseException as error:
        record.end(error)
        raise


def _not_tolerated(manifest: Manifest, failed: list[tuple[Job, StageError]], record: RunLog) -> str | None:
    """Return a description of the failures that exceed the manifest's `tolerate_failed`; None if there are none."""
    lines = [f"{job.stage} {job.files.scene}: {error}" for job, error in failed]
    rows = record.all_rows()
    for kind, counts in failures(rows).items():
        tolerated = getattr(manifest.tolerate_failed, kind)
        if counts["of"] and counts["failed"] / counts["of"] > tolerated:  # a product would be rounded below the count
            found = f"{counts['failed']} of {counts['of']} {kind} failed"
            lines.append(f"{found}; tolerate_failed.{kind} is {tolerated:g}.")
    if not lines:
        return None
    whats: dict[str, list[str]] = {}
    for row in rows:
        for one in row.get("left_out", ()):
            whats.setdefault(one["reason"], []).append(f"{one['what']} of {row['scene']}")
    if whats:
        lines += [f"{', '.join(dict.fromkeys(names))}: {reason}" for reason, names in whats.items()]
        lines.append("Repair the data, or exclude what failed with `devices:` or `pairs:` in the manifest.")
    return "\n".join(lines)


def tree_fingerprint(folder: Path) -> str:
    """Return a fingerprint, 16 hex digits, of the files below a folder by size and time; links are followed."""
    rows = []
    for root, folders, names in os.walk(folder, followlinks=True):
        folders.sort()
        parent = os.path.relpath(root, folder)
        for name in sorted(names):
            with suppress(FileNotFoundError):
                stat = os.stat(f"{root}/{name}")  # noqa: PTH116 - a Path for each is 5 times slower
                rows.append([parent, name, stat.st_size, stat.st_mtime_ns])
    return fingerprint(rows)


def _name_embedder(manifest: Manifest, say: Say) -> Manifest:
    """Return the manifest with `embed.model: auto` replaced by an embedder's name; refuse an unknown name."""
    settings = manifest.embed
    name = resolve_model(settings.model, settings.checkpoint)
    if name != settings.model:
        say(f"embed.model {settings.model}: {name}")
    return manifest.model_copy(update={"embed": settings.model_copy(update={"model": name})})


def _require_weights(stage: str, settings: Settings) -> None:
    """Find or download the weights of a stage: before hours of work, and where the user sees the progress."""
    for source, checkpoint in _weights_needed(stage, settings):
        check_weights(source, resolve_weights(source, checkpoint))


def _weights_needed(stage: str, settings: Settings) -> list[tuple[WeightsSource, str | None]]:
    """Return (weights, checkpoint from the settings) of each network that a stage runs with these settings."""
    if isinstance(settings, EmbedSettings):
        return [(EMBEDDER_WEIGHTS[name], settings.checkpoint) for name in settings.models if name in EMBEDDER_WEIGHTS]
    if not isinstance(settings, LocalizeSettings | RerankSettings) or getattr(settings, "method", "") == "nearest":
        return []
    needed: list[tuple[WeightsSource, str | None]] = []
    predictor = settings.predictor if isinstance(settings, LocalizeSettings) and settings.predicts else None
    if predictor and (network := ARCHITECTURES.get(predictor.name)):
        needed.append((network.weights, predictor.checkpoint))
    for source, checkpoint in local_weights(resolve_auto(settings)):
        section = source.setting.removeprefix("localize.")
        needed.append((replace(source, setting=f"{stage}.{section}"), checkpoint))
    return needed


def _captures(manifest: Manifest) -> list[Path]:
    """Return the folders of the captures; render that of `demo_data`."""
    if manifest.demo_data is None:
        return [Path(capture) for capture in manifest.captures]
    from toolkit.synthetic import render_capture

    return [render_capture(_demo_folder(manifest), **manifest.demo_data.model_dump())]


def _demo_folder(manifest: Manifest) -> Path:
    return Path(manifest.output_root).parent / "data" / manifest.name


def _job(manifest: Manifest, stage: str, capture: Path, files: SceneFiles, force: bool) -> Job:
    """Return the job of a stage: the folders and pairs that its notebook has parameters for, and all its settings."""
    values: dict[str, Any] = {
        **{name: str(folder) for name, folder in files.folders(stage, manifest.rerank is not None).items()},
        "run": str(files.run),
        "sessions_root": str(capture / "sessions"),
        "queries": manifest.queries,
        **selection(manifest, capture),
    }
    if force:
        values["skip_existing"] = False
    settings = manifest.stage(stage)
    if given := settings.given():
        values["settings"] = given
    known = notebook_parameters(notebook_path(stage))
    return Job(stage, files, settings, {name: value for name, value in values.items() if name in known})


def _inputs_of(job: Job, capture: str) -> str:
    """Return a fingerprint of a job's inputs: parameters, capture, code, weights, and the stages it builds on."""
    # These two do not change the results.
    parameters = {name: value for name, value in job.parameters.items() if name not in ("run", "skip_existing")}
    source = hashlib.sha256(notebook_path(job.stage).read_bytes()).hexdigest()
    upstream = [read_json(job.record.with_name(f"{stage}.json")).get("made") for stage in UPSTREAM[job.stage]]
    return fingerprint([parameters, table_record(), _files_of(job), capture, _code_fingerprint(), source, upstream])


def _files_of(job: Job) -> str | None:
    """Return a fingerprint of the weights and rough poses that a job reads; None if there are no such files yet."""
    needed = _weights_needed(job.stage, job.settings)
    paths = [path for source, checkpoint in needed if (path := find_weights(source, checkpoint))]
    if isinstance(job.settings, RetrieveSettings) and job.settings.mask.poses:
        paths.append(Path(job.settings.mask.poses))
    return files_fingerprint([path.resolve() for path in paths]) if paths else None


@cache
def _code_fingerprint() -> str:
    """Return a fingerprint of the toolkit's code, because the version is the same for many commits."""
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    return fingerprint([hashlib.sha256(path.read_bytes()).hexdigest() for path in sources])


def _reusable(job: Job, inputs: str) -> dict[str, Any] | None:
    """Return the row of an earlier execution if its inputs, outputs and notebook are still the same; else None."""
    record = read_json(job.record)
    if record.get("inputs") != inputs or not read_json(job.notebook):
        return None
    if record.get("outputs") != (job.outputs() or None):
        return None
    # Left-out pairs are tried again: a repair, such as a changed permission, may not show in a fingerprint.
    return None if record["row"].get("left_out") else {**record["row"], "status": "reused"}


def _run_job(job: Job, inputs: str, head: str, record: RunLog, say: Say, kernels: Kernels) -> dict[str, Any]:
    """Execute a job and return its row of `run.json`."""
    line = StatusLine(head, say)
    row: dict[str, Any] = {"stage": job.stage, "scene": job.files.scene}
    row |= {"notebook": str(job.notebook.relative_to(job.files.run)), "parameters": job.parameters}
    # There is no record while the stage runs, so a killed stage runs again.
    job.record.unlink(missing_ok=True)
    (job.files.run / "report.html").unlink(missing_ok=True)  # nor is the report current until it is written again
    started, logged = time.perf_counter(), (job.files.run / LOG).stat().st_size
    try:
        notebook, memory = execute(notebook_path(job.stage), job.notebook, job.parameters, line, kernels)
    except BaseException as error:
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        line.end(status)
        row |= {"status": status, "seconds": round(time.perf_counter() - started, 2), "error": sentence(error)}
        with suppress(OSError):  # the disk itself may be the cause
            record.add(row)
        raise
    seconds = time.perf_counter() - started
    work = work_seconds(notebook)
    counts = handed_counts(notebook)
    memory = max(memory, counts.pop("peak_memory_mb", 0.0))
    row |= {name: counts.pop(name) for name in ("left_out", "asked") if name in counts}
    row |= {"status": "done", "seconds": round(seconds, 2), "startup_seconds": round(seconds - work, 2)}
    row |= {"work_seconds": round(work, 2), "peak_memory_mb": round(memory), "counts": counts}
    made = {"made": datetime.now(UTC).isoformat(), "inputs": inputs, "outputs": job.outputs(), "row": row}
    write_text(job.record, json.dumps(made, indent=1) + "\n")
    took = f"{work:.1f} s + {seconds - work:.1f} s start-up, {memory:.0f} MB"
    line.end(f"{counts_text(counts)}; {took}" if counts else took)
    for one in row.get("left_out", ()):
        say(f"  left out: {one['what']}: {one['reason']}")
    warnings = [one for one in warnings_of_kernels(job.files.run / LOG, logged) if one not in record.shown]
    record.shown.update(warnings)
    for one in warnings[:MAX_WARNINGS]:
        say(f"  warning: {one}")
    if len(warnings) > MAX_WARNINGS:
        say(f"  ... and {len(warnings) - MAX_WARNINGS} more warnings, see {job.files.run / LOG}")
    return row


def _write_report(run_dir: Path) -> None:
    from toolkit.report.page import write_report

    write_report(run_dir)
