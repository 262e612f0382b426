"""The sequence stage on files: a rendered capture's query session with odometry, and poses of some of its queries."""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest

from benchmarks.common import scaled
from tests.sequences.drifting import PLACE, Drive, drive, lost_in_a_gap, small_motion
from toolkit import geometry, sequence
from toolkit.capture import Session, Trajectory
from toolkit.capture.tables import POSES_UNIT, as_strings
from toolkit.embed import embed_sessions
from toolkit.errors import ManifestError
from toolkit.files import SceneFiles, map_record_path, pair_name
from toolkit.localize import localize_pairs
from toolkit.pose.base import QueryResult, Status
from toolkit.retrieve import retrieve_pairs
from toolkit.sequence import COLUMNS, sequence_pairs
from toolkit.sequences.pose_graph import FAR
from toolkit.synthetic import capture as rendering
from toolkit.synthetic import render_capture
from toolkit.synthetic.capture import DEVICES, IMAGE_PERIOD_S, RATE_HZ, tracked
from toolkit.synthetic.render import Scene, build_room

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
    poses = np.array([truth.world_from_device[row] @ small_motion(rng, 0.002, 0.02) for row in rows]).reshape(-1, 4, 4)
    covariances = np.tile(np.diag(np.repeat([0.002, 0.02], 3) ** 2), (len(rows), 1, 1))
    keys = truth.timestamps[rows], truth.device_ids[rows]
    Trajectory.from_poses(*keys, poses, covariances).write(stem.with_name(f"{stem.name}.txt"))
    table = pd.DataFrame({"timestamp": keys[0], "device_id": keys[1], "status": status, "p_correct": 0.9})
    table.to_csv(stem.with_name(f"{stem.name}.csv"), index=False)


def drive_through(folder: Path, capture: Path, way: Drive) -> Trajectory:
    """Make a drive the only recording of the ios queries, with poses of its queries; return the true poses."""
    session, times = Session(capture / "sessions/ios_query"), way.odometry.timestamps
    ids = [f"{next(iter(session.subsessions))}/cam_phone_{time}" for time in times]
    Trajectory.from_poses(times, ids, way.odometry.odom_from_rig).write(session.path / "trajectories.txt")
    truth = Trajectory.from_poses(times, ids, way.world_from_rig)
    localized(folder, capture, truth, way.queries.frames)
    return truth


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


def test_lengths_of_an_unknown_unit_are_not_named_meters(place: Path, tmp_path: Path) -> None:
    record = map_record_path(tmp_path / "poses", place.name, "ios")
    record.write_text('{"unit": null, "depth": 5.0}')
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    assert done["queries"] > 0
    path = Path(str(done["path"]).replace(".txt", ".csv"))
    table = pd.read_csv(path)
    assert not [name for name in table if name.endswith("_m")]
    assert set(table["unit"]) == {"unknown"}
    assert list(table.rename(columns=POSES_UNIT))[:-1] == list(COLUMNS)


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


