"""Run the notebooks of a manifest in order, resumable, with a record in `run.json`.

Each notebook is one stage; papermill executes it in a kernel of its own. A stage is skipped (`reused`) if its settings,
inputs, code and outputs match its record under `RUN/SCENE/.stages/`. A stage that does run still reuses the finished
work that it finds.
"""

import hashlib
import json
import logging
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from toolkit.capture.devices import extra_devices, table_record
from toolkit.capture.names import allow_outside
from toolkit.embedders import WEIGHTS as EMBEDDER_WEIGHTS
from toolkit.embedders import resolve_model
from toolkit.errors import ManifestError, StageError, ToolkitError, exit_code, sentence
from toolkit.exchange.download import is_unfinished
from toolkit.features.matching import local_weights, resolve_auto
from toolkit.files import (
    SceneFiles,
    any_unfinished,
    checksum,
    files_fingerprint,
    fingerprint,
    of_sequence,
    older_files,
    read_json,
    write_text,
)  # fmt: skip
from toolkit.manifest import (
    STAGES,
    EmbedSettings,
    LocalizeSettings,
    Manifest,
    RerankSettings,
    RetrieveSettings,
    Settings,
    load_manifest,
    nearest,
)
from toolkit.models.weights import WeightsSource, check_weights, find_weights, resolve_weights
from toolkit.notebook import (
    UPSTREAM,
    Say,
    StatusLine,
    check_names,
    check_parameters,
    execute,
    handed_counts,
    notebook_parameters,
    notebook_path,
    stage_folders,
    stage_outputs,
    work_seconds,
)
from toolkit.prediction.architectures import ARCHITECTURES
from toolkit.runs.cluster import open_cluster
from toolkit.runs.folder import LOG, held, warnings_of_kernels
from toolkit.runs.kernel import Kernels
from toolkit.runs.pairs import pair_text, way_out
from toolkit.runs.record import OLDER, Earlier, RunLog, failures
from toolkit.runs.sweep import Shared, SweptRun, changed_keys, swept_runs, take_over, variant_name
from toolkit.sequences.pose_graph import require_gtsam

log = logging.getLogger(__name__)

MOST_WARNINGS = 5
"""Limit of warnings per stage on the terminal; `run.log` has all of them."""


@dataclass(frozen=True)
class Job:
    """One execution of one notebook, for one capture and perhaps only one device or pair of devices."""

    stage: str
    files: SceneFiles
    settings: Settings
    parameters: dict[str, Any]
    label: str = ""
    """Part of the stage, if the stage takes several executions; part of the paths of its outputs."""

    @property
    def name(self) -> str:
        return f"{self.files.scene} {self.label}".rstrip()

    @property
    def notebook(self) -> Path:
        stem = f"{self.files.scene}_{notebook_path(self.stage).stem}"
        return self.files.run / "notebooks" / f"{stem}{self.label and '_' + self.label}.ipynb"

    @property
    def record(self) -> Path:
        return self.files.root / ".stages" / f"{self.stage}{self.label and '_' + self.label}.json"

    @property
    def pair(self) -> dict[str, str]:
        """Map and query device if the job is for one pair; else empty."""
        return {name: self.parameters[name] for name in ("map_device", "query_device") if self.label.startswith("map_")}

    def makes(self, name: str) -> bool:
        """Return whether this job writes a file, given by its path in the stage's folder of results."""
        if self.stage == "embed":  # a folder per session, perhaps below one per model; only sessions have a _
            return re.match(f"([^_/]+/)?{self.label}", name) is not None
        pair = name.rpartition("/")[2].removeprefix(f"{self.files.scene}_")
        if self.stage in ("localize", "sequence") and of_sequence(pair) != (self.stage == "sequence"):
            return False
        return not self.label or re.match(f"{self.label}(?![a-z0-9-])", pair) is not None

    def outputs(self) -> str:
        """Return a fingerprint of the files that the job has made."""
        folder = stage_outputs(self.files, self.stage)
        results = tree_fingerprint(folder, self.makes, content=True) if folder else ""
        beside = {"retrieve": (self.files.index, "faiss"), "localize": (self.files.maps, "npz")}
        if self.stage not in beside:
            return results
        folder, suffix = beside[self.stage]
        device = self.parameters.get("map_device", "all")
        maps = sorted(folder.glob(f"{'*' if device == 'all' else device}_map*.{suffix}"))
        return fingerprint([results, [[path.name, checksum(path)] for path in maps]])

    def older(self) -> str:
        """Return why the results are older than what they were made from; empty if they are not."""
        folder = stage_outputs(self.files, self.stage)
        older = older_files(folder, self.stage, self.makes) if folder else {}
        return next(iter(older.values()), "")

    def forget(self) -> None:
        """Remove the fingerprints beside the outputs of a stage without `skip_existing`, so that it reuses none.

        The other stages discard their results themselves; without their records, these would look torn.
        """
        folder = stage_outputs(self.files, self.stage)
        if folder and "skip_existing" not in self.parameters:
            for path in folder.rglob("*.meta.json"):
                if self.makes(path.relative_to(folder).as_posix()):
                    path.unlink()


