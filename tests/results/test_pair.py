"""Results of queries: what is written is read."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest

from tests.localized import read_queries, some_correspondences, stored, write_queries
from toolkit.capture import Trajectory
from toolkit.errors import ArtifactError
from toolkit.geometry import make_pose
from toolkit.pose.base import QueryResult, Rival, Status
from toolkit.results.pair import PairResults
from toolkit.store.hdf5 import CHECKSUM

NAMES = ["ios_map/raw_data/1.jpg", "ios_map/raw_data/morning walk/2.jpg"]
QUERIES = {
    (5, "phone"): stored(
        ["ios_query/raw_data/5.jpg"],
        NAMES,
        ["ios_map/raw_data/ä.jpg"],
        some_correspondences([0] * 6, [True, False] * 3),
        (Rival(make_pose(np.eye(3), [1.0, 2.0, 3.0]), 0.8), Rival(np.eye(4), 0.25)),
    ),
    (17, "robot/body"): stored(
        ["spot_query/raw_data/front/17.jpg", "spot_query/raw_data/back/17.jpg"],
        NAMES,
        [],
        some_correspondences([0, 1, 1, 0], [True, True, False, True], point_index=-1),
    ),
    (17, "phone"): stored(["ios_query/raw_data/17.jpg"]),
    (18, "phone"): stored(),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "poses" / "pair.h5"
    write_queries(path, QUERIES, ["ios_map.npz"])
    return path


@pytest.mark.parametrize("key", QUERIES)
def test_what_is_written_is_read(path: Path, key: tuple[int, str]) -> None:
    read, written = read_queries(path)(*key), QUERIES[key]
    assert (read.images, read.references, read.rejected) == (written.images, written.references, written.rejected)
    assert [rival.support for rival in read.rivals] == [rival.support for rival in written.rivals]
    for one, other in zip(read.rivals, written.rivals, strict=True):
        np.testing.assert_array_equal(one.world_from_rig, other.world_from_rig)
    assert len(read.correspondences) == len(written.correspondences)
    for name, array in vars(written.correspondences).items():
        again = getattr(read.correspondences, name)
        assert again.dtype.kind == array.dtype.kind, name
        assert again.dtype.itemsize == array.dtype.itemsize or array.dtype.kind == "U", name
        np.testing.assert_allclose(again, array, atol=1e-4) if array.dtype.kind == "f" else (
            np.testing.assert_array_equal(again, array)
        )


@pytest.mark.parametrize("key", [(6, "phone"), (5, "robot"), (5, "phone/images")])
def test_a_query_that_the_file_lacks_has_no_correspondences(path: Path, key: tuple[int, str]) -> None:
    read = read_queries(path)(*key)
    assert (read.status, len(read.correspondences), read.images) == (Status.FAILED, 0, ())


def test_maps_are_named(path: Path) -> None:
    assert PairResults(path, pd.DataFrame()).maps == ["ios_map.npz"]


def test_a_missing_torn_or_incomplete_file_says_what_to_do(path: Path, tmp_path: Path) -> None:
    (tmp_path / "torn.h5").write_bytes(path.read_bytes()[:2000])
    with h5py.File(path, "a") as file:
        del file["5/phone/references"]
    for given, named in (
        (tmp_path / "none.h5", r"none\.h5.*Localize again"),
        (tmp_path / "torn.h5", r"torn\.h5.*Localize again"),
        (path, r"pair\.h5 is damaged at 5/phone.*run its stage again"),
    ):
        with pytest.raises(ArtifactError, match=named):
            read_queries(given)(5, "phone")


@pytest.mark.parametrize("pixels", [None, np.zeros((3, 3), np.float32), np.zeros(2, np.float32)])
def test_a_file_of_another_tool_that_is_not_as_a_run_writes_it_says_what_to_do(
    path: Path, pixels: np.ndarray | None
) -> None:
    with h5py.File(path, "a") as file:
        group = file["17/robot%2Fbody"]
        del group.attrs[CHECKSUM], group["pixels"]
        if pixels is not None:
            group["pixels"] = pixels
    with pytest.raises(ArtifactError, match=r"pair\.h5: 17/robot%2Fbody .*Localize again"):
        read_queries(path)(17, "robot/body")


@pytest.mark.parametrize("posed", [True, False])
def test_a_result_comes_back_from_its_row_and_arrays(posed: bool) -> None:
    pose, covariance = make_pose(np.eye(3), [1.0, 2.0, 3.0]), np.diag([1e-4] * 3 + [0.01] * 3)
    first = replace(QUERIES[5, "phone"], num_inliers=12, num_matches=30, p_correct=0.97, rmse_px=0.5, seconds=0.25)
    if posed:
        written = replace(
            first, world_from_rig=pose, covariance=covariance, camera_contradicted=True, found_by="pnp+near",
            focals_px=(450.5, np.nan), centers_px=((np.nan, np.nan), (320.5, 240.0)),
        )  # fmt: skip
    else:
        written = replace(first, status=Status.FAILED, reason="too few inliers (3: within)", remark="torn.jpg")
    row = json.loads(json.dumps(written.to_row(5, "phone")))
    assert row["status"] == ("ok" if posed else "failed: too few inliers (3: within)")
    read = QueryResult.from_row(row, written.arrays())
    assert json.dumps(read.to_row(5, "phone")) == json.dumps(row)
    np.testing.assert_array_equal(read.focals_px, written.focals_px)
    assert (read.world_from_rig is not None) == (read.covariance is not None) == read.camera_contradicted == posed
    for name in ("status", "reason", "remark", "num_inliers", "num_matches", "p_correct", "rmse_px", "seconds"):
        assert getattr(read, name) == getattr(written, name), name
    assert (read.found_by, read.images, read.references) == (written.found_by, written.images, written.references)
    if posed:
        np.testing.assert_array_equal(read.world_from_rig, pose)
        np.testing.assert_array_equal(read.covariance, covariance)


@pytest.mark.parametrize(("text", "expected"), [
    ("ok", ("ok", "")), ("failed: a: b", ("failed", "a: b")), ("low_confidence: map?", ("low_confidence", "map?")),
])  # fmt: skip
def test_status_and_reason_of_a_text(text: str, expected: tuple[str, str]) -> None:
    assert Status.parse(text) == expected
    assert [status.rank for status in Status] == [2, 1, 0]


def test_a_query_is_found_by_number_key_and_image(tmp_path: Path) -> None:
    path = tmp_path / "P_map_ios_query_hl.h5"
    write_queries(path, QUERIES)
    keys = list(QUERIES)
    Trajectory.from_poses([keys[0][0]], [keys[0][1]], np.eye(4)[None]).write(path.with_suffix(".txt"))
    listed = enumerate(QUERIES.items())
    rows = [one.to_row(*key) | {"image": f"a/{number}.jpg;b/{number}.jpg"} for number, (key, one) in listed]
    pd.DataFrame(rows).to_csv(path.with_suffix(".csv"), index=False)
    results = PairResults.open(path)
    for number, key in enumerate(keys):
        found = [results[number], results[key], results[f"a/{number}.jpg"]]
        assert [one.images for one in found] == [QUERIES[key].images] * 3
        assert results[f"b/{number}.jpg"].references == QUERIES[key].references
    for unknown in ((7, "nobody"), "c.jpg", len(keys)):
        with pytest.raises(ArtifactError):
            results[unknown]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("column", [{}, {"image": np.nan}], ids=["no column", "no names"])
def test_a_table_without_names_of_images_is_read(tmp_path: Path, column: dict[str, float]) -> None:
    """pandas warned that it will not fill missing numbers with texts."""
    path = tmp_path / "P_map_ios_query_hl.h5"
    write_queries(path, QUERIES)
    (key, result), *_ = QUERIES.items()
    results = PairResults(path.with_suffix(".txt"), pd.DataFrame([result.to_row(*key) | column]))
    Trajectory.from_poses([key[0]], [key[1]], np.eye(4)[None]).write(results.path)
    assert results[0].images == results[key].images == result.images
    with pytest.raises(ArtifactError, match="There are none"):
        results["0.jpg"]
