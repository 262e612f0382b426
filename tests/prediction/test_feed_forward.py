"""Localizing by predicted cameras, on a rendered capture, with a predictor that knows the truth and blurs it."""

import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from tests.rendered import LIST, LOW, World, run_stage
from toolkit import geometry
from toolkit.capture import Capture, Trajectory
from toolkit.errors import ImageError, ManifestError, WeightsError
from toolkit.figures.prediction import draw_prediction
from toolkit.figures.style import save_figure
from toolkit.files import SceneFiles
from toolkit.localize import COLUMNS, PREDICTION_COLUMNS
from toolkit.pose.base import Query, QueryInput, QueryResult, References, View
from toolkit.prediction.feed_forward import (
    MAX_DEPTH_POINTS,
    FeedForwardAnswer,
    FeedForwardLocalizer,
    QueryPrediction,
)
from toolkit.prediction.interface import Prediction
from toolkit.prediction.network import SimulatedPredictor, _warn_of_simulation
from toolkit.store.items import Items

Floats = NDArray[np.float64]


def answers_of(localizer: FeedForwardLocalizer, queries: Sequence[QueryInput]) -> list[FeedForwardAnswer]:
    """Return the answers for queries that the network predicts in one call."""
    predicted = localizer.predict(queries)
    return [localizer.answer(*query, one) for query, one in zip(queries, predicted, strict=True)]


def errors(answers: Sequence[FeedForwardAnswer], true: Floats) -> tuple[Floats, Floats]:
    poses = [answer.estimate.world_from_rig for answer in answers]
    assert all(pose is not None for pose in poses), [answer.estimate.status for answer in answers]
    return geometry.pose_error(np.stack(poses), true)  # type: ignore[arg-type]


# --------------------------------------------------------------------------------------------------- the poses


@pytest.mark.parametrize("device", ["ios", "hl", "spot"])
def test_poses_are_metric_and_right(world: World, device: str) -> None:
    queries, true = world.queries(device)
    answers = answers_of(world.localizer(world.predictor(**LOW)), queries)
    rotation_deg, distance_m = errors(answers, true)
    assert (rotation_deg < 1).all()
    assert (distance_m < 0.1).all()
    assert all(answer.estimate.status == "ok" for answer in answers)
    for answer in answers:
        assert np.linalg.eigvalsh(answer.estimate.covariance).min() > 0
        assert answer.estimate.scale_std < 0.1
        assert answer.estimate.found_by == "feed_forward"


def test_the_covariance_is_that_of_the_rig(world: World) -> None:
    """A rig whose origin is 10 m from its camera turns about it: its place is as uncertain as that arm is long."""
    ((query, references), *_), _ = world.queries("ios")
    localizer = world.localizer(world.predictor(**LOW))
    (near,) = answers_of(localizer, [(query, references)])
    rig_from_cam = geometry.make_pose(np.eye(3), [10.0, 0.0, 0.0])[None]
    (far,) = answers_of(localizer, [(replace(query, rig_from_cams=rig_from_cam), references)])
    np.testing.assert_allclose(far.estimate.world_from_rig @ rig_from_cam[0], near.estimate.world_from_rig, atol=1e-9)
    assert np.isclose(far.estimate.rotation_std_deg, near.estimate.rotation_std_deg)
    arm_m = 10 * np.radians(near.estimate.rotation_std_deg) * np.sqrt(2 / 3)
    assert abs(far.estimate.position_std / np.hypot(arm_m, near.estimate.position_std) - 1) < 0.2


class Refocused(SimulatedPredictor):
    """Predicts focal lengths that are off by factors."""

    focal_factors = (1.0, 1.0)
    """Of the query's focal length, and of the references'."""

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        found = []
        for group, prediction in zip(groups, super().predict(groups), strict=True):
            K = np.stack([view.camera.calibration_matrix() for view in group])
            K[:, [0, 1], [0, 1]] *= np.where(np.arange(len(group)) == 0, *self.focal_factors)[:, None]
            found.append(replace(prediction, intrinsics=K))
        return found