def run(
    manifest_path: str | Path,
    only: str | None = None,
    force: bool = False,
    overrides: Iterable[str] = (),
    say: Say = print,
    cluster: str | None = None,
    name: str | None = None,
    in_place: bool = False,
) -> Path:
    """Run a manifest and return its run folder, with `run.json` and `report.html` in it.

    With `overrides` that change a result, the run has a folder of its own, `<output_root>/<name>-<key>-<value>`, and
    takes over from the run of the manifest itself what they leave as it is. So a finished run changes only by its
    manifest.

    Args:
        manifest_path: YAML file, see `toolkit.manifest`.
        only: run only this stage, on the results of earlier stages.
        force: also execute stages that are up to date, without reuse of their own results.
        overrides: `key=value` or `stage.key=value`, replace values of the manifest.
        say: prints progress lines; called like `print`.
        cluster: cluster whose workers the stages use, see `runs.cluster.open_cluster`.
        name: name of the run folder; None: as above.
        in_place: write into the folder of the manifest, whatever the overrides are.

    Raises:
        ManifestError: the manifest or an argument is wrong; nothing has run.
        StageError: a notebook failed; `run.json` then says `"status": "failed"`.
    """
    if in_place and name:
        raise ManifestError("--in-place and --name exclude each other: give one of them.")
    overrides = list(overrides)
    manifest = load_manifest(manifest_path, overrides)
    _check_only(only, manifest, manifest_path)
    if not in_place:
        name, shared = own_run(manifest_path, manifest, overrides, name)
        if name != manifest.name or shared:
            manifest = _own_manifest(manifest, name, shared, shared.run if shared else name)
            say(f"Run folder: {Path(manifest.output_root) / name}")
    return _run_in(manifest, manifest_path, only, force, say, cluster)


def _check_only(only: str | None, manifest: Manifest, manifest_path: str | Path) -> None:
    """Raise ManifestError for a stage to run alone that does not exist or is off."""
    if only is not None and only not in STAGES:
        raise ManifestError(f"--only {only}: no such stage. {nearest(only, STAGES)}")
    if only is not None and only not in manifest.stages:
        raise ManifestError(f"--only {only}: {manifest_path} has no section `{only}`, so the stage is off.")


def own_run(
    manifest_path: str | Path, manifest: Manifest, overrides: Sequence[str], name: str | None = None
) -> tuple[str, Shared | None]:
    """Return the name of the run of a manifest with overrides, and what it shares with the run without them.

    Args:
        manifest: content of `manifest_path`, with the overrides.
        name: chosen by the user; None: named after the overrides that change a result.

    Returns:
        The name; and what it shares, None if it is the manifest's own run or there can be none.
    """
    try:
        plain = load_manifest(manifest_path)
    except ManifestError:  # it needs the overrides, so there is no run without them
        return name or manifest.name, None
    keys = changed_keys(plain, manifest, overrides)
    if name is None:
        chosen = any(override.partition("=")[0].strip() == "name" for override in overrides)
        name = manifest.name if chosen else variant_name(plain.name, keys)
    return name, Shared(plain.name, list(keys)) if name != plain.name else None


def _own_manifest(manifest: Manifest, name: str, shared: Shared | None, plain: str) -> Manifest:
    """Return the manifest of a run of its own, and fill its folder with what it shares with another run.

    Args:
        plain: name of the manifest without overrides, whose rendered capture all its runs use.
    """
    own = manifest.model_copy(update={"name": name})
    if shared is None or {key.partition(".")[0] for key in shared.differing} & {"captures", "demo_data"}:
        return own
    if manifest.demo_data:
        captures = _captures(manifest.model_copy(update={"name": plain}))
        own = own.model_copy(update={"demo_data": None, "captures": list(map(str, captures))})
    root = Path(own.output_root)
    take_over(root / shared.run, root / name, [Path(capture).name for capture in own.captures], shared.differing)
    return own


