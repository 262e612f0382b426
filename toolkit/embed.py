"""The embed stage: global descriptors of all images of a capture, one matrix and one table per subsession."""

import logging
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session
from toolkit.capture.images import default_workers, prefetch, read_image
from toolkit.capture.upright import upright_turns
from toolkit.embedders import WEIGHTS, resolve_model
from toolkit.embedders.embedded import Describer
from toolkit.errors import CaptureError, ImageError, ManifestError, ToolkitError
from toolkit.features.features import LocalFeatures, SiftExtractor
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import (
    files_fingerprint,
    fingerprint,
    is_current,
    link_or_copy,
    read_json,
    read_sidecar,
    sidecar_path,
    write_atomic,
    write_csv,
    write_sidecar,
    write_text,
)
from toolkit.geometry import Ints
from toolkit.manifest import EmbedSettings
from toolkit.models.weights import resolve_weights
from toolkit.store.items import Items, items_beside, remove_items, retry_damaged
from toolkit.threads import one_thread

log = logging.getLogger(__name__)

VECTORS = "vectors"
"""Name of a batch's array in the file of progress."""
VOCABULARY_IMAGES = 2048
"""Map images from which the vocabulary is learned, at most, spread evenly: bounds time and memory."""
GROWTH = 2.0
"""Factor by which the map images may become more before the vocabulary is learned from all of them."""


@retry_damaged
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
        model_settings = settings.model_copy(update={"model": name})
        stage = _Model(capture, model_settings, devices, own, other, features_dir, skip_existing)
        tables.append(stage.embed(subsession))
    write_text(out_dir / "settings.json", settings.model_dump_json(indent=1) + "\n")
    return pd.concat(tables, ignore_index=True) if several else tables[0]


@dataclass(frozen=True)
class _Subsession:
    """A subsession to embed."""

    session: Session
    name: str
    rows: NDArray[np.intp]
    """(N,) rows of `session.images`."""
    turns: Ints
    """(N,) counter-clockwise quarter turns that make each image upright; 0 if the embedder takes them as stored."""


