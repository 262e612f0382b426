"""Localizing by matching and by a prediction: the better supported answer."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from tests.queries import session_query
from tests.rendered import LIST, LOW, World, run_stage
from toolkit import geometry
from toolkit.capture import Capture, Trajectory
from toolkit.features.features import MutualMatcher
from toolkit.features.stores import extract_session
from toolkit.files import SceneFiles
from toolkit.pose.base import Prior, QueryInput, QueryResult, References, Status
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import PnpLocalizer
from toolkit.prediction.feed_forward import FeedForwardAnswer
from toolkit.prediction.hybrid import HybridLocalizer

Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def pnp(world: World) -> PnpLocalizer:
    features = extract_session(world.map_session, world.files.features, progress=False)
    return PnpLocalizer([MappedFeatures(world.map, features)])


@pytest.fixture(scope="module")
def hybrid(world: World, pnp: PnpLocalizer) -> HybridLocalizer:
    return HybridLocalizer(pnp, world.localizer(world.predictor(**LOW)))


def input_of(world: World, device: str, index: int) -> QueryInput:
    """Return a query with its features, and its references."""
    session = world.capture[f"{device}_query"]
    store = extract_session(session, world.files.features, progress=False)
    return session_query(session, session.rows_of_keyframes(session.keyframes(LIST))[index], world.map, store=store)


def localize_with(
    hybrid: HybridLocalizer, query_input: QueryInput, predicted: QueryResult
) -> QueryResult:
    """Localize where the network gives this pose."""
    network = copy(hybrid.feed_forward)
    network.answer = lambda *_: FeedForwardAnswer(predicted)  # type: ignore[method-assign]
    return HybridLocalizer(hybrid.pnp, network).localize(*query_input)


def same(one: QueryResult, other: QueryResult) -> bool:
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
    query_input = input_of(world, device, 0)
    expected = pnp.localize(*query_input)
    assert expected.status == "ok"
    assert same(localize_with(hybrid, query_input, QueryResult.failed("no references")), expected)
    unknown = np.diag([1e-4] * 3 + [np.inf] * 3)
    far = QueryResult(Status.LOW_CONFIDENCE, "", np.eye(4), unknown, found_by="feed_forward")
    assert same(localize_with(hybrid, query_input, far), expected)


@pytest.mark.parametrize("device", ["ios", "spot"])
def test_a_wrong_prediction_does_no_harm(
    world: World, pnp: PnpLocalizer, hybrid: HybridLocalizer, device: str
) -> None:
    query, references = input_of(world, device, 0)
    expected = pnp.localize(query, references)
    wrong = expected.world_from_rig @ geometry.make_pose(np.eye(3), [1.0, 0.5, 0.0])
    prediction = predicted_at(wrong, names_of(world, references))
    assert same(localize_with(hybrid, (query, references), prediction), expected)


def names_of(world: World, references: Sequence[References]) -> list[str]:
    """Return the names of the first references of a query's first image."""
    return [world.map.image_names[index] for index in references[0].images[:4]]


def predicted_at(world_from_rig: Floats, references: Sequence[str]) -> QueryResult:
    covariance = np.diag([1e-4] * 3 + [1e-3] * 3)
    return QueryResult(Status.OK, "", world_from_rig, covariance, references=tuple(references), found_by="feed_forward")


def prediction_near(true: Floats, references: Sequence[str], seed: int = 0) -> QueryResult:
    rng = np.random.default_rng(seed)
    nearby = true @ geometry.make_pose(
        geometry.quaternion_to_rotation([1.0, *(rng.normal(size=3) * 0.004)]), rng.normal(size=3) * 0.02
    )
    return predicted_at(nearby, references)


def test_a_prediction_finds_what_descriptors_alone_do_not(world: World, hybrid: HybridLocalizer) -> None:
    """Descriptors too alike to be matched in all of an image are matched about the predicted pose."""
    query, references = input_of(world, "ios", 0)
    true, near = world.queries("ios")[1][0], names_of(world, references)
    features = hybrid.pnp.matcher.mapped[0].features
    strict = PnpLocalizer([MappedFeatures(world.map, features, matcher=MutualMatcher(min_score=2.0))])
    alone = strict.localize(query, references)
    assert alone.status.startswith("failed")
    prediction = prediction_near(true, near)
    found = localize_with(HybridLocalizer(strict, hybrid.feed_forward), (query, references), prediction)
    assert found.found_by == "pnp+feed_forward"
    assert found.status == "ok"
    error_deg, error_m = geometry.pose_error(found.world_from_rig, true)
    assert error_deg < 0.3
    assert error_m < 0.03
    assert set(found.references) <= set(near)


def test_where_nothing_matches_the_prediction_is_the_answer(world: World, hybrid: HybridLocalizer) -> None:
    query, references = input_of(world, "ios", 0)
    blind = replace(query, features=[[kinds[0].take(slice(0))] for kinds in query.features])
    true = world.queries("ios")[1][0]
    prediction = prediction_near(true, names_of(world, references))
    found = localize_with(hybrid, (blind, references), prediction)
    assert found.found_by == "feed_forward"
    assert found.status == "ok"
    np.testing.assert_array_equal(found.world_from_rig, prediction.world_from_rig)
    assert "failed: too few matches" in found.remark


def test_a_hybrid_asks_its_network_where_no_prediction_is_given(world: World, hybrid: HybridLocalizer) -> None:
    query_input = input_of(world, "ios", 0)
    found = hybrid.localize(*query_input)
    assert same(found, hybrid.localize(*query_input, hybrid.predict([query_input])[0]))
    assert np.isfinite(found.scale_std)


def test_a_prior_is_found_again_in_whatever_order(world: World, pnp: PnpLocalizer) -> None:
    query_input = input_of(world, "spot", 1)
    true = world.queries("spot")[1][1]
    images = np.unique(np.concatenate([retrieved.images for retrieved in query_input[1]]))
    priors = [Prior(prediction_near(true, [], seed).world_from_rig, images, 2.0, "feed_forward") for seed in range(2)]
    found = [pnp.localize(*query_input, priors=priors) for _ in range(2)]
    assert same(*found)
    assert same(found[0], pnp.localize(*query_input, priors=priors[::-1]))


@pytest.mark.slow
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
        assert rows["method"].str.fullmatch(r"hybrid:simulated/((pnp|lifted)(\+feed_forward)?|feed_forward)").all()
