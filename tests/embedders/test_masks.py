"""Masks of map images: what is known of a query before images are compared."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from toolkit.capture import Session, Trajectory
from toolkit.embedders import masks as masks_module
from toolkit.embedders.masks import Masks, combine, gps_masks, near, pose_masks, radio_masks
from toolkit.geometry import make_pose


def turned(axis: str, angle_deg: float, at: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    return make_pose(Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix(), at)


def test_cameras_near_a_pose_stand_close_and_look_a_similar_way() -> None:
    query = turned("y", 30, (1, 2, 3))
    cams = np.stack([
        query,
        turned("y", 30, (1, 2, 5)),
        turned("y", 30, (1, 2, 5.001)),
        turned("y", 74, (1, 2, 3)),
        turned("y", 76, (1, 2, 3)),
        turned("y", 210, (1, 2, 3)),
        query @ turned("z", 90),
        np.full((4, 4), np.nan),
    ])  # fmt: skip
    assert near(cams, query, 2, 45).tolist() == [True, True, False, True, False, False, True, False]
    assert near(cams, query, 2).tolist() == [True, True, False, True, True, True, True, False]
    assert near(cams[:1], query, 0, 0).tolist() == [True], "the pose itself"
    assert near(cams, np.full((4, 4), np.nan), 2).sum() == 0
    assert near(cams[:0], query, 2).shape == (0,)


def session_of(path: Path, files: Mapping[str, str], places: Sequence[tuple[float, float]] = ()) -> Session:
    """A session with one image each 10 s, at places (x, y) if it is a map's, and more text files."""
    rows = range(max(len(places), 4))
    (path / "proc").mkdir(parents=True)
    (path / "sensors.txt").write_text("s/cam, , camera, PINHOLE, 64, 48, 50, 50, 32, 24\n")
    (path / "images.txt").write_text("".join(f"{row * 10_000_000}, s/cam, s/{row}.jpg\n" for row in rows))
    poses = "".join(f"{row * 10_000_000}, s/cam, 1, 0, 0, 0, {x}, {y}, 0\n" for row, (x, y) in enumerate(places))
    if places:
        (path / "trajectories.txt").write_text(poses)
    for name, text in files.items():
        (path / name).write_text(text)
    return Session.open(path)


def wifi(*scans: tuple[float, dict[str, float]], sensor: str = "s/wifi") -> str:
    """The text of wifi.txt: scans of times, seconds, and dBm by name of an emitter."""
    return "".join(
        f"{round(seconds * 1e6)}, {sensor}, {name}, 2412000, {dbm}, net, 0, 0\n"
        for seconds, signals in scans
        for name, dbm in signals.items()
    )


def shown(masks: Masks) -> list[list[int]]:
    """The rows that each query may find."""
    return [np.flatnonzero(row).tolist() for row in masks.rows(0, masks.count)]


def radio(tmp_path: Path, of_map: str, of_query: str, least: int = 1) -> list[list[int]]:
    mapped = session_of(tmp_path / "ios_map", {"wifi.txt": of_map}, [(0, 0), (1, 0), (20, 0), (21, 0)])
    asked = session_of(tmp_path / "hl_query", {"wifi.txt": of_query})
    return shown(radio_masks((mapped, np.arange(4)), (asked, np.arange(4)), least, 2))


def test_radio_finds_the_place_that_received_the_same(tmp_path: Path) -> None:
    near_a, near_b = {"a": -40.0, "b": -80.0}, {"a": -80.0, "b": -40.0}
    of_map = wifi((0, near_a), (11.9, {"a": -50, "b": -70}), (20, near_b), (30, {"b": -50}))
    # Ids are compared as the benchmark does, in lower case; the third has an emitter that the map does not know, the
    # fourth nothing that it knows.
    of_query = wifi((1, {"A": -45, "B": -85}), (9, near_b), (20, {"b": -45, "new": -30}), (30, {"new": -30}))
    everything = [0, 1, 2, 3]
    assert radio(tmp_path, of_map, of_query) == [[0], [2], [3], everything]
    assert radio(tmp_path / "half", of_map, of_query, 2) == [[0, 1], [2, 3], [2, 3], everything]


def test_a_place_with_more_emitters_than_the_query_is_another(tmp_path: Path) -> None:
    of_map = wifi((0, {"a": -60}), (10, {"a": -60, "b": -40, "c": -40}), (20, {"c": -40}), (30, {"d": -40}))
    assert radio(tmp_path, of_map, wifi((0, {"a": -60}))) == [[0], [0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 2, 3]]


