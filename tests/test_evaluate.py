import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest

from tests.calls import call
from tests.localized import write_queries
from toolkit import evaluate
from toolkit.capture import Trajectory, write_session
from toolkit.errors import CaptureError, ToolkitError
from toolkit.evaluate import draw_evaluation, evaluate_scene, pose_errors, recall
from toolkit.files import write_sidecar
from toolkit.geometry import make_pose, pose_error
from toolkit.mapping.local_map import LocalMap
from toolkit.results import metrics

CAMERA_MODEL = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
CAMERA = ("camera", "PINHOLE", "640", "480", "500", "500", "320", "240")
# Two cameras a meter to either side of the rig's origin, so that a turn of the rig moves them.
RIG_FROM_CAM = {"left": make_pose(np.eye(3), [-1, 0, 0]), "right": make_pose(np.eye(3), [1, 0, 0])}


def turned(degrees: float, axis: str = "z") -> np.ndarray:
    """Return a rotation about an axis."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    rotation = {"z": [[c, -s, 0], [s, c, 0], [0, 0, 1]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}[axis]
    return np.array(rotation)


def pose(x: float = 0, degrees: float = 0, axis: str = "z") -> np.ndarray:
    return make_pose(turned(degrees, axis), [x, 0, 0])


def write_capture(root: Path, ground_truth: bool = True) -> Path:
    """Write a capture `TINY`: ios and hl maps, four ios and two hl (rig) queries, each 10 m apart."""
    sessions = root / "TINY" / "sessions"
    for device, sensors in (("ios", ["phone"]), ("hl", ["left", "right"])):
        for split, count in (("map", 4), ("query", 4 if device == "ios" else 2)):
            times = np.arange(count)
            rig = device == "hl"
            ids = ["rig" if rig else "phone"] * count
            truth = Trajectory.from_poses(times, ids, np.stack([pose(10.0 * t) for t in times]))
            given = truth if split == "map" or ground_truth else None
            keys = pd.DataFrame({"timestamp": times, "device_id": ids})
            write_session(
                sessions / f"{device}_{split}",
                [(s, s, *CAMERA) for s in sensors],
                [("rig", s, RIG_FROM_CAM[s]) for s in sensors] if rig else None,
                given if split == "map" else None,
                [(int(t), s, f"{s}/{t}.jpg") for t in times for s in sensors],
                keyframes={"pruned_subsampled": keys} if split == "query" else None,
                ground_truth=given if split == "query" else None,
            )
    return sessions


def write_poses(
    folder: Path, pair: str, rows: list[tuple[int, str, np.ndarray | None, str]], table: bool = True
) -> None:
    """Write poses of a pair: rows (timestamp, device id, pose or None, status)."""
    found = [row for row in rows if row[2] is not None]
    trajectory = Trajectory.from_poses(
        [r[0] for r in found], [r[1] for r in found], np.array([r[2] for r in found]).reshape(-1, 4, 4)
    )
    trajectory.write(folder / f"TINY_{pair}.txt")
    if table:
        details = pd.DataFrame(rows, columns=["timestamp", "device_id", "pose", "status"])
        details.drop(columns="pose").assign(num_inliers=10).to_csv(folder / f"TINY_{pair}.csv", index=False)


def write_references(folder: Path, pair: str, found: dict[tuple[int, str, str], list[np.ndarray]]) -> None:
    """Write references of a pair: for (timestamp, device id, sensor id), world_from_cam of the map images."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for (time, device, sensor), poses in found.items():
        trs = RIG_FROM_CAM.get(sensor, np.eye(4)).tolist()
        path = "TINY/sessions/ios_{}/raw_data/{}.jpg"
        topk = [
            {"rank": k, "score": 1.0, "path": path.format("map", k), "Tws": p.tolist()} for k, p in enumerate(poses)
        ]
        line = {"path": path.format("query", time), "device_id": device, "sensor_id": sensor, "timestamp": str(time)}
        lines.append(json.dumps(line | {"Trs": trs, "topk": topk}))
    (folder / f"TINY_{pair}.jsonl").write_text("\n".join(lines) + "\n")


IOS = "map_ios_query_ios"


