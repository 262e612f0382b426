"""Kinds of local features, by name."""

import pytest

from toolkit.errors import ManifestError
from toolkit.features.features import SiftExtractor, create_extractor
from toolkit.manifest import FeaturesSettings, SiftSettings


def test_extractors_by_name() -> None:
    sift = create_extractor("sift", FeaturesSettings.of({"sift": {"max_keypoints": 200, "min_long_side": 0}}))
    assert sift.settings == SiftExtractor(SiftSettings(min_long_side=0, max_keypoints=200)).settings
    assert next(iter(sift.settings)) == "name"
    for name, settings, named in (
        ("sift", {"sift": {"keypoints": 5}}, "'sift.keypoints'.*max_keypoints"),
        ("surf", {}, "Unknown local features 'surf'"),
    ):
        with pytest.raises(ManifestError, match=named):
            create_extractor(name, FeaturesSettings.of(settings))
