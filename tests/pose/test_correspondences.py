"""The file of what each pose rests on: what is written is read."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.localized import some_correspondences, write_queries
from toolkit.errors import ArtifactError
from toolkit.geometry import make_pose
from toolkit.pose.correspondences import (
    Correspondences,
    LocalizedQueries,
    LocalizedQuery,
    Rival,
)
from toolkit.store.hdf5 import CHECKSUM

NAMES = ["ios_map/raw_data/1.jpg", "ios_map/raw_data/morning walk/2.jpg"]
QUERIES = {
    (5, "phone"): LocalizedQuery(
        ["ios_query/raw_data/5.jpg"],
        NAMES,
        ["ios_map/raw_data/ä.jpg"],
        some_correspondences([0] * 6, [True, False] * 3),
        (Rival(make_pose(np.eye(3), [1.0, 2.0, 3.0]), 0.8), Rival(np.eye(4), 0.25)),
    ),
    (17, "robot/body"): LocalizedQuery(
        ["spot_query/raw_data/front/17.jpg", "spot_query/raw_data/back/17.jpg"],
        NAMES,
        [],
        some_correspondences([0, 1, 1, 0], [True, True, False, True], point_index=-1),
    ),
    (17, "phone"): LocalizedQuery(["ios_query/raw_data/17.jpg"]),
    (18, "phone"): LocalizedQuery(),
}


@pytest.fixture
def stored(tmp_path: Path) -> LocalizedQueries:
    path = tmp_path / "poses" / "pair.h5"
    write_queries(path, QUERIES, ["ios_map.npz"])
    return LocalizedQueries(path)


@pytest.mark.parametrize("key", QUERIES)
def test_what_is_written_is_read(stored: LocalizedQueries, key: tuple[int, str]) -> None:
    assert key in stored
    read, written = stored[key], QUERIES[key]
    assert (read.images, read.references, read.rejected) == (written.images, written.references, written.rejected)
    assert [rival.support for rival in read.rivals or ()] == [rival.support for rival in written.rivals or ()]
    for one, other in zip(read.rivals or (), written.rivals or (), strict=True):
        np.testing.assert_array_equal(one.world_from_rig, other.world_from_rig)
    assert len(read.correspondences) == len(written.correspondences)
    for name, array in vars(written.correspondences).items():
        again = getattr(read.correspondences, name)
        assert again.dtype.kind == array.dtype.kind, name
        assert again.dtype.itemsize == array.dtype.itemsize or array.dtype.kind == "U", name
        np.testing.assert_allclose(again, array, atol=1e-4) if array.dtype.kind == "f" else (
            np.testing.assert_array_equal(again, array)
        )


def test_a_file_is_a_mapping_of_queries(stored: LocalizedQueries) -> None:
    assert len(stored) == len(QUERIES)
    # `/` in a device's id makes no further level.
    assert set(stored) == {(5, "phone"), (17, "robot/body"), (17, "phone"), (18, "phone")}
    assert stored.maps == ["ios_map.npz"]
    for key in ((6, "phone"), (5, "robot"), (5, "phone/images"), 5, "5/phone"):
        assert key not in stored
    with pytest.raises(KeyError):
        stored[6, "phone"]
    stored.close()


def test_correspondences_of_one_image(stored: LocalizedQueries) -> None:
    correspondences = stored[17, "robot/body"].correspondences
    assert correspondences.in_camera(1).tolist() == [1, 2]
    assert correspondences.in_camera(2).tolist() == []
    assert len(Correspondences().in_camera(0)) == 0


def test_a_missing_torn_or_incomplete_file_says_what_to_do(stored: LocalizedQueries, tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"none\.h5.*Localize again"):
        LocalizedQueries(tmp_path / "none.h5")
    stored.close()
    torn = tmp_path / "torn.h5"
    torn.write_bytes(stored.path.read_bytes()[:2000])
    with pytest.raises(ArtifactError, match=r"torn\.h5.*Localize again"):
        LocalizedQueries(torn)
    with h5py.File(stored.path, "a") as file:
        del file["5/phone/references"]
    with pytest.raises(ArtifactError, match=r"pair\.h5 is damaged at 5/phone.*run its stage again"):
        LocalizedQueries(stored.path)[5, "phone"]


@pytest.mark.parametrize("pixels", [None, np.zeros((3, 3), np.float32), np.zeros(2, np.float32)])
def test_a_file_of_another_tool_that_is_not_as_a_run_writes_it_says_what_to_do(
    stored: LocalizedQueries, pixels: np.ndarray | None
) -> None:
    stored.close()
    with h5py.File(stored.path, "a") as file:
        group = file["17/robot%2Fbody"]
        del group.attrs[CHECKSUM], group["pixels"]
        if pixels is not None:
            group["pixels"] = pixels
    with pytest.raises(ArtifactError, match=r"pair\.h5: 17/robot%2Fbody .*Localize again"):
        LocalizedQueries(stored.path)[17, "robot/body"]


def test_a_file_of_an_older_run_does_not_know_of_rivals(stored: LocalizedQueries) -> None:
    stored.close()
    with h5py.File(stored.path, "a") as file:
        for name in ("rivals", "rival_supports"):
            del file["5/phone"][name]
        del file["5/phone"].attrs[CHECKSUM]
    again = LocalizedQueries(stored.path)
    assert again[5, "phone"].rivals is None
    assert again[5, "phone"].references == NAMES
    assert again[18, "phone"].rivals == ()
