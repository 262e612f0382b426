import numpy as np

from toolkit.figures.top_view import Ground, places_of


def test_ground_axes_are_seen_from_above():
    none = np.zeros((0, 4, 4))
    for up in ([0, 0, -1], [0, 1, 0], [0.1, 0.2, 0.9]):
        ground = Ground.below(none, up)
        np.testing.assert_allclose(np.cross(*ground.axes), up / np.linalg.norm(up), atol=1e-12)
        assert len(ground.labels) == 2
    assert Ground.below(none, [0, 0, -1]).labels == ["x [m]", "−y [m]"]
    assert Ground.below(none, [0, 0, -1], (None, 1.0)).labels == ["x", "−y"]


def test_far_apart_places_are_told_apart():
    rng = np.random.default_rng(0)
    row = np.stack([np.arange(20.0), np.zeros(20)], axis=1)
    east, north = np.array([100, 0]), np.array([0, 90])
    positions = np.concatenate([row + east, row + east, row, rng.normal(size=(30, 2)) + north])
    place = places_of(positions)
    assert place.tolist() == [0] * 40 + [1] * 20 + [2] * 30
    assert set(places_of(row)) == {0}
    assert places_of(np.zeros((3, 2))).tolist() == [0, 0, 0]
    assert len(places_of(np.zeros((0, 2)))) == 0