def _run_in(
    manifest: Manifest, manifest_path: str | Path, only: str | None, force: bool, say: Say, cluster: str | None
) -> Path:
    devices = [device.model_dump(exclude_none=True) for device in manifest.extra_devices]
    with extra_devices(devices), allow_outside(manifest.allow_outside):
        return _run(manifest, manifest_path, only, force, say, cluster)


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

    Each run takes over, from the earlier run with the most values in common, the results that the differing keys do not
    change, even if that run failed. The first run takes them from the plain run of the manifest, if there is one. A
    demo capture is rendered once for all runs. If a run fails, the next ones still run.

    Args:
        sweeps: `key=a,b,c` each, see `runs.sweep.swept_runs`; several keys give all combinations of their values.
        manifest_path, overrides, say, only, force, cluster: as for `run`.

    Returns:
        The folders of the runs that succeeded, and the errors of the runs that failed.

    Raises:
        ManifestError: the manifest or a swept value is wrong; nothing has run.
    """
    name, shared = own_run(manifest_path, load_manifest(manifest_path, overrides), overrides)
    plain = shared or Shared(name, [])
    runs = {one: load_manifest(manifest_path, [*overrides, *one.overrides]) for one in swept_runs(name, sweeps)}
    for manifest in runs.values():  # find mistakes before hours of work
        _check_only(only, manifest, manifest_path)
        _check_stages(manifest, manifest_path)
    done, failed = dict[SweptRun, Path](), dict[SweptRun, ToolkitError]()
    for number, (one, manifest) in enumerate(runs.items(), 1):
        say(f"{one.name} ({number} of {len(runs)}): {', '.join(one.overrides)}")
        # The run that differs in the fewest keys has most results to share; among equals, prefer one that succeeded.
        donor = max(
            [*done, *failed],
            key=lambda other: (len({*other.overrides} & {*one.overrides}), other in done),
            default=SweptRun(plain.run, ()),
        )
        keys = [override.partition("=")[0] for override in one.overrides if override not in donor.overrides]
        differing = [*keys, *(plain.differing if donor.name == plain.run else ())]
        try:
            own = _own_manifest(manifest, one.name, Shared(donor.name, differing), plain.run)
            done[one] = _run_in(own, manifest_path, only, force, say, cluster)
        except ToolkitError as error:
            say(f"{one.name}: {sentence(error)}")
            failed[one] = error
    return list(done.values()), list(failed.values())


def _run(
    manifest: Manifest, manifest_path: str | Path, only: str | None, force: bool, say: Say, cluster: str | None
) -> Path:
    _require_downloads(manifest, manifest_path)
    _check_stages(manifest, manifest_path)
    manifest = _name_embedder(manifest, say)
    run_dir = Path(manifest.output_root) / manifest.name
    stages = [only] if only else [stage for stage in STAGES if stage in manifest.stages]
    if "sequence" in stages:
        require_gtsam()
    for stage in stages:
        if not any(run_dir.glob(f"*/.stages/{stage}*.json")):
            _require_weights(stage, manifest.stage(stage))
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ManifestError(f"output_root: {run_dir} cannot be made ({error.strerror}). Choose another.") from None
    with held(run_dir), open_cluster(cluster, say), Kernels(run_dir / "notebooks") as kernels:
        try:
            _run_stages(manifest, stages, run_dir, force, say, kernels)
        except BaseException as error:
            log.debug("stopped", exc_info=error)
            if exit_code(error) != 3 or isinstance(error, StageError):
                raise
            text = f"{sentence(error)} The traceback is in {run_dir / LOG}."
            raise StageError(text, internal=True) from error
    return run_dir


def _check_stages(manifest: Manifest, manifest_path: str | Path) -> None:
    """Raise ManifestError for settings that a stage or its notebook does not know."""
    for stage in STAGES:
        path, settings = notebook_path(stage), manifest.stage(stage)
        parameters = settings_parameters(settings, notebook_parameters(path))
        check_parameters(path, parameters, f"{manifest_path}: {stage}.")
        try:
            check_names(settings)
        except ManifestError as error:
            raise ManifestError(f"{manifest_path}: {stage}: {error}") from None


def _run_stages(manifest: Manifest, stages: list[str], run_dir: Path, force: bool, say: Say, kernels: Kernels) -> None:
    captures = _captures(manifest)
    every = [
        job
        for capture in captures
        for stage in STAGES
        if stage in manifest.stages
        for job in _jobs(manifest, stage, capture, SceneFiles(run_dir, capture.name), force)
    ]
    jobs = [job for job in every if job.stage in stages]
    inputs = {capture.name: tree_fingerprint(capture / "sessions") for capture in captures}
    for job in jobs:
        # Weights first, because `_reusable` reads all output files of the job.
        if _weights_needed(job.stage, job.settings) and (
            force or not _reusable(job, _inputs_of(job, inputs[job.files.scene]))
        ):
            _require_weights(job.stage, job.settings)
    earlier = [Earlier(job.record, job.older) for job in every if job.stage not in stages]
    record = RunLog(run_dir, manifest, inputs, _code_fingerprint(), earlier)
    try:
        record.write()
        failed: list[tuple[Job, StageError]] = []
        for i, job in enumerate(jobs, 1):
            kernels.left = len(jobs) - i + 1
            head = f"[{i}/{len(jobs)}] {job.stage:<9} {job.name}"
            try:
                _run_or_reuse(job, inputs[job.files.scene], failed, force, head, record, say, kernels)
            except StageError as error:
                if not error.of_the_data:
                    raise
                failed.append((job, error))  # other captures and pairs may succeed
        for row in record.all_rows():
            if row["status"] == OLDER:
                say(f"{row['stage']} {row['scene']} was not run again: {row['reason']}")
        last = [row["status"] for row in record.rows if row["stage"] == stages[-1]]
        if failed and not {"done", "reused"} & set(last):
            raise failed[0][1]
        record.end(incomplete=_not_tolerated(manifest, failed, record, _devices(manifest, captures)))
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


def _run_or_reuse(
    job: Job,
    capture: str,
    failed: list[tuple[Job, StageError]],
    force: bool,
    head: str,
    record: RunLog,
    say: Say,
    kernels: Kernels,
) -> None:
    """Execute a job, reuse its results, or skip it, and add its row to the record."""
    inputs = _inputs_of(job, capture)
    if cause := next((other for other, _ in failed if _builds_on(job, other)), None):
        message = f"skipped: {cause.stage} has failed"
        row = {"stage": job.stage, "scene": job.files.scene, "part": job.label, "status": "skipped", "error": message}
    elif not force and (reusable := _reusable(job, inputs)):
        row, message = reusable, "reused"
    else:
        row, message = _run_job(job, inputs, force, head, record, say, kernels), ""
    if message:
        say(f"{head}  {message}")
        log.info("%s  %s", head, message)
    record.add(row)


def _builds_on(job: Job, other: Job) -> bool:
    """Return whether a job needs the results of another job."""
    upstream = set(UPSTREAM[job.stage])
    for stage in reversed(STAGES):
        upstream |= set(UPSTREAM[stage]) if stage in upstream else set()
    return job.files == other.files and other.stage in upstream and other.label in ("", job.label)


def _devices(manifest: Manifest, captures: list[Path]) -> list[str]:
    """Return the devices of the captures that the manifest includes."""
    from toolkit.capture import Capture

    present = dict.fromkeys(device for capture in captures for device in Capture.open(capture).devices)
    return [device for device in present if manifest.devices == "auto" or device in manifest.devices]


def _not_tolerated(
    manifest: Manifest, failed: list[tuple[Job, StageError]], record: RunLog, devices: list[str]
) -> str | None:
    """Return a description of the failures that exceed the manifest's `tolerate_failed`; None if there are none."""
    lines = [f"{job.stage} {job.name}: {error}" for job, error in failed if not job.label]
    rows = record.all_rows()
    for kind, counts in failures(rows).items():
        tolerated = getattr(manifest.tolerate_failed, kind)
        if counts["of"] and counts["failed"] / counts["of"] > tolerated:  # a product would be rounded below the count
            lines.append(
                f"{counts['failed']} of {counts['of']} {kind} failed; tolerate_failed.{kind} is {tolerated:g}."
            )
    if not lines:
        return None
    lost = [one | {"scene": row["scene"]} for row in rows for one in row.get("left_out", ())]
    whats: dict[str, list[str]] = {}
    for one in lost:
        whats.setdefault(one["reason"], []).append(f"{one['what']} of {one['scene']}")
    reasons = [f"{', '.join(dict.fromkeys(names))}: {reason}" for reason, names in whats.items()]
    pairs = [(one["map_device"], one["query_device"]) for one in lost if "map_device" in one]
    advice = [way_out(pairs, devices)] if pairs else []
    return "\n".join([*lines, *reasons, *advice])


