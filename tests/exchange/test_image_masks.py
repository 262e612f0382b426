"""Masks of images: carried into a capture, no features in them, a changed one makes features anew."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.features.test_sift import textured
from toolkit.capture import Capture, parse_camera
from toolkit.capture.images import find_mask
from toolkit.errors import CaptureError, ImageError
from toolkit.exchange.interchange import import_images
from toolkit.exchange.photographs import gather
from toolkit.features.features import SiftExtractor, usable
from toolkit.features.matching import create_local_methods, resolve_auto
from toolkit.features.stores import extract_session
from toolkit.manifest import LocalizeSettings
from toolkit.scene.map import Map

CAMERA = "PINHOLE, 320, 240, 300, 300, 160, 120"


def save_mask(path: Path, size: tuple[int, int] = (320, 240), left: int = 0, black: int = 0) -> Path:
    """Write a mask whose left columns are black."""
    pixels = np.full(size[::-1], 255, np.uint8)
    pixels[:, :left] = black
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels)
    return path


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Four photographs; the first three have masks: the left half, all, another size."""
    for number in range(4):
        (tmp_path / "images/cam").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / f"images/cam/{number}.jpg"), textured(number))
    for number, (size, left) in enumerate([((320, 240), 160), ((320, 240), 320), ((160, 120), 0)]):
        save_mask(tmp_path / f"masks/cam/{number}.jpg.png", size, left)
    return tmp_path / "images"


@pytest.mark.parametrize("placing", ["link", "copy"])
def test_masks_of_an_import_hide_features(photos: Path, placing: str) -> None:
    report = import_images(photos, photos.parent / "CAP", camera=CAMERA, placing=placing)
    assert report.record["masks"][0] == 3
    assert any("2.jpg.png" in note and "160 x 120" in note for note in report.notes)
    session = Capture.open(photos.parent / "CAP")["ios_query"]
    store = extract_session(session, photos.parent / "features", SiftExtractor(), progress=False)
    name = "ios_query/raw_data/import/images/cam/{}.jpg".format
    (free,) = SiftExtractor().extract([cv2.imread(str(photos / "cam/0.jpg"), cv2.IMREAD_GRAYSCALE)])
    expected = free.keypoints[free.keypoints[:, 0] >= 160]
    assert 0 < len(expected) < len(free)
    assert np.array_equal(store[name(0)].keypoints, expected)
    assert sorted(store.failed) == [name(1), name(2)]
    assert "black everywhere" in store.failed[name(1)]
    assert "160 x 120" in store.failed[name(2)]
    assert (store[name(3)].keypoints[:, 0] < 160).any()


def test_a_changed_mask_makes_only_the_features_of_its_image_anew(photos: Path) -> None:
    import_images(photos, photos.parent / "CAP", camera=CAMERA)
    session = Capture.open(photos.parent / "CAP")["ios_query"]
    out, name = photos.parent / "features", "ios_query/raw_data/import/images/cam/0.jpg"
    before = extract_session(session, out, progress=False)
    images = session.files_fingerprint
    save_mask(photos.parent / "masks/cam/0.jpg.png", left=80)
    changed = Capture.open(photos.parent / "CAP")["ios_query"]
    after = extract_session(changed, out, progress=False)
    assert 80 <= after[name].keypoints[:, 0].min() < 160 <= before[name].keypoints[:, 0].min()
    assert [key for key in after if after.made_from[key] != before.made_from[key]] == [name]
    assert changed.files_fingerprint != images
    (photos.parent / "masks/cam/0.jpg.png").unlink()  # the link in the session leads nowhere, and is no missing mask
    lost = extract_session(Capture.open(photos.parent / "CAP")["ios_query"], out, progress=False)
    assert "0.jpg.png" in lost.failed[name]


def test_a_query_uses_its_mask(photos: Path) -> None:
    camera = parse_camera("camera", CAMERA)
    (method,) = create_local_methods(resolve_auto(LocalizeSettings()), ["sift"])
    (view,) = Map.query(photos / "cam/0.jpg", camera).views
    assert view.extract(method).keypoints[:, 0].min() >= 160
    (view,) = Map.query(photos / "cam/1.jpg", camera).views
    with pytest.raises(ImageError, match="black everywhere"):
        view.extract(method)
    (view,) = Map.query(cv2.imread(str(photos / "cam/0.jpg")), camera).views
    assert view.extract(method).keypoints[:, 0].min() < 160


def test_masks_are_found_where_colmap_has_them(tmp_path: Path) -> None:
    image = tmp_path / "images/a/1.jpg"
    assert find_mask(image) is None
    beside = save_mask(tmp_path / "images/a/masks/1.jpg.png")
    assert find_mask(image) == beside
    inside = save_mask(tmp_path / "images/masks/a/1.jpg.png")
    assert find_mask(image) == inside
    given = save_mask(tmp_path / "other/1.jpg.png")
    assert find_mask(image, tmp_path / "other") == given
    assert find_mask(image, tmp_path / "nowhere") is None


def test_dark_gray_is_not_black(tmp_path: Path) -> None:
    (features,) = SiftExtractor().extract([textured(0)])
    camera = parse_camera("camera", CAMERA)
    assert usable(features, None, camera) is features
    assert len(usable(features, save_mask(tmp_path / "m.png", left=320, black=1), camera)) == len(features)


def test_masks_are_no_photographs(photos: Path) -> None:
    save_mask(photos / "masks/cam/3.jpg.png", left=10)
    found, _ = gather([photos], photos.parent / "PLACE/reconstruction/images")
    assert [item.name for item in found] == [f"cam/{number}.jpg" for number in range(4)]
    assert [item.mask and item.mask.name for item in found] == [f"{number}.jpg.png" for number in range(4)]


def test_a_folder_without_a_mask_of_the_images_is_refused(photos: Path) -> None:
    (photos.parent / "empty").mkdir()
    for take in (
        lambda masks: import_images(photos, photos.parent / "CAP", camera=CAMERA, masks=masks),
        lambda masks: gather([photos], photos.parent / "PLACE/reconstruction/images", masks=masks),
    ):
        with pytest.raises(CaptureError, match=r"cam/0\.jpg\.png"):
            take(photos.parent / "empty")
    assert not (photos.parent / "CAP/sessions/ios_query").exists()
