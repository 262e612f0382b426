"""Localizing by predicted cameras, on a rendered capture, with a predictor that knows the truth and blurs it."""

import json
import logging
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from tests.calls import call
from toolkit import geometry
from toolkit import localize as localize_stage
from toolkit.capture import Capture, Session, Trajectory
from toolkit.errors import CaptureError, ImageError, ManifestError, WeightsError
from toolkit.features.matching import MutualMatcher
from toolkit.features.stores import extract_session
from toolkit.files import SceneFiles
from toolkit.localize import COLUMNS, PREDICTION_COLUMNS, localize_pairs
from toolkit.localizers.hybrid import HybridLocalizer
from toolkit.localizers.mapped import MappedFeatures
from toolkit.localizers.mapping import LocalMap
from toolkit.localizers.pnp import PnpLocalizer, PoseEstimate, Prior
from toolkit.localizers.prediction import Prediction, View
from toolkit.localizers.predictors import create_predictor
from toolkit.localizers.simulated import SimulatedPredictor
from toolkit.localizers.vggt import VggtAnswer, VggtLocalizer, VggtQuery
from toolkit.manifest import PredictorSettings
from toolkit.show.visualize_prediction import draw_prediction

Floats = NDArray[np.float64]
LIST = "keyframes_original"
LOW = {"rotation_noise_deg": 0.2, "position_noise_m": 0.01, "depth_noise": 0.02}


class World:
    """A rendered capture with a triangulated phone map, and its queries."""

    def __init__(self, capture: Path, files: SceneFiles) -> None:
        self.files = files
        self.capture = Capture.open(capture)
        self.sessions = [self.capture[name] for name in self.capture.session_ids]
        self.map_session = self.capture["ios_map"]
        self.map = LocalMap.load(files.maps / "ios_map.npz")

    def predictor(self, depth: bool = True, **noise: float) -> SimulatedPredictor:
        return SimulatedPredictor(self.sessions, self.files.maps if depth else None, **noise)  # type: ignore[arg-type]

    def localizer(self, predictor: object, **settings: int) -> VggtLocalizer:
        return VggtLocalizer(self.map, self.map_session, predictor, PredictorSettings(**settings))  # type: ignore[arg-type]

    def queries(self, device: str, count: int = 10) -> tuple[list[VggtQuery], Floats]:
        """Return the queries of a device with the map images that stand and look most alike, and their true poses."""
        session = self.capture[f"{device}_query"]
        keyframes = session.keyframes(LIST)
        queries = [self.query(session, rows, count) for rows in session.rows_of_keyframes(keyframes)]
        return queries, session.ground_truth.lookup(keyframes["timestamp"], keyframes["device_id"])

    def query(self, session: Session, rows: NDArray[np.int64], count: int) -> VggtQuery:
        references, scores = [], []
        for pose in session.world_from_cam(rows, ground_truth=True):
            score = likeness(self.map.world_from_cams, pose)
            best = np.argsort(-score, kind="stable")[:count]
            references.append(best)
            scores.append(score[best])
        sensors = session.images["sensor_id"].to_numpy()
        views = [
            View(session.image_name(int(row)), session.image_path(int(row)), session.camera(str(sensors[row])), False)
            for row in rows
        ]
        return VggtQuery(views, session.rig_from_cam(rows), references, scores)


def run_stage(capture: Path, files: SceneFiles, **more: object) -> pd.DataFrame:
    options = {"map_device": "ios", "queries": LIST, "workers": 1, "predictor": "simulated", "method": "vggt"} | more
    folders = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    return call(localize_pairs, capture / "sessions", *folders, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def finished(small_capture: Path, small_features: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    """A run that has localized all devices in the phone's map by predictions; do not write to it."""
    files = SceneFiles(tmp_path_factory.mktemp("vggt"), small_capture.name)
    shutil.copytree(small_features, files.features)
    capture = Capture.open(small_capture)
    for device in capture.devices:
        write_retrieval(files.retrieval("ios", device), capture["ios_map"], capture[f"{device}_query"])
    run_stage(small_capture, files)
    return files


def write_retrieval(path: Path, mapped: Session, session: Session) -> None:
    """Write what the retrieve stage would: for each query image the map images that stand and look most alike."""
    lines = []
    for row, pose in enumerate(session.world_from_cam(ground_truth=True)):
        score = likeness(mapped.world_from_cam(), pose)
        topk = [
            {"path": f"SMALL/sessions/{mapped.image_name(int(k))}", "score": float(score[k])}
            for k in np.argsort(-score, kind="stable")[:10]
        ]
        image = session.images.iloc[row]
        lines.append({"timestamp": str(image["timestamp"]), "sensor_id": image["sensor_id"], "topk": topk})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))


