"""The embed stage: global descriptors of all images of a capture, one matrix and one table per subsession."""

import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.capture.images import default_workers, prefetch, read_image
from toolkit.capture.upright import Turns, turn_image, upright_turns
from toolkit.embedders import WEIGHTS, Embedder, create_embedder, resolve_model, shows_upright
from toolkit.errors import CaptureError, ImageError, ManifestError, ToolkitError
from toolkit.features.features import LocalFeatures
from toolkit.features.sift import SiftExtractor
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import (
    file_fingerprint,
    files_fingerprint,
    fingerprint,
    is_current,
    read_json,
    sidecar_path,
    write_atomic,
    write_sidecar,
    write_text,
)
from toolkit.geometry import Ints, unit
from toolkit.manifest import EmbedSettings
from toolkit.models.weights import resolve_weights
from toolkit.store.items import Items, heals, items_beside, remove_items
from toolkit.threads import one_thread

log = logging.getLogger(__name__)

VECTORS = "vectors"
"""Name of a batch's array in the file of progress."""
VOCABULARY_IMAGES = 2048
"""Map images from which the vocabulary is learned, at most, spread evenly: bounds time and memory."""


@heals
def embed_sessions(
    sessions_root: str | Path,
    out_dir: str | Path,
    settings: EmbedSettings | Mapping[str, Any] | None = None,
    *,
    device: str | Sequence[str] = "auto",
    subsession: str = "all",
    features_dir: str | Path | None = None,
    skip_existing: bool = True,
) -> pd.DataFrame:
    """Write `<out_dir>/<session>/<subsession>/<subsession>.npy` (N, D) and its `manifest.csv`.

    With several models, each writes these files below `<out_dir>/<model>`. Both files omit images that cannot be read;
    `failed.csv` beside them lists these with the reason. Memory does not grow with the number of images. A killed run
    continues within a subsession.

    Args:
        sessions_root: `<capture>/sessions`.
        out_dir: the embeddings folder; the vocabulary goes there too.
        settings: see `EmbedSettings`; a dict needs only the values that differ from the defaults.
        device: `ios`, `hl`, `spot`, a list of them, or `auto`: all devices of the capture.
        subsession: one subsession's name, or `all`.
        features_dir: folder of the local features that stages share; None: `<out_dir>/../features`.
        skip_existing: reuse subsessions made from the same images and settings.

    Returns:
        One row per subsession and model: session, subsession, images, embedded, unreadable, turned, seconds, skipped,
        model, dim, reason; and one row, with the `reason`, per session that cannot be read.

    Raises:
        CaptureError: no session can be read.
        ManifestError: a parameter is not valid.
        WeightsError: the weights of a learned model are missing, or of another network. Raised before any work.
    """
    settings = EmbedSettings.of(settings)
    out_dir = Path(out_dir)
    features_dir = Path(features_dir) if features_dir is not None else out_dir.parent / "features"
    capture = Capture.from_sessions_root(sessions_root)
    devices = capture.devices if device in ("auto", "all") else [device] if isinstance(device, str) else list(device)
    if not {*devices} <= {*capture.devices}:
        raise ManifestError(f"device is {device!r}; {capture.name} has {', '.join(capture.devices)} (or `auto`).")
    model = resolve_model(settings.model, settings.checkpoint)
    if settings.model == "auto":
        log.warning("model auto: %s", model)
    settings = settings.model_copy(update={"model": model})
    several = len(settings.models) > 1
    if several:
        for name in settings.models:
            if name in WEIGHTS:  # fail before another model has worked for hours
                resolve_weights(WEIGHTS[name], settings.checkpoint)
    tables = []
    for name in settings.models:
        # A run with several models reuses the files of a run with one of them alone, and vice versa.
        own, other = (out_dir / name, out_dir) if several else (out_dir, out_dir / name)
        folders = _Folders(own, other, features_dir)
        model_settings = settings.model_copy(update={"model": name})
        tables.append(_embed_with_model(capture, folders, model_settings, devices, subsession, skip_existing))
    write_text(out_dir / "settings.json", settings.model_dump_json(indent=1) + "\n")
    return pd.concat(tables, ignore_index=True) if several else tables[0]


