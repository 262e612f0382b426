"""Indexes find the candidates that the exact search finds, made and kept in bounded memory."""

import resource
import shutil
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.embedders import StoredVectors, Vectors
from toolkit.embedders import search as index_module
from toolkit.embedders.masks import Masks
from toolkit.embedders.search import load_index, make_index, search
from toolkit.errors import ArtifactError, ManifestError, ToolkitError
from toolkit.files import sidecar_path
from toolkit.geometry import unit
from toolkit.manifest import RetrieveSettings

DIM = 64
_SLOW = pytest.param("IVF2,PQ16x4", marks=pytest.mark.slow)  # trained for seconds
FACTORIES = ["RaBitQ", "IVF16,Flat", "PCA32,IVF16,RaBitQ", "HNSW16", _SLOW, "PCA32,Flat"]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with vectors in 40 clusters, `0.npy` and `1.npy`."""
    rng = np.random.default_rng(0)
    folder = tmp_path_factory.mktemp("vectors")
    for number, size in enumerate((700, 900)):
        centers = np.random.default_rng(1).normal(size=(40, DIM))
        vectors = centers[rng.integers(40, size=size)] + rng.normal(size=(size, DIM)) * 0.3
        np.save(folder / f"{number}.npy", vectors.astype(np.float16))
    return folder


def stored(place: Path, normalize: bool = True) -> Vectors:
    rows = np.delete(np.arange(1600), [3, 800])
    return Vectors({"": StoredVectors((place / "0.npy", place / "1.npy"), (0, 700, 1600), DIM, rows, normalize)})


def queries(place: Path) -> NDArray[np.float32]:
    noise = np.random.default_rng(2).normal(size=(30, DIM)).astype(np.float32)
    return stored(place)[np.arange(0, 1500, 50)] + 0.01 * noise


@pytest.mark.parametrize("factory", FACTORIES)
@pytest.mark.parametrize("normalize", [True, False])
def test_an_index_finds_what_the_exact_search_finds(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, factory: str, normalize: bool
) -> None:
    monkeypatch.setattr(index_module, "_BLOCK_BYTES", 4 * DIM * 100)
    settings = RetrieveSettings(index=factory, index_candidates=200)
    vectors = stored(place, normalize)
    index = make_index(tmp_path / "embeddings", "ios_map", vectors, settings)
    exact, found = search(queries(place), vectors, 5), search(queries(place), vectors, 5, index=index)
    assert (found[1] == exact[1]).mean() > 0.9
    same = found[1] == exact[1]
    np.testing.assert_array_equal(found[0][same], exact[0][same])
    assert (np.diff(found[0], axis=1) <= 0).all()


@pytest.mark.parametrize("factory", ["Flat", *FACTORIES])
def test_rows_that_are_not_allowed_are_not_found(place: Path, tmp_path: Path, factory: str) -> None:
    vectors = stored(place)
    settings = RetrieveSettings(index=factory, index_candidates=200, nprobe=16)
    index = make_index(tmp_path / "embeddings", "ios_map", vectors, settings)
    assert (index is None) == (factory == "Flat")
    rows_of_all = np.arange(len(vectors))
    for allowed in (rows_of_all % 3 == 1, np.isin(rows_of_all, [7, 1200]), rows_of_all < 0):
        scores, rows = search(queries(place), vectors, 5, index=index, allowed=allowed)
        there = rows >= 0
        assert allowed[rows[there]].all()
        assert (there.sum(axis=1) == min(5, allowed.sum())).all()
        assert np.isneginf(scores[~there]).all()
        expected, _ = search(queries(place), vectors, 5, allowed=allowed)
        assert (scores == expected).mean() > 0.8


@pytest.mark.parametrize("factory", ["IVF16,Flat", "IVF2,PQ16x4"])
def test_each_query_finds_what_it_may(place: Path, tmp_path: Path, factory: str) -> None:
    vectors = stored(place)
    settings = RetrieveSettings(index=factory, index_candidates=200, nprobe=16)
    index = make_index(tmp_path / "embeddings", "ios_map", vectors, settings)
    rng = np.random.default_rng(0)
    # More than candidates, of which the index finds some; fewer, which are compared one by one; none.
    distinct = np.stack([rng.random(len(vectors)) < share for share in (0.5, 0.2, 0.05, 0.001, 0)])
    which = rng.integers(-1, 5, len(queries(place)))
    masks = Masks(len(vectors), np.packbits(distinct, axis=1, bitorder="little"), which)
    found = search(queries(place), vectors, 5, index=index, allowed=masks)
    exact = search(queries(place), vectors, 5, allowed=masks)
    approximate = (which < 0) | (distinct.sum(axis=1)[which] > index.candidates)
    for one, other in zip(found, exact, strict=True):
        np.testing.assert_array_equal(one[~approximate], other[~approximate])
    assert (found[1][approximate] == exact[1][approximate]).mean() > 0.8
    assert ((found[1] >= 0) == (exact[1] >= 0)).all()
    assert all(distinct[mask][row[row >= 0]].all() for mask, row in zip(which, found[1], strict=True) if mask >= 0)


@pytest.mark.parametrize("factory", ["LSH", "PQ16", "SQ8", "IVF16,Flat,RFlat", "RR32,IVF16,Flat", "IVF4096,Flot", ""])
def test_an_index_of_another_kind_is_refused(factory: str) -> None:
    with pytest.raises(ManifestError, match=rf"index: found '{factory}', expected Flat, .* as PCA512,IVF4096,RaBitQ"):
        RetrieveSettings.of({"index": factory})


def test_an_index_is_kept_until_its_vectors_or_settings_change(place: Path, tmp_path: Path) -> None:
    embeddings, vectors = tmp_path / "embeddings", stored(place)
    settings = RetrieveSettings(index="IVF16,Flat", index_candidates=10)
    path = tmp_path / "index" / "ios_map.faiss"

    def refuses(named: str, theirs: Vectors = vectors, wanted: RetrieveSettings = settings) -> None:
        with pytest.raises(ArtifactError, match=rf"ios_map\.faiss.*{named}"):
            load_index(embeddings, "ios_map", theirs, wanted)

    def made(settings: RetrieveSettings = settings, vectors: Vectors = vectors) -> bool:
        before = path.stat().st_ino if path.exists() else None
        index = make_index(embeddings, "ios_map", vectors, settings)
        assert index is not None
        assert index.indexes[0].ntotal == len(vectors)
        return path.stat().st_ino != before

    refuses("Retrieve again")
    assert [made(), made()] == [True, False]
    assert not made(settings.model_copy(update={"nprobe": 3, "index_candidates": 20}))
    assert made(settings.model_copy(update={"index": "IVF8,RaBitQ"}))
    fewer = vectors.choose(np.arange(1, 1598))
    assert made(vectors=fewer)
    others = [(vectors, settings), (stored(place, False).choose(np.arange(1, 1598)), settings)]
    for theirs, wanted in [*others, (fewer, settings.model_copy(update={"index": "RaBitQ"}))]:
        refuses("from other embeddings, poses or settings", theirs, wanted)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    refuses("damaged")
    assert made()
    path.write_bytes(b"no index")
    sidecar_path(path).unlink()
    refuses("cannot be read")


def test_an_index_is_of_its_embeddings(place: Path, tmp_path: Path) -> None:
    shutil.copytree(place, tmp_path / "embeddings")
    vectors, settings = stored(tmp_path / "embeddings"), RetrieveSettings(index="RaBitQ", index_candidates=10)
    make_index(tmp_path / "embeddings", "ios_map", vectors, settings)
    assert load_index(tmp_path / "embeddings", "ios_map", vectors, settings) is not None
    matrix = np.load(vectors.parts[""].paths[1])
    np.save(vectors.parts[""].paths[1], matrix[::-1])
    with pytest.raises(ArtifactError):
        load_index(tmp_path / "embeddings", "ios_map", vectors, settings)


def test_a_small_map_needs_no_index(place: Path, tmp_path: Path) -> None:
    for factory, candidates in (("RaBitQ", 1598), ("IVF1598,Flat", 10), ("PCA32,IVF4096,RaBitQ", 10)):
        settings = RetrieveSettings(index=factory, index_candidates=candidates)
        assert make_index(tmp_path / "embeddings", "ios_map", stored(place), settings) is None
        assert load_index(tmp_path / "embeddings", "ios_map", stored(place), settings) is None
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("factory", ["IVF16,PQ7", "PCA128,Flat"])
def test_an_index_that_cannot_be_made_is_refused_by_name(place: Path, tmp_path: Path, factory: str) -> None:
    settings = RetrieveSettings(index=factory, index_candidates=10)
    with pytest.raises(ManifestError, match=rf"retrieve\.index: '{factory}' .* vectors of 64 dimensions \((?!Error)"):
        make_index(tmp_path / "embeddings", "ios_map", stored(place), settings)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("factory", FACTORIES)
def test_a_vector_that_is_not_finite_is_told(place: Path, tmp_path: Path, factory: str) -> None:
    vectors = np.load(place / "0.npy")
    vectors[5] = np.nan
    np.save(tmp_path / "0.npy", vectors)
    broken = Vectors({"": StoredVectors((tmp_path / "0.npy",), (0, 700), DIM, np.arange(700))})
    with pytest.raises(ValueError, match="database has 1 rows with NaN or infinite values, first row 5"):
        make_index(tmp_path / "embeddings", "ios_map", broken, RetrieveSettings(index=factory, index_candidates=10))


def test_a_faiss_without_gpus_is_told(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lacks(*_: object) -> None:
        raise NameError("name 'GpuResourcesVector' is not defined")  # as faiss-cpu says it

    monkeypatch.setattr(index_module.faiss, "index_cpu_to_all_gpus", lacks)
    settings = RetrieveSettings(index="RaBitQ", index_candidates=10, faiss_gpu=True)
    with pytest.raises(ToolkitError, match=r"faiss_gpu: .* RaBitQ .*Set faiss_gpu: false"):
        make_index(tmp_path / "embeddings", "ios_map", stored(place), settings)


def test_a_full_disk_is_told_and_leaves_nothing(place: Path, tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(ToolkitError, match=r"ios_map\.faiss: .* cannot be written .*File too large"):
            make_index(tmp_path / "embeddings", "ios_map", stored(place), RetrieveSettings(index="RaBitQ"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list((tmp_path / "index").iterdir())


def test_vectors_that_an_index_is_trained_with_are_in_memory_once(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(index_module, "_BLOCK_BYTES", 4 * DIM * 100)
    settings = RetrieveSettings(index="IVF16,RaBitQ", index_candidates=10)
    tracemalloc.start()
    try:
        make_index(tmp_path / "embeddings", "ios_map", stored(place), settings)
        assert tracemalloc.get_traced_memory()[1] < 1.7 * 4 * DIM * len(stored(place))
    finally:
        tracemalloc.stop()


def test_there_are_as_many_candidates_as_references(place: Path, tmp_path: Path) -> None:
    settings = RetrieveSettings(index="RaBitQ", index_candidates=3, topk=5)
    index = make_index(tmp_path / "embeddings", "ios_map", stored(place), settings)
    assert (search(queries(place), stored(place), 5, index=index)[1] >= 0).all()


@pytest.mark.slow
def test_an_index_that_is_not_asked_for_loads_no_torch() -> None:
    code = "import sys, toolkit.retrieve, toolkit.scene.map; sys.exit('torch' in sys.modules)"
    root = Path(index_module.__file__).parents[2]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


@pytest.mark.parametrize("dims", [(9,), (4, 300)], ids=["one descriptor", "two"])
def test_a_single_image_finds_what_the_search_of_many_finds(tmp_path: Path, dims: tuple[int, ...]) -> None:
    rng, count = np.random.default_rng(0), 40
    parts = {}
    for number, dim in enumerate(dims):
        vectors = unit(rng.normal(size=(count, dim)).astype(np.float32))
        vectors[7] = vectors[3]  # a tie
        np.save(tmp_path / f"{number}.npy", vectors)
        parts[str(number)] = StoredVectors((tmp_path / f"{number}.npy",), (0, count), dim, np.arange(count))
    stored = Vectors(parts)
    asked = np.vstack([rng.normal(size=(6, sum(dims))), np.zeros((1, sum(dims)))]).astype(np.float32)
    for query in [*asked, stored[:][3]]:
        for mask in (None, np.arange(count) % 3 == 0, np.zeros(count, bool)):
            for k in (1, 11, 100):
                expected = search(query[None], stored, k, allowed=mask, dims=dims)
                masks = None if mask is None else Masks(count, np.packbits(mask[None], 1, "little"), np.zeros(1, int))
                for allowed, vectors in ((mask, stored), (masks, stored[:])):
                    found = search(query[None], vectors, k, "numpy", allowed=allowed, dims=dims)
                    for one, other in zip(found, expected, strict=True):
                        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="NaN"):
        search(np.full((1, sum(dims)), np.nan, np.float32), stored, 1, "numpy", dims=dims)
    allowed, broken = np.arange(count) < 5, stored[:].copy()
    broken[5:] = np.nan  # rows that a mask excludes are not read
    masks = Masks.of([allowed[None]], np.zeros(1, np.int64), count)
    np.testing.assert_array_equal(
        search(asked[:1], broken, 3, "numpy", allowed=masks, dims=dims)[1],
        search(asked[:1], stored, 3, allowed=allowed, dims=dims)[1],
    )