def likeness(world_from_cams: Floats, world_from_query: Floats) -> Floats:
    rotation_deg, distance_m = geometry.pose_error(world_from_cams, world_from_query[None])
    return np.asarray(-rotation_deg / 20 - distance_m)


@pytest.fixture(scope="module")
def world(small_capture: Path, finished: SceneFiles) -> World:
    return World(small_capture, finished)


@pytest.fixture
def run(finished: SceneFiles, tmp_path: Path) -> SceneFiles:
    """A copy of the run without its poses, to work in."""
    files = SceneFiles(tmp_path / "run", finished.scene)
    shutil.copytree(finished.root, files.root)
    shutil.rmtree(files.poses_dir)
    return files


def errors(answers: Sequence[VggtAnswer], true: Floats) -> tuple[Floats, Floats]:
    poses = [answer.estimate.world_from_rig for answer in answers]
    assert all(pose is not None for pose in poses), [answer.estimate.status for answer in answers]
    return geometry.pose_error(np.stack(poses), true)  # type: ignore[arg-type]


# ---------------------------------------------------------------------------------------------- the prediction


def test_depth_is_read_where_the_photograph_has_it() -> None:
    depth = np.arange(12, dtype=np.float32).reshape(1, 3, 4) + 1
    # Half the size, cut by 10 pixels at the top.
    prediction = Prediction(np.eye(4)[None], depth, map_from_image=np.array([[0.5, 0.5, 0.0, -10.0]]))
    xy = [[1, 21], [3, 21], [2, 21], [7, 25], [4, 23], [9, 21], [1, 19], [np.nan, 21]]
    np.testing.assert_allclose(prediction.depth_at(0, xy), [1, 2, 1.5, 12, 6.5, np.nan, np.nan, np.nan])


def test_depth_next_to_unknown_or_unsure_depth_is_unknown() -> None:
    depth = np.full((1, 4, 5), 2.0, np.float32)
    depth[0, 0, 0], depth[0, 0, 4] = np.nan, 0.0
    confidence = np.full((1, 4, 5), 3.0, np.float32)
    whole = np.array([[1.0, 1.0, 0.0, 0.0]])
    sure = Prediction(np.eye(4)[None], depth, confidence, whole)
    np.testing.assert_array_equal(sure.depth_at(0, [[1, 1], [4, 1], [2.5, 2.5]]), [np.nan, np.nan, 2])
    confidence[0, 3] = 1.0  # a quarter of the pixels
    confidence[0, 3, 4] = 0.9
    unsure = Prediction(np.eye(4)[None], depth, confidence, whole).depth_at(0, [[4.5, 3.5], [2.5, 2.5]])
    np.testing.assert_array_equal(unsure, [np.nan, 2])


def test_no_depth_is_unknown_depth() -> None:
    assert np.isnan(Prediction(np.eye(4)[None]).depth_at(0, [[1, 1], [2, 2]])).all()


# ------------------------------------------------------------------------------------- the simulated predictor


def group_of(world: World, device: str = "ios", index: int = 0) -> list[View]:
    query = world.queries(device)[0][index]
    localizer = world.localizer(world.predictor())
    return [query.views[0], *(localizer.view(int(i)) for i in query.references[0][:4])]


def test_a_simulation_depends_on_seed_and_names_alone(world: World) -> None:
    group, other = group_of(world), group_of(world, "spot")
    first = world.predictor().predict([group, other])
    again = world.predictor().predict([other, group[::-1]])
    assert first[0].simulated
    np.testing.assert_array_equal(first[0].model_from_cams, again[1].model_from_cams[::-1])
    np.testing.assert_array_equal(first[0].depth, again[1].depth[::-1])
    np.testing.assert_array_equal(first[1].model_from_cams, again[0].model_from_cams)
    assert not np.allclose(world.predictor(seed=1).predict([group])[0].model_from_cams, first[0].model_from_cams)


