"""Localizing by predicted cameras, on a rendered capture, with a predictor that knows the truth and blurs it."""

import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from tests.calls import call
from tests.queries import likeness, session_query
from toolkit import geometry
from toolkit import localize as localize_stage
from toolkit.capture import Capture, Session, Trajectory
from toolkit.errors import CaptureError, ImageError, ManifestError, WeightsError
from toolkit.features.matching import MutualMatcher
from toolkit.features.stores import extract_session
from toolkit.files import SceneFiles
from toolkit.localize import COLUMNS, PREDICTION_COLUMNS, localize_pairs
from toolkit.localizers.base import PoseEstimate, Prior, Query, References, View
from toolkit.localizers.feed_forward import FeedForwardAnswer, FeedForwardLocalizer
from toolkit.localizers.hybrid import HybridLocalizer
from toolkit.localizers.mapping import LocalMap
from toolkit.localizers.matches import MappedFeatures
from toolkit.localizers.pnp import PnpLocalizer
from toolkit.localizers.prediction import Prediction
from toolkit.localizers.predictors import create_predictor
from toolkit.localizers.simulated import SimulatedPredictor
from toolkit.manifest import PredictorSettings
from toolkit.show.visualize_prediction import draw_prediction

Floats = NDArray[np.float64]
Asked = tuple[Query, list[References]]
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

    def localizer(self, predictor: object, **settings: int) -> FeedForwardLocalizer:
        return FeedForwardLocalizer(self.map, self.map_session, predictor, PredictorSettings(**settings))  # type: ignore[arg-type]

    def queries(self, device: str, count: int = 10) -> tuple[list[Asked], Floats]:
        """Return the queries of a device with the map images that stand and look most alike, and their true poses."""
        session = self.capture[f"{device}_query"]
        keyframes = session.keyframes(LIST)
        queries = [session_query(session, rows, self.map, count) for rows in session.rows_of_keyframes(keyframes)]
        return queries, session.ground_truth.lookup(keyframes["timestamp"], keyframes["device_id"])


def run_stage(
    capture: Path, files: SceneFiles, predictor: Mapping[str, object] | None = None, **more: object
) -> pd.DataFrame:
    """Localize; `predictor` holds what differs from a simulation with the default settings."""
    settings = {"method": "vggt", "predictor": {"name": "simulated"} | dict(predictor or {})}
    options = {"map_device": "ios", "queries": LIST, "workers": 1} | settings | more
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


def errors(answers: Sequence[FeedForwardAnswer], true: Floats) -> tuple[Floats, Floats]:
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
    query, references = world.queries(device)[0][index]
    localizer = world.localizer(world.predictor())
    return [query.views[0], *(localizer.view(int(i)) for i in references[0].images[:4])]


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
    answers = world.localizer(world.predictor(**LOW)).predict(queries)
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
    ((query, references), *_), _ = world.queries("ios")
    localizer = world.localizer(world.predictor(**LOW))
    (near,) = localizer.predict([(query, references)])
    rig_from_cam = geometry.make_pose(np.eye(3), [10.0, 0.0, 0.0])[None]
    (far,) = localizer.predict([(replace(query, rig_from_cams=rig_from_cam), references)])
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
        answers = world.localizer(predictor, num_references=8).predict(queries)
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
        answers = localizer.predict(queries)
        rotation_deg, _ = errors(answers, true)
        for answer, error in zip(answers, rotation_deg, strict=True):
            assert answer.estimate.status == "low_confidence"
            assert np.isinf(answer.estimate.scale_std)
            assert np.isinf(answer.estimate.position_std_m)
            assert error < 3
            assert np.linalg.norm(answer.estimate.world_from_rig[:3, 3] - places[0, :3, 3]) < 2
        assert answers[0].estimate.reason


