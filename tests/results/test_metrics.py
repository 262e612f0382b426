from types import SimpleNamespace

import numpy as np
import pandas as pd

from toolkit.pose.base import split_status
from toolkit.results.metrics import camera_messages, parse_threshold, threshold_name, worst_first, worst_of_each


def test_without_truth_failed_and_weak_queries_come_first():
    """A sheet of 18 phone pictures once began with the query of the most inliers and left out the weakest."""
    queries = split_status(pd.DataFrame({
        "status": ["ok", "ok", "low_confidence: camera?", "failed: too few inliers", "ok", "low_confidence"],
        "num_inliers": [593, 20, 30, np.nan, 20, 12],
        "position_std_m": [0.01, 0.02, 0.5, np.nan, 0.3, 0.1],
    }))  # fmt: skip
    assert worst_first(queries).tolist() == [3, 5, 2, 4, 1, 0]
    nothing = np.full(6, np.nan)
    unknown = queries.assign(rotation_error_deg=nothing, translation_error_m=nothing)
    assert worst_first(unknown).tolist() == [3, 5, 2, 4, 1, 0]


def test_with_truth_the_larger_error_in_units_of_the_threshold_decides():
    queries = split_status(pd.DataFrame({
        "status": ["ok", "low_confidence: camera?", "failed", "ok"],
        "num_inliers": [9, 8, 0, 500],
        "rotation_error_deg": [2.0, 0.1, np.inf, 0.1],
        "translation_error_m": [0.01, 0.15, np.inf, 0.4],
    }))  # fmt: skip
    assert worst_first(queries, (1, 0.1)).tolist() == [2, 3, 0, 1]
    assert worst_first(queries, (0.1, 10)).tolist() == [2, 0, 1, 3]
    assert not len(worst_first(queries.iloc[:0]))


def test_names_of_thresholds_are_read_back():
    assert parse_threshold(f"recall@{threshold_name((5, 0.5))}") == (5, 0.5)


def test_a_camera_that_does_not_fit_most_of_its_queries_is_named_once():
    """A phone with a camera for each picture, and a rig of which one camera is off in one of three answers."""
    names = ["phone/cam_630003697552", "phone/cam_630007005828", "rig/left", "rig/right", "rig/left", "rig/right"]
    stated = {"phone/cam_630003697552": 500.0, "phone/cam_630007005828": 510.0, "rig/left": 400.0, "rig/right": 400.0}
    session = SimpleNamespace(
        id="ios_query",
        images=pd.DataFrame({"sensor_id": names}),
        camera=lambda name: SimpleNamespace(
            mean_focal_length=lambda: stated[name], principal_point_x=320.0, principal_point_y=240.0
        ),
        rows_of_keyframes=lambda table: [np.array(rows) for rows in ([0], [1], [2, 3], [4, 5])][: len(table)],
    )
    doubted = "low_confidence: camera?"
    first = split_status(pd.DataFrame({
        "status": [doubted, doubted, doubted, doubted], "focal_px": ["450.0", "459.0", "361.0;440.0", "359.0;"],
    }))  # fmt: skip
    rest = pd.DataFrame({"status": ["ok", "failed: no match", "ok", "ok"], "focal_px": np.full(4, np.nan)})
    second = split_status(rest)
    messages = camera_messages(session, [first, second])  # type: ignore[arg-type]
    assert [message.split(":")[0] for message in messages] == ["camera phone/cam", "camera rig/left"]
    assert "0.900 times those in ios_query/sensors.txt (median of 2 poses)" in messages[0]
    assert "360 px (median of 2 poses), ios_query/sensors.txt says 400 px" in messages[1]
    centers = pd.DataFrame({"status": [doubted, doubted], "principal_point_px": ["300.0 260.0", "310.0 250.0"]})
    (message,) = camera_messages(session, [split_status(centers)])  # type: ignore[arg-type]
    assert message.startswith("camera phone/cam: the principal point that fits is 305, 255 px (median of 2 poses)")
    assert "says 320, 240. Correct it" in message
    assert camera_messages(session, [second.drop(columns="focal_px")]) == []  # type: ignore[arg-type]
    # One image tells only if its pose is sure but for the camera, also if it is unsure in two maps.
    for sure, said in ((0.978, 0), (1.0, 1)):
        alone = pd.DataFrame({"status": [doubted], "focal_px": ["4292.0"], "p_correct": [sure]})
        assert len(camera_messages(session, [split_status(alone)] * 2)) == said  # type: ignore[arg-type]
    contradicted = "low_confidence: the poses of the map contradict its images"
    # A doubt for another reason, such as the map's poses, names no focal length, be the column of numbers or texts.
    for focals_px in ([np.nan] * 4, [np.nan, "450.0", "", "361.0;"], [np.nan, 450.0, 450.0, np.nan]):
        other = pd.DataFrame({"status": [contradicted, "ok", "ok", "ok"], "focal_px": focals_px})
        assert camera_messages(session, [split_status(other)]) == []  # type: ignore[arg-type]


def test_the_worst_are_different_queries() -> None:
    """A torn image was three of the ten worst of a run with three maps."""
    queries = pd.DataFrame({
        "map_device": ["a", "b", "a", "b"], "query_device": "q", "device_id": "c", "timestamp": [1, 1, 2, 2],
        "status": ["ok", "failed", "ok", "ok"], "rotation_error_deg": [0.0, np.inf, 1.0, 3.0],
        "translation_error_m": [0.0, np.inf, 0.0, 0.0],
    })  # fmt: skip
    assert worst_of_each(queries, 10).tolist() == [1, 3]
    assert worst_of_each(queries, 1).tolist() == [1]
