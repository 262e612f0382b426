"""Points made for one query, and asking for more features only where a pose is not sure."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from tests.queries import indices_of, query_of
from toolkit import geometry
from toolkit.features.features import KINDS, LocalFeatures, MutualMatcher, PairMatches
from toolkit.features.matching import LocalMethod, Matcher
from toolkit.mapping.local_map import LocalMap
from toolkit.pose.base import QueryResult, References
from toolkit.pose.local_triangulation import OnDemandLocalizer, PosedImages
from toolkit.pose.map_matching import MappedFeatures

Floats = NDArray[np.float64]
SIZE = (640, 480)
POINTS = 300
CAMERA = pycolmap.Camera(model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[500, 500, 320, 240])


def view_from(place: Sequence[float]) -> Floats:
    """Return world_from_cam of a camera that looks at the origin, 5 m in front of it."""
    forward = geometry.unit(-np.array(place, np.float64))
    right = geometry.unit(np.cross([0.0, 1.0, 0.0], forward))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = place
    return pose


MAP_POSES = np.stack([view_from((x, y, -5.0)) for x in (-1.2, 0.0, 1.2) for y in (-0.5, 0.5)])
QUERY_POSE = view_from((0.4, 0.1, -4.5))


class ByPoint:
    """Matches features that are of the same point, whatever their descriptors; some wrongly if asked to."""

    batch_size = 1
    settings = {"name": "by point"}  # noqa: RUF012

    def __init__(self, wrong: float = 0.0) -> None:
        self.wrong = wrong

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        rng, found = np.random.default_rng(0), []
        for a, b in pairs:  # the score of a feature is the number of its point
            _, first, second = np.intersect1d(a.scores, b.scores, return_indices=True)
            bad = rng.uniform(size=len(second)) < self.wrong
            second[bad] = rng.permutation(second[bad])
            found.append(PairMatches(np.column_stack([first, second]), np.ones(len(first), np.float32)))
        return found


class Scene:
    """Points in a box, seen by map cameras and by a query camera."""

    def __init__(self, alike: bool = True, length: int = 128) -> None:
        """`alike`: a point has the same descriptor in all map images; `length`: of the descriptors."""
        rng = np.random.default_rng(1)
        self.points = rng.uniform((-1.5, -1, -1), (1.5, 1, 1), (POINTS, 3))
        self.names = [f"ios_map/raw_data/{index}.jpg" for index in range(len(MAP_POSES))]
        common = rng.normal(size=(POINTS, length))
        self.features = {
            name: self._seen(pose, common if alike else rng.normal(size=(POINTS, length)), rng)
            for name, pose in zip(self.names, MAP_POSES, strict=True)
        }
        self.query = query_of([CAMERA], np.eye(4)[None], [self._seen(QUERY_POSE, common, rng)])
        self.references = [References.of(range(len(MAP_POSES)))]

    def _seen(self, world_from_cam: Floats, descriptors: Floats, rng: np.random.Generator) -> LocalFeatures:
        pixels = CAMERA.img_from_cam(geometry.transform(geometry.invert(world_from_cam), self.points))
        order = rng.permutation(POINTS)
        return LocalFeatures(
            (pixels + rng.normal(0, 0.3, pixels.shape))[order].astype(np.float32),
            np.ones(POINTS, np.float32),
            order.astype(np.float32),
            geometry.unit(descriptors)[order].astype(np.float16),
            SIZE,
        )

    def mapped(self, images: Sequence[int], name: str = "sift", far: int = 0) -> MappedFeatures:
        """Return the map of some of the images, whose first points, far away, none of them sees."""
        names, count = [self.names[image] for image in images], far + POINTS
        whole = LocalMap(
            image_names=names,
            cameras=[CAMERA] * len(names),
            world_from_cams=MAP_POSES[list(images)],
            points=np.concatenate([np.full((far, 3), 100.0), self.points]),
            colors=np.zeros((count, 3), np.uint8),
            obs_image=np.repeat(np.arange(len(names)), POINTS),
            obs_keypoint=np.concatenate([np.argsort(self.features[name].scores) for name in names]),
            obs_point=np.tile(np.arange(far, count), len(names)),
            noise_px=np.full(count, 0.3, np.float32),
        )
        return MappedFeatures(whole, self.features, name, ByPoint(), KINDS["sift"])

    def localizer(
        self,
        mapped: Sequence[MappedFeatures] = (),
        source: Callable[[str], LocalFeatures] | None = None,
        instants: Sequence[int] = range(len(MAP_POSES)),
        wrong: float = 0.0,
        matcher: Matcher | None = None,
    ) -> OnDemandLocalizer:
        cameras = [CAMERA] * len(self.names)
        names = list(mapped[0].map.image_names) if mapped else self.names
        posed = PosedImages(names, cameras, MAP_POSES, np.array(instants))
        method: Any = LocalMethod("aliked", SimpleNamespace(), matcher or ByPoint(wrong))
        return OnDemandLocalizer(posed, mapped, [(method, source or self.features.__getitem__)])


def assert_right(estimate: QueryResult, max_m: float = 0.01) -> None:
    assert estimate.world_from_rig is not None, estimate.status
    rotation_deg, distance_m = geometry.pose_error(estimate.world_from_rig, QUERY_POSE)
    assert rotation_deg < 0.1
    assert distance_m < max_m


@pytest.mark.parametrize("alike", [True, False])
def test_no_map_is_needed(alike: bool) -> None:
    """Where map images have nothing alike along epipolar lines, what the query shows of them makes the points."""
    scene = Scene(alike)
    estimate = scene.localizer().localize(scene.query, scene.references)
    assert estimate.status == "ok"
    assert_right(estimate)
    assert len(np.unique(estimate.correspondences.points, axis=0)) > 0.9 * POINTS
    assert set(estimate.correspondences.point_index) == {-1}, "they are in no file"
    assert {name.split("/")[0] for name in estimate.correspondences.found_by} == {"aliked"}
    assert set(indices_of(estimate.references)) <= set(range(len(MAP_POSES)))


def test_wrong_matches_make_no_points() -> None:
    """A third of the query's matches are wrong; two wrong ones that agree with the map's poses are rare."""
    scene = Scene(alike=False)
    estimate = scene.localizer(wrong=0.33).localize(scene.query, scene.references)
    assert_right(estimate, 0.02)
    used = estimate.correspondences
    distances = np.linalg.norm(scene.points - used.points[used.agrees][:, None], axis=2).min(axis=1)
    assert np.mean(distances < 0.05) > 0.95


def test_the_cameras_of_a_rig_make_no_points_together() -> None:
    scene = Scene()
    estimate = scene.localizer(instants=[7] * len(MAP_POSES)).localize(scene.query, scene.references)
    assert estimate.status_text == "failed: too few matches"


@pytest.mark.parametrize("length", [128, 256])
def test_a_reference_without_features_is_left_out(length: int) -> None:
    """Its descriptors have another type, and another length than those of SuperPoint."""
    scene = Scene(length=length)

    def source(name: str) -> LocalFeatures:
        return LocalFeatures.none(SIZE) if name == scene.names[0] else scene.features[name]

    localizer = scene.localizer(source=source, matcher=MutualMatcher())
    assert_right(localizer.localize(scene.query, scene.references))


def test_matches_from_a_file_lack_what_could_not_be_read() -> None:
    scene = Scene()
    pairs = {
        name: ByPoint().match([(scene.query.features[0][0], scene.features[name])])[0]  # type: ignore[list-item]
        for name in scene.names[1:]
    }

    def source(name: str) -> LocalFeatures:
        return scene.features[name] if name in pairs else LocalFeatures.none(SIZE)

    query = replace(scene.query, network_matches=[[pairs.__getitem__]])
    result = scene.localizer(source=source).localize(query, scene.references)
    assert_right(result)
    # Matches of an image that could be read in an earlier run are still in the file.
    earlier = ByPoint().match([(scene.query.features[0][0], scene.features[scene.names[0]])])[0]  # type: ignore[list-item]
    stale = replace(scene.query, network_matches=[[{scene.names[0]: earlier, **pairs}.__getitem__]])
    again = scene.localizer(source=source).localize(stale, scene.references)
    np.testing.assert_array_equal(again.world_from_rig, result.world_from_rig)


def test_references_that_are_known_are_not_matched_again() -> None:
    """The fallback features ask few references first, then all: those of the first round went through the network."""
    scene, matcher = Scene(), Mock(wraps=ByPoint())
    localizer = scene.localizer(matcher=matcher)
    number_of = {id(scene.features[name]): number for number, name in enumerate(scene.names)}
    few = localizer.match(scene.query, [References.of([1, 4])])
    with_all = localizer.match(replace(scene.query, network_matches=few.query.network_matches), scene.references)
    asked = [[number_of[id(pair[1])] for pair in call.args[0]] for call in matcher.match.call_args_list]
    assert asked == [[1, 4], [0, 2, 3, 5]]
    in_one = scene.localizer().localize(scene.query, scene.references)
    np.testing.assert_array_equal(localizer.solve(with_all).world_from_rig, in_one.world_from_rig)


def test_without_references_there_is_no_pose() -> None:
    scene = Scene()
    assert scene.localizer().localize(scene.query, [References.of([])]).status_text == "failed: no references"


def test_references_of_one_query_image_only() -> None:
    """A rig whose second image has no references, and whose third cannot be read."""
    scene = Scene()
    features = scene.query.features[0]
    rig = query_of([CAMERA] * 3, np.stack([np.eye(4)] * 3), [features, features, "no such file"])
    nothing = References.of([])
    estimate = scene.localizer().localize(rig, [scene.references[0], nothing, scene.references[0]])
    assert_right(estimate)
    assert set(estimate.correspondences.camera) <= {0, 1}
    # A run stores no matches of an image that it cannot read; asking for them failed the whole query.
    with_first = scene.localizer().match(rig, [scene.references[0], nothing, nothing])
    stored = dict(zip(scene.names, map(with_first.query.network_matches[0][0], scene.names), strict=True))
    rig = replace(rig, network_matches=[[stored.__getitem__], [{}.__getitem__], [{}.__getitem__]])
    again = scene.localizer().localize(rig, [scene.references[0], nothing, scene.references[0]])
    np.testing.assert_array_equal(again.world_from_rig, estimate.world_from_rig)


def test_points_of_the_map_keep_their_index() -> None:
    """The map has points that the references do not see; those that they see are named as in the whole map."""
    scene = Scene()
    mapped = scene.mapped(range(len(MAP_POSES)), far=50)
    whole = mapped.map
    both = replace(scene.query, features=[[*scene.query.features[0], *scene.query.features[0]]])
    estimate = scene.localizer([mapped]).localize(both, scene.references)
    assert_right(estimate)
    index = estimate.correspondences.point_index
    kinds = np.array([name.split("/")[0] for name in estimate.correspondences.found_by])
    assert set(index[kinds == "aliked"]) == {-1}
    np.testing.assert_array_equal(
        whole.points[index[kinds == "sift"]], estimate.correspondences.points[kinds == "sift"]
    )
    assert (kinds == "sift").sum() > 200


@pytest.mark.parametrize(("references", "of_second"), [([4, 5], True), ([0, 1], False)])
def test_a_kind_may_have_other_images(references: list[int], of_second: bool) -> None:
    """Only the last two images have features of the second kind."""
    scene = Scene()
    mapped = [scene.mapped(range(len(MAP_POSES))), scene.mapped([4, 5], "superpoint")]
    query = replace(scene.query, features=[scene.query.features[0] * 3])  # type: ignore[list-item]
    estimate = scene.localizer(mapped).localize(query, [References.of(references)])
    assert_right(estimate)
    used = estimate.correspondences
    kinds = np.array([name.split("/")[0] for name in used.found_by])
    assert set(kinds) == {"sift", "aliked"} | ({"superpoint"} if of_second else set())
    for number, kind in enumerate(["sift", "superpoint"]):
        index = used.point_index[kinds == kind] - number * POINTS
        np.testing.assert_array_equal(scene.points[index], used.points[kinds == kind])