def test_errors_have_known_values():
    true = np.stack([pose(), pose(2, 30), pose(), pose()])
    estimated = np.stack([pose(0.3), pose(2, 37), pose(degrees=180), pose(-1, 90)])
    rotation, translation = pose_errors(estimated, true)
    np.testing.assert_allclose(rotation, [0, 7, 180, 90], atol=1e-9)
    np.testing.assert_allclose(translation, [0.3, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pose_error(estimated, true), (rotation, translation))


def test_missing_pose_is_infinitely_wrong_and_missing_truth_is_unknown():
    nothing = np.full((4, 4), np.nan)
    rotation, translation = pose_errors(np.stack([nothing, pose()]), np.stack([pose(), nothing]))
    assert np.isinf(rotation[0])
    assert np.isinf(translation[0])
    assert np.isnan(rotation[1])
    assert np.isnan(translation[1])


def test_trajectories_are_joined_on_time_and_device():
    keys = pd.DataFrame({"timestamp": [1, 1, 2], "device_id": ["a", "b", "a"]})
    truth = Trajectory.from_poses([1, 1, 2], ["a", "b", "a"], np.stack([pose(), pose(5), pose(9)]))
    estimated = Trajectory.from_poses([1, 1], ["b", "a"], np.stack([pose(5), pose(1)]))
    np.testing.assert_allclose(pose_errors(estimated, truth, keys)[1], [1, 0, np.inf])
    with pytest.raises(ValueError, match="keys"):
        pose_errors(estimated, truth)


def test_threshold_is_strict_on_both_errors():
    rotation, translation = np.array([0.5, 1.0, 0.5, 0.5]), np.array([0.05, 0.05, 0.1, np.inf])
    assert recall(rotation, translation, [(1, 0.1)])[0] == 0.25
    assert recall(rotation, translation, [(1.001, 0.1001)])[0] == 0.75
    assert np.isnan(recall(np.zeros(0), np.zeros(0))).all()


@pytest.fixture
def scene(tmp_path):
    """Sessions, poses and references: one ios query right, one without reference, one failed, one wrong."""
    sessions = write_capture(tmp_path)
    poses, references = tmp_path / "poses", tmp_path / "retrieval"
    write_poses(
        poses,
        IOS,
        [
            (0, "phone", pose(0.01), "ok"),
            (1, "phone", pose(13.0), "low_confidence"),
            (2, "phone", None, "failed: too few inliers"),
            (3, "phone", pose(30.2), "ok"),
        ],
    )
    write_references(
        references,
        IOS,
        {
            (0, "phone", "phone"): [pose(30), pose(0, 90), pose(0)],  # a roll about the view does not matter
            (1, "phone", "phone"): [pose(30), pose(10, 90, "y")],  # near, but looks elsewhere
            (2, "phone", "phone"): [pose(20)],
            (3, "phone", "phone"): [pose(31)],
        },
    )
    return sessions, poses, references


def evaluate_ios(scene, **options):
    return call(evaluate_scene, *scene, options.pop("out", None), map_device="ios", query_device="ios", **options)


def test_scene_tables(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "RETRIEVAL_RADIUS_M", 5)
    monkeypatch.setattr(evaluate, "RETRIEVAL_KS", (1, 2))
    result = evaluate_ios(scene, out=tmp_path / "out")
    (row,) = result.recall.to_dict("records")
    assert row["state"] == "evaluated"
    counts = [row[c] for c in ("queries", "localized", "ok", "low_confidence", "failed")]
    assert counts == [4, 3, 2, 1, 1]
    assert [row[f"recall@({t})"] for t in ("1deg,0.1m", "5deg,0.5m", "5deg,1m")] == [0.25, 0.5, 0.5]
    assert row["median_translation_m"] == pytest.approx((0.2 + 3) / 2)
    assert row["ok_wrong"] == 0
    (found,) = result.retrieval.to_dict("records")
    assert [found["recall@1"], found["recall@2"], found["in_map"]] == [0.5, 0.75, 1.0]
    losses = result.losses.set_index("threshold")
    reasons = ["missed", "no good reference", "no pose", "wrong pose"]
    assert losses.loc["(1deg,0.1m)", reasons].tolist() == [3, 1, 1, 1]
    assert losses.loc["(5deg,0.5m)", reasons].tolist() == [2, 1, 1, 0]
    assert result.errors["loss@(1deg,0.1m)"].tolist() == ["", "no good reference", "no pose", "wrong pose"]
    assert not result.messages
    for name in ("recall", "errors", "retrieval", "losses"):
        written = pd.read_csv(tmp_path / "out" / f"{name}.csv")
        assert len(written) == len(getattr(result, name))
    for name in ("recall", "median_errors", "error_curves", "losses", "retrieval"):
        assert (tmp_path / "out" / f"{name}.png").stat().st_size > 1000


@pytest.mark.slow
def test_nothing_lost_leaves_no_figure_of_losses(scene, tmp_path):
    evaluate_ios(scene, out=tmp_path)
    assert (tmp_path / "losses.png").is_file()
    write_poses(scene[1], IOS, [(t, "phone", pose(10.0 * t), "ok") for t in range(4)])
    result = evaluate_ios(scene, out=tmp_path)
    assert result.recall["recall@(1deg,0.1m)"].item() == 1
    assert not (tmp_path / "losses.png").exists()


def test_wrong_pose_called_ok_is_counted(scene):
    write_poses(scene[1], IOS, [(t, "phone", pose(10.0 * t + (t == 3)), "ok") for t in range(4)])
    assert evaluate_ios(scene).recall["ok_wrong"].item() == 0.25


def test_median_is_infinite_where_most_have_no_pose(scene):
    rows = [(0, "phone", pose(), "ok")] + [(t, "phone", None, "failed: x") for t in (1, 2, 3)]
    write_poses(scene[1], IOS, rows)
    result = evaluate_ios(scene)
    assert np.isinf(result.recall["median_rotation_deg"].item())
    assert draw_evaluation(result)


def test_a_pose_of_unknown_scale_is_not_drawn_over_its_stated_deviation(scene):
    """A network knows no scale if its references stand in one place: the deviation of the position is infinite."""
    path = scene[1] / f"TINY_{IOS}.csv"
    table = pd.read_csv(path)
    table.assign(position_std_m=np.inf).to_csv(path, index=False)
    assert "deviations" not in draw_evaluation(evaluate_ios(scene))
    table.assign(position_std_m=[0.01, np.inf, np.nan, 0.1]).to_csv(path, index=False)
    (axis,) = draw_evaluation(evaluate_ios(scene))["deviations"].axes
    drawn = [line.get_xydata() for line in axis.lines if line.get_alpha()]
    np.testing.assert_allclose(np.concatenate(drawn), [(0.01, 0.01), (0.1, 0.2)])


def test_lengths_of_an_unknown_unit_are_named_so_in_memory_too(scene, tmp_path):
    (scene[1] / "TINY_map_ios.json").write_text('{"unit": null, "depth": 30}')
    result = evaluate_ios(scene, out=tmp_path)
    for name, table in (("recall", result.recall), ("errors", result.errors), ("retrieval", result.retrieval)):
        assert not [column for column in table if column.endswith("_m")]
        assert list(pd.read_csv(tmp_path / f"{name}.csv")) == list(table)
    assert result.recall["median_translation_L"].item() == pytest.approx((0.2 + 3) / 2 / 3)


def test_pairs_in_meters_and_in_an_unknown_unit_keep_their_names():
    one, other = pd.DataFrame({"translation_error_m": [1.0]}), pd.DataFrame({"translation_error_m": [2.0]})
    both = pd.concat([metrics.named_by_unit(one, "m"), metrics.named_by_unit(other, "L")], ignore_index=True)
    assert list(both) == ["translation_error_m", "translation_error_L"]
    assert metrics.named_as_meters(both)["translation_error_m"].tolist() == [1, 2]
    assert list(metrics.named_as_meters(both)) == ["translation_error_m"]
    assert metrics.unit_of("recall@(1deg,0.1m)", "recall@(1deg,0.1L)") == "m or L"


def test_the_unit_is_that_of_the_pairs_that_were_evaluated(scene):
    """Only the map that was localized in has a record of its unknown unit; the last one was left out."""
    (scene[1] / "TINY_map_ios.json").write_text('{"unit": null, "depth": 30}')
    (scene[1] / "TINY_map_hl_query_ios.left_out.json").write_text('{"reason": "a dragon"}')
    result = call(evaluate_scene, *scene, None, query_device="ios", pairs=[["ios", "ios"], ["hl", "ios"]])
    assert result.unit == "L"
    assert result.recall["recall@(1deg,0.1L)"].tolist()[0] == 0.5, "0.2 is 0.067 L"
    assert {"recall", "error_curves"} <= draw_evaluation(result).keys()


def test_poses_of_another_tool_need_no_table(scene):
    (scene[1] / f"TINY_{IOS}.csv").unlink()
    (row,) = evaluate_ios(scene).recall.to_dict("records")
    assert [row["state"], row["ok"], row["failed"]] == ["evaluated", 3, 1]


def test_a_damaged_table_of_queries_is_named(scene):
    (scene[1] / f"TINY_{IOS}.csv").write_text("")
    assert evaluate_ios(scene).recall["state"].item().startswith("unreadable table of queries (")


@pytest.mark.parametrize("suffix", ["txt", "csv"])
def test_results_that_are_not_as_they_were_written_are_not_counted_as_evaluated(scene, suffix):
    stem = scene[1] / f"TINY_{IOS}"
    write_sidecar(stem.with_suffix(".txt"), {}, [stem.with_suffix(".csv")])
    assert evaluate_ios(scene).recall["state"].item() == "evaluated"
    path = stem.with_suffix(f".{suffix}")
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))
    assert f"{path.name} is damaged" in evaluate_ios(scene).recall["state"].item()
    path.unlink()
    assert evaluate_ios(scene).recall["state"].item() != "evaluated"