@dataclass(frozen=True)
class _Folders:
    """Folders of one model: its embeddings, and its inputs."""

    out: Path
    other: Path
    """Folder where a run with another number of models puts the same embeddings."""
    features: Path

    def take_over(self, path: Path, record: dict[str, Any]) -> bool:
        """Copy an artifact and the files of its record from the other folder; False if it is not current there."""
        source = self.other / path.relative_to(self.out)
        if not is_current(source, record):
            return False
        (path.parent / "failed.csv").unlink(missing_ok=True)
        # Files are replaced, never changed, so both folders can share them by hard links.
        for name in [*read_json(sidecar_path(source))["files"], sidecar_path(source).name]:
            with write_atomic(path.with_name(name)) as temporary:
                try:
                    temporary.unlink()
                    os.link(source.with_name(name), temporary)
                except OSError:  # a file system without links
                    shutil.copyfile(source.with_name(name), temporary)
        return True


def _embed_with_model(
    capture: Capture,
    folders: _Folders,
    settings: EmbedSettings,
    devices: list[str],
    subsession: str,
    skip_existing: bool,
) -> pd.DataFrame:
    out_dir, features_dir = folders.out, folders.features
    parts, unreadable = _subsessions(capture, devices, subsession)
    embedder = _open_embedder(capture, settings, folders, skip_existing)
    if (turns := _turns(capture, embedder, settings)) is not None:
        parts = [replace(part, turns=turns.of(part.session, part.rows)) for part in parts]
    if subsession == "all":
        names = [name for name in _session_names(capture, devices) if name not in unreadable]
        _remove_former(out_dir, names, parts)

    @cache
    def store_of(session_id: str) -> FeatureStore:
        """Return the features of all subsessions of a session, so that its file is written once."""
        rows = [part.rows for part in parts if part.session.id == session_id]
        return extract_session(capture[session_id], features_dir, rows=np.concatenate(rows))

    table = []
    for part in parts:
        started = time.perf_counter()
        folder = out_dir / part.session.id / part.name
        matrix_path = folder / f"{Path(part.name).name}.npy"
        record = {
            "embedder": embedder.settings,
            "features": SiftExtractor().settings if embedder.inputs == "features" else None,
            "images": _images_fingerprint(part.session, part.rows),
            "sensors": file_fingerprint(part.session.path / "sensors.txt"),
            "turns": fingerprint(part.turns.tolist()) if part.turns.any() else None,
            "normalize": settings.normalize,
            "dtype": settings.dtype,
        }
        skipped = skip_existing and (is_current(matrix_path, record) or folders.take_over(matrix_path, record))
        if skipped:
            remove_items(matrix_path)
            embedded = len(np.load(matrix_path, mmap_mode="r"))
        else:
            # Progress is kept per batch, so it depends on the batch size; the finished matrix does not, up to rounding.
            source = fingerprint({**record, "rows_a_batch": settings.batch_size})
            with Items(items_beside(matrix_path), again=not skip_existing) as batches:
                failed = _embed(embedder, part, batches, source, settings, store_of)
                embedded = len(part.rows) - len(failed)
                tables = _write_tables(folder, capture.name, part, failed)
                vectors = (batches[name][VECTORS] for name in _names(part, settings))
                write_matrix(matrix_path, vectors, embedded, embedder.dim, settings.dtype)
                write_sidecar(matrix_path, record, tables)
            remove_items(matrix_path)
        table.append(
            {
                "session": part.session.id,
                "subsession": part.name,
                "images": len(part.rows),
                "embedded": embedded,
                "unreadable": len(part.rows) - embedded,
                "turned": int(np.count_nonzero(part.turns)),
                "seconds": round(time.perf_counter() - started, 3),
                "skipped": skipped,
                "model": embedder.name,
                "dim": embedder.dim,
                "reason": "",
            }
        )
    empty_row = {name: type(value)() for name, value in table[0].items()}
    table += [{**empty_row, "session": name, "reason": reason} for name, reason in unreadable.items()]
    return pd.DataFrame(table)