def test_depth_of_the_map_gives_the_scale_that_baselines_do_not(world: World) -> None:
    query, (references,) = world.queries("ios")[0][0]
    best = References(references.images[:1], references.scores[:1])
    without, with_depth = (
        world.localizer(world.predictor(depth, **LOW)).predict([(query, [best])])[0] for depth in (False, True)
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
    answers = localizer.predict(queries)
    assert (errors(answers, true)[1] < 0.15).all()
    assert all(answer.estimate.scale_std < 0.1 for answer in answers)


def test_a_rig_knows_better_than_its_cameras(world: World) -> None:
    together, alone = [], []
    for seed in range(4):
        localizer = world.localizer(world.predictor(seed=seed))
        queries, true = world.queries("spot")
        together += errors(localizer.predict(queries), true)[1].tolist()
        for camera in range(len(queries[0][0].views)):
            single = [(query.part([camera]), [references[camera]]) for query, references in queries]
            alone += errors(localizer.predict(single), true)[1].tolist()
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
    good = world.localizer(world.predictor(**LOW)).predict(queries)
    predictor = Failing(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.bad, predictor.how = queries[1][0].views[0].name, how
    answers = world.localizer(predictor).predict(queries)
    assert answers[1].estimate.status == reason
    assert answers[1].estimate.world_from_rig is None
    for index in (0, 2):
        np.testing.assert_array_equal(answers[index].estimate.world_from_rig, good[index].estimate.world_from_rig)


def test_a_rig_goes_on_without_a_camera_that_fails(world: World) -> None:
    queries, true = world.queries("spot")
    predictor = Failing(world.sessions, world.files.maps, **LOW)  # type: ignore[arg-type]
    predictor.bad = queries[0][0].views[0].name
    (answer,) = world.localizer(predictor).predict(queries[:1])
    assert geometry.pose_error(answer.estimate.world_from_rig, true[0])[1] < 0.1
    assert "RuntimeError: out of luck" in answer.estimate.reason


def test_without_references_there_is_no_pose(world: World) -> None:
    ((query, _), *_), _ = world.queries("ios")
    (answer,) = world.localizer(world.predictor()).predict([(query, [References.of([])])])
    assert answer.estimate.status == "failed: no references"
    assert world.localizer(world.predictor()).predict([]) == []


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
    with pytest.raises(WeightsError, match=r"(?s)VGGT-1B.*localize\.predictor\.checkpoint.*localize\.method: pnp"):
        run_stage(small_capture, run, method=method, predictor={"name": "vggt"})
    with pytest.raises(WeightsError, match=r"nowhere\.pt"):
        run_stage(small_capture, run, method=method, predictor={"name": "vggt", "checkpoint": "nowhere.pt"})
    assert not run.poses_dir.exists()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"predictor": {"name": "magic"}}, r"predictor\.name.*magic"),
        ({"predictor": {"num_references": 0}}, r"predictor\.num_references.*0"),
        ({"predictor": {"candidates": 0}}, r"predictor\.candidates.*0"),
        ({"predictor": {"batch_size": 0}}, r"predictor\.batch_size.*0"),
        ({"predictor": {"name": "vggt"}, "compute_device": "tpu"}, r"compute_device.*tpu"),
        ({"predictor": {"name": "vggt"}, "dtype_compute": "int8"}, r"dtype_compute.*int8"),
    ],
)
def test_wrong_parameters_are_refused(run: SceneFiles, small_capture: Path, wrong: dict, message: str) -> None:
    with pytest.raises(ManifestError, match=message):
        run_stage(small_capture, run, **wrong)
    with pytest.raises(ManifestError, match=r"Unknown predictor 'magic'. Known: vggt, simulated"):
        create_predictor("magic")


