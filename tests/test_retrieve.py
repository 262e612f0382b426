"""Search and the retrieve stage."""

import json
import re
import shutil
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.test_embed import HL_RIG
from toolkit.capture import Capture
from toolkit.embed import embed_sessions
from toolkit.embedders import StoredVectors, Vectors, masks
from toolkit.embedders import search as search_module
from toolkit.embedders.masks import Masks, near
from toolkit.errors import ArtifactError, CaptureError, ManifestError
from toolkit.files import sidecar_path
from toolkit.geometry import unit
from toolkit.retrieve import load_embeddings, retrieve_pairs, search
from toolkit.synthetic import render_capture

BACKENDS = ["faiss", "torch", "numpy"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_search_is_the_sorted_product(backend: str) -> None:
    rng = np.random.default_rng(0)
    query, database = rng.normal(size=(7, 12)), rng.normal(size=(200, 12))
    scores, indices = search(query, database, 5, backend)
    full = (query.astype(np.float32).astype(float) @ database.astype(np.float32).astype(float).T).astype(np.float32)
    np.testing.assert_array_equal(indices, np.argsort(-full, axis=1, kind="stable")[:, :5])
    np.testing.assert_allclose(scores, -np.sort(-full, axis=1)[:, :5], rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_scores_come_by_index(backend: str) -> None:
    rng = np.random.default_rng(0)
    database = np.repeat(rng.normal(size=(4, 300)), 100, axis=0)[rng.permutation(400)]
    query = np.concatenate([database[:3], np.zeros((1, 300))])
    scores, indices = search(query, database, 6, backend)
    for row in range(3):
        same = np.flatnonzero((database == query[row]).all(axis=1))
        assert indices[row].tolist() == same[:6].tolist()
    assert indices[3].tolist() == list(range(6))
    assert not scores[3].any()


def test_queries_of_zeros_take_no_further_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    passes, once = [], search_module._candidates
    monkeypatch.setattr(search_module, "_candidates", lambda *given: passes.append(given) or once(*given))
    query = np.random.default_rng(0).normal(size=(4, 8))
    query[[0, 2]] = 0
    scores, indices = search(query, np.random.default_rng(1).normal(size=(500, 8)), 3)
    assert indices[[0, 2]].tolist() == [[0, 1, 2]] * 2
    assert (scores == 0).all(axis=1).tolist() == [True, False] * 2
    assert len(passes) == 1


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
@pytest.mark.parametrize("normalize", [True, False])
def test_vectors_on_disk_are_searched_block_by_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dtype: type, normalize: bool
) -> None:
    rng = np.random.default_rng(0)
    sizes, dim = (13, 0, 1, 40), 24
    parts = [(rng.normal(size=(size, dim)) * rng.uniform(0.5, 2)).astype(dtype) for size in sizes]
    parts[3][20:30] = parts[3][5]  # ties across blocks
    for number, part in enumerate(parts):
        np.save(tmp_path / f"{number}.npy", part)
    chosen = np.array([0, 2, 3, 4, 5, 12, 13, *range(15, 54)])
    stack = np.concatenate(parts).astype(np.float32)[chosen]
    starts = (0, *np.cumsum(sizes).tolist())
    files = tuple(tmp_path / f"{n}.npy" for n in range(4))
    stored = Vectors({"": StoredVectors(files, starts, dim, chosen, normalize)})
    np.testing.assert_array_equal(stored[:], unit(stack) if normalize else stack)
    np.testing.assert_array_equal(stored[np.array([1, 8, 40])], stored[:][[1, 8, 40]])
    np.testing.assert_array_equal(stored[np.array([40, 8, 1, 9, 8])], stored[:][[40, 8, 1, 9, 8]])
    np.testing.assert_array_equal(stored[np.array([8, 8, 10])], stored[:][[8, 8, 10]])
    np.testing.assert_array_equal(stored.choose(np.array([40, 1]))[:], stored[:][[40, 1]])
    query = np.concatenate([rng.normal(size=(9, dim)), parts[3][5:6], np.zeros((1, dim))])
    expected = search(query, stored[:], 12)
    monkeypatch.setattr(search_module, "_BLOCK_BYTES", 7 * 4 * dim)
    for backend in BACKENDS:
        scores, indices = search(query, stored, 12, backend)
        np.testing.assert_array_equal(indices, expected[1])
        np.testing.assert_array_equal(scores, expected[0])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_a_memory_mapped_matrix_is_not_loaded_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dtype: type
) -> None:
    rng = np.random.default_rng(0)
    database, query = rng.normal(size=(20_000, 128)).astype(dtype), rng.normal(size=(5, 128))
    np.save(tmp_path / "a.npy", database)
    expected = search(query, database.astype(np.float32), 10)
    monkeypatch.setattr(search_module, "_BLOCK_BYTES", 1 << 18)
    search(query, database[:100], 10)  # imports
    tracemalloc.start()
    found = search(query, np.load(tmp_path / "a.npy", mmap_mode="r"), 10)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    for array, wanted in zip(found, expected, strict=True):
        np.testing.assert_array_equal(array, wanted)
    assert peak < 2 << 20, "the matrix takes 10 MB as float32"