@pytest.mark.parametrize(("factors", "sees"), [((1.3, 1.0), 1.3), ((1.3, 1.3), None), ((1.1, 1.0), None)])
def test_a_network_sees_a_wrong_camera(world: World, factors: tuple[float, float], sees: float | None) -> None:
    """One that errs alike of all photographs, or by 10 %, tells nothing."""
    queries, _ = world.queries("ios")
    predictor = Refocused(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.focal_factors = factors
    for (query, _), answer in zip(queries, answers_of(world.localizer(predictor), queries), strict=True):
        estimate, focal_px = answer.estimate, query.views[0].camera.mean_focal_length()
        assert estimate.status_text == ("ok" if sees is None else "low_confidence: camera?")
        assert estimate.focals_px == (() if sees is None else (pytest.approx(sees * focal_px),))
        assert ("sees a focal length" in estimate.remark) == (sees is not None)


def test_wrong_references_are_left_out(world: World) -> None:
    right, rejected, wrong = 0, 0, 0
    for seed in range(3):
        predictor = world.predictor(**LOW, wrong_references=0.25, seed=seed)
        queries, true = world.queries("ios")
        answers = answers_of(world.localizer(predictor, num_references=8), queries)
        rotation_deg, distance_m = errors(answers, true)
        right += int(((rotation_deg < 1) & (distance_m < 0.1)).sum())
        for answer, found in zip(answers, zip(rotation_deg, distance_m, strict=True), strict=True):
            rejected += len(answer.estimate.rejected)
            assert not set(answer.estimate.rejected) & set(answer.estimate.references)
            wrong += answer.estimate.status == "ok" and (found[0] > 5 or found[1] > 0.5)
            if answer.estimate.rejected:
                assert "contradict" in answer.estimate.remark
    assert right >= 7
    assert rejected >= 9
    assert wrong == 0


class Coincident:
    """Wraps a predictor: without depth, and as if all references stood at one place."""

    name, simulated = "coincident", True

    def __init__(self, base: SimulatedPredictor) -> None:
        self.base = base
        self.settings: dict[str, object] = {}

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        found = []
        for prediction in self.base.predict(groups):
            poses = prediction.model_from_cams.copy()
            poses[1:, :3, 3] = poses[1, :3, 3]
            found.append(Prediction(poses))
        return found


def test_an_unknown_scale_is_never_ok(world: World) -> None:
    """References at one place and no depth: the rotation is still right, the place near a reference."""
    places = world.map.world_from_cams.copy()
    places[:, :3, 3] = places[0, :3, 3]
    localizer = world.localizer(Coincident(world.predictor(**LOW)))
    localizer.map = replace(world.map, world_from_cams=places)
    for device in ("ios", "spot"):
        queries, true = world.queries(device)
        answers = answers_of(localizer, queries)
        rotation_deg, _ = errors(answers, true)
        for answer, error in zip(answers, rotation_deg, strict=True):
            assert answer.estimate.status == "low_confidence"
            assert np.isinf(answer.estimate.scale_std)
            assert np.isinf(answer.estimate.position_std)
            assert error < 3
            assert np.linalg.norm(answer.estimate.world_from_rig[:3, 3] - places[0, :3, 3]) < 2
        assert answers[0].estimate.remark


def test_depth_of_the_map_gives_the_scale_that_baselines_do_not(world: World) -> None:
    query, (references,) = world.queries("ios")[0][0]
    best = References(references.images[:1], references.scores[:1])
    without, with_depth = (
        answers_of(world.localizer(world.predictor(depth, **LOW)), [(query, [best])])[0] for depth in (False, True)
    )
    assert np.isinf(without.estimate.scale_std)
    assert with_depth.estimate.scale_std < 0.1
    assert with_depth.estimate.status == "low_confidence", "nothing confirms a single reference"


def test_depth_maps_stand_in_for_points(world: World) -> None:
    """An image of the map that sees no triangulated point has a depth map."""
    localizer = world.localizer(world.predictor(**LOW))
    triangulated = localizer._points(0)
    empty = replace(world.map, obs_image=np.zeros(0, np.int64), obs_keypoint=np.zeros(0, np.int64),
                    obs_point=np.zeros(0, np.int64))  # fmt: skip
    localizer.map = empty
    points = localizer._points(0)
    assert len(points) == MAX_DEPTH_POINTS
    in_cam = [geometry.transform(world.map.cams_from_world[0], p) for p in (points, triangulated)]
    pixels = [np.asarray(world.map.cameras[0].img_from_cam(p)) for p in in_cam]
    near = np.linalg.norm(pixels[0][:, None] - pixels[1][None], axis=2).argmin(axis=0)
    ratio = in_cam[0][near, 2] / in_cam[1][:, 2]
    assert np.median(np.abs(ratio - 1)) < 0.1, "both lie on what the camera sees"
    queries, true = world.queries("ios")
    answers = answers_of(localizer, queries)
    assert (errors(answers, true)[1] < 0.15).all()
    assert all(answer.estimate.scale_std < 0.1 for answer in answers)


@pytest.mark.slow
def test_a_rig_knows_better_than_its_cameras(world: World) -> None:
    together, alone = [], []
    for seed in range(4):
        localizer = world.localizer(world.predictor(seed=seed))
        queries, true = world.queries("spot")
        together += errors(answers_of(localizer, queries), true)[1].tolist()
        for camera in range(len(queries[0][0].views)):
            single = [
                (Query([query.views[camera]], query.rig_from_cams[camera][None]), [references[camera]])
                for query, references in queries
            ]
            alone += errors(answers_of(localizer, single), true)[1].tolist()
    assert np.median(together) < 0.9 * np.median(alone)


# ---------------------------------------------------------------------------------------------- what goes wrong


class Failing(SimulatedPredictor):
    """Raises, or returns what is no number, for groups with a query image of some name."""

    bad = ""
    how = "raise"

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        found = super().predict(groups)
        for index, group in enumerate(groups):
            if self.bad and self.bad in group[0].name:
                if self.how == "raise":
                    raise RuntimeError("out of luck")
                poses = found[index].model_from_cams.copy()
                if self.how in ("too few", "no numbers"):
                    odd: Any = poses[:-1] if self.how == "too few" else "x"
                    found[index] = replace(found[index], model_from_cams=odd)
                    continue
                poses[0 if self.how == "query" else slice(None)] = np.nan
                if self.how == "references":
                    poses[0] = np.eye(4)
                found[index] = replace(found[index], model_from_cams=poses)
        return found


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("raise", "failed: internal: RuntimeError: out of luck"),
        ("query", "failed: the predicted camera is not finite"),
        ("references", "failed: references 0, 1, 2, 3, 4 left out: not finite; no usable reference"),
        ("too few", "failed: AlignmentError: Found 4 model_from_cams and 5 world_from_cams: expected equal numbers"),
        ("no numbers", "failed: internal: ValueError: could not convert string to float: 'x'"),
    ],
)
def test_one_bad_query_is_a_failed_answer_and_the_others_go_on(world: World, how: str, reason: str) -> None:
    queries, _ = world.queries("ios")
    good = answers_of(world.localizer(world.predictor(**LOW)), queries)
    predictor = Failing(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.bad, predictor.how = queries[1][0].views[0].name, how
    answers = answers_of(world.localizer(predictor), queries)
    assert answers[1].estimate.status_text == reason
    assert answers[1].estimate.world_from_rig is None
    for index in (0, 2):
        np.testing.assert_array_equal(answers[index].estimate.world_from_rig, good[index].estimate.world_from_rig)


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("CUDA error: no kernel image is available for execution on the device"),
        RuntimeError("cuDNN error: CUDNN_STATUS_NOT_INITIALIZED"),
        RuntimeError("GET was unable to find an engine to execute this computation"),
        TypeError("Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64."),
        MemoryError(),
        OSError(5, "disk"),
    ],
)
def test_what_a_device_refuses_is_no_answer_to_a_query(
    world: World, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> list[Prediction]:
        raise error

    monkeypatch.setattr(SimulatedPredictor, "predict", refuse)
    queries, _ = world.queries("ios")
    with pytest.raises(type(error)):
        answers_of(world.localizer(world.predictor(**LOW)), queries)


def test_threads_that_localize_ask_the_network_one_after_the_other(world: World) -> None:
    queries, _ = world.queries("ios")
    running: list[int] = []
    together: list[int] = []

    class Slow(SimulatedPredictor):
        def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
            running.append(1)
            time.sleep(0.02)
            together.append(len(running))
            running.pop()
            return super().predict(groups)

    localizer = world.localizer(Slow(world.sessions, None))
    with ThreadPoolExecutor(len(queries)) as pool:
        list(pool.map(lambda query: localizer.localize(*query), queries))
    assert together == [1] * len(queries)


def test_a_rig_goes_on_without_a_camera_that_fails(world: World) -> None:
    queries, true = world.queries("spot")
    predictor = Failing(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.bad = queries[0][0].views[0].name
    (answer,) = answers_of(world.localizer(predictor), queries[:1])
    assert geometry.pose_error(answer.estimate.world_from_rig, true[0])[1] < 0.1
    assert "RuntimeError: out of luck" in answer.estimate.remark


def test_without_references_there_is_no_pose(world: World) -> None:
    ((query, _), *_), _ = world.queries("ios")
    (answer,) = answers_of(world.localizer(world.predictor()), [(query, [References.of([])])])
    assert answer.estimate.status_text == "failed: no references"
    assert world.localizer(world.predictor()).predict([]) == []


# --------------------------------------------------------------------------------------------------- the stage


def table_of(files: SceneFiles, query: str) -> str:
    return pd.read_csv(files.poses_csv("ios", query)).drop(columns="seconds").to_csv()


def test_rows_say_that_they_are_simulated(finished: SceneFiles, small_capture: Path) -> None:
    for device in ("ios", "hl", "spot"):
        found = pd.read_csv(finished.poses_csv("ios", device))
        assert list(found.columns) == [*COLUMNS, *PREDICTION_COLUMNS]
        assert found["method"].isin(["feed_forward:simulated/feed_forward", "feed_forward:simulated"]).all()
        session = Capture.open(small_capture)[f"{device}_query"]
        assert len(found) == len(session.keyframes(LIST))
        estimated = Trajectory.read(finished.poses_txt("ios", device))
        true = session.ground_truth.lookup(estimated.timestamps, estimated.device_ids)
        ok = found[found["status"] == "ok"]["timestamp"]
        _, distance_m = geometry.pose_error(estimated.world_from_device, true)
        assert (distance_m[np.isin(estimated.timestamps, ok)] < 0.5).all()
    assert len(ok)


def test_the_log_says_that_it_is_simulated(
    run: SceneFiles, small_capture: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _warn_of_simulation.cache_clear()
    with caplog.at_level(logging.WARNING):
        run_stage(small_capture, run, query_device="ios")
        run_stage(small_capture, run, query_device="ios", skip_existing=False)
    assert caplog.text.count("simulated looks up the true poses") == 1


@pytest.mark.parametrize("method", ["feed_forward", "hybrid"])
def test_the_network_is_never_replaced_by_the_simulation(
    run: SceneFiles, small_capture: Path, method: str, no_hub: None
) -> None:
    for given, named in (
        ({}, r"(?s)VGGT-1B.*localize\.predictor\.checkpoint.*localize\.method: pnp"),
        ({"checkpoint": "nowhere.pt"}, r"nowhere\.pt"),
    ):
        with pytest.raises(WeightsError, match=named):
            run_stage(small_capture, run, method=method, predictor={"name": "vggt"} | given)
    assert not run.poses_dir.exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"predictor": {"name": "magic"}}, r"predictor\.name.*magic"),
        ({"predictor": {"num_references": 0}}, r"predictor\.num_references.*0"),
        ({"predictor": {"batch_size": 0}}, r"predictor\.batch_size.*0"),
        ({"predictor": {"name": "vggt"}, "compute_device": "tpu"}, r"compute_device.*tpu"),
        ({"predictor": {"name": "vggt"}, "dtype_compute": "int8"}, r"dtype_compute.*int8"),
    ],
)
def test_wrong_parameters_are_refused(run: SceneFiles, small_capture: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ManifestError, match=message):
        run_stage(small_capture, run, **wrong)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "more"),
    [
        ("feed_forward", {"predictor": {"batch_size": 1}}),
        ("hybrid", {"predictor": {"batch_size": 3}, "workers": 2}),
    ],
)
def test_rows_do_not_depend_on_batches_threads_or_being_killed(
    run: SceneFiles, small_capture: Path, monkeypatch: pytest.MonkeyPatch, method: str, more: dict
) -> None:
    run_stage(small_capture, run, method=method, query_device="spot")
    expected = table_of(run, "spot"), run.poses_txt("ios", "spot").read_bytes()
    asked: list[int] = []
    predict = SimulatedPredictor.predict

    def killed(self: SimulatedPredictor, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        asked.append(len(groups))
        if len(asked) == 2:
            raise KeyboardInterrupt
        return predict(self, groups)

    anew = {"method": method, "query_device": "spot", "skip_existing": False}
    with monkeypatch.context() as patch:
        patch.setattr(SimulatedPredictor, "predict", killed)
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, {"batch_size": 2}, **anew)
    table = run_stage(small_capture, run, **anew, **more)
    assert not table["skipped"].any()
    assert (table_of(run, "spot"), run.poses_txt("ios", "spot").read_bytes()) == expected


