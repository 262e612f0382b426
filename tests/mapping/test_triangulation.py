"""Large maps in tiles: which images are together, and that the joined map has no seams."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pycolmap
import pytest
from numpy.typing import NDArray

from tests.mapping.test_build import PINHOLE, assert_equal, looking_at
from tests.queries import ask
from toolkit import geometry
from toolkit.capture import Capture, Session
from toolkit.features.features import LocalFeatures, SiftExtractor, SiftSettings
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import sweep_partials, temporary_folder
from toolkit.manifest import MapSettings
from toolkit.mapping import build as mapping
from toolkit.mapping import local_map as local_maps
from toolkit.mapping.build import MapPlan, build_map
from toolkit.mapping.local_map import ORDERS, LocalMap
from toolkit.mapping.triangulation import JoinedImages, Tile, home_of, join_tiles, plan_tiles, triangulate
from toolkit.pose.base import Query, References, View
from toolkit.pose.map_matching import MappedFeatures
from toolkit.pose.pnp import PnpLocalizer


class Street:
    """Cameras along a street of known points, with exact keypoints; each is matched with its `reach` neighbors."""

    def __init__(self, count: int = 24, points: int = 400, reach: int = 3, camera: pycolmap.Camera = PINHOLE):
        rng = np.random.default_rng(0)
        self.points = rng.uniform([-3, 4, -2], [count + 2, 6, 2], (points, 3))
        self.poses = np.stack([looking_at([x, 0, 0], [x, 5, 0]) for x in range(count)])
        self.camera, self.names = camera, [f"ios_map/raw_data/{index:03d}.jpg" for index in range(count)]
        self.keypoints: list[NDArray[np.float32]] = []
        self.point_of: list[NDArray[np.int64]] = []  # the true point of each keypoint
        for pose in geometry.invert(self.poses):
            pixels = np.asarray(camera.img_from_cam(geometry.transform(pose, self.points)))
            inside = rng.permutation(np.flatnonzero(((pixels > 0) & (pixels < [640, 480])).all(axis=1)))
            self.keypoints.append(pixels[inside].astype(np.float32))
            self.point_of.append(inside)
        near = [(i, j) for i in range(count) for j in range(i + 1, min(i + reach + 1, count))]
        self.pairs = np.array(near, np.int64)

    def triangulate(self, images: NDArray[np.int64]) -> LocalMap:
        pairs = self.pairs[np.isin(self.pairs, images).all(axis=1)]
        common = [np.intersect1d(self.point_of[i], self.point_of[j], return_indices=True)[1:] for i, j in pairs]
        return triangulate(
            [self.names[image] for image in images],
            [self.camera] * len(images),
            self.poses[images],
            [self.keypoints[image] for image in images],
            np.searchsorted(images, pairs),
            [np.column_stack(indices) for indices in common],
        )

    def plan(self, most: int) -> list[Tile]:
        return plan_tiles(self.poses[:, :3, 3] + 5 * self.poses[:, :3, 2], self.pairs, most)

    def join(self, tiles: list[Tile], folder: Path) -> LocalMap:
        def load(number: int) -> LocalMap:
            core, images = tiles[number]
            whole = self.triangulate(images)
            return whole.part(np.unique(whole.obs_point[np.isin(images[whole.obs_image], core)]))

        images = JoinedImages(
            self.names,
            [self.camera] * len(self.names),
            self.poses,
            self.keypoints.__getitem__,
            lambda images, keypoints: np.column_stack([images, keypoints, keypoints]).astype(np.uint8),
        )
        folder.mkdir()
        return join_tiles(tiles, load, images, folder)

    def truth(self, local_map: LocalMap) -> NDArray[np.int64]:
        """Return the true point of each observation."""
        pairs = zip(local_map.obs_image, local_map.obs_keypoint, strict=True)
        return np.array([self.point_of[image][keypoint] for image, keypoint in pairs], np.int64)


# ------------------------------------------------------------------------------------------------------------- plans


@pytest.mark.parametrize("most", [1, 5, 7, 24, 100])
def test_each_image_is_in_one_core_and_its_partners_in_the_tile(most: int) -> None:
    street = Street()
    tiles = street.plan(most)
    assert np.sort(np.concatenate([tile.core for tile in tiles])).tolist() == list(range(24))
    assert max(len(tile.core) for tile in tiles) <= most
    assert len(tiles) == -(-24 // most)
    home = home_of([tile.core for tile in tiles])
    for number, (core, images) in enumerate(tiles):
        assert (home[core] == number).all()
        partners = {int(image) for pair in street.pairs for image in pair if np.isin(pair, core).any()}
        assert set(images.tolist()) == partners | set(core.tolist())
        assert (np.diff(core) > 0).all()
        assert (np.diff(images) > 0).all()
        assert np.ptp(core) == len(core) - 1  # along a street, what is together is near


def test_images_at_one_place_are_parted_too() -> None:
    tiles = plan_tiles(np.zeros((10, 3)), np.zeros((0, 2), np.int64), 4)
    assert [tile.core.tolist() for tile in tiles] == [[0, 1, 2], [3, 4, 5], [6, 7, 8, 9]]


# --------------------------------------------------------------------------------------------------------------- seams


@pytest.mark.parametrize("most", [4, 8, 12])
def test_a_point_that_several_tiles_see_is_one_point(tmp_path: Path, most: int) -> None:
    street = Street()
    whole, joined = street.triangulate(np.arange(24)), street.join(street.plan(most), tmp_path / "join")
    truth = street.truth(joined)
    # Each point is one of the world's, at its place, and no two are the same.
    of_point = np.array([np.unique(truth[joined.obs_point == point]) for point in range(len(joined.points))])
    assert of_point.shape[1] == 1
    assert len(np.unique(of_point)) == len(of_point)
    np.testing.assert_allclose(joined.points, street.points[of_point[:, 0]], atol=1e-4)
    # Its track goes across seams: the observations are those of the map in one piece.
    seen = [set(zip(each.obs_image.tolist(), each.obs_keypoint.tolist(), strict=True)) for each in (whole, joined)]
    assert len(joined.obs_image) == len(seen[1])
    assert seen[0] == seen[1]
    assert joined.noise_px.max() < 1e-2


def test_the_orders_of_a_joined_map_are_those_of_its_observations(tmp_path: Path) -> None:
    joined = Street().join(Street().plan(6), tmp_path / "join")
    assert (np.diff(joined.obs_image) >= 0).all()
    plain = replace(joined)  # computes them
    for name in ORDERS:
        np.testing.assert_array_equal(getattr(joined, name), getattr(plain, name))
    # The color of a point is that of its first observation.
    first = np.unique(joined.obs_point, return_index=True)[1]
    assert joined.colors[:, 0].tolist() == joined.obs_image[first].tolist()
    joined.save(tmp_path / "map.npz")
    assert_equal(LocalMap.load(tmp_path / "map.npz"), joined)


def test_a_keypoint_of_which_tiles_say_different_things_sees_one_point(tmp_path: Path) -> None:
    street = Street(count=8)
    tiles = street.plan(4)
    joined = {}

    def load(number: int) -> LocalMap:
        part = street.triangulate(tiles[number].images)
        if number == 0:  # which exchanges two keypoints of an image that both tiles have
            image = int(np.searchsorted(tiles[0].images, tiles[1].core[0]))
            at = np.arange(part.image_starts[image], part.image_starts[image + 1])[:2]
            points = part.obs_point.copy()
            points[at] = points[at[::-1]]
            part = replace(part, obs_point=points)
        return part

    images = JoinedImages(
        street.names, [PINHOLE] * 8, street.poses, street.keypoints.__getitem__, lambda i, _: np.zeros((len(i), 3))
    )
    (tmp_path / "join").mkdir()
    joined = join_tiles(tiles, load, images, tmp_path / "join")
    seen = np.column_stack([joined.obs_image, joined.obs_keypoint])
    assert len(np.unique(seen, axis=0)) == len(seen)
    truth = street.truth(joined)
    for point in range(len(joined.points)):  # what contradicted the others was taken out
        assert len(np.unique(truth[joined.obs_point == point])) == 1
    assert len(joined.points) > 0.9 * len(np.unique(truth))


def test_tiles_without_points_are_joined(tmp_path: Path) -> None:
    street = Street(count=12)
    for image in range(6):  # no keypoints in the first half
        street.keypoints[image], street.point_of[image] = street.keypoints[image][:0], street.point_of[image][:0]
    joined = street.join(street.plan(3), tmp_path / "join")
    assert joined.obs_image.min() == 6
    for image in range(12):
        street.keypoints[image], street.point_of[image] = street.keypoints[image][:0], street.point_of[image][:0]
    nothing = street.join(street.plan(3), tmp_path / "nothing")
    assert nothing.points.shape == (0, 3)
    nothing.save(tmp_path / "map.npz")
    assert_equal(LocalMap.load(tmp_path / "map.npz"), nothing)


def test_a_query_in_a_tiled_map_without_points_has_too_few_matches(tmp_path: Path) -> None:
    """A tripod: many images, no baseline, no points."""
    street = Street(count=4)
    pixels = street.keypoints[0][:50]
    street.keypoints = [keypoints[:0] for keypoints in street.keypoints]
    street.point_of = [points[:0] for points in street.point_of]
    street.join(street.plan(2), tmp_path / "join").save(tmp_path / "map.npz")
    opened = LocalMap.load(tmp_path / "map.npz")
    assert_equal(opened, street.triangulate(np.arange(4)))  # the map in one piece
    features = LocalFeatures(pixels, *np.ones((2, 50), np.float32), np.eye(50, 128, dtype=np.float16), (640, 480))
    localizer = PnpLocalizer([MappedFeatures(opened, dict.fromkeys(street.names, features))])
    assert ask(localizer, [street.camera], np.eye(4)[None], [features], [range(4)]).reason == "too few matches"


# -------------------------------------------------------------------------------------------------------- photographs


@pytest.fixture(scope="module")
def phone(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Session, FeatureStore]:
    """The phone's map session of the rendered capture, and its features."""
    session = Capture.open(small_capture)["ios_map"]
    sift = SiftExtractor(SiftSettings(max_keypoints=800))
    return session, extract_session(session, tmp_path_factory.mktemp("features"), sift, progress=False)