def test_without_noise_a_simulation_is_the_truth_under_a_similarity(world: World) -> None:
    group = group_of(world)
    (found,) = world.predictor(rotation_noise_deg=0, position_noise_m=0, depth_noise=0).predict([group])
    poses = {
        session.image_name(row): pose
        for session in world.sessions
        for row, pose in enumerate(session.world_from_cam(ground_truth=True))
    }
    true = np.stack([poses[view.name] for view in group])
    baselines = [np.linalg.norm(p[1:, :3, 3] - p[:1, :3, 3], axis=1) for p in (found.model_from_cams, true)]
    scale = (baselines[0] / baselines[1])[0]
    np.testing.assert_allclose(baselines[0], scale * baselines[1])
    relative = [geometry.invert(p[0]) @ p[1:] for p in (found.model_from_cams, true)]
    np.testing.assert_allclose(relative[0][:, :3, :3], relative[1][:, :3, :3], atol=1e-9)
    # Depth at the map's points is their depth, times the same scale.
    index = world.map.index_of[group[1].name]
    points = world.map.points[np.unique(world.map.observations(index)[1])]
    in_cam = geometry.transform(world.map.cams_from_world[index], points)
    ratio = found.depth_at(1, group[1].camera.img_from_cam(in_cam)) / in_cam[:, 2]
    assert abs(np.nanmedian(ratio) / scale - 1) < 0.02
    assert np.isfinite(ratio).mean() > 0.9
    assert found.depth is not None
    assert np.isfinite(found.depth[0]).all(), "the query has depth too"


def test_a_view_without_a_true_pose_is_refused(world: World) -> None:
    group = group_of(world)
    with pytest.raises(CaptureError, match="no true pose of nobody"):
        world.predictor().predict([[replace(group[0], name="nobody/raw_data/1.jpg"), *group[1:]]])


# --------------------------------------------------------------------------------------------------- the poses


@pytest.mark.parametrize("device", ["ios", "hl", "spot"])
def test_poses_are_metric_and_right(world: World, device: str) -> None:
    queries, true = world.queries(device)
    answers = world.localizer(world.predictor(**LOW)).localize(queries)
    rotation_deg, distance_m = errors(answers, true)
    assert (rotation_deg < 1).all()
    assert (distance_m < 0.1).all()
    assert all(answer.estimate.status == "ok" for answer in answers)
    for answer in answers:
        assert np.linalg.eigvalsh(answer.estimate.covariance).min() > 0
        assert answer.estimate.scale_std < 0.1
        assert answer.estimate.found_by == "vggt"


def test_the_covariance_is_that_of_the_rig(world: World) -> None:
    """A rig whose origin is 10 m from its camera turns about it: its place is as uncertain as that arm is long."""
    (query, *_), _ = world.queries("ios")
    localizer = world.localizer(world.predictor(**LOW))
    (near,) = localizer.localize([query])
    rig_from_cam = geometry.make_pose(np.eye(3), [10.0, 0.0, 0.0])[None]
    (far,) = localizer.localize([replace(query, rig_from_cams=rig_from_cam)])
    np.testing.assert_allclose(
        far.estimate.world_from_rig @ rig_from_cam[0], near.estimate.world_from_rig, atol=1e-9
    )
    assert np.isclose(far.estimate.rotation_std_deg, near.estimate.rotation_std_deg)
    arm_m = 10 * np.radians(near.estimate.rotation_std_deg) * np.sqrt(2 / 3)
    assert abs(far.estimate.position_std_m / np.hypot(arm_m, near.estimate.position_std_m) - 1) < 0.2