def tree_fingerprint(folder: Path, of: Callable[[str], bool] | None = None, content: bool = False) -> str:
    """Return a fingerprint, 16 hex digits, of the files below a folder; links are followed.

    Args:
        of: selects files by their path below the folder; None: all files.
        content: hash the content of each file beside its path and size, instead of the time of its last change. This
            also detects damage, and takes about a second for some gigabytes that are in the page cache.
    """
    rows = []
    for root, folders, names in os.walk(folder, followlinks=True):
        folders.sort()
        parent = os.path.relpath(root, folder)
        for name in sorted(names):
            if of is None or of(f"{parent}/{name}"):
                with suppress(FileNotFoundError):
                    stat = os.stat(file := f"{root}/{name}")  # noqa: PTH116 - a Path for each is 5 times slower
                    rows.append([parent, name, stat.st_size, checksum(file) if content else stat.st_mtime_ns])
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
    needed: list[tuple[WeightsSource, str | None]] = []
    if isinstance(settings, LocalizeSettings):
        if settings.method == "nearest":
            return []
        if settings.predicts and (network := ARCHITECTURES.get(settings.predictor.name)):
            needed.append((network.weights, settings.predictor.checkpoint))
        local = local_weights(resolve_auto(settings))
    elif isinstance(settings, RerankSettings):
        local = local_weights(resolve_auto(settings))
    else:
        return []
    for source, checkpoint in local:
        section = source.setting.removeprefix("localize.")
        needed.append((replace(source, setting=f"{stage}.{section}"), checkpoint))
    return needed