@pytest.mark.parametrize(
    ("method", "more"),
    [("vggt", {"predictor": {"batch_size": 1}}), ("hybrid", {"predictor": {"batch_size": 3}, "workers": 2})],
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
    predict, row = FeedForwardLocalizer.predict, localize_stage._row
    rows: list[object] = []

    def killed(*args: object) -> dict:
        rows.append(args)
        if len(rows) == 3:
            raise KeyboardInterrupt
        return row(*args)  # type: ignore[arg-type]

    def counted(self: FeedForwardLocalizer, queries: Sequence[Asked]) -> list[FeedForwardAnswer]:
        asked.extend(query.views[0].name for query, _ in queries)
        return predict(self, queries)

    with monkeypatch.context() as patch:
        patch.setattr(localize_stage, "_row", killed)
        with pytest.raises(KeyboardInterrupt):
            run_stage(small_capture, run, query_device="ios", predictor={"batch_size": 1})
    assert not run.poses_txt("ios", "ios").exists()
    (part,) = run.poses_dir.glob(".*.parts/*.h5")
    with h5py.File(part) as file:
        assert sum(len(devices) for devices in file.values()) == 2
    monkeypatch.setattr(FeedForwardLocalizer, "predict", counted)
    table = run_stage(small_capture, run, query_device="ios")
    assert len(asked) == table["queries"].iloc[0] - 2
    assert table_of(run, "ios") == table_of(finished, "ios")
    assert run.poses_txt("ios", "ios").read_bytes() == finished.poses_txt("ios", "ios").read_bytes()


def test_other_noise_references_or_weights_make_poses_anew(run: SceneFiles, small_capture: Path) -> None:
    def skipped(**more: object) -> bool:
        return bool(run_stage(small_capture, run, query_device="ios", **more)["skipped"].iloc[0])

    assert not skipped()
    assert skipped(predictor={"batch_size": 1}, workers=2)
    assert not skipped(predictor={"num_references": 3})
    assert not skipped(predictor={"candidates": 4})
    assert not skipped(seed=1)
    assert not skipped(method="hybrid")


# -------------------------------------------------------------------------------------------------- the hybrid


@pytest.fixture(scope="module")
def pnp(world: World) -> PnpLocalizer:
    return PnpLocalizer.of_sift(world.map, extract_session(world.map_session, world.files.features, progress=False))


@pytest.fixture(scope="module")
def hybrid(world: World, pnp: PnpLocalizer) -> HybridLocalizer:
    return HybridLocalizer(pnp, world.localizer(world.predictor(**LOW)))


def asked_of(world: World, device: str, index: int) -> Asked:
    """Return a query with its features, and its references."""
    session = world.capture[f"{device}_query"]
    store = extract_session(session, world.files.features, progress=False)
    return session_query(session, session.rows_of_keyframes(session.keyframes(LIST))[index], world.map, store=store)


def same(one: PoseEstimate, other: PoseEstimate) -> bool:
    return (
        one.status == other.status
        and one.num_inliers == other.num_inliers
        and one.found_by == other.found_by
        and np.array_equal(one.world_from_rig, other.world_from_rig)
        and np.array_equal(one.covariance, other.covariance)
    )


@pytest.mark.parametrize("device", ["ios", "spot"])
def test_without_a_usable_prediction_the_hybrid_is_pnp(
    world: World, pnp: PnpLocalizer, hybrid: HybridLocalizer, device: str
) -> None:
    asked = asked_of(world, device, 0)
    expected = pnp.localize(*asked)
    assert expected.status == "ok"
    assert same(hybrid.localize(*asked, FeedForwardAnswer(PoseEstimate("failed: no references"))), expected)
    unknown = np.diag([1e-4] * 3 + [np.inf] * 3)
    far = PoseEstimate("low_confidence", np.eye(4), unknown, found_by="vggt")
    assert same(hybrid.localize(*asked, FeedForwardAnswer(far)), expected)


@pytest.mark.parametrize("device", ["ios", "spot"])
def test_a_wrong_prediction_does_no_harm(
    world: World, pnp: PnpLocalizer, hybrid: HybridLocalizer, device: str
) -> None:
    query, references = asked_of(world, device, 0)
    expected = pnp.localize(query, references)
    wrong = expected.world_from_rig @ geometry.make_pose(np.eye(3), [1.0, 0.5, 0.0])
    prediction = predicted_at(wrong, references[0].images[:4])
    assert same(hybrid.localize(query, references, FeedForwardAnswer(prediction)), expected)


def predicted_at(world_from_rig: Floats, references: Sequence[int]) -> PoseEstimate:
    covariance = np.diag([1e-4] * 3 + [1e-3] * 3)
    rests_on = tuple(int(image) for image in references)
    return PoseEstimate("ok", world_from_rig, covariance, references=rests_on, found_by="vggt")


def prediction_near(true: Floats, references: Sequence[int], seed: int = 0) -> PoseEstimate:
    rng = np.random.default_rng(seed)
    nearby = true @ geometry.make_pose(
        geometry.quaternion_to_rotation([1.0, *(rng.normal(size=3) * 0.004)]), rng.normal(size=3) * 0.02
    )
    return predicted_at(nearby, references)


def test_a_prediction_finds_what_descriptors_alone_do_not(world: World, hybrid: HybridLocalizer) -> None:
    """Descriptors too alike to be matched in all of an image are matched about the predicted pose."""
    query, references = asked_of(world, "ios", 0)
    true, near = world.queries("ios")[1][0], references[0].images[:4]
    features = hybrid.pnp.matcher.mapped[0].features
    strict = PnpLocalizer([MappedFeatures(world.map, features, matcher=MutualMatcher(ratio=0.0))])
    alone = strict.localize(query, references)
    assert alone.status.startswith("failed")
    prediction = FeedForwardAnswer(prediction_near(true, near))
    found = HybridLocalizer(strict, hybrid.feed_forward).localize(query, references, prediction)
    assert found.found_by == "pnp+vggt"
    assert found.status == "ok"
    error_deg, error_m = geometry.pose_error(found.world_from_rig, true)
    assert error_deg < 0.3
    assert error_m < 0.03
    assert set(found.references) <= set(near)


def test_where_nothing_matches_the_prediction_is_the_answer(world: World, hybrid: HybridLocalizer) -> None:
    query, references = asked_of(world, "ios", 0)
    blind = replace(query, features=[[kinds[0].take(slice(0))] for kinds in query.features])
    true = world.queries("ios")[1][0]
    prediction = prediction_near(true, references[0].images[:4])
    found = hybrid.localize(blind, references, FeedForwardAnswer(prediction))
    assert found.found_by == "vggt"
    assert found.status == "ok"
    np.testing.assert_array_equal(found.world_from_rig, prediction.world_from_rig)
    assert "failed: too few matches" in found.reason


def test_a_hybrid_asks_its_network_where_no_prediction_is_given(world: World, hybrid: HybridLocalizer) -> None:
    asked = asked_of(world, "ios", 0)
    found = hybrid.localize(*asked)
    assert same(found, hybrid.localize(*asked, hybrid.predict([asked])[0]))
    assert np.isfinite(found.scale_std)


def test_a_prior_is_found_again_in_whatever_order(world: World, pnp: PnpLocalizer) -> None:
    asked = asked_of(world, "spot", 1)
    true = world.queries("spot")[1][1]
    images = np.unique(np.concatenate([retrieved.images for retrieved in asked[1]]))
    priors = [Prior(prediction_near(true, [], seed).world_from_rig, images, 2.0) for seed in range(2)]
    found = [pnp.localize(*asked, priors=priors) for _ in range(2)]
    assert same(*found)
    assert same(found[0], pnp.localize(*asked, priors=priors[::-1]))


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
    (answer,) = localizer.predict(queries[:1])
    figure = draw_prediction(localizer, queries[0][0], answer, out=tmp_path / "prediction.png")
    assert (tmp_path / "prediction.png").stat().st_size > 20_000
    assert figure.get_suptitle().startswith("SIMULATED, no result")
    failed = FeedForwardAnswer(PoseEstimate("failed: no references"), ())
    assert "failed: no references" in draw_prediction(localizer, queries[0][0], failed).get_suptitle()
    undecided = replace(answer.cameras[0], reason="undecided")
    failed = FeedForwardAnswer(PoseEstimate("failed: undecided"), (undecided,))
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
    with pytest.raises(WeightsError, match="of another network"):
        world.localizer(Refuses(WeightsError("of another network"))).predict(queries)
    answers = world.localizer(Refuses(ImageError("torn.jpg"))).predict(queries)
    assert {answer.estimate.status for answer in answers} == {"failed: ImageError: torn.jpg"}
