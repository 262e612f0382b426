import numpy as np
import pycolmap
import pytest

from toolkit.capture.images import turn_image, turn_points, turned_from_cam
from toolkit.geometry import invert, make_pose, transform


@pytest.mark.parametrize("k", range(4))
@pytest.mark.parametrize("shape", [(5, 8), (5, 8, 3)])
def test_a_marked_pixel_is_where_turn_points_says(shape: tuple[int, ...], k: int) -> None:
    image = np.zeros(shape, np.uint8)
    image[1, 6] = 200
    turned = turn_image(image, k)
    np.testing.assert_array_equal(turned, np.rot90(image, k))
    assert turned.flags.c_contiguous
    x, y = turn_points([[6.5, 1.5]], 8, 5, k)[0]
    assert x % 1 == y % 1 == 0.5
    assert np.all(turned[int(y), int(x)] == 200)


def test_four_turns_are_none() -> None:
    image = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    four = image
    for _ in range(4):
        four = turn_image(four, 1)
    np.testing.assert_array_equal(four, image)
    np.testing.assert_array_equal(turned_from_cam(1) @ turned_from_cam(3), np.eye(4))
    assert turned_from_cam(np.array([[0, 1, 2], [3, 0, 1]])).shape == (2, 3, 4, 4)


@pytest.mark.parametrize("k", range(4))
def test_a_turned_pose_keeps_the_center_and_shows_the_same_world(k: int) -> None:
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 480, 330, 230])
    focal = [500, 480] if k % 2 == 0 else [480, 500]
    turned = pycolmap.Camera(model="PINHOLE", params=[*focal, *turn_points([[330, 230]], 640, 480, k)[0]])
    world_from_cam = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [1, 2, 3])
    world_from_turned = world_from_cam @ invert(turned_from_cam(k))
    np.testing.assert_array_equal(world_from_turned[:3, 3], [1, 2, 3])
    points = transform(world_from_cam, [[0.1, 0.2, 2.0], [-0.3, 0.1, 4.0]])
    before = camera.img_from_cam(transform(invert(world_from_cam), points))
    after = turned.img_from_cam(transform(invert(world_from_turned), points))
    np.testing.assert_allclose(after, turn_points(before, 640, 480, k), atol=1e-9)
