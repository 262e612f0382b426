"""The predictor that looks up true poses and depth, and blurs them."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rendered import World
from toolkit import geometry
from toolkit.errors import CaptureError
from toolkit.pose.base import View


def group_of(world: World, device: str = "ios", index: int = 0) -> list[View]:
    query, references = world.queries(device)[0][index]
    localizer = world.localizer(world.predictor())
    return [query.views[0], *(localizer.view(int(i)) for i in references[0].images[:4])]


def test_a_simulation_depends_on_seed_and_names_alone(world: World) -> None:
    group, other = group_of(world), group_of(world, "spot")
    first = world.predictor().predict([group, other])
    again = world.predictor().predict([other, group[::-1]])
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