@dataclass(frozen=True)
class _Model:
    """The embeddings of a capture by one model."""

    capture: Capture
    settings: EmbedSettings
    devices: list[str]
    out: Path
    other: Path
    """Folder where a run with another number of models puts the same embeddings."""
    features: Path
    skip_existing: bool

    def embed(self, subsession: str) -> pd.DataFrame:
        """Write the embeddings, and return a row per subsession; see `embed_sessions`."""
        capture, settings, out = self.capture, self.settings, self.out
        ids = [f"{key}_{split}" for key in self.devices for split in ("map", "query")]
        ids = [id_ for id_ in ids if id_ in capture]
        parts, unreadable = self._subsessions(ids, subsession)
        (model,) = settings.models
        if model == "vlad":
            self._learn_vocabulary()
        describer = Describer.open(model, settings, out)
        embedder = describer.embedder
        if describer.upright:
            turns = upright_turns(capture, settings.world_up)
            parts = [replace(part, turns=turns.of(part.session, part.rows)) for part in parts]
        if subsession == "all":
            _remove_former(out, [id_ for id_ in ids if id_ not in unreadable], parts)

        @cache
        def store_of(session_id: str) -> FeatureStore:
            """Return the features of all subsessions of a session, so that its file is written once."""
            rows = [part.rows for part in parts if part.session.id == session_id]
            return extract_session(capture[session_id], self.features, rows=np.concatenate(rows))

        table = []
        for part in parts:
            started = time.perf_counter()
            folder = out / part.session.id / part.name
            matrix_path = folder / f"{folder.name}.npy"
            record = {
                "embedder": embedder.settings,
                "features": SiftExtractor().settings if embedder.inputs == "features" else None,
                "normalize": settings.normalize,
                "dtype": settings.dtype,
                **_first_images(part),
            }
            skipped = self._is_current(matrix_path, record)
            if skipped:
                embedded = len(np.load(matrix_path, mmap_mode="r"))
            else:
                kept, failed = self._kept(matrix_path, part, record)
                done = len(kept) + len(failed)
                new = replace(part, rows=part.rows[done:], turns=part.turns[done:])
                # Progress is kept per batch, so it depends on the batch size; the matrix does not, up to rounding.
                source = fingerprint({**record, "rows_a_batch": settings.batch_size, "kept": done})
                todo = [(f"{at:08d}", source, at) for at in range(-(-len(new.rows) // settings.batch_size))]
                store = store_of(part.session.id) if embedder.inputs == "features" else None
                arguments = describer, new, store
                with Items(items_beside(matrix_path), skip_existing=self.skip_existing) as batches:
                    left = batches.distribute(_embed_into, batches.left(todo), arguments, _label(part), "batch")
                    _embed_into(batches, left, *arguments)
                    batches.flush()
                    failed |= {done + at: why for name, *_ in todo for at, why in batches.note(name)["failed"]}
                    embedded = len(part.rows) - len(failed)
                    tables = _write_tables(folder, capture.name, part, failed)
                    starts = range(0, len(kept), settings.batch_size)
                    before = (kept[start : start + settings.batch_size] for start in starts)
                    vectors = chain(before, (batches[name][VECTORS] for name, *_ in todo))
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
        table += [{**empty_row, "session": id_, "reason": str(error)} for id_, error in unreadable.items()]
        return pd.DataFrame(table)

    def _is_current(self, path: Path, record: dict[str, Any]) -> bool:
        """Tell whether to reuse an artifact, which is linked from the other folder if it is current only there."""
        if not self.skip_existing:
            return False
        source = self.other / path.relative_to(self.out)
        if not is_current(path, record) and is_current(source, record):
            (path.parent / "failed.csv").unlink(missing_ok=True)
            for name in [*read_json(sidecar_path(source))["files"], sidecar_path(source).name]:
                with write_atomic(path.with_name(name)) as temporary:
                    temporary.unlink()
                    link_or_copy(source.with_name(name), temporary)
        return is_current(path, record)

    def _kept(self, path: Path, part: _Subsession, record: dict[str, Any]) -> tuple[NDArray[Any], dict[int, str]]:
        """Return the vectors of the images that a subsession had before others were added, and why some have none."""
        old = (self.skip_existing and read_sidecar(path)) or {}
        count = old.get("count", 0)
        if not 0 < count < len(part.rows) or fingerprint(old) != fingerprint(record | _first_images(part, count)):
            return np.zeros((0, 0)), {}
        why, table = dict[str, str](), path.parent / "failed.csv"
        if table.is_file():
            why = pd.read_csv(table, index_col="abs_path", keep_default_na=False)["reason"].to_dict()
        names = enumerate(_abs_path(self.capture.name, part.session, row) for row in part.rows[:count])
        return np.load(path, mmap_mode="r"), {at: why[name] for at, name in names if name in why}

    def _subsessions(self, ids: list[str], subsession: str) -> tuple[list[_Subsession], dict[str, CaptureError]]:
        """Return the subsessions to embed, without turns, and the error of each unreadable session."""
        parts, unreadable = list[_Subsession](), dict[str, CaptureError]()
        for id_ in ids:
            try:
                session = self.capture[id_]
                rows = session.camera_rows
            except CaptureError as error:
                log.warning("%s is left out: %s", id_, error)
                unreadable[id_] = error
                continue
            # Images outside all listed subsessions are embedded too, under the session's name.
            names = np.where((names := session.subsession_of(rows)) == "", session.id, names)
            for name in dict.fromkeys(names.tolist()):
                members = rows[names == name]
                parts.append(_Subsession(session, name, members, np.zeros(len(members), np.int64)))
        selected = [part for part in parts if subsession in ("all", part.name)]
        if not parts and unreadable:
            raise next(iter(unreadable.values()))
        if not selected:
            known = ", ".join(part.name for part in parts)
            raise ManifestError(f"No images of subsession {subsession!r} in {', '.join(ids)}; known: {known}.")
        return selected, unreadable

    def _learn_vocabulary(self) -> None:
        """Learn the VLAD vocabulary from the map images of all devices, unless the file is current.

        It stays while the map grows, up to `GROWTH`, so that what was embedded with it stays, too.
        """
        from toolkit.embedders.vlad import MAX_DIM, VLAD_FORMAT, Vlad

        capture, path = self.capture, self.out / "vlad.npz"
        maps = {
            session.id: _Subsession(session, session.id, session.camera_rows, 0 * session.camera_rows)
            for session in capture.usable("map")
        }
        images = [(part.session, int(row)) for part in maps.values() for row in part.rows]
        if not images:
            fault = "has no <device>_map session that can be read; `vlad` learns its vocabulary from the map"
            raise ToolkitError(f"{capture.path}/sessions {fault}.")

        def record_of(counts: Mapping[str, int]) -> dict[str, Any]:
            """Return the record of a vocabulary from the first images of each map."""
            of_maps = {name: _first_images(maps[name], count) for name, count in counts.items()}
            settings = {"features": SiftExtractor().settings, "seed": self.settings.seed, "format": VLAD_FORMAT}
            return settings | {"maps": of_maps}

        record = record_of({name: len(part.rows) for name, part in maps.items()})
        if self._is_current(path, record):
            return
        old = ((self.skip_existing and read_sidecar(path)) or {}).get("maps", {})
        counts = {name: one["count"] for name, one in old.items()}
        grown = counts.keys() == maps.keys() and all(
            GROWTH * counts[name] >= len(part.rows) for name, part in maps.items()
        )
        enough = grown and sum(counts.values()) >= MAX_DIM  # else the dimension is the number of images
        if enough and self._is_current(path, record_of(counts)):
            return
        chosen: dict[str, list[int]] = {}
        for index in np.linspace(0, len(images) - 1, min(len(images), VOCABULARY_IMAGES)).astype(int).tolist():
            session, row = images[index]
            chosen.setdefault(session.id, []).append(row)
        stores = {
            name: extract_session(capture[name], self.features, rows=np.array(rows)) for name, rows in chosen.items()
        }
        keys = [(name, capture[name].image_name(row)) for name, rows in chosen.items() for row in rows]
        keys = [(name, image) for name, image in keys if image in stores[name]]

        def features() -> Iterator[LocalFeatures]:
            for name, image in tqdm(keys, desc="vocabulary", unit="image"):
                yield stores[name][image]

        vlad = Vlad.learn(features, len(keys), self.settings.seed)
        vlad.save(path)
        write_sidecar(path, record)


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


def _label(part: _Subsession) -> str:
    return f"embed {part.session.id}/{part.name}"


def _embed_into(
    batches: Items,
    todo: Sequence[tuple[str, str, int]],
    describer: Describer,
    part: _Subsession,
    store: FeatureStore | None,
) -> None:
    """Embed the batches `todo` (name, source, number); store their vectors and the reasons for unreadable images."""
    size, session, embedder = describer.settings.batch_size, part.session, describer.embedder
    rows = [np.arange(len(part.rows))[number * size : (number + 1) * size] for *_, number in todo]
    left = np.concatenate([np.zeros(0, np.int64), *rows])

    def read(at: int) -> tuple[int, Any | str]:
        """Return the number and the input (features or a prepared image) of an image; a str is why it has none."""
        row = int(part.rows[at])
        if store is not None:
            name = session.image_name(row)
            if name not in store:
                return at, store.failed.get(name, "no local features were extracted")
            return at, embedder.prepare(store[name])
        try:
            image = read_image(session.image_path(row), min_side=embedder.min_side)
        except ImageError as error:
            return at, str(error)
        return at, describer.prepare(image, int(part.turns[at]))

    def stack(items: list[tuple[int, Any | str]]) -> tuple[Any, dict[int, str]]:
        readable = [item for _, item in items if not isinstance(item, str)]
        unreadable = {at: item for at, item in items if isinstance(item, str)}
        return embedder.stack(readable) if readable else readable, unreadable

    inputs = iter(prefetch(read, left.tolist(), workers=default_workers(), ahead=2 * size))
    # Copy the next batch to the device while one is embedded.
    stacked = prefetch(stack, (list(islice(inputs, len(each))) for each in rows), workers=1, ahead=0)
    bar = tqdm(total=len(part.rows), initial=len(part.rows) - len(left), desc=_label(part), unit="image")
    # Features are described in a thread a core; a network has its own threads.
    with bar, one_thread() if store is not None else nullcontext():
        for (name, source, _), (batch, unreadable) in zip(todo, stacked, strict=True):
            vectors = describer.describe(batch)
            batches.add(name, source, {VECTORS: vectors}, {"failed": list(unreadable.items())})
            bar.update(len(batch) + len(unreadable))


def write_matrix(path: Path, batches: Iterable[NDArray[np.floating]], rows: int, dim: int, dtype: str) -> None:
    """Write the vectors of all batches to a `.npy` file (rows, dim), one batch in memory at a time."""
    with write_atomic(path) as temporary, open(temporary, "wb") as stream:
        header = {"descr": np.dtype(dtype).str, "fortran_order": False, "shape": (rows, dim)}
        np.lib.format.write_array_header_1_0(stream, header)
        for vectors in batches:
            stream.write(np.ascontiguousarray(vectors, dtype).tobytes())


def _first_images(part: _Subsession, count: int | None = None) -> dict[str, Any]:
    """Return the number of the first images of a subsession, and a fingerprint of their keys, cameras and turns, and of
    the names, sizes and times of change of their files.
    """
    session, rows = part.session, part.rows[:count]
    table, params = session.images.iloc[rows], session.sensors.drop_duplicates("sensor_id").set_index("sensor_id")
    columns = [table[column].tolist() for column in ("timestamp", "sensor_id", "path")]
    columns += [params["params"].reindex(table["sensor_id"]).tolist(), session.device_ids[rows].tolist()]
    files = files_fingerprint([*map(session.image_path, rows.tolist()), *session.mask_paths(rows.tolist())])
    return {"count": len(rows), "images": fingerprint([columns, part.turns[:count].tolist(), files])}


def _abs_path(capture: str, session: Session, row: int) -> str:
    return f"{capture}/sessions/{session.image_name(int(row))}"


def _write_tables(folder: Path, capture: str, part: _Subsession, failed: dict[int, str]) -> list[Path]:
    """Write the manifest of the embedded images, and `failed.csv` if any are unreadable; return the files."""
    session, images = part.session, part.session.images.iloc[part.rows]
    table = pd.DataFrame(
        {
            "device_id": session.device_ids[part.rows],
            "sensor_id": images["sensor_id"].to_numpy(),
            "timestamp": images["timestamp"].to_numpy(),
            "abs_path": [_abs_path(capture, session, row) for row in part.rows],
            "reason": [failed.get(at, "") for at in range(len(part.rows))],
        }
    )
    unreadable = folder / "failed.csv"
    if failed:
        log.warning("%s/%s: %d of %d images cannot be read, see %s",
                    session.id, part.name, len(failed), len(table), unreadable)  # fmt: skip
        write_csv(unreadable, table[table["reason"] != ""])
    else:
        unreadable.unlink(missing_ok=True)
    embedded = table[table["reason"] == ""].drop(columns="reason").reset_index(drop=True)
    write_csv(folder / "manifest.csv", embedded, index=True, index_label="row_index")
    return [folder / "manifest.csv", *([unreadable] if failed else [])]