def test_a_stopped_map_goes_on_at_the_tile_where_it_was(
    phone: tuple[Session, FeatureStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, store = phone
    path, settings = tmp_path / "ios_map.npz", MapSettings(pairs_per_image=2, tile_images=2)
    whole = build_map(session, store, path, settings)
    tiles = sorted((tmp_path / "ios_map.tiles").glob("*.npz"))
    assert len(tiles) == 3
    assert not list(tmp_path.glob(".*"))
    path.unlink()
    tiles[1].write_bytes(b"torn")
    done = []
    work = mapping.triangulate
    monkeypatch.setattr(mapping, "triangulate", lambda names, *rest: done.append(len(names)) or work(names, *rest))
    monkeypatch.setattr(mapping, "match_along_epipolar_lines", None)
    assert_equal(build_map(session, store, path, settings), whole)
    assert done == [len(LocalMap.load(tiles[1]).image_names)]


def test_a_tile_may_have_no_point_that_earlier_ones_have_not(
    phone: tuple[Session, FeatureStore], tmp_path: Path
) -> None:
    session, store = phone
    two = FeatureStore(store.path, dict(list(store.made_from.items())[:2]), {}, store.settings)
    joined, whole = (
        build_map(session, two, tmp_path / str(size) / "ios_map.npz", MapSettings(tile_images=size)) for size in (1, 9)
    )
    assert len(joined.points) == len(whole.points) > 0


@pytest.mark.slow
def test_tiles_of_other_features_are_made_anew(phone: tuple[Session, FeatureStore], tmp_path: Path) -> None:
    session, store = phone
    settings = MapSettings(pairs_per_image=2, tile_images=2)
    build_map(session, store, tmp_path / "ios_map.npz", settings)
    fewer = extract_session(session, tmp_path, SiftExtractor(SiftSettings(max_keypoints=300)), progress=False)
    again = build_map(session, fewer, tmp_path / "ios_map.npz", settings, inputs="fewer")
    assert_equal(again, build_map(session, fewer, tmp_path / "alone" / "ios_map.npz", settings))


def test_a_query_gets_the_same_pose_from_either_tile(phone: tuple[Session, FeatureStore], tmp_path: Path) -> None:
    session, store = phone
    settings = MapSettings(tile_images=3)
    joined = build_map(session, store, tmp_path / "ios_map.npz", settings)
    plan = MapPlan(session, store, tmp_path / "ios_map.npz", settings)
    assert len(plan.tiles) == 2
    query = int(plan.tiles[0].core[-1])
    assert query in plan.tiles[1].images
    localizer = PnpLocalizer([MappedFeatures(joined, store)])
    view = View(plan.names[query], Path(), plan.cameras[query], in_map=False, turns=0)
    asked = Query([view], np.eye(4)[None], [[store[plan.names[query]]]], [])
    poses = []
    for tile in plan.tiles:
        estimate = localizer.localize(asked, [References.of(np.setdiff1d(tile.core, [query]).tolist())])
        assert estimate.status == "ok"
        assert estimate.world_from_rig is not None
        poses.append(estimate.world_from_rig)
    angle_deg, distance_m = geometry.pose_error(*poses)
    assert angle_deg < 0.02
    assert distance_m < 0.002
    assert geometry.pose_error(poses[0], plan.world_from_cams[query])[1] < 0.02


# -------------------------------------------------------------------------------------------------------------- memory


def test_a_large_map_takes_the_memory_of_what_is_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images, each = 2000, 2000
    count = images * each
    large = LocalMap(
        [f"ios_map/{index}.jpg" for index in range(images)],
        [PINHOLE] * images,
        np.tile(np.eye(4), (images, 1, 1)),
        np.zeros((count // 2, 3)),
        np.zeros((count // 2, 3), np.uint8),
        np.repeat(np.arange(images), each),
        np.tile(np.arange(each), images),
        np.arange(count) % each + np.arange(count) // (2 * each) * each,  # images 2i and 2i + 1 see the same
        np.ones(count // 2, np.float32),
    )
    large.save(tmp_path / "map.npz")
    del large
    assert (tmp_path / "map.npz").stat().st_size > 150e6
    process = psutil.Process()
    before = process.memory_info().rss
    opened = LocalMap.load(tmp_path / "map.npz")
    seen, points = opened.around(np.array([100, 500]))
    assert len(points) == 2 * each
    assert seen.images_seeing(np.arange(2 * each)).nonzero()[0].tolist() == [100, 101, 500, 501]
    assert process.memory_info().rss - before < 40e6


@pytest.mark.parametrize("limit", [0, 1 << 30])
def test_a_map_is_the_same_mapped_or_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    street = Street(count=6)
    local_map = street.triangulate(np.arange(6))
    local_map.save(tmp_path / "map.npz")
    monkeypatch.setattr(local_maps, "IN_MEMORY", limit)
    opened = LocalMap.load(tmp_path / "map.npz")
    assert_equal(opened, local_map)
    assert all(getattr(opened, name).flags.aligned for name in ("points", "obs_point", *ORDERS))
    assert not opened.points.flags.writeable
    (tmp_path / "map.npz").write_bytes((tmp_path / "map.npz").read_bytes()[:-200])
    with pytest.raises(local_maps.ArtifactError):
        LocalMap.load(tmp_path / "map.npz")


def test_a_scaled_map_is_not_sorted_again(tmp_path: Path) -> None:
    Street(count=3).triangulate(np.arange(3)).save(tmp_path / "map.npz")
    opened = LocalMap.load(tmp_path / "map.npz")
    scaled = opened.scaled(0.5)
    assert scaled.length == 0.5
    for name in ORDERS:
        assert getattr(scaled, name) is getattr(opened, name)


def test_what_a_killed_join_left_is_swept(tmp_path: Path) -> None:
    with temporary_folder(tmp_path / "ios_map.npz") as folder:
        (folder / "0.npz").write_bytes(b"")
        sweep_partials(tmp_path)
        assert folder.is_dir()  # its process lives
        left = folder.with_name(folder.name.replace(f".{psutil.Process().pid}-", ".999999999-"))
        folder.rename(left)
        sweep_partials(tmp_path)
        assert not left.exists()
        folder.mkdir()
    assert not list(tmp_path.iterdir())
