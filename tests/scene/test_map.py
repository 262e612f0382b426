"""The way of a query through a map: when fallback features are used, and what they judge."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import PIL.Image
import pycolmap
import pytest
from numpy.typing import NDArray

from tests.pose.test_local_triangulation import Scene
from toolkit.features.features import LocalFeatures
from toolkit.manifest import LocalizeSettings
from toolkit.pose.base import (
    CAMERA,
    Localizer,
    Prior,
    Query,
    QueryMatches,
    QueryResult,
    References,
    Rival,
    Status,
    View,
)
from toolkit.scene.images import localize_images
from toolkit.scene.map import Map
from toolkit.scene.query import MapCameras, camera_key


class Scripted(Localizer):
    """A localizer that answers what it was told, and keeps what it was asked."""

    image_names = ["a"]  # noqa: RUF012

    def __init__(self, *answers: QueryResult) -> None:
        self.answers, self.asked, self.priors = list(answers), list[Query](), list[Prior]()

    def solve(self, matches: QueryMatches, prediction: Any = None, priors: Sequence[Prior] = ()) -> QueryResult:
        self.asked.append(matches.query)
        self.priors += priors
        return self.answers.pop(0)


def with_pixels(query: Query) -> Query:
    """Return a query whose images have the size of their cameras."""
    blank = np.zeros((480, 640), np.uint8)
    return replace(query, views=[replace(view, image=blank) for view in query.views])


def scripted_map(
    first: Localizer, fallback: Localizer, kinds: Sequence[Any], near: dict[float, list[int]] | None = None
) -> Map:
    """Return a map with these localizers; `near`: indices of the map images that may show a pose, by its x."""
    scene_map = Map("ios", Path(), Path(), LocalizeSettings(unit="m"), escalation=kinds)
    vars(scene_map).update(localizer=first, fallback=fallback, estimated_cameras=set())
    vars(scene_map)["_images_near"] = lambda pose: np.array((near or {}).get(pose[0, 3], []), np.int64)
    return scene_map


OK, LOW = QueryResult(Status.OK, "", np.eye(4)), QueryResult(Status.LOW_CONFIDENCE, "", np.eye(4))
VAGUE = replace(OK, covariance=np.eye(6))
FAILED = QueryResult.failed("no consistent pose")
DOUBTED = QueryResult(Status.LOW_CONFIDENCE, CAMERA, np.eye(4), camera_contradicted=True)
ALIKE = replace(LOW, rivals=(Rival(np.eye(4), 0.95),))
SLIGHT = replace(VAGUE, camera_contradicted=True)  # a contradiction that shows in the covariance alone


@pytest.mark.parametrize(
    ("first", "second", "status", "found_by"),
    [
        (OK, None, "ok", "pnp"),
        (DOUBTED, None, "low_confidence: camera?", "pnp"),
        (SLIGHT, None, "ok", "pnp"),
        (FAILED, DOUBTED, "low_confidence: camera?", "pnp+sift"),
        (LOW, OK, "ok", "pnp+sift"),
        (FAILED, OK, "ok", "pnp+sift"),
        (LOW, LOW, "low_confidence", "pnp+sift"),
        (LOW, FAILED, "low_confidence", "pnp"),
        (VAGUE, OK, "ok", "pnp+sift"),
        (VAGUE, LOW, "ok", "pnp"),
        (VAGUE, ALIKE, "low_confidence", "pnp+sift"),
        (FAILED, FAILED, "failed: no consistent pose", "pnp"),
    ],
)
def test_more_features_are_asked_where_a_pose_is_not_sure(
    first: QueryResult, second: QueryResult | None, status: str, found_by: str
) -> None:
    scene = Scene()
    extracted: list[NDArray[np.uint8]] = []

    def extract(images: Sequence[NDArray[np.uint8]]) -> list[LocalFeatures]:
        extracted.extend(images)
        return [scene.features[scene.names[0]]] * len(images)

    extractor = SimpleNamespace(extract=extract, color=False)
    further = Scripted(*([] if second is None else [second]))
    kind: Any = SimpleNamespace(name="sift", extractor=extractor)
    scene_map = scripted_map(Scripted(first), further, [kind])
    result = scene_map.locate(with_pixels(scene.query), references=scene.references)
    assert (result.status_text, result.found_by) == (status, found_by)
    assert result.first_status == (None if second is None else first.status_text)
    assert len(extracted) == len(further.asked) == (second is not None)
    if further.asked:
        assert [len(kinds) for kinds in further.asked[0].features] == [2]


def test_an_ok_pose_asks_the_references_that_support_it_first() -> None:
    scene_map = scripted_map(Scripted(), Scripted(), [])
    vars(scene_map)["index_of"] = {"a": 0, "b": 1, "c": 2, "d": 3, "e": 4, "f": 5}
    references = [References.of([5, 4, 3, 2, 1, 0]), References.of([4, 5])]
    vague = replace(VAGUE, references=("c", "a", "b", "f", "d"))

    def asked(first: QueryResult) -> list[list[list[int]]]:
        query, results, rounds = Query([], np.eye(4)[None], [[]] * len(references)), [first], []
        while part := scene_map.asked_next(query, references, results):
            rounds.append([found.images.tolist() for found in part])
            results.append(first)
        return rounds

    every = [[5, 4, 3, 2, 1, 0], [4, 5]]
    assert asked(vague) == [[[5, 2, 1, 0], [5]], every]
    assert asked(replace(vague, status=Status.LOW_CONFIDENCE)) == [every], "other references may show another place"
    assert asked(VAGUE) == [every]
    assert asked(replace(VAGUE, references=tuple("fedcba"[:4]))) == [[[5, 4, 3, 2], [4, 5]], every]
    references = [References.of([5, 2])]
    assert asked(vague) == [[[5, 2]]], "they are all"


def test_what_few_references_find_has_the_rivals_of_all_and_is_not_elsewhere() -> None:
    """Few references do not show the places of the others, and so once made a pose of two places sure."""
    scene, there, nearby, far = Scene(), np.eye(4), np.eye(4), np.eye(4)
    there[0, 3], nearby[0, 3], far[0, 3] = 28.0, 0.02, 2.0
    first = replace(VAGUE, references=("c",), rivals=(Rival(there, 0.6), Rival(nearby, 0.4)), p_correct=0.995)
    precise = replace(OK, p_correct=1.0, rivals=(Rival(far, 0.3),))
    extractor = SimpleNamespace(extract=lambda images: [scene.features[scene.names[0]]] * len(images), color=False)
    kind = SimpleNamespace(name="sift", extractor=extractor)

    def located(*answers: QueryResult) -> tuple[QueryResult, Scripted]:
        further = Scripted(*answers)
        scene_map = scripted_map(Scripted(first), further, [kind])
        vars(scene_map)["index_of"] = {name: number for number, name in enumerate("abcdef")}
        references = [References.of([3, 2])] * len(scene.query.views)
        return scene_map.locate(with_pixels(scene.query), references=references), further

    result, further = located(precise)
    assert [(rival.world_from_rig[0, 3], rival.support) for rival in result.rivals] == [(28.0, 0.6), (2.0, 0.3)]
    assert (result.status, result.rival_support, len(further.asked)) == (Status.OK, 0.6, 1)
    assert 0.99 < result.p_correct < 1.0
    assert [len(found.images) for found in result._in_map.open()[2]] == [2], "with all references"
    elsewhere = replace(precise, world_from_rig=there)
    result, further = located(elsewhere, elsewhere)
    assert len(further.asked) == 2, "all references are asked"
    result, further = located(replace(VAGUE, covariance=np.eye(6) / 4), FAILED)
    assert (len(further.asked), result.position_std, result.first_status) == (2, VAGUE.position_std / 2, "ok")


def test_what_the_first_attempt_knew_of_rivals_is_judged_by_all_features() -> None:
    """More features once turned a wrong pose into ok, as they had forgotten the rival that SIFT knew."""
    scene, there, far = Scene(), np.eye(4), np.eye(4)
    there[0, 3], far[0, 3] = 28.0, 900.0
    first = replace(LOW, rivals=(Rival(there, 0.9), Rival(far, 0.3)))
    extractor = SimpleNamespace(extract=lambda images: [scene.features[scene.names[0]]] * len(images), color=False)
    further, kind = Scripted(OK), SimpleNamespace(name="sift", extractor=extractor)
    near = {0.0: [0, 1], 28.0: [5], 900.0: []}
    scripted_map(Scripted(first), further, [kind], near).locate(with_pixels(scene.query), references=scene.references)
    assert [(prior.world_from_rig[0, 3], prior.images.tolist()) for prior in further.priors] == [(0, [0, 1]), (28, [5])]


@pytest.mark.parametrize("lacks", ["references", "readable image"])
def test_a_query_that_nothing_can_help_is_not_asked_again(lacks: str) -> None:
    scene = Scene()
    query = scene.query if lacks == "references" else replace(scene.query, features=["no image"])
    references = [References.of([])] if lacks == "references" else scene.references
    first, further = Scripted(FAILED), Scripted()
    result = scripted_map(first, further, []).locate(query, references=references)
    assert (result.status_text, result.first_status) == (FAILED.status_text, None)
    assert not further.asked


class OfOneCamera:
    """A map in which images (H, W) of value 1 tell that the true focal length is 500 px, those of value 0 nothing, and
    those of value 2 only that it is no small one."""

    cameras: Any = None

    def query(self, image: Any, camera: pycolmap.Camera, *_: Any) -> Query:
        return Query([View("image", image, camera, False)], np.eye(4)[None])

    def describe(self, query: Query) -> Query:
        return query

    def locate(self, query: Query, near: Any) -> QueryResult:
        (view,) = query.views
        focal_px, tells = view.camera.mean_focal_length(), 1 if isinstance(view.image, Path) else int(view.image.max())
        true = abs(focal_px - 500) < 1 or (tells == 2 and focal_px > 300)
        result = replace(OK if true or not tells else DOUBTED, num_inliers=50)
        return result if true or not tells else replace(result, focals_px=(500.0,))


def test_images_of_one_camera_share_what_one_of_them_tells_of_its_focal_length() -> None:
    told, telling_nothing, other_size = np.ones((48, 64), np.uint8), np.zeros((48, 64), np.uint8), np.zeros((48, 60))
    images = [telling_nothing, told, other_size, "no image.jpg"]
    results = localize_images(OfOneCamera(), images)  # type: ignore[arg-type]
    assert [result.status_text for result in results[:3]] == ["ok", "ok", "low_confidence: camera?"]
    assert results[0].remark.startswith("focal length 500 px, from 1 other")
    assert results[1].remark.startswith("focal length 500 px, which fits")
    assert "do not tell it" in results[2].remark
    assert results[3].status_text.startswith("failed: ImageError")
    alone = localize_images(OfOneCamera(), [telling_nothing])  # type: ignore[arg-type]
    assert alone[0].status_text == "low_confidence: camera?"


def test_images_of_two_cameras_of_the_map_do_not_share_a_focal_length() -> None:
    image, left, right = (
        np.zeros((48, 64), np.uint8),
        *(
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=64, height=48, params=[focal, 32.0, 24.0])
            for focal in (50, 90)
        ),
    )
    assert camera_key(image, left) == camera_key(image, left) != camera_key(image, right)


def test_a_focal_length_that_fits_as_others_do_is_not_ok() -> None:
    """A photograph squeezed to half of its height was ok with a focal length three times too long, 13 units away."""
    (result,) = localize_images(OfOneCamera(), [np.full((48, 64), 2, np.uint8)])  # type: ignore[arg-type]
    assert result.status_text == "low_confidence: camera?"
    assert result.remark == "focal length 500 px, which fits its matches, as other intrinsics do"


@pytest.mark.parametrize("of_map", [False, True], ids=["EXIF", "camera of the map"])
@pytest.mark.parametrize(("side", "status"), [(64, "ok"), (128, "low_confidence: camera?")])
def test_a_cropped_image_is_ok_only_if_the_matches_tell_its_principal_point(
    tmp_path: Path, side: int, status: str, of_map: bool
) -> None:
    """A crop of a corner that kept its EXIF was ok 1.5 m and 19 degrees off. The map's may be of another corner."""
    exif = PIL.Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 35, 0xA002: side, 0xA003: 48})
    PIL.Image.new("RGB", (64, 48)).save(tmp_path / "a.jpg", exif=exif)
    scene_map = OfOneCamera()
    if of_map:
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=64, height=48, params=[500.0, 32.0, 24.0])
        sensors = pd.DataFrame({"sensor_type": ["camera"], "sensor_id": ["cam"]})
        images = pd.DataFrame({"sensor_id": ["cam"], "path": ["a.jpg"]})
        session: Any = SimpleNamespace(
            camera_rows=[0],
            sensors=sensors,
            images=images,
            camera=lambda _: camera,
            image_path=lambda _: tmp_path / "a.jpg",
        )
        scene_map.cameras = MapCameras(session)
    (result,) = localize_images(scene_map, [tmp_path / "a.jpg"])  # type: ignore[arg-type]
    assert result.status_text == status