def _captures(manifest: Manifest) -> list[Path]:
    """Return the folders of the captures; render that of `demo_data`."""
    if manifest.demo_data is not None:
        from toolkit.synthetic import render_capture

        folder = Path(manifest.output_root).parent / "data" / manifest.name
        return [render_capture(folder, **manifest.demo_data.model_dump())]
    return [Path(capture) for capture in manifest.captures]


def _require_downloads(manifest: Manifest, manifest_path: str | Path) -> None:
    """Raise ManifestError if a capture has yet to be downloaded, or its download has not finished."""
    fetch = f"python -m toolkit download {manifest_path}"
    for capture in map(Path, manifest.captures):
        if is_unfinished(capture):
            raise ManifestError(f"{capture}: its download is not complete. Continue it first: {fetch}")
        if manifest.dataset and capture.name in manifest.dataset.sources and not (capture / "sessions").is_dir():
            raise ManifestError(
                f"{capture}: no such capture. Download it first: {fetch}\n"
                "If you already have it, name its folder in `captures`."
            )


def _jobs(manifest: Manifest, stage: str, capture: Path, files: SceneFiles, force: bool) -> Iterator[Job]:
    """Yield the jobs of a stage: one, or several if the manifest selects only some devices or pairs."""
    values: dict[str, Any] = {
        **stage_folders(files),
        "sessions_root": capture / "sessions",
        "out_dir": stage_outputs(files, stage),
        "queries": manifest.queries,
    }
    if manifest.rerank is not None:
        reranked = {"localize": "retrieval_dir", "evaluate": "reranked_dir"}
        values |= {name: files.reranked_dir for of, name in reranked.items() if of == stage}
    if force:
        values["skip_existing"] = False
    known = notebook_parameters(notebook_path(stage))
    for label, choice in _parts(manifest, stage, capture):
        parameters = {name: value for name, value in (values | choice).items() if name in known}
        plain = {name: str(value) if isinstance(value, Path) else value for name, value in parameters.items()}
        settings = manifest.stage(stage)
        yield Job(stage, files, settings, plain | settings_parameters(settings, known), label)


def settings_parameters(settings: Settings, known: Iterable[str]) -> dict[str, Any]:
    """Return settings that were set as notebook parameters: those in its parameters cell, and a dict of the rest."""
    given = settings.given()
    rest = {key: value for key, value in given.items() if key not in known}
    return {key: value for key, value in given.items() if key in known} | ({"settings": rest} if rest else {})