def test_wrong_references_are_left_out(world: World) -> None:
    right, rejected, wrong = 0, 0, 0
    for seed in range(3):
        predictor = world.predictor(**LOW, wrong_references=0.25, seed=seed)
        queries, true = world.queries("ios")
        answers = world.localizer(predictor, num_references=8).localize(queries)
        rotation_deg, distance_m = errors(answers, true)
        right += int(((rotation_deg < 1) & (distance_m < 0.1)).sum())
        for answer, found in zip(answers, zip(rotation_deg, distance_m, strict=True), strict=True):
            rejected += len(answer.estimate.rejected)
            assert not set(answer.estimate.rejected) & set(answer.estimate.references)
            wrong += answer.estimate.status == "ok" and (found[0] > 5 or found[1] > 0.5)
            if answer.estimate.rejected:
                assert "contradict" in answer.estimate.reason
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
        answers = localizer.localize(queries)
        rotation_deg, _ = errors(answers, true)
        for answer, error in zip(answers, rotation_deg, strict=True):
            assert answer.estimate.status == "low_confidence"
            assert np.isinf(answer.estimate.scale_std)
            assert np.isinf(answer.estimate.position_std_m)
            assert error < 3
            assert np.linalg.norm(answer.estimate.world_from_rig[:3, 3] - places[0, :3, 3]) < 2
        assert answers[0].estimate.reason


def test_depth_of_the_map_gives_the_scale_that_baselines_do_not(world: World) -> None:
    query = world.queries("ios")[0][0]
    best = query.references[0][:1]
    alone = replace(query, references=[best], scores=[query.scores[0][:1]])
    without, with_depth = (
        world.localizer(world.predictor(depth, **LOW)).localize([alone])[0] for depth in (False, True)
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
    assert len(points) == localizer.settings.depth_points
    in_cam = [geometry.transform(world.map.cams_from_world[0], p) for p in (points, triangulated)]
    pixels = [np.asarray(world.map.cameras[0].img_from_cam(p)) for p in in_cam]
    near = np.linalg.norm(pixels[0][:, None] - pixels[1][None], axis=2).argmin(axis=0)
    ratio = in_cam[0][near, 2] / in_cam[1][:, 2]
    assert np.median(np.abs(ratio - 1)) < 0.1, "both lie on what the camera sees"
    queries, true = world.queries("ios")
    answers = localizer.localize(queries)
    assert (errors(answers, true)[1] < 0.15).all()
    assert all(answer.estimate.scale_std < 0.1 for answer in answers)


def test_a_rig_knows_better_than_its_cameras(world: World) -> None:
    together, alone = [], []
    for seed in range(4):
        localizer = world.localizer(world.predictor(seed=seed))
        queries, true = world.queries("spot")
        together += errors(localizer.localize(queries), true)[1].tolist()
        for camera in range(len(queries[0].views)):
            single = [
                VggtQuery([q.views[camera]], q.rig_from_cams[camera : camera + 1], [q.references[camera]],
                          [q.scores[camera]])
                for q in queries
            ]  # fmt: skip
            alone += errors(localizer.localize(single), true)[1].tolist()
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
                poses[0 if self.how == "query" else slice(None)] = np.nan
                if self.how == "references":
                    poses[0] = np.eye(4)
                found[index] = replace(found[index], model_from_cams=poses)
        return found


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("raise", "failed: RuntimeError: out of luck"),
        ("query", "failed: the predicted camera is not finite"),
        ("references", "failed: references 0, 1, 2, 3, 4 left out: not finite; no usable reference"),
    ],
)
def test_one_bad_query_is_a_failed_answer_and_the_others_go_on(world: World, how: str, reason: str) -> None:
    queries, _ = world.queries("ios")
    good = world.localizer(world.predictor(**LOW)).localize(queries)
    predictor = Failing(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.bad, predictor.how = queries[1].views[0].name, how
    answers = world.localizer(predictor).localize(queries)
    assert answers[1].estimate.status == reason
    assert answers[1].estimate.world_from_rig is None
    for index in (0, 2):
        np.testing.assert_array_equal(answers[index].estimate.world_from_rig, good[index].estimate.world_from_rig)


def test_a_rig_goes_on_without_a_camera_that_fails(world: World) -> None:
    queries, true = world.queries("spot")
    predictor = Failing(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.bad = queries[0].views[0].name
    (answer,) = world.localizer(predictor).localize(queries[:1])
    assert geometry.pose_error(answer.estimate.world_from_rig, true[0])[1] < 0.1
    assert "RuntimeError: out of luck" in answer.estimate.reason


def test_without_references_there_is_no_pose(world: World) -> None:
    (query, *_), _ = world.queries("ios")
    nothing = replace(query, references=[np.zeros(0, np.int64)], scores=[np.zeros(0)])
    (answer,) = world.localizer(world.predictor()).localize([nothing])
    assert answer.estimate.status == "failed: no references"
    assert world.localizer(world.predictor()).localize([]) == []


# --------------------------------------------------------------------------------------------------- the stage


def table_of(files: SceneFiles, query: str) -> str:
    return pd.read_csv(files.poses_csv("ios", query)).drop(columns="seconds").to_csv()


def test_rows_say_that_they_are_simulated(finished: SceneFiles, small_capture: Path) -> None:
    for device in ("ios", "hl", "spot"):
        found = pd.read_csv(finished.poses_csv("ios", device))
        assert list(found.columns) == [*COLUMNS, *PREDICTION_COLUMNS]
        assert found["method"].isin(["vggt:simulated/vggt", "vggt:simulated"]).all()
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
    with caplog.at_level(logging.WARNING):
        run_stage(small_capture, run, query_device="ios")
    assert "simulated looks up the true poses" in caplog.text


@pytest.mark.parametrize("method", ["vggt", "hybrid"])
def test_the_network_is_never_replaced_by_the_simulation(
    run: SceneFiles, small_capture: Path, method: str, no_hub: None
) -> None:
    with pytest.raises(WeightsError, match=r"(?s)VGGT-1B.*localize\.checkpoint.*localize\.method: pnp"):
        run_stage(small_capture, run, method=method, predictor="vggt")
    with pytest.raises(WeightsError, match=r"nowhere\.pt"):
        run_stage(small_capture, run, method=method, predictor="vggt", checkpoint="nowhere.pt")
    assert not run.poses_dir.exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"predictor": "magic"}, "Unknown predictor 'magic'. Known: vggt, simulated"),
        ({"num_references": 0}, "num_references is 0"),
        ({"candidates": 0}, "candidates is 0"),
        ({"batch_size": 0}, "batch_size is 0"),
        ({"predictor": "vggt", "compute_device": "tpu"}, "compute_device is 'tpu'"),
        ({"predictor": "vggt", "dtype_compute": "int8"}, "dtype_compute is 'int8'"),
    ],
)
def test_wrong_parameters_are_refused(run: SceneFiles, small_capture: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ManifestError, match=message):
        run_stage(small_capture, run, **wrong)
    with pytest.raises(ManifestError):
        create_predictor("magic")


