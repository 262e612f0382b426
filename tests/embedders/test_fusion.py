"""Several descriptors: their fused similarities, the exact search by them, and runs with them."""

import json
import shutil
from pathlib import Path
from typing import Any

import faiss
import numpy as np
import pytest

from toolkit.embed import embed_sessions
from toolkit.embedders import EMBEDDERS, MANIFEST_COLUMNS, load_embeddings
from toolkit.embedders import search as search_module
from toolkit.embedders.masks import Masks
from toolkit.embedders.search import VectorIndex, Vectors, fuse, open_descriptors, search
from toolkit.errors import ArtifactError, ManifestError, WeightsError
from toolkit.figures.explore import draw_similarity
from toolkit.geometry import unit
from toolkit.manifest import EmbedSettings
from toolkit.retrieve import retrieve_pairs

DIMS = (6, 9)


class Thumbnail:
    """A small descriptor of somebody's own: the colors of an image in 3 x 4 cells."""

    name, inputs, upright, min_side, dim = "thumbnail", "images", False, None, 36
    settings = {"name": "thumbnail"}  # noqa: RUF012

    def __init__(self, **_: object) -> None:
        pass

    def prepare(self, item: np.ndarray) -> np.ndarray:
        """Return the mean colors of the cells."""
        rows = np.array_split(item.astype(np.float32), 3, axis=0)
        return np.array([cell.mean(axis=(0, 1)) for row in rows for cell in np.array_split(row, 4, axis=1)]).ravel()

    def stack(self, inputs: Any) -> Any:
        """Return them as they are."""
        return inputs

    def embed(self, inputs: Any) -> np.ndarray:
        """Return the colors, less the gray of each image."""
        colors = np.array(inputs, np.float32)
        return colors - colors.mean(axis=1, keepdims=True)


def reference(similarities: np.ndarray) -> np.ndarray:
    """Fuse (n, ...) by the formula as it is written, above the pole."""
    return 1 / np.mean(1 / (0.5 + similarities / len(similarities)), axis=0) - 0.5


def brute(query: np.ndarray, database: np.ndarray, k: int, dims: tuple[int, ...] = DIMS) -> tuple[Any, Any]:
    """Return scores and indices of the fused matrix, sorted, equal ones by index."""
    cuts = np.cumsum(dims)[:-1]
    parts = zip(np.split(query, cuts, axis=1), np.split(database, cuts, axis=1), strict=True)
    products = [np.einsum("qd,nd->qn", q.astype(np.float64), d.astype(np.float64)) for q, d in parts]
    fused = reference(np.array(products)).astype(np.float32)
    order = np.argsort(-fused, axis=1, kind="stable")[:, :k]
    return np.take_along_axis(fused, order, 1), order