@dataclass(frozen=True)
class _Subsession:
    """A subsession to embed."""

    session: Session
    name: str
    rows: NDArray[np.intp]
    """(N,) rows of `session.images`."""
    turns: Ints
    """(N,) counter-clockwise quarter turns that make each image upright; 0 if the embedder takes them as stored."""


def _open_embedder(capture: Capture, settings: EmbedSettings, folders: _Folders, skip_existing: bool) -> Embedder:
    (name,) = settings.models
    if name == "vlad":
        return create_embedder(name, vocabulary=_vocabulary(capture, folders, settings, skip_existing))
    return create_embedder(
        name,
        checkpoint=settings.checkpoint,
        device=settings.compute_device,
        dtype_compute=settings.dtype_compute,
        image_size=settings.image_size,
    )


def _turns(capture: Capture, embedder: Embedder, settings: EmbedSettings) -> Turns | None:
    """Return the turns that make images upright, or None if the embedder takes them as stored."""
    return upright_turns(capture, settings.world_up) if shows_upright(embedder, settings.upright) else None


def _session_names(capture: Capture, devices: list[str]) -> list[str]:
    names = [f"{key}_{split}" for key in devices for split in ("map", "query")]
    return [name for name in names if name in capture]


def _subsessions(capture: Capture, devices: list[str], subsession: str) -> tuple[list[_Subsession], dict[str, str]]:
    """Return the subsessions to embed, without turns, and for each unreadable session the reason."""
    names = _session_names(capture, devices)
    parts, unreadable = list[_Subsession](), dict[str, CaptureError]()
    for id_ in names:
        try:
            session = capture[id_]
            rows = session.camera_rows
        except CaptureError as error:
            log.warning("%s is left out: %s", id_, error)
            unreadable[id_] = error
            continue
        subsessions = session.subsession_of(rows)
        # Images outside all listed subsessions are embedded too, under the session's name.
        subsessions = np.where(subsessions == "", session.id, subsessions)
        for name in dict.fromkeys(subsessions.tolist()):
            members = rows[subsessions == name]
            parts.append(_Subsession(session, name, members, np.zeros(len(members), np.int64)))
    selected = [part for part in parts if subsession in ("all", part.name)]
    if not parts and unreadable:
        raise next(iter(unreadable.values()))
    if not selected:
        known = ", ".join(part.name for part in parts)
        raise ManifestError(f"No images of subsession {subsession!r} in {', '.join(names)}; known: {known}.")
    return selected, {id_: str(error) for id_, error in unreadable.items()}


def _remove_former(out_dir: Path, names: list[str], parts: list[_Subsession]) -> None:
    """Remove embeddings of subsessions that the sessions no longer have; `open_embeddings` would read them."""
    folders = {out_dir / part.session.id / part.name for part in parts}
    for name in names:
        for manifest in sorted((out_dir / name).rglob("manifest.csv")):
            if manifest.parent not in folders:
                log.warning("%s: removed, the session no longer has this subsession", manifest.parent)
                matrix = manifest.parent / f"{manifest.parent.name}.npy"
                for path in (manifest, matrix, sidecar_path(matrix), manifest.parent / "failed.csv"):
                    path.unlink(missing_ok=True)