def test_table_of_other_queries_is_named_stale(scene):
    write_poses(scene[1], IOS, [(0, "phone", pose(), "ok")])
    result = evaluate_ios(scene)
    assert result.recall["state"].item().startswith("stale: 1 of 4 queries")
    assert result.recall["recall@(1deg,0.1m)"].item() == 0.25
    assert len(result.messages) == 1
    table = scene[1] / f"TINY_{IOS}.csv"
    table.write_text(table.read_text() + "".join(f"{number},phone,\n" for number in (1, 2, 3)))
    assert evaluate_ios(scene).recall["state"].item().startswith("stale: 1 of 4 queries")
    table.write_text(table.read_text().replace("phone,\n", "phone,ok\n"))
    state = evaluate_ios(scene).recall["state"].item()
    assert state == f"stale: {table.name} and {table.stem}.txt differ in which queries have a pose"


def test_camera_errors_follow_the_rig(tmp_path):
    sessions, poses = write_capture(tmp_path), tmp_path / "poses"
    rows = [(0, "rig", make_pose(turned(4, "y"), [0, 0, 0]), "ok"), (1, "rig", None, "failed: x")]
    write_poses(poses, "map_hl_query_hl", rows)
    options = {"map_device": "hl", "query_device": "hl"}
    device = call(evaluate_scene, sessions, poses, None, None, **options)
    camera = call(evaluate_scene, sessions, poses, None, None, at="camera", **options)
    assert len(device.errors) == 2
    assert device.errors["translation_error_m"].tolist() == [0, np.inf]
    assert camera.errors["sensor_id"].tolist() == ["left", "right"] * 2
    assert device.errors["image"].tolist() == ["left/0.jpg;right/0.jpg", "left/1.jpg;right/1.jpg"]
    assert camera.errors["image"].tolist() == ["left/0.jpg", "right/0.jpg", "left/1.jpg", "right/1.jpg"]
    arc = 2 * np.sin(np.radians(2))  # a camera one meter from the rig's origin moves along the arc
    np.testing.assert_allclose(camera.errors["translation_error_m"], [arc, arc, np.inf, np.inf])
    np.testing.assert_allclose(camera.errors["rotation_error_deg"][:2], 4)
    assert camera.recall["queries"].item() == 4