def _parts(manifest: Manifest, stage: str, capture: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return (label, parameters that select devices) for each job of a stage."""
    from toolkit.capture import Capture

    content = Capture.open(capture)
    present = content.devices
    # Without any map or query session, the stages say what is missing.
    maps, queries = ([d for d in present if f"{d}_{split}" in content] or present for split in ("map", "query"))
    every = list(product(maps, queries))
    devices = present if manifest.devices == "auto" else manifest.devices
    wanted = every if manifest.pairs == "all" else dict.fromkeys((m, q) for m, q in manifest.pairs)
    pairs = [(m, q) for m, q in wanted if {m, q} <= {*devices} & {*present}]
    if not pairs:
        raise ManifestError(
            f"{capture}: `devices` and `pairs` of the manifest select none of its maps with queries. "
            f"Its sessions: {', '.join(content)}."
        )
    if set(pairs) == set(every):
        return [("", {"device": "auto", "map_device": "all", "query_device": "all"})]
    if stage == "embed":
        return [(f"{d}_", {"device": d}) for d in present if any(d in pair for pair in pairs)]
    if stage in ("retrieve", "rerank", "localize", "sequence"):
        return [(f"map_{m}_query_{q}", {"map_device": m, "query_device": q}) for m, q in pairs]
    return [("", {"map_device": "all", "query_device": "all", "pairs": [list(pair) for pair in pairs]})]


def _inputs_of(job: Job, capture: str) -> str:
    """Return a fingerprint of a job's inputs: parameters, capture, code, weights, and the stages it builds on."""
    # `skip_existing` does not change the results.
    parameters = {name: value for name, value in job.parameters.items() if name != "skip_existing"}
    source = hashlib.sha256(notebook_path(job.stage).read_bytes()).hexdigest()
    upstream = [
        read_json(record).get("made")
        for stage in UPSTREAM[job.stage]
        for record in sorted(job.record.parent.glob(f"{stage}*.json"))
    ]
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
    if record.get("inputs") != inputs or record.get("outputs") != job.outputs() or not read_json(job.notebook):
        return None
    # Left-out pairs are tried again: a repair, such as a changed permission, may not show in a fingerprint.
    return None if record["row"].get("left_out") else {**record["row"], "status": "reused"}


def _run_job(
    job: Job, inputs: str, force: bool, head: str, record: RunLog, say: Say, kernels: Kernels
) -> dict[str, Any]:
    """Execute a job and return its row of `run.json`."""
    line = StatusLine(head, say)
    row: dict[str, Any] = {"stage": job.stage, "scene": job.files.scene, "part": job.label}
    row |= {"notebook": str(job.notebook.relative_to(job.files.run)), "parameters": job.parameters}
    row |= {"asked": 1} if job.pair else {}
    # There is no record while the stage runs, so a killed stage runs again.
    job.record.unlink(missing_ok=True)
    if force:
        job.forget()
    started, logged = time.perf_counter(), (job.files.run / LOG).stat().st_size
    try:
        notebook, memory = execute(notebook_path(job.stage), job.notebook, job.parameters, line, kernels)
    except BaseException as error:
        status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
        line.end(status)
        row |= {"status": status, "seconds": round(time.perf_counter() - started, 2), "error": sentence(error)}
        if job.pair:
            row["left_out"] = [job.pair | {"what": pair_text(job.pair), "reason": sentence(error)}]
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
    folder = stage_outputs(job.files, job.stage)
    # With unfinished outputs, an empty fingerprint makes the next run execute the stage again.
    outputs = "" if folder and any_unfinished(folder, job.makes) else job.outputs()
    made = {"made": datetime.now(UTC).isoformat(), "inputs": inputs, "outputs": outputs, "row": row}
    write_text(job.record, json.dumps(made, indent=1) + "\n")
    summary = ", ".join(f"{value} {name.replace('_', ' ')}" for name, value in counts.items())
    line.end(f"{summary}{summary and '; '}{work:.1f} s + {seconds - work:.1f} s start-up, {memory:.0f} MB")
    for one in row.get("left_out", ()):
        say(f"  left out: {one['what']}: {one['reason']}")
    warnings = [one for one in warnings_of_kernels(job.files.run / LOG, logged) if one not in record.shown]
    record.shown.update(warnings)
    for one in warnings[:MOST_WARNINGS]:
        say(f"  warning: {one}")
    if len(warnings) > MOST_WARNINGS:
        say(f"  ... and {len(warnings) - MOST_WARNINGS} more warnings, see {job.files.run / LOG}")
    return row


def _write_report(run_dir: Path) -> None:
    from toolkit.show.report import write_report

    write_report(run_dir)
