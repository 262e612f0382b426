"""The sequence stage on files: a rendered capture's query session with odometry, and poses of some of its queries."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.localizers.drifting import PLACE, small_motion
from toolkit import geometry
from toolkit.capture import Session, Trajectory
from toolkit.capture.tables import as_strings
from toolkit.errors import ManifestError
from toolkit.files import pair_name
from toolkit.sequence import COLUMNS, sequence_pairs

pytest.importorskip("gtsam")


@pytest.fixture
def place(small_capture: Path, tmp_path: Path) -> Path:
    """A capture whose ios queries have odometry, with poses of the even ones in `poses`."""
    capture = tmp_path / small_capture.name
    shutil.copytree(small_capture, capture)
    session = Session(capture / "sessions/ios_query")
    truth = session.ground_truth
    assert truth is not None
    odometry = geometry.invert(PLACE) @ truth.world_from_device
    (capture / "sessions/hl_query/trajectories.txt").unlink()
    Trajectory.from_poses(truth.timestamps, truth.device_ids, odometry).write(session.path / "trajectories.txt")
    localized(tmp_path, capture, truth, np.arange(0, len(truth), 2))
    return capture


def localized(folder: Path, capture: Path, truth: Trajectory, rows: np.ndarray, status: str = "ok") -> None:
    stem = folder / "poses" / pair_name(capture.name, "ios", "ios")
    stem.parent.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    poses = np.stack([truth.world_from_device[row] @ small_motion(rng, 0.002, 0.02) for row in rows])
    covariances = np.tile(np.diag(np.repeat([0.002, 0.02], 3) ** 2), (len(rows), 1, 1))
    keys = truth.timestamps[rows], truth.device_ids[rows]
    Trajectory.from_poses(*keys, poses, covariances).write(stem.with_name(f"{stem.name}.txt"))
    table = pd.DataFrame({"timestamp": keys[0], "device_id": keys[1], "status": status, "p_correct": 0.9})
    table.to_csv(stem.with_name(f"{stem.name}.csv"), index=False)


def test_every_frame_of_the_odometry_has_a_pose(place: Path, tmp_path: Path) -> None:
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    truth = Session(place / "sessions/ios_query").ground_truth
    assert truth is not None
    assert done["frames"] == done["ok"] == len(truth)
    assert done["queries"] == done["used"] == len(range(0, len(truth), 2))
    found = Trajectory.read(done["path"])
    rotation_deg, position_m = geometry.pose_error(found.lookup(truth.timestamps, truth.device_ids),
                                                   truth.world_from_device)  # fmt: skip
    assert rotation_deg.max() < 0.5
    assert position_m.max() < 0.1
    table = pd.read_csv(str(done["path"]).replace(".txt", ".csv"))
    assert list(table) == list(COLUMNS)
    assert table["single_status"].notna().tolist() == [row % 2 == 0 for row in range(len(truth))]
    assert found.covariances is not None
    stds = np.sqrt(np.trace(found.covariances[:, 3:, 3:], axis1=1, axis2=2))
    np.testing.assert_allclose(stds, table["position_std_m"], atol=1e-6)


def test_a_result_is_made_again_when_poses_odometry_or_settings_change(place: Path, tmp_path: Path) -> None:
    def skipped(**settings: float) -> bool:
        table = sequence_pairs(place / "sessions", tmp_path / "poses", settings, map_device="ios", query_device="ios")
        return bool(table["skipped"].item())

    odometry = place / "sessions/ios_query/trajectories.txt"
    assert [skipped(), skipped(), skipped(scale_std=0.01), skipped(scale_std=0.01)] == [False, True, False, True]
    odometry.write_text("".join(odometry.read_text().splitlines(keepends=True)[:-1]))
    assert [skipped(scale_std=0.01), skipped(scale_std=0.01)] == [False, True]
    with (tmp_path / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.csv").open("a") as table:
        table.write("1,nobody,failed: no image,\n")
    assert [skipped(scale_std=0.01), skipped(scale_std=0.01)] == [False, True]


def test_a_query_without_odometry_keeps_its_own_pose(place: Path, tmp_path: Path) -> None:
    odometry = place / "sessions/ios_query/trajectories.txt"
    lines = odometry.read_text().splitlines(keepends=True)
    odometry.write_text("".join([lines[0], *lines[2:]]))
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    single = Trajectory.read(tmp_path / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.txt")
    key = single.timestamps[:1], single.device_ids[:1]
    np.testing.assert_allclose(Trajectory.read(done["path"]).lookup(*key), single.lookup(*key), atol=1e-12)
    row = pd.read_csv(str(done["path"]).replace(".txt", ".csv")).iloc[-1]
    assert (row["timestamp"], row["device_id"]) == (key[0][0], key[1][0])
    assert pd.isna(row["recording"])


def test_pieces_end_where_tracking_was_lost(place: Path, tmp_path: Path) -> None:
    path = place / "sessions/ios_query/trajectories.txt"
    odometry = Trajectory.read(path)
    poses, half = odometry.world_from_device, len(odometry) // 2
    poses[half:] = geometry.make_pose(np.eye(3), [0.0, 500.0, 0.0]) @ poses[half:]
    Trajectory.from_poses(odometry.timestamps, odometry.device_ids, poses).write(path)
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    whole = pd.read_csv(str(done["path"]).replace(".txt", ".csv")).groupby("recording")["piece"].nunique()
    assert done["pieces"] == whole.sum() > len(whole)
    truth = Session(place / "sessions/ios_query").ground_truth
    assert truth is not None
    found = Trajectory.read(done["path"])
    there = truth.lookup(found.timestamps, found.device_ids)
    assert geometry.pose_error(found.world_from_device, there)[1].max() < 0.1


def test_online_there_are_poses_of_queries_alone(place: Path, tmp_path: Path) -> None:
    done = sequence_pairs(place / "sessions", tmp_path / "poses", {"online": True, "length_s": 10.0},
                          map_device="ios", query_device="ios").iloc[0]  # fmt: skip
    single = Trajectory.read(tmp_path / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.txt")
    found = Trajectory.read(done["path"])
    assert found.timestamps.tolist() == single.timestamps.tolist()
    assert done["frames"] == done["ok"] == len(single)
    with pytest.raises(ManifestError, match="online"):
        sequence_pairs(place / "sessions", tmp_path / "poses", {"length_s": 10.0})


def test_what_cannot_be_done_has_a_reason(place: Path, tmp_path: Path) -> None:
    table = sequence_pairs(place / "sessions", tmp_path / "poses").set_index(["map_device", "query_device"])
    assert table.loc[("ios", "ios"), "reason"] == ""
    assert "Localize first" in table.loc[("hl", "ios"), "reason"]
    assert "trajectories.txt" in table.loc[("ios", "hl"), "reason"]
    assert (table.drop(("ios", "ios"))["frames"] == 0).all()
    with pytest.raises(ManifestError):
        sequence_pairs(place / "sessions", tmp_path / "poses", {"scale": 1.0})


def test_a_map_session_has_no_odometry(place: Path) -> None:
    assert Session(place / "sessions/ios_map").odometry is None
    assert Session(place / "sessions/hl_query").odometry is None
    odometry = Session(place / "sessions/ios_query").odometry
    assert odometry is not None
    assert len(odometry)


def test_a_query_between_two_poses_of_the_odometry_has_one_in_between(place: Path, tmp_path: Path) -> None:
    path = place / "sessions/ios_query/trajectories.txt"
    truth = Session(place / "sessions/ios_query").ground_truth
    assert truth is not None
    odometry = Trajectory.read(path)
    asked = odometry.index.find(truth.timestamps[::2], as_strings(truth.device_ids[::2]))
    # A pose before and behind each query, which has none itself; the names of phones tell the time.
    times = np.concatenate([odometry.timestamps[asked] + shift for shift in (-1000, 1000)])
    rows = np.tile(asked, 2)
    early = Trajectory(times, [f"{odometry.device_ids[row]}_" for row in rows], odometry.qt[rows])
    early.write(path)
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    found = Trajectory.read(done["path"])
    single = Trajectory.read(tmp_path / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.txt")
    there = truth.lookup(single.timestamps, single.device_ids)
    poses = found.lookup(single.timestamps, single.device_ids)
    assert np.isfinite(poses).all()
    assert geometry.pose_error(poses, there)[1].max() < 0.1
    assert len(found) == len(early) + len(single)