def _vocabulary(capture: Capture, folders: _Folders, settings: EmbedSettings, skip_existing: bool) -> Path:
    """Learn the VLAD vocabulary from the map images of all devices, unless the file is current."""
    from toolkit.embedders.vlad import VLAD_FORMAT, Vlad

    maps = capture.usable("map")
    if not maps:
        raise ToolkitError(
            f"{capture.path}/sessions has no <device>_map session that can be read; `vlad` learns its vocabulary from "
            "the map."
        )
    images = [(session.id, int(row)) for session in maps for row in session.camera_rows]
    rows_by_session: dict[str, list[int]] = {}
    for index in np.linspace(0, len(images) - 1, min(len(images), VOCABULARY_IMAGES)).astype(int).tolist():
        name, row = images[index]
        rows_by_session.setdefault(name, []).append(row)
    chosen = {name: np.array(rows) for name, rows in rows_by_session.items()}
    record = {
        "features": SiftExtractor().settings,
        "images": {name: _images_fingerprint(capture[name], rows) for name, rows in chosen.items()},
        "seed": settings.seed,
        "format": VLAD_FORMAT,
    }
    path, features_dir = folders.out / "vlad.npz", folders.features
    if skip_existing and (is_current(path, record) or folders.take_over(path, record)):
        return path
    stores = {name: extract_session(capture[name], features_dir, rows=rows) for name, rows in chosen.items()}
    keys = [(name, capture[name].image_name(row)) for name, rows in rows_by_session.items() for row in rows]
    keys = [(name, image) for name, image in keys if image in stores[name]]

    def features() -> Iterator[LocalFeatures]:
        for name, image in tqdm(keys, desc="vocabulary", unit="image"):
            yield stores[name][image]

    vlad = Vlad.learn(features, len(keys), settings.seed)
    vlad.save(path)
    write_sidecar(path, record)
    return path


def _embed(
    embedder: Embedder,
    part: _Subsession,
    batches: Items,
    source: str,
    settings: EmbedSettings,
    store_of: Callable[[str], FeatureStore],
) -> dict[int, str]:
    """Add the vectors of the readable images, in order; return the reason for each unreadable one, by row."""
    store = store_of(part.session.id) if embedder.inputs == "features" else None
    names, label = _names(part, settings), f"embed {part.session.id}/{part.name}"
    todo = batches.left((name, source, number) for number, name in enumerate(names))
    arguments = embedder, part, settings, store, label
    _embed_into(batches, batches.spread(_embed_into, todo, arguments, label, "batch"), *arguments)
    batches.flush()
    return {row: reason for name in names for row, reason in batches.note(name)["failed"]}