def test_good_reference_of_any_camera_counts_for_the_rig(tmp_path):
    sessions, poses, references = write_capture(tmp_path), tmp_path / "poses", tmp_path / "retrieval"
    pair = "map_ios_query_hl"
    write_poses(poses, pair, [(0, "rig", pose(), "ok"), (1, "rig", pose(10), "ok")])
    found = {(0, "rig", "left"): [pose(30)], (0, "rig", "right"): [pose(1)], (1, "rig", "left"): [pose(30)]}
    write_references(references, pair, found)
    result = evaluate_scene(sessions, poses, references, None, map_device="ios", query_device="hl")
    assert result.retrieval["recall@1"].item() == 0.5


def test_no_ground_truth_is_said_and_skipped(tmp_path, caplog):
    sessions = write_capture(tmp_path, ground_truth=False)
    result = evaluate_scene(sessions, tmp_path / "poses", tmp_path / "retrieval", tmp_path / "out")
    assert result.recall["state"].tolist() == ["no ground truth"] * 4
    assert result.losses["missed"].isna().all()
    assert len(result.errors) == 0
    assert sorted(result.messages) == [
        "hl_query has no ground truth; it is not evaluated.",
        "ios_query has no ground truth; it is not evaluated.",
    ]
    assert "ios_query has no ground truth" in caplog.text
    assert len(pd.read_csv(tmp_path / "out" / "recall.csv")) == 4
    assert len(pd.read_csv(tmp_path / "out" / "errors.csv")) == 0
    result = evaluate_scene(sessions, tmp_path / "poses", tmp_path / "retrieval", None, pairs=[["hl", "ios"]])
    assert result.messages == ["ios_query has no ground truth; it is not evaluated."], "nothing of a device not asked"