@pytest.mark.parametrize(("method", "more"), [("vggt", {"batch_size": 1}), ("hybrid", {"batch_size": 3, "workers": 2})])
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

    with monkeypatch.context() as patch:
        patch.setattr(SimulatedPredictor, "predict", killed)
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, method=method, query_device="spot", skip_existing=False, batch_size=2)
    table = run_stage(small_capture, run, method=method, query_device="spot", skip_existing=False, **more)
    assert not table["skipped"].any()
    assert (table_of(run, "spot"), run.poses_txt("ios", "spot").read_bytes()) == expected


def test_a_killed_run_goes_on_where_it_was(
    run: SceneFiles, finished: SceneFiles, small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    localize, row = VggtLocalizer.localize, localize_stage._row
    rows: list[object] = []

    def killed(*args: object) -> dict:
        rows.append(args)
        if len(rows) == 3:
            raise KeyboardInterrupt
        return row(*args)  # type: ignore[arg-type]

    def counted(self: VggtLocalizer, queries: Sequence[VggtQuery]) -> list[VggtAnswer]:
        asked.extend(query.views[0].name for query in queries)
        return localize(self, queries)

    with monkeypatch.context() as patch:
        patch.setattr(localize_stage, "_row", killed)
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios", batch_size=1)
    assert not run.poses_txt("ios", "ios").exists()
    (progress,) = run.poses_dir.glob(".*.partial.jsonl")
    assert len(progress.read_text().splitlines()) == 3, "the record, and two rows"
    monkeypatch.setattr(VggtLocalizer, "localize", counted)
    table = run_stage(small_capture, run, query_device="ios")
    assert len(asked) == table["queries"].iloc[0] - 2
    assert table_of(run, "ios") == table_of(finished, "ios")
    assert run.poses_txt("ios", "ios").read_bytes() == finished.poses_txt("ios", "ios").read_bytes()


def test_other_noise_references_or_weights_make_poses_anew(run: SceneFiles, small_capture: Path) -> None:
    def skipped(**more: object) -> bool:
        return bool(run_stage(small_capture, run, query_device="ios", **more)["skipped"].iloc[0])

    assert not skipped()
    assert skipped(batch_size=1, workers=2)
    assert not skipped(num_references=3)
    assert not skipped(candidates=4)
    assert not skipped(seed=1)
    assert not skipped(method="hybrid")


# -------------------------------------------------------------------------------------------------- the hybrid


@pytest.fixture(scope="module")
def pnp(world: World) -> PnpLocalizer:
    return PnpLocalizer(world.map, extract_session(world.map_session, world.files.features, progress=False))


def asked_of(world: World, device: str, index: int, references: int = 10) -> tuple:
    """Return the arguments of `PnpLocalizer.localize` for a query."""
    session = world.capture[f"{device}_query"]
    query = world.queries(device, references)[0][index]
    store = extract_session(session, world.files.features, progress=False)
    features = [store[view.name] for view in query.views]
    return [view.camera for view in query.views], query.rig_from_cams, features, [r.tolist() for r in query.references]


def same(one: PoseEstimate, other: PoseEstimate) -> bool:
    return (
        one.status == other.status
        and one.num_inliers == other.num_inliers
        and one.found_by == other.found_by
        and np.array_equal(one.world_from_rig, other.world_from_rig)
        and np.array_equal(one.covariance, other.covariance)
    )


@pytest.mark.parametrize("device", ["ios", "spot"])
def test_without_a_usable_prediction_the_hybrid_is_pnp(world: World, pnp: PnpLocalizer, device: str) -> None:
    asked = asked_of(world, device, 0)
    expected = pnp.localize(*asked)
    assert expected.status == "ok"
    assert same(HybridLocalizer(pnp).localize(*asked, VggtAnswer(PoseEstimate("failed: no references"))), expected)
    unknown = np.diag([1e-4] * 3 + [np.inf] * 3)
    far = PoseEstimate("low_confidence", np.eye(4), unknown, found_by="vggt")
    assert same(HybridLocalizer(pnp).localize(*asked, VggtAnswer(far)), expected)


@pytest.mark.parametrize("device", ["ios", "spot"])
def test_a_wrong_prediction_does_no_harm(world: World, pnp: PnpLocalizer, device: str) -> None:
    asked = asked_of(world, device, 0)
    expected = pnp.localize(*asked)
    wrong = expected.world_from_rig @ geometry.make_pose(np.eye(3), [1.0, 0.5, 0.0])
    covariance = np.diag([1e-4] * 3 + [1e-3] * 3)
    prediction = PoseEstimate("ok", wrong, covariance, references=tuple(asked[3][0][:4]), found_by="vggt")
    found = HybridLocalizer(pnp).localize(*asked, VggtAnswer(prediction))
    assert same(found, expected)


def prediction_near(true: Floats, references: Sequence[int], seed: int = 0) -> PoseEstimate:
    rng = np.random.default_rng(seed)
    nearby = true @ geometry.make_pose(
        geometry.quaternion_to_rotation([1.0, *(rng.normal(size=3) * 0.004)]), rng.normal(size=3) * 0.02
    )
    covariance = np.diag([1e-4] * 3 + [1e-3] * 3)
    return PoseEstimate("ok", nearby, covariance, references=tuple(references), found_by="vggt")


def test_a_prediction_finds_what_descriptors_alone_do_not(world: World, pnp: PnpLocalizer) -> None:
    """Descriptors too alike to be matched in all of an image are matched about the predicted pose."""
    cameras, rig_from_cams, features, references = asked_of(world, "ios", 0)
    true = world.queries("ios")[1][0]
    strict = PnpLocalizer.of([MappedFeatures(world.map, pnp.mapped[0].features, matcher=MutualMatcher(ratio=0.0))])
    alone = strict.localize(cameras, rig_from_cams, features, references)
    assert alone.status.startswith("failed")
    found = HybridLocalizer(strict).localize(
        cameras, rig_from_cams, features, references, VggtAnswer(prediction_near(true, references[0][:4]))
    )
    assert found.found_by == "pnp+vggt"
    assert found.status == "ok"
    error_deg, error_m = geometry.pose_error(found.world_from_rig, true)
    assert error_deg < 0.3
    assert error_m < 0.03
    assert set(found.references) <= set(references[0][:4])


def test_where_nothing_matches_the_prediction_is_the_answer(world: World, pnp: PnpLocalizer) -> None:
    cameras, rig_from_cams, features, references = asked_of(world, "ios", 0)
    blind = [
        replace(f, keypoints=f.keypoints[:0], scales=f.scales[:0], descriptors=f.descriptors[:0]) for f in features
    ]
    true = world.queries("ios")[1][0]
    prediction = prediction_near(true, references[0][:4])
    found = HybridLocalizer(pnp).localize(cameras, rig_from_cams, blind, references, VggtAnswer(prediction))
    assert found.found_by == "vggt"
    assert found.status == "ok"
    np.testing.assert_array_equal(found.world_from_rig, prediction.world_from_rig)
    assert "failed: too few matches" in found.reason


def test_a_prior_is_found_again_in_whatever_order(world: World, pnp: PnpLocalizer) -> None:
    asked = asked_of(world, "spot", 1)
    true = world.queries("spot")[1][1]
    images = np.unique(np.concatenate([np.array(refs) for refs in asked[3]]))
    priors = [Prior(prediction_near(true, [], seed).world_from_rig, images, 2.0) for seed in range(2)]
    found = [pnp.localize(*asked, priors) for _ in range(2)]
    assert same(*found)
    assert same(found[0], pnp.localize(*asked, priors[::-1]))


def test_the_hybrid_run_is_as_good_as_pnp(run: SceneFiles, small_capture: Path) -> None:
    run_stage(small_capture, run, method="pnp")
    before = {device: Trajectory.read(run.poses_txt("ios", device)) for device in ("ios", "hl", "spot")}
    run_stage(small_capture, run, method="hybrid")
    for device, poses in before.items():
        session = Capture.open(small_capture)[f"{device}_query"]
        keyframes = session.keyframes(LIST)
        keys = keyframes["timestamp"], keyframes["device_id"]
        true = session.ground_truth.lookup(*keys)
        after = Trajectory.read(run.poses_txt("ios", device))
        right = [
            np.nan_to_num(np.stack(geometry.pose_error(p.lookup(*keys), true)), nan=1e9) for p in (poses, after)
        ]
        for limits in ((1.0, 0.1), (5.0, 0.5)):
            counts = [int(((r[0] < limits[0]) & (r[1] < limits[1])).sum()) for r in right]
            assert counts[1] >= counts[0]
        rows = pd.read_csv(run.poses_csv("ios", device))
        assert rows["method"].str.fullmatch(r"hybrid:simulated/((pnp|lifted)(\+vggt)?|vggt)").all()


def test_a_prediction_is_drawn_and_labeled(world: World, tmp_path: Path) -> None:
    queries, _ = world.queries("spot")
    localizer = world.localizer(world.predictor(wrong_references=0.3, seed=2))
    (answer,) = localizer.localize(queries[:1])
    figure = draw_prediction(localizer, queries[0], answer, out=tmp_path / "prediction.png")
    assert (tmp_path / "prediction.png").stat().st_size > 20_000
    assert figure.get_suptitle().startswith("SIMULATED, no result")
    failed = VggtAnswer(PoseEstimate("failed: no references"), ())
    assert "failed: no references" in draw_prediction(localizer, queries[0], failed).get_suptitle()
    undecided = replace(answer.cameras[0], reason="undecided")
    failed = VggtAnswer(PoseEstimate("failed: undecided"), (undecided,))
    assert draw_prediction(localizer, queries[0], failed).get_suptitle().count("undecided") == 1


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
    with pytest.raises(WeightsError, match="of another network"):
        world.localizer(Refuses(WeightsError("of another network"))).localize(queries)
    answers = world.localizer(Refuses(ImageError("torn.jpg"))).localize(queries)
    assert {answer.estimate.status for answer in answers} == {"failed: ImageError: torn.jpg"}