def joined(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.hstack([unit(rng.normal(size=(count, dim)).astype(np.float32)) for dim in DIMS])


def test_known_answers() -> None:
    one, none, opposite = np.array([1.0]), np.array([0.0]), np.array([-1.0])
    assert fuse([one, one]) == pytest.approx(1 / 2)
    assert fuse([one, one, one]) == pytest.approx(1 / 3)
    assert fuse([none, none]) == 0
    assert fuse([one, none]) == fuse([none, one]) == pytest.approx(1 / 6)
    assert fuse([opposite, one]) == fuse([one, 3 * opposite]) == -0.5, "at the pole, and beyond it"
    values = np.linspace(-1, 1, 41)
    for other in (-0.9, 0.0, 0.4):
        assert (np.diff(fuse([values, np.full(41, other)])) > 0).all()
    pairs = np.random.default_rng(0).uniform(-0.99, 1, (2, 100))
    np.testing.assert_allclose(fuse(list(pairs)), reference(pairs), rtol=1e-12)


@pytest.mark.parametrize("backend", ["faiss", "torch", "numpy"])
@pytest.mark.parametrize("block_bytes", [1 << 20, 4 * sum(DIMS) * 37])
def test_search_is_the_sorted_fused_matrix(monkeypatch: pytest.MonkeyPatch, backend: Any, block_bytes: int) -> None:
    monkeypatch.setattr(search_module, "_BLOCK_BYTES", block_bytes)
    monkeypatch.setattr(search_module, "_QUERY_BYTES", 4 * sum(DIMS) * 3)
    rng = np.random.default_rng(0)
    database, query = joined(rng, 400), joined(rng, 8)
    database[200:300] = database[rng.integers(0, 5, 100)]  # ties, more than are looked at first
    database[7, : DIMS[0]] = database[9] = 0
    query[2, : DIMS[0]] = query[3, DIMS[0] :] = query[4] = 0
    query[5] = database[0]
    scores, indices = search(query, database, 30, backend, dims=DIMS)
    expected_scores, expected = brute(query, database, 30)
    np.testing.assert_array_equal(indices, expected)
    np.testing.assert_array_equal(scores, expected_scores)
    allowed = rng.random(400) < 0.3
    rows = np.flatnonzero(allowed)
    scores, indices = search(query, database, 30, backend, allowed=allowed, dims=DIMS)
    np.testing.assert_array_equal(indices, rows[brute(query, database[rows], 30)[1]])
    of_each, which = rng.random((3, 400)) < 0.3, np.array([0, 1, 2, 0, 1, -1, 2, 0])
    masks = Masks(400, np.packbits(of_each, axis=1, bitorder="little"), which)
    scores, indices = search(query, database, 30, backend, allowed=masks, dims=DIMS)
    for number, mask in enumerate(which):
        rows = np.arange(400) if mask < 0 else np.flatnonzero(of_each[mask])
        expected_scores, expected = brute(query[number : number + 1], database[rows], 30)
        np.testing.assert_array_equal(indices[number], rows[expected[0]])
        np.testing.assert_array_equal(scores[number], expected_scores[0])
    with pytest.raises(ValueError, match=r"dims.*sum of 15"):
        search(query, database, 3, dims=(6, 8))


@pytest.mark.parametrize("masked", [False, True])
def test_candidates_of_each_index_are_ranked_by_the_fused_similarity(masked: bool) -> None:
    rng = np.random.default_rng(0)
    database, query = joined(rng, 200), joined(rng, 6)
    allowed = rng.random(200) < 0.5 if masked else np.ones(200, bool)
    parts, candidates = [], []
    for part, of_query in zip(np.split(database, [6], axis=1), np.split(query, [6], axis=1), strict=True):
        index = faiss.IndexFlatIP(part.shape[1])
        index.add(np.ascontiguousarray(part))
        parts.append(index)
        products = np.where(allowed, of_query @ part.T, -np.inf)
        candidates.append(np.argsort(-products, axis=1)[:, :4])
    index = VectorIndex(tuple(parts), 4)
    found = search(query, database, 5, index=index, allowed=allowed if masked else None, dims=DIMS)
    for number, rows in enumerate(np.hstack(candidates)):
        rows = np.unique(rows)
        scores, order = brute(query[number : number + 1], database[rows], 5)
        np.testing.assert_array_equal(found[1][number, : len(rows)], rows[order[0]])
        np.testing.assert_array_equal(found[0][number, : len(rows)], scores[0])


def test_vectors_that_are_longer_than_one_are_searched_past_the_pole() -> None:
    rng = np.random.default_rng(0)
    query, database = 3 * joined(rng, 5), 3 * joined(rng, 60)
    scores, indices = search(query, database, 60, dims=DIMS)
    parts = [query[:, cut] @ database[:, cut].T for cut in (slice(0, 6), slice(6, 15))]
    fused = fuse([part.astype(np.float64) for part in parts])
    assert (scores[:, -5:] == -0.5).all()
    np.testing.assert_allclose(scores, -np.sort(-fused, axis=1), atol=1e-5)
    assert all(sorted(row) == list(range(60)) for row in indices.tolist())


def test_descriptors_on_disk_are_those_of_images_that_have_all(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    names = [f"S/sessions/ios_map/raw_data/a/{number}.jpg" for number in range(6)]
    held = {"one": [0, 1, 2, 4, 5], "two": [5, 3, 2, 1, 0]}
    matrices = {}
    for name, images in held.items():
        folder = tmp_path / name / "ios_map" / "a"
        folder.mkdir(parents=True)
        matrices[name] = rng.normal(size=(5, 3 if name == "one" else 4)).astype(np.float16)
        np.save(folder / "a.npy", matrices[name])
        lines = [f"{row},d,c,{image},{names[image]}" for row, image in enumerate(images)]
        (folder / "manifest.csv").write_text("\n".join([",".join(MANIFEST_COLUMNS), *lines]) + "\n")
    (tmp_path / "settings.json").write_text(json.dumps({"model": ["one", "two"]}))
    vectors, table = open_descriptors(tmp_path, "ios_map", normalize=True)
    assert table["abs_path"].tolist() == [names[number] for number in (0, 1, 2, 5)]
    assert (vectors.dims, vectors.shape) == ((3, 4), (4, 7))
    one, two = (matrices[name].astype(np.float32) for name in held)
    expected = np.hstack([unit(one[[0, 1, 2, 4]]), unit(two[[4, 3, 2, 0]])])
    np.testing.assert_array_equal(vectors[:], expected)
    twice = Vectors.stack([vectors, vectors.choose(np.array([2, 0]))])
    np.testing.assert_array_equal(twice[np.array([5, 4, 1])], expected[[0, 2, 1]])
    (tmp_path / "two/ios_map/a/manifest.csv").write_text(
        (tmp_path / "two/ios_map/a/manifest.csv").read_text().replace("/a/", "/b/")
    )
    with pytest.raises(ArtifactError, match=r"no image of ios_map has all of one, two"):
        open_descriptors(tmp_path, "ios_map", normalize=True)


@pytest.fixture
def place(tiny_embedded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the run, where `thumbnail` is an embedder."""
    monkeypatch.setitem(EMBEDDERS, "thumbnail", f"{__name__}:Thumbnail")
    return Path(shutil.copytree(tiny_embedded, tmp_path / "run"))


def inodes(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_ino for path in folder.rglob("*.np[yz]")}


def test_another_model_does_not_embed_the_first_again(place: Path) -> None:
    sessions, out = place / "TINY" / "sessions", place / "embeddings"
    alone = inodes(out)
    table = embed_sessions(sessions, out, {"model": ["thumbnail", "vlad"]})
    assert table.groupby("model")["skipped"].agg(list).to_dict() == {"thumbnail": [False] * 4, "vlad": [True] * 4}
    assert inodes(out / "vlad") == alone
    assert json.loads((out / "settings.json").read_text())["model"] == ["thumbnail", "vlad"]
    matrix, images = load_embeddings(out / "thumbnail" / "hl_map")
    assert (matrix.shape, len(images)) == ((12, 36), 12)
    assert embed_sessions(sessions, out, {"model": ["vlad", "thumbnail"]})["skipped"].all()
    assert embed_sessions(sessions, out, {"model": "vlad"})["skipped"].all()
    assert embed_sessions(sessions, out, {"model": "thumbnail"})["skipped"].all()
    np.testing.assert_array_equal(load_embeddings(out / "hl_map")[0], matrix)
    assert not (out / "vlad" / "ios_map" / "ios_a" / "ios_a.npy").samefile(out / "ios_map" / "ios_a" / "ios_a.npy")


def test_links_are_copies_where_the_disk_has_none(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr("os.link", refuse)
    out = place / "embeddings"
    table = embed_sessions(place / "TINY" / "sessions", out, {"model": ["vlad", "thumbnail"]})
    assert table.loc[table["model"] == "vlad", "skipped"].all()
    one, other = (folder / "hl_map" / "hl_a" / "hl_a.npy" for folder in (out, out / "vlad"))
    assert one.read_bytes() == other.read_bytes()
    assert not one.samefile(other)


@pytest.mark.slow
def test_retrieval_ranks_by_the_fused_similarity(place: Path) -> None:
    sessions, out = place / "TINY" / "sessions", place / "embeddings"
    before = retrieve_pairs(sessions, out, settings={"topk": 5})
    single = Path(before["path"][0]).read_text()
    embed_sessions(sessions, out, {"model": ["vlad", "thumbnail"]})
    table = retrieve_pairs(sessions, out, settings={"topk": 5})
    assert not table["skipped"].any()
    assert (table["reason"] == "").all()
    for row in table.itertuples():
        query, database = (
            {name: load_embeddings(out / name / session) for name in ("vlad", "thumbnail")}
            for session in (f"{row.query_device}_query", f"{row.map_device}_map")
        )
        dims = tuple(vectors.shape[1] for vectors, _ in database.values())
        joint = [np.hstack([unit(vectors) for vectors, _ in of.values()]) for of in (query, database)]
        scores, order = brute(*joint, 5, dims)
        paths = [of["vlad"][1]["abs_path"].tolist() for of in (query, database)]
        for line in map(json.loads, Path(row.path).read_text().splitlines()):
            number = paths[0].index(line["path"])
            assert [best["path"] for best in line["topk"]] == [paths[1][index] for index in order[number]]
            np.testing.assert_allclose([best["score"] for best in line["topk"]], scores[number], atol=1e-7)
    assert retrieve_pairs(sessions, out, settings={"topk": 5})["skipped"].all()
    of_index = {"topk": 5, "index": "IVF2,Flat", "index_candidates": 11, "nprobe": 2}
    exact = [Path(path).read_text() for path in table["path"]]
    found = retrieve_pairs(sessions, out, settings=of_index)
    assert [Path(path).read_text() for path in found["path"]] == exact, "all but one are candidates"
    assert sorted(path.parent.name for path in (place / "index").rglob("hl_map.faiss")) == ["thumbnail", "vlad"]
    assert retrieve_pairs(sessions, out, settings=of_index)["skipped"].all()
    (place / "index/vlad/hl_map.faiss").unlink()
    assert not retrieve_pairs(sessions, out, settings=of_index, map_device="hl")["skipped"].any()
    assert draw_similarity(out).axes[0].images[0].get_array().shape == (6, 6)
    embed_sessions(sessions, out)
    again = retrieve_pairs(sessions, out, settings={"topk": 5})
    assert Path(again["path"][0]).read_text() == single


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ([], r"model: found an empty list, expected a name"),
        (["vlad", "megaloc", "vlad"], r"model: found 'vlad' twice, expected .* different names"),
        (["auto", "vlad"], r"model: found 'auto' in a list, expected"),
        (3, r"model: found 3\. .*string"),
        (["vlad", 3], r"model\.1: found 3\. .*string"),
    ],
)
def test_refused_lists(model: Any, message: str) -> None:
    with pytest.raises(ManifestError, match=message):
        EmbedSettings.of({"model": model})


@pytest.mark.usefixtures("no_hub")
def test_an_unknown_name_or_missing_weights_stop_before_any_work(place: Path) -> None:
    out = place / "others"
    for name, error, named in (("megalok", ManifestError, "'megalok'.*megaloc"), ("megaloc", WeightsError, "MegaLoc")):
        with pytest.raises(error, match=named):
            embed_sessions(place / "TINY" / "sessions", out, {"model": ["vlad", name]})
    assert not out.exists()
    assert EmbedSettings.of({"model": ["vlad"]}).model == "vlad"
