"""Models made level and metric: GPS, known positions, a measured distance, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from toolkit.errors import CaptureError, ManifestError
from toolkit.exchange.georeference import (
    GPS,
    WORLD_DEVIATION,
    Placing,
    alignment,
    drift_factor,
    east_north_up,
    fit,
    place,
    read_positions,
)
from toolkit.geometry import Floats, quaternion_to_rotation, unit

SCALE = 3.7  # meters per unit of the models


def cloud(rng: np.random.Generator, count: int = 40) -> tuple[Floats, Floats, pycolmap.Sim3d]:
    """Positions with z up, the same in meters, and the similarity between them, whose rotation is about z."""
    source = rng.normal(size=(count, 3)) * [6, 4, 0.5]
    cos, sin = np.cos(1.1), np.sin(1.1)
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
    target_from_source = pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(rotation), np.array([5.0, -3.0, 40.0]))
    return source, target_from_source * source, target_from_source


def synthetic() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=12))


def centers(model: pycolmap.Reconstruction) -> dict[str, Floats]:
    return {image.name: np.asarray(image.projection_center()) for image in model.images.values()}


def placed(model: pycolmap.Reconstruction, geo: dict[str, tuple[float, float, float]], **options: object) -> Placing:
    return place(model, {}, geo, **options)  # type: ignore[arg-type]


def test_a_degree_east_and_north() -> None:
    # Length of a degree at 45 degrees: 111.132 km of latitude, 78.847 km of longitude.
    moved = east_north_up(np.array([[45.0005, 7.0, 0.0], [45.0, 7.001, 0.0], [45.0, 7.0, 9.0]]), np.array([45, 7, 0.0]))
    np.testing.assert_allclose(moved, [[0.0, 55.566, 0.0], [78.847, 0.0, 0.0], [0.0, 0.0, 9.0]], atol=0.01)


def test_gps_noise_and_outliers() -> None:
    rng = np.random.default_rng(0)
    source, target, truth = cloud(rng)
    target = target + rng.normal(size=target.shape) * 1.0
    target[:5] += 200.0
    fitted = fit(source, target)
    assert fitted is not None
    assert not fitted[1][:5].any()
    assert fitted[1][5:].mean() > 0.9
    assert fitted[0].scale == pytest.approx(truth.scale, rel=0.05)
    assert np.linalg.norm(fitted[0] * source - truth * source, axis=1).max() < 2.0
    assert 0 < fitted[3] < 0.05


def test_a_straight_path_keeps_up() -> None:
    rng = np.random.default_rng(1)
    source, _, truth = cloud(rng)
    source[:, 1:] *= 0.01
    target = truth * source
    fitted = fit(source, target + rng.normal(size=target.shape) * 0.3)
    assert fitted is not None
    assert not fitted[4]
    np.testing.assert_allclose(fitted[0].rotation.matrix() @ [0, 0, 1], [0, 0, 1], atol=1e-9)
    assert fitted[0].scale == pytest.approx(SCALE, rel=0.02)


@pytest.mark.slow
def test_scale_is_as_sure_as_noise_and_spread_allow() -> None:
    off = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        source = rng.uniform(-5, 5, (40, 3)) * [1, 1, 0.1]  # meters; the noise spreads positions as much as this
        fitted = fit(source / SCALE, source + rng.normal(size=source.shape) * 2)
        assert fitted is not None
        off.append((fitted[0].scale / SCALE - 1) / fitted[3])
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.2


def test_known_positions_of_a_model() -> None:
    model = synthetic()
    truth = {name: SCALE * center + 10 for name, center in centers(model).items()}
    result = placed(model, {}, positions=truth)
    assert result.unit == "m"
    for name, center in centers(model).items():
        np.testing.assert_allclose(center, truth[name], atol=1e-6)
    assert result.record["residual_m"] < 1e-6


def test_gps_of_a_model() -> None:
    model = synthetic()
    at = {name: SCALE * 5 * center for name, center in centers(model).items()}
    # Local meters to degrees at the equator.
    geo = {name: (y / 110574.3, 11 + x / 111319.5, z) for name, (x, y, z) in at.items()}
    result = placed(model, geo)
    assert result.unit == "m"
    assert result.record["meters"] == GPS
    assert result.record["origin"]["longitude_deg"] == pytest.approx(11, abs=1e-3)
    names = list(at)
    apart = [np.linalg.norm(poses[names[0]] - poses[names[7]]) for poses in (at, centers(model))]
    assert apart[0] == pytest.approx(apart[1], rel=1e-3)


def test_too_few_or_too_close_positions_give_no_meters() -> None:
    model = synthetic()
    two = dict.fromkeys(list(centers(model))[:2], (0.0, 0.0, 0.0))
    assert placed(model, two).unit is None
    rng = np.random.default_rng(0)
    noise = {name: rng.normal(size=3) * 3 for name in centers(model)}
    result = placed(synthetic(), {}, positions=noise)
    assert result.unit is None
    assert re.search(r"scale known to \d+ %", result.notes[0])


def test_images_of_a_capture_have_their_names() -> None:
    """As those of a second model that `reconstruct` found, which `import colmap` takes: "no photograph has GPS"."""
    true = {image.name: image.cam_from_world().inverse().matrix() for image in synthetic().images.values()}
    poses = {f"ios_map/raw_data/import/images/{name}": np.vstack([pose, [0, 0, 0, 1]]) for name, pose in true.items()}
    positions = {name: SCALE * pose[:3, 3] for name, pose in poses.items()}
    result, new_from_old = alignment(poses, {}, {}, positions)
    assert result.unit == "m"
    assert new_from_old.scale == pytest.approx(SCALE)


def test_noise_of_positions_is_that_of_the_place() -> None:
    model, errors = synthetic(), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        true = {name: SCALE * 20 * center for name, center in centers(model).items()}
        result = placed(model, {}, positions={name: at + rng.normal(size=3) for name, at in true.items()})
        middle = [np.mean([*found.values()], axis=0) for found in (centers(model), true)]
        errors.append(np.linalg.norm(middle[0][:2] - middle[1][:2]) / result.record[WORLD_DEVIATION])
        model = synthetic()
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 2


def test_drift_of_rough_poses_is_no_independent_noise() -> None:
    rng = np.random.default_rng(0)
    noise = 0.05 * rng.normal(size=(400, 3))
    assert drift_factor(noise, 0.1) < 1.2
    drift = np.zeros_like(noise)
    for row in range(1, len(noise)):
        drift[row] = 0.9 * drift[row - 1] + np.sqrt(1 - 0.9**2) * noise[row]
    assert 3 < drift_factor(drift, 0.1) < 5.5  # sqrt(1.9 / 0.1) = 4.4
    assert drift_factor(np.zeros((1, 3)), 0.1) == 1


def test_level_by_the_cameras() -> None:
    model = synthetic()
    tilted = pycolmap.Sim3d(
        1.0, pycolmap.Rotation3d(quaternion_to_rotation(unit(np.array([1.0, 0.4, 0.2, 0.1])))), np.zeros(3)
    )
    model.transform(tilted)
    assert placed(model, {}).unit is None
    downs = [image.cam_from_world().inverse().rotation.matrix()[:, 1] for image in model.images.values()]
    assert np.mean(downs, axis=0)[2] < 0  # y is down in upright cameras


def test_a_distance_between_cameras_or_pixels() -> None:
    model = synthetic()
    names = sorted(centers(model))
    assert placed(model, {}, distance=(names[0], names[3], 2.5)).unit == "m"
    now = centers(model)
    assert np.linalg.norm(now[names[0]] - now[names[3]]) == pytest.approx(2.5)
    image = next(iter(model.images.values()))
    a, b = [point for point in image.points2D if point.has_point3D()][:2]
    before = np.linalg.norm(model.points3D[a.point3D_id].xyz - model.points3D[b.point3D_id].xyz)
    texts = [f"{image.name}:{point.xy[0]},{point.xy[1]}" for point in (a, b)]
    try:
        placed(model, {}, distance=(*texts, 7.0))
    except ManifestError:  # other points are near them, at other depths
        return
    after = np.linalg.norm(model.points3D[a.point3D_id].xyz - model.points3D[b.point3D_id].xyz)
    assert after == pytest.approx(7.0, rel=0.2)
    assert after != pytest.approx(before)


@pytest.mark.parametrize("text", ["nothing.png", "nothing.png:1,2", "NAME:1", "NAME:a,b", "NAME:-900,-900"])
def test_a_point_that_is_not_there(text: str) -> None:
    model = synthetic()
    first, second = sorted(centers(model))[:2]
    with pytest.raises(ManifestError):
        placed(model, {}, distance=(text.replace("NAME", first), second, 1.0))
    with pytest.raises(ManifestError):
        placed(model, {}, distance=(first, first, 1.0))
    with pytest.raises(ManifestError):
        placed(model, {}, distance=(first, second, -1.0))


def test_table_of_positions(tmp_path: Path) -> None:
    table = tmp_path / "positions.csv"
    table.write_text("image, x, y, z\na.jpg, 1, 2, 3.5\n")
    np.testing.assert_array_equal(read_positions(table)["a.jpg"], [1, 2, 3.5])
    table.write_text("image,x,y,z\na.jpg,1,2,3\nb.jpg,1,two,3\n")
    for name, named in (("positions.csv", r"positions\.csv, line 3"), ("missing.csv", r"missing\.csv")):
        with pytest.raises(CaptureError, match=named):
            read_positions(tmp_path / name)