def test_places_that_are_equal_by_radio_stay_together_and_others_than_received_go(tmp_path: Path) -> None:
    of_map = wifi((0, {"a": -50}), (10, {"a": -50}), (20, {"a": -50}), (30, {"b": -50}))
    assert radio(tmp_path, of_map, wifi((0, {"a": -90})))[0] == [0, 1, 2]
    assert radio(tmp_path / "all", of_map, wifi((0, {"a": -90})), 4)[0] == [0, 1, 2], "b was not received"


def test_scans_count_for_their_recording_and_time_alone(tmp_path: Path) -> None:
    a, b = {"a": -50.0}, {"b": -50.0}
    # Those of a sensor in another recording, or farther than two seconds, are of no image: images 1 and 3 take the
    # scans of the nearest place.
    of_map = wifi((0, a), (17, b), (20, b)) + wifi((0, b), (10, a), sensor="t/wifi")
    places = [(0.0, 0.0), (1.0, 0.0), (20.0, 0.0), (21.0, 0.0)]
    mapped = session_of(tmp_path / "ios_map", {"wifi.txt": of_map, "proc/subsessions.txt": "s\nt\n"}, places)
    asked = session_of(tmp_path / "hl_query", {"wifi.txt": wifi((0, a), (10, b)) + wifi((20, b), sensor="wifi")})
    found = shown(radio_masks((mapped, np.arange(4)), (asked, np.arange(4)), 1, 2))
    assert found == [[0, 1], [2, 3], [2, 3], [0, 1, 2, 3]]


def test_strengths_of_several_scans_and_of_bluetooth_are_joined(tmp_path: Path) -> None:
    beacon = "".join(f"{time}, s/bt, G:1:{minor}, -50\n" for time, minor in ((0, 1), (10_000_000, 2)))
    of_map = wifi((0, {"a": -50}), (10, {"a": -50}), (20, {"a": -90}), (30, {"a": -30}))
    asked = session_of(
        tmp_path / "hl_query",
        {"wifi.txt": wifi((0, {"a": -50})), "bt.txt": "1, s/bt, g:1:2, -40\n2, s/bt, g:1:2, -60\n"},
    )
    places = [(0.0, 0.0), (1.0, 0.0), (20.0, 0.0), (21.0, 0.0)]
    mapped = session_of(tmp_path / "ios_map", {"wifi.txt": of_map, "bt.txt": beacon}, places)
    assert shown(radio_masks((mapped, np.arange(4)), (asked, np.arange(1)), 1, 2)) == [[1]]


def test_radio_of_one_side_limits_nothing(tmp_path: Path) -> None:
    for name, files in (
        ("map", ({"wifi.txt": wifi((0, {"a": -50}))}, {})),
        ("query", ({}, {"bt.txt": "0, b, x, -5\n"})),
    ):
        mapped = session_of(tmp_path / name / "ios_map", files[0], [(0, 0)])
        asked = session_of(tmp_path / name / "hl_query", files[1])
        masks = radio_masks((mapped, np.arange(1)), (asked, np.arange(4)), 1, 2)
        assert (masks.which == -1).all()
        assert shown(masks) == [[0]] * 4


def test_radio_in_blocks_is_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    texts = [
        wifi(*((time, dict(zip("abcdefgh", rng.uniform(-95, -30, 8), strict=True))) for time in range(0, 200, 3)))
        for _ in range(2)
    ]
    places = [tuple(place) for place in rng.uniform(0, 50, (20, 2))]
    mapped = session_of(tmp_path / "ios_map", {"wifi.txt": texts[0]}, places)
    asked = session_of(tmp_path / "hl_query", {"wifi.txt": texts[1]}, places)
    whole = radio_masks((mapped, np.arange(20)), (asked, np.arange(20)), 2, 2)
    assert set(whole.rows(0, 20).sum(axis=1)) == {2}
    monkeypatch.setattr(masks_module, "_BLOCK", 50)
    assert shown(radio_masks((mapped, np.arange(20)), (asked, np.arange(20)), 2, 2)) == shown(whole)
    some = np.array([3, 19, 4])
    assert shown(radio_masks((mapped, np.arange(20)), (asked, some), 2, 2)) == shown(whole.choose(some))


# A degree of latitude near 47.4 is 111,177 m, one of longitude 75,457 m (WGS 84).
NORTH, EAST = 1 / 111_177, 1 / 75_457