def test_a_killed_run_goes_on_where_it_was(
    run: SceneFiles, finished: SceneFiles, small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    predict, row = FeedForwardLocalizer.predict, QueryResult.to_row
    rows: list[object] = []

    def killed(*args: object) -> dict:
        rows.append(args)
        if len(rows) == 3:
            raise KeyboardInterrupt
        return row(*args)  # type: ignore[arg-type]

    def counted(self: FeedForwardLocalizer, queries: Sequence[QueryInput]) -> list[QueryPrediction]:
        asked.extend(query.views[0].name for query, _ in queries)
        return predict(self, queries)

    with monkeypatch.context() as patch:
        patch.setattr(QueryResult, "to_row", killed)
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios", predictor={"batch_size": 1})
    assert not run.poses_txt("ios", "ios").exists()
    assert len(Items(run.poses_txt("ios", "ios").with_suffix(".items"))) == 2
    monkeypatch.setattr(FeedForwardLocalizer, "predict", counted)
    table = run_stage(small_capture, run, query_device="ios")
    assert len(asked) == table["queries"].iloc[0] - 2
    assert table_of(run, "ios") == table_of(finished, "ios")
    assert run.poses_txt("ios", "ios").read_bytes() == finished.poses_txt("ios", "ios").read_bytes()


@pytest.mark.slow
def test_other_noise_references_or_weights_make_poses_anew(run: SceneFiles, small_capture: Path) -> None:
    def skipped(**more: object) -> bool:
        return bool(run_stage(small_capture, run, query_device="ios", **more)["skipped"].iloc[0])

    assert not skipped()
    assert skipped(predictor={"batch_size": 1}, workers=2)
    assert not skipped(predictor={"num_references": 3})
    assert not skipped(seed=1)
    assert not skipped(method="hybrid")


@pytest.mark.slow
def test_a_prediction_is_drawn_and_labeled(world: World, tmp_path: Path) -> None:
    queries, _ = world.queries("spot")
    localizer = world.localizer(world.predictor(wrong_references=0.3, seed=2))
    (answer,) = answers_of(localizer, queries[:1])
    figure = draw_prediction(localizer, queries[0][0], answer)
    assert save_figure(figure, tmp_path / "prediction.png").stat().st_size > 20_000
    assert figure.get_suptitle().startswith("SIMULATED, no result")
    localizer.unit = "L", 0.5
    in_lengths = draw_prediction(localizer, queries[0][0], answer)
    assert [figure.axes[0].get_xlabel()[-3:], in_lengths.axes[0].get_xlabel()[-3:]] == ["[m]", "[L]"]
    depths = [[axis.get_title() for axis in one.axes if "depth" in axis.get_title()] for one in (figure, in_lengths)]
    assert depths[0][0].endswith(" m")
    assert depths[1][0].endswith(" L")
    np.testing.assert_allclose(float(depths[1][0].split()[1]), 2 * float(depths[0][0].split()[1]), atol=0.2)
    failed = FeedForwardAnswer(QueryResult.failed("no references"), ())
    assert "failed: no references" in draw_prediction(localizer, queries[0][0], failed).get_suptitle()
    undecided = replace(answer.cameras[0], reason="undecided")
    failed = FeedForwardAnswer(QueryResult.failed("undecided"), (undecided,))
    assert draw_prediction(localizer, queries[0][0], failed).get_suptitle().count("undecided") == 1


class Refuses:
    """A predictor that cannot predict."""

    name, simulated = "vggt", False
    settings: ClassVar[dict[str, str]] = {}

    def __init__(self, error: Exception) -> None:
        self.error = error

    def predict(self, groups: Sequence[Sequence[View]]) -> list[Prediction]:
        raise self.error


def test_wrong_weights_end_the_run_and_a_bad_image_does_not(world: World) -> None:
    queries, _ = world.queries("ios")
    with pytest.raises(WeightsError):
        world.localizer(Refuses(WeightsError("of another network"))).predict(queries)
    answers = answers_of(world.localizer(Refuses(ImageError("torn.jpg"))), queries)
    assert {answer.estimate.status_text for answer in answers} == {"failed: ImageError: torn.jpg"}