def _names(part: _Subsession, settings: EmbedSettings) -> list[str]:
    """Return the names of the batches of a subsession, in order."""
    return [f"{number:08d}" for number in range(-(-len(part.rows) // settings.batch_size))]


def _embed_into(
    batches: Items,
    todo: Sequence[tuple[str, str, int]],
    embedder: Embedder,
    part: _Subsession,
    settings: EmbedSettings,
    store: FeatureStore | None,
    label: str,
) -> None:
    """Embed the batches `todo` (name, source, number); store their vectors and the reasons for unreadable images."""
    size = settings.batch_size
    slices = [slice(number * size, (number + 1) * size) for *_, number in todo]
    left = np.concatenate([np.zeros(0, np.int64), *(np.arange(len(part.rows))[rows] for rows in slices)])
    inputs = _inputs(embedder, replace(part, rows=part.rows[left], turns=part.turns[left]), size, store)

    def stack(items: list[tuple[int, Any | str]]) -> tuple[Any, dict[int, str]]:
        readable = [item for _, item in items if not isinstance(item, str)]
        unreadable = {row: item for row, item in items if isinstance(item, str)}
        return embedder.stack(readable) if readable else readable, unreadable

    # Copy the next batch to the device while one is embedded.
    inputs_of_batches = (list(islice(inputs, len(part.rows[rows]))) for rows in slices)
    stacked = prefetch(stack, inputs_of_batches, workers=1, ahead=0)
    bar = tqdm(total=len(part.rows), initial=len(part.rows) - len(left), desc=label, unit="image")
    # Features are described in a thread a core; a network has its own threads.
    with bar, one_thread() if store is not None else nullcontext():
        for (name, source, _), (batch, unreadable) in zip(todo, stacked, strict=True):
            vectors = embedder.embed(batch)
            if vectors.shape != (len(batch), embedder.dim):
                raise ValueError(f"{embedder.name} gave {vectors.shape}; expected {(len(batch), embedder.dim)}.")
            if settings.normalize:
                vectors = unit(vectors)
            batches.add(name, source, {VECTORS: vectors}, {"failed": list(unreadable.items())})
            bar.update(len(batch) + len(unreadable))


def write_matrix(path: Path, batches: Iterable[NDArray[np.floating]], rows: int, dim: int, dtype: str) -> None:
    """Write the vectors of all batches to a `.npy` file (rows, dim), one batch in memory at a time."""
    with write_atomic(path) as temporary, open(temporary, "wb") as stream:
        header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": (rows, dim)}
        np.lib.format.write_array_header_1_0(stream, header)
        for vectors in batches:
            stream.write(np.ascontiguousarray(vectors, dtype).tobytes())


def _inputs(
    embedder: Embedder, part: _Subsession, batch_size: int, store: FeatureStore | None
) -> Iterator[tuple[int, Any | str]]:
    """Yield the row and the input (features or a prepared image) of each image; a str is why it has none."""
    session = part.session

    def read(item: tuple[int, int]) -> tuple[int, Any | str]:
        row, turns = item
        if store is not None:
            name = session.image_name(row)
            if name not in store:
                return row, store.failed.get(name, "no local features were extracted")
            return row, embedder.prepare(store[name])
        try:
            image = read_image(session.image_path(row), least_side=embedder.least_side)
        except ImageError as error:
            return row, str(error)
        return row, embedder.prepare(turn_image(image, turns))

    items = zip(part.rows.tolist(), part.turns.tolist(), strict=True)
    yield from prefetch(read, items, workers=default_workers(), ahead=2 * batch_size)


def _images_fingerprint(session: Session, rows: NDArray[np.intp]) -> str:
    """Return a fingerprint of images: their keys, and the name, size and time of change of their files."""
    table = session.images.iloc[rows]
    keys = [table[column].tolist() for column in ("timestamp", "sensor_id", "path")]
    files = files_fingerprint([session.image_path(int(row)) for row in rows])
    return fingerprint([keys, session.device_ids[rows].tolist(), files])


def _write_tables(folder: Path, capture: str, part: _Subsession, failed: dict[int, str]) -> list[Path]:
    """Write the manifest of the embedded images, and `failed.csv` if any are unreadable; return the files."""
    session, images = part.session, part.session.images.iloc[part.rows]
    table = pd.DataFrame(
        {
            "device_id": session.device_ids[part.rows],
            "sensor_id": images["sensor_id"].to_numpy(),
            "timestamp": images["timestamp"].to_numpy(),
            "abs_path": [f"{capture}/sessions/{session.image_name(int(row))}" for row in part.rows],
            "reason": [failed.get(int(row), "") for row in part.rows],
        }
    )
    unreadable = folder / "failed.csv"
    if failed:
        log.warning("%s/%s: %d of %d images cannot be read, see %s",
                    session.id, part.name, len(failed), len(table), unreadable)  # fmt: skip
        with write_atomic(unreadable) as temporary:
            table[table["reason"] != ""].to_csv(temporary, index=False)
    else:
        unreadable.unlink(missing_ok=True)
    embedded = table[table["reason"] == ""].drop(columns="reason").reset_index(drop=True)
    with write_atomic(folder / "manifest.csv") as temporary:
        embedded.to_csv(temporary, index_label="row_index")
    return [folder / "manifest.csv", *([unreadable] if failed else [])]
