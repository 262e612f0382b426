"""Damaged artifacts: whatever happens to a file of a run, its stage makes it again as it was, and says so."""

import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest

from tests.rendered import copy_shared
from toolkit.embed import embed_sessions
from toolkit.files import SceneFiles
from toolkit.localize import localize_pairs
from toolkit.rerank import rerank_pairs
from toolkit.retrieve import retrieve_pairs
from toolkit.store.items import Items

PAIR = {"map_device": "ios", "query_device": "ios"}
QUERIES = "keyframes_original"


def embed(capture: Path, files: SceneFiles) -> pd.DataFrame:
    settings = {"model": "vlad"}
    return embed_sessions(
        capture / "sessions", files.embeddings, settings, device="ios", features_dir=files.features
    )  # fmt: skip


def retrieve(capture: Path, files: SceneFiles) -> pd.DataFrame:
    return retrieve_pairs(capture / "sessions", files.embeddings, files.retrieval_dir, queries=QUERIES, **PAIR)


def rerank(capture: Path, files: SceneFiles) -> pd.DataFrame:
    folders = files.retrieval_dir, files.features, files.reranked_dir
    return rerank_pairs(capture / "sessions", *folders, workers=1, **PAIR)


def localize(capture: Path, files: SceneFiles) -> pd.DataFrame:
    folders = files.retrieval_dir, files.poses_dir, files.features, files.maps
    return localize_pairs(capture / "sessions", *folders, queries=QUERIES, workers=1, **PAIR)


@pytest.fixture(scope="module")
def capture(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The phone's part of the capture, without its other sessions."""
    ignored = shutil.ignore_patterns("hl_*", "spot_*")
    return Path(shutil.copytree(small_capture, tmp_path_factory.mktemp("data") / "SMALL", ignore=ignored))


@pytest.fixture(scope="module")
def finished(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """A run of the phone's pair; do not write to it."""
    files = SceneFiles(tmp_path_factory.mktemp("whole"), capture.name)
    for stage in (embed, retrieve, rerank, localize):
        stage(capture, files)
    return files


def exactly(array: Any) -> object:
    """Return what an array holds, to compare."""
    array = np.asarray(array)
    return array.tolist() if array.dtype.hasobject else (array.dtype.str, array.shape, array.tobytes())


def content(folder: Path) -> dict[str, Any]:
    """Return what a run holds but for times, by file; records and settings left out."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".shard":
            found[Path(name).parent.as_posix()] = {
                item: {key: exactly(array) for key, array in arrays.items()}
                for item, arrays in sorted(Items(path.parent).items())
            }
        elif path.suffix == ".h5":
            items: dict[str, Any] = {}
            with h5py.File(path) as file:
                file.visititems(lambda key, item, items=items: items.update(
                    {key: exactly(item[()])} if isinstance(item, h5py.Dataset) else {}))  # fmt: skip
            found[name] = items
        elif path.suffix == ".csv" and "poses" in name:
            found[name] = pd.read_csv(path).drop(columns="seconds").to_csv()
        elif path.is_file() and not name.endswith((".meta.json", "settings.json")):
            found[name] = path.read_bytes()
    return found


@pytest.fixture(scope="module")
def whole(finished: SceneFiles) -> dict[str, Any]:
    return content(finished.root)


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def first_number(path: Path) -> int:
    """Return where the first array of numbers of an HDF5 file begins."""

    def start(_: str, item: h5py.Group | h5py.Dataset) -> int | None:
        numbers = isinstance(item, h5py.Dataset) and item.size and item.dtype.kind == "f"
        return item.id.get_offset() if numbers else None

    with h5py.File(path) as file:
        return int(file.visititems(start))


DAMAGES: dict[str, Callable[[bytes], bytes | None]] = {
    "one byte differs": flipped,
    "half": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "other content": lambda data: b"{}\n" * 100,
    "gone": lambda data: None,
}


def damage(path: Path, how: str) -> None:
    """Damage a file; its time of change stays."""
    stat, data = path.stat(), path.read_bytes()
    damaged = DAMAGES[how](data)
    if path.suffix == ".h5" and how == "one byte differs":  # of numbers, as other bytes may mean nothing
        start = first_number(path)
        damaged = data[:start] + flipped(data[start : start + 1]) + data[start + 1 :]
    if path.suffix == ".shard" and how == "one byte differs":  # of the first item, which every stage reads
        start = len(data) // 20
        damaged = data[:start] + flipped(data[start : start + 1]) + data[start + 1 :]
    if damaged is None:
        path.unlink()
        return
    path.write_bytes(damaged)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


ARTIFACTS: dict[str, tuple[Callable[[Path, SceneFiles], pd.DataFrame], str, tuple[str, ...]]] = {
    "vectors": (embed, "embeddings/ios_map/*/*.npy", ()),
    "manifest of vectors": (embed, "embeddings/ios_map/*/manifest.csv", ()),
    "record of vectors": (embed, "embeddings/ios_map/*/*.npy.meta.json", ()),
    "vocabulary": (embed, "embeddings/vlad.npz", ()),
    "features for embed": (embed, "features/ios_map/sift-*/*", ("embeddings/ios_map/*/*.npy",)),
    "references": (retrieve, "retrieval/*.jsonl", ()),
    "record of references": (retrieve, "retrieval/*.jsonl.meta.json", ()),
    "reranked references": (rerank, "reranked/*.jsonl", ()),
    "poses": (localize, "poses/*.txt", ()),
    "table of queries": (localize, "poses/*.csv", ()),
    "correspondences": (localize, "poses/*.h5", ()),
    "what is known of a map": (localize, "poses/*_map_ios.json", ()),
    "record of poses": (localize, "poses/*.txt.meta.json", ()),
    "results of queries": (localize, "poses/*.items/*", ("poses/*.txt",)),
    "map": (localize, "map/ios_map.npz", ()),
    "matches of the map": (localize, "map/*/*/*.shard", ("map/ios_map.npz",)),
    "features of the map": (localize, "features/ios_map/sift-*/*", ("map/ios_map.npz", "map/ios_map-*/*/*.shard")),
    "features of queries": (localize, "features/ios_query/sift-*/*", ("poses/*.items/*", "poses/*.txt")),
}
"""The stage that makes an artifact, its files, and what has to be gone so that the stage looks at it again."""


THOROUGH = ("vectors", "poses")  # with all kinds of damage
LONG = ("features of the map",)  # the whole map is made again


def cases() -> Iterator[Any]:
    for artifact in ARTIFACTS:
        for how in DAMAGES if artifact in THOROUGH else ("one byte differs", "half", "gone"):
            quick = artifact in THOROUGH or (how == "one byte differs" and artifact not in LONG)
            yield pytest.param(artifact, how, marks=() if quick else pytest.mark.slow)


@pytest.mark.parametrize(("artifact", "how"), list(cases()))
def test_a_damaged_artifact_is_made_again_as_it_was(
    capture: Path,
    finished: SceneFiles,
    whole: dict[str, Any],
    tmp_path: Path,
    artifact: str,
    how: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    stage, files, gone = ARTIFACTS[artifact]
    run = SceneFiles(tmp_path, finished.scene)
    copy_shared(finished.root, run.root)
    path = sorted(run.root.glob(files))[0]
    damage(path, how)
    for name in gone:
        next(run.root.glob(name)).unlink()
    with caplog.at_level(logging.WARNING):
        stage(capture, run)
    assert content(run.root) == whole
    if how != "gone":
        assert str(path) in caplog.text
    caplog.clear()
    stage(capture, run)
    assert path.name not in caplog.text, "it is whole again"