def test_several_sets_of_queries_on_disk_are_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    database, parts = rng.normal(size=(50, 8)), []
    for number, (size, chosen) in enumerate([(5, [0, 3]), (4, []), (9, [0, 1, 2, 7, 8])]):
        np.save(tmp_path / f"{number}.npy", rng.normal(size=(size, 8)))
        rows = np.array(chosen, np.int64)
        parts.append(Vectors({"": StoredVectors((tmp_path / f"{number}.npy",), (0, size), 8, rows, normalize=True)}))
    stacked = Vectors.stack([*parts, parts[0]])
    query = np.concatenate([part[:] for part in (*parts, parts[0])])
    np.testing.assert_array_equal(stacked[:], query)
    expected = search(query, database, 4)
    monkeypatch.setattr(search_module, "_QUERY_BYTES", 3 * 4 * 8)
    for found, wanted in zip(search(stacked, database, 4), expected, strict=True):
        np.testing.assert_array_equal(found, wanted)


def brute_force(query: np.ndarray, database: np.ndarray, k: int, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a search among the allowed rows (Q, N) is to find."""
    full = (query.astype(np.float64) @ database.astype(np.float64).T).astype(np.float32)
    full[~allowed] = -np.inf
    indices = np.argsort(-full, axis=1, kind="stable")[:, :k]
    scores = np.take_along_axis(full, indices, 1)
    return scores, np.where(np.isneginf(scores), -1, indices)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.4])
def test_a_masked_search_is_that_among_the_allowed_rows(
    monkeypatch: pytest.MonkeyPatch, backend: str, share: float
) -> None:
    rng = np.random.default_rng(0)
    # Whole numbers, so that many scores are equal, and rounding makes no difference.
    database = rng.integers(-2, 3, (203, 8)).astype(np.float32)
    query = rng.integers(-2, 3, (37, 8)).astype(np.float32)
    query[[4, 36]] = 0
    distinct, which = rng.random((9, 203)) < share, rng.integers(-1, 9, 37)
    masks = Masks(203, np.packbits(distinct, axis=1, bitorder="little"), which)
    allowed = np.where((which < 0)[:, None], True, distinct[which])
    expected = brute_force(query, database, 5, allowed)
    for block, queries in ((1 << 20, 1 << 20), (4 * 8 * 21, 4 * 8 * 10)):
        monkeypatch.setattr(search_module, "_BLOCK_BYTES", block)
        monkeypatch.setattr(search_module, "_QUERY_BYTES", queries)
        for found, wanted in zip(search(query, database, 5, backend, allowed=masks), expected, strict=True):
            np.testing.assert_array_equal(found, wanted)
    found = search(query, database, 5, backend, allowed=distinct[0])
    wanted = brute_force(query, database, 5, np.tile(distinct[0], (37, 1)))
    np.testing.assert_array_equal(found[1], wanted[1])


def test_search_limits() -> None:
    scores, indices = search(np.ones((2, 3)), np.ones((4, 3), np.float16), 10)
    assert indices.tolist() == [[0, 1, 2, 3]] * 2, "k beyond the database: all of it"
    assert search(np.ones((0, 3)), np.ones((4, 3)), 2)[0].shape == (0, 2)
    two, four, nine = np.ones((2, 3)), np.ones((4, 3)), Masks.of([], np.array([-1]), 9)
    for query, database, k, allowed, named in (
        (np.ones((2, 2)), four, 1, None, r"\b2 .*\b3\b"),
        (two, np.array([[0, 0, 0], [1, 1, 1], [0, np.nan, 1]]), 1, None, r"database.*row 2\b"),
        (two, four, 0, None, r"\bk\b.*\b0\b"),
        (np.ones(3), four, 1, None, "shape"),
        (two, four, 1, nine, "1 masks of 9 rows for 2 queries and 4 rows"),
        (two, four, 1, np.ones(3, bool), r"allowed has shape .*\(4,\)"),
        (two, four, 1, np.ones((2, 4), bool), r"allowed has shape .*\(4,\)"),
    ):
        with pytest.raises(ValueError, match=named):
            search(query, database, k, allowed=allowed)
    assert scores.dtype == np.float32


@pytest.fixture
def tiny(tiny_embedded: Path, tmp_path: Path) -> Path:
    """A copy of the capture, its embeddings beside it."""
    shutil.copytree(tiny_embedded, tmp_path, dirs_exist_ok=True)
    return tmp_path / "TINY"


def lines(path: str | Path) -> list[dict]:
    return [json.loads(line) for line in Path(path).read_text().splitlines()]


def test_all_pairs(tiny: Path, tmp_path: Path) -> None:
    table = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings={"topk": 4})
    assert table[["map_device", "query_device", "query_images", "database"]].to_numpy().tolist() == [
        ["ios", "ios", 3, 6],
        ["ios", "hl", 6, 6],
        ["hl", "ios", 3, 12],
        ["hl", "hl", 6, 12],
    ]
    path = tmp_path / "retrieval" / "TINY_map_hl_query_hl.jsonl"
    assert table["path"].iloc[3] == str(path)
    records = lines(path)
    first = records[0]
    assert list(first) == ["path", "subsession", "device_id", "sensor_id", "timestamp", "Trs", "topk"]
    assert list(first["topk"][0]) == ["rank", "score", "subsession", "timestamp", "sensor_id", "path", "Tws"]
    assert (first["subsession"], first["device_id"], first["timestamp"]) == ("hl_a", HL_RIG, "1000")
    assert first["path"] == "TINY/sessions/hl_query/raw_data/hl_a/images/left/1000.png"
    assert [reference["rank"] for reference in first["topk"]] == [1, 2, 3, 4]
    for row in table["path"]:
        for record in lines(row):
            best = record["topk"][0]
            assert int(best["timestamp"]) // 10 == int(record["timestamp"]) // 10, "the same wall"
            wall, view = divmod(int(best["timestamp"]) - 1000, 10)
            assert best["Tws"][0] == [1.0, 0.0, 0.0, wall * 10 + view]
            assert np.shape(record["Trs"]) == (4, 4)


def test_backends_write_the_same_and_files_are_reused(tiny: Path, tmp_path: Path) -> None:
    retrieve_pairs(tiny / "sessions", tmp_path / "embeddings")
    retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", tmp_path / "torch", {"use_faiss": False})
    for path in (tmp_path / "retrieval").glob("*.jsonl"):
        assert path.read_bytes() == (tmp_path / "torch" / path.name).read_bytes()
    assert retrieve_pairs(tiny / "sessions", tmp_path / "embeddings")["skipped"].all()
    assert not retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings={"topk": 3})["skipped"].any()
    embed_sessions(tiny / "sessions", tmp_path / "embeddings", settings={"dtype": "float16"})
    assert not retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings={"topk": 3})["skipped"].any()


def test_an_index_is_made_once_and_part_of_what_files_are_made_of(tiny: Path, tmp_path: Path) -> None:
    exact = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", tmp_path / "exact", {"topk": 3})
    settings = {"topk": 3, "index": "IVF2,Flat", "index_candidates": 5, "nprobe": 2}
    found = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings=settings)
    for row, expected in zip(found["path"], exact["path"], strict=True):
        assert Path(row).read_bytes() == Path(expected).read_bytes()
    index = tmp_path / "index" / "ios_map.faiss"
    made = index.stat().st_ino
    assert retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings=settings)["skipped"].all()
    again = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings=settings | {"nprobe": 1})
    assert not again["skipped"].any()
    assert index.stat().st_ino == made
    index.unlink()
    retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings=settings | {"nprobe": 1})
    assert index.exists(), "the pairs do not need it, a picture that is localized does"
    made = index.stat().st_ino
    poses = tiny / "sessions" / "ios_map" / "trajectories.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:-1]) + "\n")
    retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings=settings | {"index_candidates": 4})
    assert index.stat().st_ino != made, "of fewer images"


def test_missing_images_and_poses_are_reported(tiny: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("left/1000.png", "right/1000.png", "right/1010.png"):
        (tiny / "sessions" / "hl_query" / "raw_data" / "hl_a" / "images" / name).unlink()
    poses = tiny / "sessions" / "hl_map" / "trajectories.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:-1]) + "\n")
    embed_sessions(tiny / "sessions", tmp_path / "embeddings", device="hl")
    out = tmp_path / "one.jsonl"
    row = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", out, map_device="hl", query_device="hl").iloc[0]
    assert (row["keyframes"], row["keyframes_missing"], row["query_images"], row["images_missing"]) == (3, 1, 3, 3)
    assert (row["database"], row["unposed"]) == (10, 2)
    assert "1 of 3 keyframes have no embedded image" in caplog.text
    assert len(lines(out)) == 3


def test_only_listed_keyframes(tiny: Path, tmp_path: Path) -> None:
    listed = tiny / "sessions" / "ios_query" / "proc" / "keyframes_few.txt"
    listed.write_text("1010, ios_a/cam\n1020, another_device\n")
    options = {"map_device": "ios", "query_device": "ios", "queries": "keyframes_few"}
    row = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", **options).iloc[0]
    assert (row["keyframes"], row["keyframes_missing"], row["query_images"]) == (2, 1, 1)
    assert [record["timestamp"] for record in lines(row["path"])] == ["1010"]
    listed.write_text("1000, ios_a/cam\n1020, another_device\n")
    row = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", **options).iloc[0]
    assert not row["skipped"], "another list is another question"
    assert [record["timestamp"] for record in lines(row["path"])] == ["1000"]


def test_vectors_of_two_vocabularies_are_not_compared(tiny: Path, tmp_path: Path) -> None:
    """One device is embedded again with another seed; the vectors have the same length."""
    embed_sessions(tiny / "sessions", tmp_path / "embeddings", {"seed": 1}, device="ios")
    table = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings").set_index(["map_device", "query_device"])
    for pair in (("ios", "hl"), ("hl", "ios")):
        assert {f"{name}.npy" for name in ("ios_a", "hl_a")} <= {*re.findall(r"\w+\.npy", table["reason"][pair])}, pair
    assert table["reason"]["ios", "ios"] == table["reason"]["hl", "hl"] == ""
    (tmp_path / "embeddings/ios_map").rename(tmp_path / "embeddings/hl_map/ios_map")
    with pytest.raises(ArtifactError, match=r"ios_a\.npy and .*\.npy were made by different"):
        load_embeddings(tmp_path / "embeddings/hl_map")


@pytest.mark.parametrize(("folder", "options", "error", "named"), [
    ("nowhere", {}, ArtifactError, "--only embed"),
    ("embeddings", {"map_device": "spot"}, CaptureError, "'spot'.*ios, hl"),
    ("embeddings", {"queries": "nope"}, CaptureError, "pruned_subsampled"),
    ("embeddings", {"out_jsonl": "one.jsonl"}, ManifestError, r"one\.jsonl"),
    ("embeddings", {"settings": {"topk": 0}}, ManifestError, "topk"),
])  # fmt: skip
def test_refused(
    tiny: Path, tmp_path: Path, folder: str, options: dict[str, Any], error: type[Exception], named: str
) -> None:
    with pytest.raises(error, match=named):
        retrieve_pairs(tiny / "sessions", tmp_path / folder, **options)


def test_embeddings_that_do_not_fit(tiny: Path, tmp_path: Path) -> None:
    folder = tmp_path / "embeddings" / "ios_map" / "ios_a"
    matrix, table = load_embeddings(folder)
    assert table["subsession"].unique().tolist() == ["ios_a"]
    manifest = (folder / "manifest.csv").read_text()
    for wrong, listed, named in (
        (matrix[:, :3], manifest, r"ios_a\.npy is damaged"),
        (matrix[:, :3], manifest, "model"),  # another tool's, from now on
        (np.full_like(matrix, np.nan), manifest, "NaN"),
        (matrix[1:], manifest, r"ios_a\.npy"),
        (matrix, manifest.replace("1000.png", "9.png"), r"cam/9\.png"),
    ):
        np.save(folder / "ios_a.npy", wrong)
        (folder / "manifest.csv").write_text(listed)
        with pytest.raises(ArtifactError, match=named):
            retrieve_pairs(
                tiny / "sessions", tmp_path / "embeddings", map_device="ios", query_device="hl", skip_existing=False
            )
        sidecar_path(folder / "ios_a.npy").unlink(missing_ok=True)


@pytest.mark.parametrize(
    ("file", "content", "left_out", "named"),
    [
        ("hl_query/images.txt", "a line\n", [("hl", "hl"), ("ios", "hl")], r"hl_query/images\.txt, line 1"),
        ("hl_query/proc/keyframes_pruned_subsampled.txt", None, [("hl", "hl"), ("ios", "hl")], "keyframe list"),
        ("hl_map/trajectories.txt", None, [("hl", "hl"), ("hl", "ios")], "hl_map has a pose"),
        ("hl_map/sensors.txt", None, [("hl", "hl"), ("hl", "ios")], r"sensors\.txt"),
    ],
)
def test_an_unusable_session_stops_its_own_pairs_alone(
    tiny: Path, tmp_path: Path, file: str, content: str | None, left_out: list[tuple[str, str]], named: str
) -> None:
    path = tiny / "sessions" / file
    before = path.read_text()
    path.unlink() if content is None else path.write_text(content)
    table = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings")
    lost = table[table["reason"] != ""]
    assert sorted(zip(lost["map_device"], lost["query_device"], strict=True)) == left_out
    assert lost["reason"].str.contains(named).all()
    assert (lost["query_images"] == 0).all()
    done = table[table["reason"] == ""]
    assert len(done) == 2
    assert all(len(lines(path)) == count > 0 for path, count in zip(done["path"], done["query_images"], strict=True))
    path.write_text(before)
    assert (retrieve_pairs(tiny / "sessions", tmp_path / "embeddings")["reason"] == "").all()


def test_a_vector_that_is_not_finite_stops_its_own_pairs_alone(tiny: Path, tmp_path: Path) -> None:
    expected = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", tmp_path / "before")
    folder = tmp_path / "embeddings" / "hl_query" / "hl_a"
    matrix, _ = load_embeddings(folder)
    matrix[1] = np.nan
    np.save(folder / "hl_a.npy", matrix)
    sidecar_path(folder / "hl_a.npy").unlink()  # another tool's, from now on
    table = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings")
    lost = table["query_device"] == "hl"
    assert table["reason"][lost].str.contains(r"query hl_query: query has 1 rows with NaN .* first row 1").all()
    assert (table["query_images"] > 0).tolist() == (table["reason"] == "").tolist() == (~lost).tolist()
    for before, after in zip(expected["path"][~lost], table["path"][~lost], strict=True):
        assert [row["topk"] for row in lines(before)] == [row["topk"] for row in lines(after)]


@pytest.fixture
def short_window(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tiny capture has an image each microsecond or ten."""
    monkeypatch.setattr(masks, "WINDOW_S", 4e-6)


def write_wifi(capture: Path, session: str, walls: dict[int, int]) -> None:
    """Write a scan at each wall, which receives the emitters of a wall, or of another one."""
    device = session.partition("_")[0]
    scans = (f"{1000 + 10 * wall}, {device}_a/wifi, 02:00:0{heard}, 2412000, -50\n" for wall, heard in walls.items())
    (capture / "sessions" / session / "wifi.txt").write_text("".join(scans))


def first_walls(path: str | Path) -> list[int]:
    """The walls of the first references, in order of the queries."""
    return [(int(record["topk"][0]["timestamp"]) - 1000) // 10 for record in lines(path)]


@pytest.mark.usefixtures("short_window")
def test_references_come_from_where_radio_says(tiny: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    asked = {"map_device": "hl", "query_device": "hl"}

    def retrieve(**mask: object) -> pd.Series:
        settings = {"topk": 9, "mask": mask}
        return retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", settings=settings, **asked).iloc[0]

    without = retrieve()
    assert first_walls(without["path"]) == [0, 0, 1, 1, 2, 2]
    before = Path(without["path"]).read_bytes()
    write_wifi(tiny, "hl_map", {0: 0, 1: 1, 2: 2})
    write_wifi(tiny, "hl_query", {0: 2, 1: 1})
    assert retrieve()["skipped"], "radio that is not asked for makes no difference"
    assert "without_radio" not in without
    row = retrieve(radio=True)
    assert not row["skipped"]
    assert first_walls(row["path"]) == [2, 2, 1, 1, 2, 2]
    assert [len(record["topk"]) for record in lines(row["path"])] == [4, 4, 4, 4, 9, 9], "images of one scan are equal"
    assert row["without_radio"] == 2
    assert "radio leaves the whole map to 2 of 6 query images" in caplog.text
    again = retrieve(radio=True)
    assert (again["skipped"], again["without_radio"]) == (True, 2)
    write_wifi(tiny, "hl_map", {0: 2, 1: 1, 2: 0})
    row = retrieve(radio=True)
    assert not row["skipped"], "other signals"
    assert first_walls(row["path"]) == [0, 0, 1, 1, 2, 2]
    row = retrieve()
    assert Path(row["path"]).read_bytes() == before
    for session, bad in (("hl_query", "now, w, a, 1, 1\n"), ("hl_map", "1, x\n")):
        (tiny / "sessions" / session / "wifi.txt").write_text(bad)
        with pytest.raises(CaptureError, match=rf"{session}/wifi\.txt, line 1"):
            retrieve(radio=True)


@pytest.mark.usefixtures("short_window")
def test_masks_of_several_query_sessions_backends_and_an_index_are_joined(tiny: Path, tmp_path: Path) -> None:
    for session in ("ios_map", "ios_query", "hl_query"):
        write_wifi(tiny, session, {0: 0, 1: 1, 2: 2} if session.endswith("map") else {0: 2, 1: 1, 2: 0})
    other = {"use_faiss": False}, {"index": "IVF2,Flat", "index_candidates": 5, "nprobe": 2}
    paths = []
    for number, settings in enumerate(({}, *other)):
        settings = {"topk": 2, "mask": {"radio": True}, **settings}
        out = tmp_path / str(number)
        table = retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", out, settings, map_device="ios")
        paths.append(table["path"])
    for same in zip(*paths, strict=True):
        assert first_walls(same[0]) in ([2, 1, 0], [2, 2, 1, 1, 0, 0])
        assert len({Path(path).read_bytes() for path in same}) == 1


@pytest.mark.usefixtures("short_window")
def test_references_come_from_near_rough_poses_and_fixes(tiny: Path, tmp_path: Path) -> None:
    rough = tmp_path / "rough.txt"
    rough.write_text("1000, ios_a/cam, 1, 0, 0, 0, 20, 0, 0\n1010, ios_a/cam, 1, 0, 0, 0, 900, 0, 0\n")
    for session, east in (("ios_map", (0.0, 0.001, 0.002)), ("ios_query", (0.0, 0.002, 0.002))):
        fixes = (f"{1000 + 10 * wall}, ios_a/gps, 0, {degrees}, 0, 5\n" for wall, degrees in enumerate(east))
        (tiny / "sessions" / session / "gps.txt").write_text("".join(fixes))

    def retrieve(**mask: object) -> pd.Series:
        asked = {"map_device": "ios", "query_device": "ios", "settings": {"topk": 1, "mask": mask}}
        return retrieve_pairs(tiny / "sessions", tmp_path / "embeddings", **asked).iloc[0]

    row = retrieve(poses=str(rough), poses_distance=2)
    assert first_walls(row["path"]) == [2, 1, 2]
    assert row["without_poses"] == 2
    row = retrieve(gps=True)
    assert first_walls(row["path"]) == [0, 2, 2]
    assert row["without_gps"] == 0
    row = retrieve(gps=True, poses=str(rough), poses_distance=2)
    assert first_walls(row["path"]) == [2, 2, 2], "a rough pose outdoes the fix that contradicts it"
    assert (row["without_poses"], row["without_gps"]) == (2, 1)
    rough.write_text(rough.read_text().replace(" 900", " 10"))
    again = retrieve(gps=True, poses=str(rough), poses_distance=2)
    assert (again["skipped"], again["without_poses"]) == (False, 1)
    with pytest.raises(ManifestError, match=r"retrieve\.mask\.poses: found no file .*nowhere\.txt"):
        retrieve(poses=str(tmp_path / "nowhere.txt"))


@pytest.mark.slow
def test_radio_finds_the_right_one_of_two_rooms_that_look_alike(tmp_path: Path) -> None:
    capture = render_capture(tmp_path / "ALIKE", 2, 12, progress=False, alike=True, radio=True)
    embed_sessions(capture / "sessions", tmp_path / "embeddings")
    truth = {
        session.path.name: dict(zip(session.images["path"], session.world_from_cam(ground_truth=True), strict=True))
        for session in (Capture.open(capture)[f"{device}_query"] for device in ("ios", "hl", "spot"))
    }
    for radio in (False, True):
        settings = {"mask": {"radio": radio}}
        table = retrieve_pairs(
            capture / "sessions", tmp_path / "embeddings", settings=settings, queries="keyframes_original"
        )
        right, good = [], []
        for record in (record for path in table["path"] for record in lines(path)):
            name, _, path = record["path"].removeprefix("ALIKE/sessions/").partition("/raw_data/")
            pose, reference = truth[name][path], np.array(record["topk"][0]["Tws"])
            right.append((pose[0, 3] > 13) == (reference[0, 3] > 13))  # the second room is 27 m away along x
            good.append(near(reference[None], pose, 8, 45)[0])
        print(f"{radio=}: {np.mean(right):.1%} of {len(right)} in the right room, {np.mean(good):.1%} good references")
        assert len(right) == 216
        assert np.mean(right) > 0.95 if radio else np.mean(right) < 0.8
        assert np.mean(good) > 0.9 if radio else np.mean(good) < 0.8