def test_missing_and_torn_files_are_rows_not_exceptions(scene):
    result = evaluate_scene(*scene, None)
    states = result.recall.set_index(["map_device", "query_device"])["state"]
    assert states["ios", "ios"] == "evaluated"
    assert states["hl", "ios"] == "no poses file"
    assert states["hl", "hl"] == "no poses file"
    (scene[1] / "TINY_map_hl_query_ios.txt").write_text("0, phone, 1, 0\n")
    (scene[2] / f"TINY_{IOS}.jsonl").write_text('{"timestamp": "0"')
    result = evaluate_scene(*scene, None)
    states = result.recall.set_index(["map_device", "query_device"])["state"]
    assert states["hl", "ios"].startswith("unreadable poses file")
    assert result.retrieval["state"].str.startswith("unreadable retrieval file").sum() == 1
    assert set(result.errors["loss@(1deg,0.1m)"]) == {"", "no pose", "wrong pose"}
    assert draw_evaluation(result)


def test_unknown_choices_are_named(scene):
    for wrong, named in (
        (lambda: evaluate_scene(*scene, None, map_device="spot"), "'spot'.*ios, hl"),
        (lambda: evaluate_ios(scene, at="rig"), "device, camera"),
        (lambda: evaluate_scene(*scene, None, pairs=[["ios", "spto"]]), r"\[\['ios', 'spto'\]\]"),
        (lambda: evaluate_scene(*scene, None, {"thresholds": []}), "thresholds"),
    ):
        with pytest.raises(ToolkitError, match=named):
            wrong()


def test_only_the_pairs_asked_for_are_evaluated(scene):
    everything = evaluate_scene(*scene, None).recall
    wanted = everything[["map_device", "query_device"]].iloc[:1].to_numpy().tolist()
    some = evaluate_scene(*scene, None, pairs=wanted).recall
    assert some[["map_device", "query_device"]].to_numpy().tolist() == wanted


def test_overlap_is_judged_by_the_maps_that_the_poses_were_found_with(scene, tmp_path):
    _, poses, _ = scene
    index = np.zeros(1, np.int64)
    local_map = LocalMap(
        ["ios_map/raw_data/0.jpg"], [CAMERA_MODEL], pose()[None], np.array([[0, 0, 3.0]]), np.zeros((1, 3), np.uint8),
        index, index, index, np.ones(1, np.float32),
    )  # fmt: skip
    local_map.save(tmp_path / "ios_map-superpoint.npz")
    replace(local_map, points=np.array([[0, 0, -3.0]])).save(tmp_path / "ios_map.npz")
    write_queries(poses / f"TINY_{IOS}.h5", {}, ["ios_map-superpoint.npz"])
    (row,) = evaluate_ios(scene, map_dir=tmp_path).overlap.to_dict("records")
    assert [row["points"], row["images"]] == ["map", 4]
    assert row["retrieved"] == 0.25  # the point lies before the first query's camera; the others stand 10 m aside


def test_overlap_is_not_that_of_an_earlier_retrieval_nor_of_unknown_cameras(scene):
    lines = (scene[2] / f"TINY_{IOS}.jsonl").read_text()
    (scene[2] / f"TINY_{IOS}.jsonl").write_text(lines.replace('{"rank"', '{"sensor_id": "gone", "rank"'))
    state = evaluate_ios(scene).overlap["state"].item()
    assert state == f"TINY_{IOS}.jsonl of the retrieved cannot be read (CaptureError)"
    (scene[2] / f"TINY_{IOS}.left_out.json").write_text('{"reason": "a dragon"}')
    overlap = evaluate_ios(scene).overlap
    assert overlap["state"].item() == "left out: a dragon"
    assert overlap["images"].isna().all()


@pytest.mark.slow
def test_an_unusable_session_or_pair_is_a_row_with_the_reason(scene, tmp_path):
    sessions, poses, references = scene
    (sessions / "hl_query" / "images.txt").write_text("a line\n")
    (poses / "TINY_map_hl_query_ios.left_out.json").write_text('{"reason": "a dragon"}')
    result = evaluate_scene(sessions, poses, references, tmp_path / "out")
    state = result.recall.set_index(["map_device", "query_device"])["state"]
    assert state["ios", "ios"] == "evaluated"
    assert state["hl", "ios"] == "left out: a dragon"
    assert "hl_query/images.txt, line 1" in state["ios", "hl"]
    reasons = result.pairs.set_index(["map_device", "query_device"])["reason"]
    assert reasons["ios", "ios"] == ""
    assert reasons["hl", "ios"] == "a dragon"
    with pytest.raises(CaptureError):
        evaluate_scene(sessions, poses, references, None, query_device="hl")