def test_without_a_frame_of_odometry_all_queries_keep_their_poses(place: Path, tmp_path: Path) -> None:
    odometry = place / "sessions/ios_query/trajectories.txt"
    odometry.write_text(odometry.read_text().splitlines(keepends=True)[0])
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    single = Trajectory.read(tmp_path / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.txt")
    assert done["frames"] == done["ok"] == len(single)
    assert Trajectory.read(done["path"]).timestamps.tolist() == single.timestamps.tolist()


def test_a_pair_without_queries_has_failed_frames_alone(place: Path, tmp_path: Path) -> None:
    truth = Session(place / "sessions/ios_query").ground_truth
    assert truth is not None
    localized(tmp_path, place, truth, np.arange(0))
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    assert done["frames"] == done["failed"] == len(truth)


def test_a_query_that_met_a_bug_is_localized_again_by_the_next_run(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = Session(place / "sessions/ios_query").ground_truth
    assert truth is not None
    localized(tmp_path, place, truth, np.arange(0, len(truth), 2), "low_confidence")
    of_run = SimpleNamespace(load=Mock(), query_of_session=Mock(), locate=Mock())
    monkeypatch.setattr(sequence._Relocalizer, "_map", of_run)

    def skipped(**answer: object) -> bool:
        of_run.locate = Mock(**answer)
        table = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios")
        assert table["again"].item() == len(range(0, len(truth), 2))
        return bool(table["skipped"].item())

    assert not skipped(side_effect=RuntimeError("a bug"))
    of_network = QueryResult.failed("too few matches", remark="internal: ValueError: a bug")
    assert not skipped(return_value=of_network)
    assert not skipped(return_value=QueryResult.failed("too few matches"))
    assert skipped()


@pytest.mark.slow
def test_ground_truth_is_not_taken_for_odometry_in_silence(
    place: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    truth = drive_through(tmp_path, place, drive(np.random.default_rng(0)))
    for poses, warned in ((None, False), (truth, True)):
        if poses is not None:
            poses.write(place / "sessions/ios_query/trajectories.txt")
        sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios")
        assert ("in the frame of the map" in caplog.text) == warned


@pytest.mark.parametrize("odd", ["a line twice", "another device", "other ids", "ids without time"])
def test_ids_that_have_the_time_are_of_one_device(place: Path, tmp_path: Path, odd: str) -> None:
    path = place / "sessions/ios_query/trajectories.txt"
    odometry, lines = Trajectory.read(path), path.read_text().splitlines(keepends=True)
    assert len(set(odometry.device_ids)) == len(odometry)
    if odd == "a line twice":
        path.write_text("".join([*lines, lines[2]]))
    elif odd == "another device":  # beside the phone, at the same times, and somewhere else
        others = [line.replace("cam_phone", "cam_other").rsplit(",", 1)[0] + ", 70.0\n" for line in lines[1:]]
        path.write_text("".join([lines[0], *np.ravel(list(zip(lines[1:], others, strict=True)))]))
    else:
        ids = [id_.split("/")[0] + f"/tracker{'' if 'without' in odd else f'_{time}'}"
               for time, id_ in zip(odometry.timestamps, odometry.device_ids, strict=True)]  # fmt: skip
        Trajectory(odometry.timestamps, ids, odometry.qt).write(path)
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    recordings = len(Session(place / "sessions/ios_query").subsessions)
    assert done["pieces"] == recordings * (2 if odd == "another device" else 1)
    assert done["ok"] == len(odometry) + (done["queries"] if "ids" in odd else 0)
    assert done["failed"] == (len(odometry) if odd == "another device" else 0)
    assert done["used"] == done["queries"] == len(range(0, len(odometry), 2))


def test_odometry_that_drifts_ten_times_as_much_does_no_harm(place: Path, tmp_path: Path) -> None:
    way = drive(np.random.default_rng(0), drift=10.0)
    truth = drive_through(tmp_path, place, way)
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    found = Trajectory.read(done["path"]).world_from_device[way.queries.frames]
    assert geometry.pose_error(found, truth.world_from_device[way.queries.frames])[1].max() < 0.1
    assert done["used"] == done["queries"] == len(way.queries)
    # Between two queries such odometry does not say enough.
    assert (done["ok"], done["low_confidence"]) == (len(way.queries), len(way.odometry) - len(way.queries))


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


def test_pieces_end_where_only_queries_tell_a_loss_of_tracking(place: Path, tmp_path: Path) -> None:
    way = lost_in_a_gap(drive(np.random.default_rng(0)))
    drive_through(tmp_path, place, way)
    done = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios").iloc[0]
    table = pd.read_csv(str(done["path"]).replace(".txt", ".csv"))
    assert table["piece"].tolist() == [0] * 21 + [1] * 16
    assert set(table["status"]) == {"ok"}
    assert geometry.pose_error(Trajectory.read(done["path"]).world_from_device, way.world_from_rig)[1].max() < 0.3


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
    (tmp_path / "poses" / f"{pair_name(place.name, 'ios', 'ios')}.csv").unlink()
    table = sequence_pairs(place / "sessions", tmp_path / "poses", map_device="ios", query_device="ios")
    assert "no table of the queries" in table["reason"].item()
    with pytest.raises(ManifestError):
        sequence_pairs(place / "sessions", tmp_path / "poses", {"scale": 1.0})


@dataclass(frozen=True)
class Alike:
    """Three rooms, the last looks exactly as the first, walked through twice in 120 s; each picture is localized."""

    capture: Path
    poses: Path
    folder: Path

    @property
    def session(self) -> Session:
        return Session(self.capture / "sessions/ios_query")

    def pieces(self, rng: np.random.Generator, losses: int, gaps: int = 0, useless: float = 0.0) -> pd.DataFrame:
        """Return what becomes of each piece of odometry, of which a share of the queries is useless.

        Table: status, frames, queries with a pose, share of frames in a wrong room, median errors.
        """
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        sessions, truth = folder / self.capture.name / "sessions", self.session.ground_truth
        assert truth is not None
        for name in ("ios_map", "ios_query"):
            shutil.copytree(
                self.capture / "sessions" / name, sessions / name, ignore=shutil.ignore_patterns("raw_data")
            )
        rows, measured = [], []
        for recording in self.session.subsessions:
            own = np.flatnonzero([id_.startswith(f"{recording}/") for id_ in truth.device_ids])
            kept, poses = tracked(
                rng, truth.timestamps[own], truth.world_from_device[own], 1.0, IMAGE_PERIOD_S * RATE_HZ, losses, gaps
            )
            rows.append(own[kept])
            measured.append(poses[kept])
        kept = np.concatenate(rows)
        odometry = Trajectory.from_poses(truth.timestamps[kept], truth.device_ids[kept], np.concatenate(measured))
        odometry.write(sessions / "ios_query/trajectories.txt")
        stem = folder / "poses" / pair_name(self.capture.name, "ios", "ios")
        single, table = Trajectory.read(self.poses), pd.read_csv(self.poses.with_suffix(".csv"))
        lost = np.isin(np.arange(len(table)), rng.permutation(len(table))[: round(useless * len(table))])
        table.loc[lost, "status"] = "failed: black"
        found = single.index.find(table["timestamp"][~lost], table["device_id"][~lost])
        assert single.covariances is not None
        Trajectory.from_poses(
            single.timestamps[found], single.device_ids[found], single.world_from_device[found],
            single.covariances[found],
        ).write(stem.with_name(f"{stem.name}.txt"))  # fmt: skip
        table.to_csv(stem.with_name(f"{stem.name}.csv"), index=False)
        pieces = self.judged(sessions, folder / "poses", relocalize=False)
        assert len(pieces) == len(self.session.subsessions) * (losses + 1)
        return pieces

    def judged(self, sessions: Path, poses_dir: Path, **settings: bool) -> pd.DataFrame:
        """Return what becomes of each piece of odometry in the sequence stage, see `pieces`."""
        done, truth = sequence_pairs(sessions, poses_dir, settings).iloc[0], self.session.ground_truth
        assert truth is not None
        frames = pd.read_csv(str(done["path"]).replace(".txt", ".csv"), keep_default_na=False)
        frames = frames[frames["recording"] != ""]
        # in the right room, but not where in it
        frames["status"] = frames["status"].replace(Status.LOW_CONFIDENCE.text(FAR), "ok")
        keys = frames["timestamp"], frames["device_id"]
        poses = Trajectory.read(done["path"]).lookup(*keys)
        frames["deg"], frames["m"] = geometry.pose_error(poses, truth.lookup(*keys))
        pieces = frames.groupby(["recording", "piece"])
        status = pieces["status"].agg(lambda of_frames: of_frames.mode().iloc[0])
        # In a piece whose place is in doubt, `ok` queries keep their own poses.
        alone = frames[frames["status"] != pieces["status"].transform(lambda of_frames: of_frames.mode().iloc[0])]
        assert (alone["status"] == "ok").all()
        assert (alone["single_status"] == "ok").all()
        assert (alone["m"] < 0.5).all()
        return pd.DataFrame(
            {
                "status": status, "frames": pieces.size(),
                "queries": pieces["used"].apply(lambda used: (used != "").sum()),
                "wrong": pieces["m"].apply(lambda m: (m > 5).mean()),
                "median_m": pieces["m"].median(), "median_deg": pieces["deg"].median(),
            }
        )  # fmt: skip


@pytest.fixture(scope="module")
def alike(tmp_path_factory: pytest.TempPathFactory) -> Alike:
    def coarse_room(seed: int, index: int, look: int | None = None) -> Scene:
        scene = build_room(seed, index, look)
        for quad in scene.quads:
            quad.ppm /= 2
        return scene

    folder = tmp_path_factory.mktemp("alike")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "build_room", coarse_room)
        patch.setattr(rendering, "DEVICES", {"ios": scaled(DEVICES["ios"], 0.5)})
        capture = render_capture(
            folder / "ALIKE", 3, 16, seed=3, progress=False, alike=True, seconds=120, losses=1, radio=True
        )
    files, sessions, queries = SceneFiles(folder / "run", "ALIKE"), capture / "sessions", "keyframes_original"
    embed_sessions(sessions, files.embeddings, features_dir=files.features)
    retrieve_pairs(sessions, files.embeddings, out_jsonl=files.retrieval_dir, queries=queries)
    folders = files.retrieval_dir, files.poses_dir, files.features, files.maps
    localize_pairs(sessions, *folders, {"features": ["sift"]}, queries=queries)
    return Alike(capture, files.poses_txt("ios", "ios"), folder)


@pytest.mark.slow
def test_no_piece_ends_in_a_wrong_room_that_looks_alike(alike: Alike) -> None:
    table, truth = pd.read_csv(alike.poses.with_suffix(".csv")), alike.session.ground_truth
    assert truth is not None
    keys = table["timestamp"], table["device_id"]
    single_m = geometry.pose_error(Trajectory.read(alike.poses).lookup(*keys), truth.lookup(*keys))[1]
    wrong_room = single_m > 5
    print(f"single: {wrong_room.sum()} of {len(table)} in the wrong room, {table['status'].value_counts().to_dict()}")
    assert 4 <= wrong_room.sum() <= 12  # of 16 in rooms that look alike
    assert not wrong_room[table["status"] == "ok"].any()
    as_rendered = alike.judged(alike.capture / "sessions", alike.poses.parent)
    print(f"as rendered, localized again with the predicted poses:\n{as_rendered}")
    assert len(as_rendered) == 4
    assert as_rendered["wrong"][as_rendered["status"] == "ok"].max() == 0
    for useless in (0.0, 0.5):
        rng = np.random.default_rng(0)
        pieces = pd.concat([alike.pieces(rng, losses, 1, useless) for losses in (0, 1, 1, 2, 2, 3, 3, 4)])
        ok, posed = pieces[pieces["status"] == "ok"], pieces[~pieces["status"].str.startswith("failed")]
        print(f"{useless:.0%} of the queries useless")
        print(pieces.assign(wrong=pieces["wrong"] > 0).groupby(["status", "wrong"])["frames"].agg(["size", "sum"]))
        assert ok["wrong"].max() == 0
        assert ok["median_m"].max() < 0.3
        assert ok["median_deg"].max() < 1.0
        assert ok["frames"].sum() > (0.6, 0.4)[useless > 0] * pieces["frames"].sum()
        assert 0 < (posed["wrong"] > 0).sum() < 0.25 * len(pieces)
        assert ((pieces["queries"] == 0) == pieces["status"].str.startswith("failed")).all()
        # A recording that is one piece has been where the rooms are told apart.
        assert (pieces["status"][pieces["frames"] > 550] == "ok").all()


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