def test_fixes_are_compared_within_their_accuracies(tmp_path: Path) -> None:
    def fixes(*rows: tuple[float, float, float, float]) -> str:
        return "".join(
            f"{round(seconds * 1e6)}, s/gps, {47.4 + north * NORTH}, {8.5 + east * EAST}, 400, {accuracy}\n"
            for seconds, east, north, accuracy in rows
        )

    of_map = fixes((0, 0, 0, 5), (10, 49, 0, 5), (20, 0, 51, 5))  # none of the fourth image
    mapped = session_of(tmp_path / "ios_map", {"gps.txt": of_map}, [(0, 0)] * 4)
    asked = session_of(
        tmp_path / "hl_query",
        # The first has its fixes on both sides; one without an accuracy says nothing; the third is far from all.
        {"gps.txt": fixes((-1, -9, 0, 5), (1, 9, 0, 5), (10, 0, 100, -1), (20, 9000, 0, 5), (30, 0, 100, 5))},
    )
    found = gps_masks((mapped, np.arange(4)), (asked, np.arange(4)), margin_m=30, window_s=2)
    assert shown(found) == [[0, 1, 3], [0, 1, 2, 3], [0, 1, 2, 3], [2, 3]]
    assert found.which.tolist()[1:3] == [-1, -1]
    nothing = session_of(tmp_path / "spot_query", {"gps.txt": fixes((0, 0, 0, -1))})
    assert (gps_masks((mapped, np.arange(4)), (nothing, np.arange(4)), 30, 2).which == -1).all()


def test_fixes_are_near_across_the_date_line(tmp_path: Path) -> None:
    mapped = session_of(tmp_path / "ios_map", {"gps.txt": "0, s/gps, 0, 179.9999, 0, 1\n"}, [(0, 0), (0, 0)])
    asked = session_of(
        tmp_path / "hl_query", {"gps.txt": "0, s/gps, 0, -179.9999, 0, 1\n20000000, s/gps, 0, -179.9997, 0, 1\n"}
    )
    # They are 22.3 m and 44.5 m apart.
    assert shown(gps_masks((mapped, np.arange(1)), (asked, np.arange(1)), 20, 2)) == [[0]]
    masks = gps_masks((mapped, np.arange(1)), (asked, np.arange(4)), 20, 2)
    assert (masks.which >= 0).tolist() == [True, False, False, False], "the third is too far"


def test_rough_poses_of_rigs_and_of_cameras(tmp_path: Path) -> None:
    mapped = session_of(tmp_path / "ios_map", {}, [(0, 0), (1, 0), (20, 0), (21, 0)])
    rigs = "s/rig, s/cam, 0.7071067811865476, 0, 0.7071067811865476, 0, 0, 0, 0\n"
    asked = session_of(
        tmp_path / "hl_query", {"rigs.txt": rigs, "trajectories.txt": "10000000, s/rig, 1, 0, 0, 0, 9, 9, 9\n"}
    )
    poses = Trajectory(
        [0, 10_000_000, 30_000_000],
        ["s/cam", "s/rig", "s/cam"],
        # The rig looks to -x if its camera, turned by 90 degrees about y, looks along z.
        [[1, 0, 0, 0, 0.5, 0, 0], [0.5**0.5, 0, -(0.5**0.5), 0, 20, 0, 0], [1, 0, 0, 0, 500, 0, 0]],
    )
    assert asked.device_ids.tolist()[1] == "s/rig"
    rows = np.arange(4)
    everything = [0, 1, 2, 3]  # the third has no pose, the fourth is near nothing
    assert shown(pose_masks(poses, (mapped, rows), (asked, rows), 2, 45)) == [[0, 1], [2, 3], everything, everything]
    turned_away = Trajectory([0], ["s/cam"], [[0, 0, 1, 0, 0, 0, 0]])
    assert pose_masks(turned_away, (mapped, rows), (asked, rows), 2, 45).which.tolist() == [-1] * 4


def test_priors_are_combined_and_one_that_contradicts_those_before_it_does_not_count() -> None:
    def masks(which: list[int], *rows: str) -> Masks:
        return Masks.of([np.array([[sign == "1" for sign in row] for row in rows])], np.array(which), 11)

    first = masks([0, 1, -1, -1, 0], "11110000000", "00000000001", "00000000000")
    second = masks([0, 0, 0, -1, 1], "01110000111", "00001111000")
    both, without = combine([first, second])
    assert shown(both) == [[1, 2, 3], [10], [1, 2, 3, 8, 9, 10], list(range(11)), [0, 1, 2, 3]]
    assert without == [2, 2]
    assert both.which[3] == -1
    assert [(queries.tolist(), None if mask is None else int(mask.sum())) for queries, mask in both.distinct()] == [
        ([3], None), ([2], 6), ([0], 3), ([4], 4), ([1], 1),
    ]  # fmt: skip
    assert shown(Masks.stack([both.choose(np.array([1])), first])) == [shown(both)[1], *shown(first)]
    assert [row.tolist() for row in both.rows(8, 11)] == [row[8:] for row in both.rows(0, 11).tolist()]
    assert [row.tolist() for row in both.rows(3, 10)] == [row[3:10] for row in both.rows(0, 11).tolist()]
