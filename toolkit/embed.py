"""Global descriptors of all images of a capture: one matrix and one table a subsession."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.capture.images import default_workers, prefetch, read_image
from toolkit.capture.upright import Turns, turn_image, upright_turns
from toolkit.embedders import Embedder, create_embedder, resolve_name
from toolkit.errors import ImageError, ManifestError, ToolkitError
from toolkit.features.features import LocalFeatures, SiftExtractor
from toolkit.features.groups import GroupWriter
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import (
    file_fingerprint,
    files_fingerprint,
    fingerprint,
    is_current,
    sidecar_path,
    write_atomic,
    write_sidecar,
    write_text,
)
from toolkit.manifest import EmbedSettings

log = logging.getLogger(__name__)

VECTORS = "vectors"
"""Name of the array of a batch."""
VOCABULARY_IMAGES = 2048
"""Map images that the vocabulary is learned from at most, spread evenly: bounds time and memory."""


def embed_sessions(
    sessions_root: str | Path,
    out_dir: str | Path,
    settings: EmbedSettings | Mapping[str, Any] | None = None,
    *,
    device: str = "auto",
    subsession: str = "all",
    features_dir: str | Path | None = None,
    skip_existing: bool = True,
) -> pd.DataFrame:
    """Write `<out_dir>/<session>/<subsession>/<subsession>.npy` (N, D) and its `manifest.csv`.

    Images that cannot be read are left out of both, and listed with the reason in `failed.csv` beside them.
    Memory does not grow with the number of images, and a killed run goes on within a subsession.

    Args:
        sessions_root: `<capture>/sessions`.
        out_dir: the embeddings folder; the vocabulary goes there too.
        settings: see `EmbedSettings`; a dict holds what differs from the defaults.
        device: `ios`, `hl`, `spot`, or `auto`: all that the capture has.
        subsession: one subsession's name, or `all`.
        features_dir: folder of the local features that stages share; `<out_dir>/../features` where None.
        skip_existing: reuse subsessions made from the same images and settings.

    Returns:
        One row a subsession: session, subsession, images, embedded, unreadable, turned, seconds, skipped, model,
        dim.

    Raises:
        ManifestError: a parameter is not valid.
        WeightsError: a learned model has no weights, or other ones; before any work.
    """
    settings = EmbedSettings.of(settings)
    out_dir = Path(out_dir)
    features_dir = Path(features_dir) if features_dir is not None else out_dir.parent / "features"
    capture = Capture.from_sessions_root(sessions_root)
    jobs = _jobs(capture, device, subsession)
    embedder = _open_embedder(capture, settings, out_dir, features_dir, skip_existing)
    turns = _turns(capture, embedder, settings)
    if subsession == "all":
        _remove_former(out_dir, _session_names(capture, device), jobs)

    @cache
    def store_of(session_id: str) -> FeatureStore:
        """Return the features of all that is embedded of a session: its file is then written once."""
        rows = [rows for session, _, rows in jobs if session.id == session_id]
        return extract_session(capture[session_id], features_dir, rows=np.concatenate(rows))

    table = []
    for session, part, rows in jobs:
        started = time.perf_counter()
        job = _Job(session, part, rows, np.zeros(len(rows), np.int64) if turns is None else turns.of(session, rows))
        folder = out_dir / session.id / part
        matrix_path = folder / f"{Path(part).name}.npy"
        record = {
            "embedder": embedder.settings,
            "features": SiftExtractor().settings if embedder.inputs == "features" else None,
            "images": _images_fingerprint(session, rows),
            "sensors": file_fingerprint(session.path / "sensors.txt"),
            "turns": fingerprint(job.turns.tolist()) if job.turns.any() else None,
            "normalize": settings.normalize,
            "dtype": settings.dtype,
        }
        skipped = skip_existing and (folder / "manifest.csv").exists() and is_current(matrix_path, record)
        if skipped:
            embedded = len(np.load(matrix_path, mmap_mode="r"))
        else:
            # The same images in batches of another size are the same up to rounding.
            identity = {**record, "batch_size": settings.batch_size}
            with GroupWriter(matrix_path, identity) as batches:
                if not skip_existing:
                    batches.discard()
                failed = _embed_job(embedder, job, batches, settings.batch_size, settings.normalize, store_of)
                embedded = len(rows) - len(failed)
                _write_tables(folder, _manifest(capture, session, rows, failed), failed)
                write_matrix(matrix_path, batches, embedded, embedder.dim, settings.dtype)
                write_sidecar(matrix_path, record)
                batches.discard()
            if failed:
                log.warning("%s/%s: %d of %d images cannot be read, see %s",
                            session.id, part, len(failed), len(rows), folder / "failed.csv")  # fmt: skip
        table.append(
            {
                "session": session.id,
                "subsession": part,
                "images": len(rows),
                "embedded": embedded,
                "unreadable": len(rows) - embedded,
                "turned": int(np.count_nonzero(job.turns)),
                "seconds": round(time.perf_counter() - started, 3),
                "skipped": skipped,
                "model": embedder.name,
                "dim": embedder.dim,
            }
        )
    made_with = settings.model_copy(update={"model": embedder.name})
    write_text(out_dir / "settings.json", made_with.model_dump_json(indent=1) + "\n")
    return pd.DataFrame(table)


@dataclass(frozen=True)
class _Job:
    """One subsession: its images, and how each is turned for the embedder."""

    session: Session
    part: str
    rows: NDArray[np.intp]
    turns: NDArray[np.int64]


def _open_embedder(
    capture: Capture, settings: EmbedSettings, out_dir: Path, features_dir: Path, skip_existing: bool
) -> Embedder:
    name = resolve_name(settings.model, settings.checkpoint)
    if settings.model == "auto":
        log.warning("model auto: %s", name)
    if name == "vlad":
        return create_embedder(name, vocabulary=_vocabulary(capture, out_dir, features_dir, settings, skip_existing))
    return create_embedder(
        name,
        checkpoint=settings.checkpoint,
        device=settings.compute_device,
        dtype_compute=settings.dtype_compute,
        image_size=settings.image_size,
    )


def _turns(capture: Capture, embedder: Embedder, settings: EmbedSettings) -> Turns | None:
    """Return how images are turned upright, or None where they are taken as they are."""
    upright = embedder.upright if settings.upright is None else settings.upright
    if embedder.inputs == "features" or not upright:
        return None
    return upright_turns(capture, settings.world_up)


def _session_names(capture: Capture, device: str) -> list[str]:
    devices = capture.devices if device in ("auto", "all") else [device]
    names = [f"{key}_{split}" for key in devices for split in ("map", "query")]
    return [name for name in names if name in capture]


def _jobs(capture: Capture, device: str, subsession: str) -> list[tuple[Session, str, NDArray[np.intp]]]:
    """Return the subsessions to embed: session, subsession, image rows."""
    if device not in ("auto", "all", *capture.devices):
        raise ManifestError(
            f"device is {device!r}; {capture.name} has {', '.join(capture.devices)} (or `auto`)."
        )
    names = _session_names(capture, device)
    jobs, known = [], []
    for session in (capture[name] for name in names):
        rows = session.camera_rows
        parts = session.subsession_of(rows)
        # Images outside every listed subsession are embedded too, under the session's name.
        parts = np.where(parts == "", session.id, parts)
        for part in dict.fromkeys(parts.tolist()):
            known.append(part)
            if subsession in ("all", part):
                jobs.append((session, part, rows[parts == part]))
    if not jobs:
        raise ManifestError(
            f"No images of subsession {subsession!r} in {', '.join(names)}; known: {', '.join(known)}."
        )
    return jobs


def _remove_former(
    out_dir: Path, names: list[str], jobs: list[tuple[Session, str, NDArray[np.intp]]]
) -> None:
    """Remove the embeddings of subsessions that these sessions no longer have: whoever reads a session reads all."""
    parts = {out_dir / session.id / part for session, part, _ in jobs}
    for name in names:
        for manifest in sorted((out_dir / name).rglob("manifest.csv")):
            if manifest.parent not in parts:
                log.warning("%s: no such subsession any more, removed", manifest.parent)
                stem = manifest.parent / f"{manifest.parent.name}.npy"
                for path in (manifest, stem, sidecar_path(stem), manifest.parent / "failed.csv"):
                    path.unlink(missing_ok=True)


def _vocabulary(
    capture: Capture, out_dir: Path, features_dir: Path, settings: EmbedSettings, skip_existing: bool
) -> Path:
    """Learn the VLAD vocabulary from the map images of all devices, unless a current one is there."""
    from toolkit.embedders.vlad import Vlad

    maps = [capture[name] for name in capture if capture[name].split == "map"]
    if not maps:
        raise ToolkitError(
            f"{capture.path}/sessions has no <device>_map session; `vlad` learns its vocabulary from the map."
        )
    every = [(session.id, int(row)) for session in maps for row in session.camera_rows]
    picked = np.linspace(0, len(every) - 1, min(len(every), VOCABULARY_IMAGES)).astype(int).tolist()
    chosen: dict[str, list[int]] = {}
    for name, row in (every[index] for index in picked):
        chosen.setdefault(name, []).append(row)
    record = {
        "vlad": settings.vlad.model_dump(),
        "features": SiftExtractor().settings,
        "images": {name: _images_fingerprint(capture[name], np.array(rows)) for name, rows in chosen.items()},
        "seed": settings.seed,
    }
    path = out_dir / "vlad.npz"
    if skip_existing and is_current(path, record):
        return path
    stores = {
        name: extract_session(capture[name], features_dir, rows=np.array(rows))
        for name, rows in chosen.items()
    }
    keys = [(name, capture[name].image_name(row)) for name, rows in chosen.items() for row in rows]
    keys = [(name, image) for name, image in keys if image in stores[name]]

    def features() -> Iterator[LocalFeatures]:
        for name, image in tqdm(keys, desc="vocabulary", unit="image"):
            yield stores[name][image]

    vlad = Vlad.learn(features, len(keys), settings.vlad, settings.seed)
    vlad.save(path)
    write_sidecar(path, record)
    return path


def _embed_job(
    embedder: Embedder,
    job: _Job,
    batches: GroupWriter,
    batch_size: int,
    normalize: bool,
    store_of: Callable[[str], FeatureStore],
) -> dict[int, str]:
    """Add the vectors of the readable images, in order; return why the others (by row) have none."""
    failed: dict[int, str] = {}
    done, finished = 0, batches.notes()
    for note in finished.values():  # what a stopped run had done
        done = note["done"]
        failed |= dict(note["failed"])
    source = _features if embedder.inputs == "features" else _images
    inputs = source(embedder, job, done, batch_size, store_of)
    label = f"embed {job.session.id}/{job.part}"
    with tqdm(total=len(job.rows), initial=done, desc=label, unit="image") as bar:
        for number, (batch, unreadable) in enumerate(_batches(inputs, batch_size), start=len(finished)):
            vectors = embedder.embed(batch)
            if vectors.shape != (len(batch), embedder.dim):
                raise ValueError(f"{embedder.name} gave {vectors.shape}; expected {(len(batch), embedder.dim)}.")
            if normalize:
                vectors = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
            failed |= unreadable
            done += len(batch) + len(unreadable)
            note = {"done": done, "failed": list(unreadable.items())}
            batches.add(f"{number:08d}", arrays={VECTORS: vectors}, note=note)
            bar.update(len(batch) + len(unreadable))
    return failed


def write_matrix(path: Path, batches: GroupWriter, rows: int, dim: int, dtype: str) -> None:
    """Write the vectors of all batches to a file `.npy`, (rows, dim), without holding them in memory."""
    with write_atomic(path) as temporary, open(temporary, "wb") as stream:
        header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": (rows, dim)}
        np.lib.format.write_array_header_1_0(stream, header)
        for _, arrays in batches.read():
            stream.write(np.ascontiguousarray(arrays[VECTORS], dtype).tobytes())


def _features(
    embedder: Embedder, job: _Job, done: int, batch_size: int, store_of: Callable[[str], FeatureStore]
) -> Iterator[tuple[int, LocalFeatures | str]]:
    """Yield row and local features of the images after the first `done`, or why there are none."""
    store = store_of(job.session.id)
    for row in job.rows[done:].tolist():
        name = job.session.image_name(row)
        yield row, store[name] if name in store else store.failed.get(name, "no local features were extracted")


def _images(
    embedder: Embedder, job: _Job, done: int, batch_size: int, store_of: Callable[[str], FeatureStore]
) -> Iterator[tuple[int, NDArray[np.uint8] | str]]:
    """Yield row and prepared image of the images after the first `done`, or why it cannot be read."""

    def read(item: tuple[int, int]) -> tuple[int, NDArray[np.uint8] | str]:
        row, turns = item
        try:
            image = read_image(job.session.image_path(row))
        except ImageError as error:
            return row, str(error)
        return row, embedder.prepare(turn_image(image, turns))

    items = zip(job.rows[done:].tolist(), job.turns[done:].tolist(), strict=True)
    return prefetch(read, items, workers=default_workers(), ahead=2 * batch_size)


def _batches(
    items: Iterable[tuple[int, Any | str]], size: int
) -> Iterator[tuple[list[Any], dict[int, str]]]:
    """Yield up to `size` inputs, and the reasons (by row) of those that are none, in order."""
    batch: list[Any] = []
    unreadable: dict[int, str] = {}
    for row, item in items:
        if isinstance(item, str):
            unreadable[row] = item
        else:
            batch.append(item)
        if len(batch) == size:
            yield batch, unreadable
            batch, unreadable = [], {}
    if batch or unreadable:
        yield batch, unreadable


def _images_fingerprint(session: Session, rows: NDArray[np.intp]) -> str:
    """Identify images by their keys, and their files by name, size and time of change."""
    table = session.images.iloc[rows]
    keys = [table[column].tolist() for column in ("timestamp", "sensor_id", "path")]
    files = files_fingerprint([session.image_path(int(row)) for row in rows])
    return fingerprint([keys, session.device_ids[rows].tolist(), files])


def _manifest(
    capture: Capture, session: Session, rows: NDArray[np.intp], failed: dict[int, str]
) -> pd.DataFrame:
    table = session.images.iloc[rows]
    manifest = pd.DataFrame(
        {
            "device_id": session.device_ids[rows],
            "sensor_id": table["sensor_id"].to_numpy(),
            "timestamp": table["timestamp"].to_numpy(),
            "abs_path": [f"{capture.name}/sessions/{session.image_name(int(row))}" for row in rows],
        }
    )
    manifest["reason"] = [failed.get(int(row), "") for row in rows]
    return manifest


def _write_tables(folder: Path, manifest: pd.DataFrame, failed: dict[int, str]) -> None:
    missing = folder / "failed.csv"
    if failed:
        with write_atomic(missing) as temporary:
            manifest[manifest["reason"] != ""].to_csv(temporary, index=False)
    else:
        missing.unlink(missing_ok=True)
    embedded = manifest[manifest["reason"] == ""].drop(columns="reason").reset_index(drop=True)
    with write_atomic(folder / "manifest.csv") as temporary:
        embedded.to_csv(temporary, index_label="row_index")
