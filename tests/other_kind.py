"""A second kind of local features that needs no weights: SIFT's under another name, of images turned upright."""

from typing import Any

import pytest

from toolkit.features.features import KINDS, FeatureKind, SiftExtractor

OTHER = FeatureKind(
    "tests.other_kind:OtherExtractor", ("mutual",), 0.85, -1.0,
    epipolar_min_score=0.6, guided_min_score=0.75, scale_octaves=1.0,
)  # fmt: skip


class OtherExtractor(SiftExtractor):
    def __init__(self, *_: object, settings: None) -> None:
        super().__init__()

    @property
    def settings(self) -> dict[str, Any]:
        return {**super().settings, "name": "other"}


def add_other_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let manifests name the kind `other`."""
    monkeypatch.setitem(KINDS, "other", OTHER)
