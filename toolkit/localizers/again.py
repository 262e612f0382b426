"""Queries of a finished run localized once more, with other settings, from what the run stored of them."""

import time
from collections.abc import Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from toolkit.capture import Session
from toolkit.errors import ManifestError
from toolkit.features.stores import FeatureStore
from toolkit.geometry import Ints
from toolkit.localizers.base import Localizer, PoseEstimate
from toolkit.localizers.correspondences import LocalizedQuery
from toolkit.localizers.map import Map, create_localizer
from toolkit.localizers.queries import ReferencesOfImage, localized_query, references_of_images, stored_query
from toolkit.manifest import LocalizeSettings

MADE_BEFORE = ("features", "matcher", "map", "unit", "world_up")
"""Settings that what is stored was made with: features, and the points of the map."""


class LocalizeAgain:
    """Localizes queries of one pair as the localize stage does; nothing is written, and the map stays open."""

    def __init__(self, place: Map, session: Session, retrieval: Path) -> None:
        """
        Args:
            place: the open map.
            session: of the queries.
            retrieval: the pair's references, `<pair>.jsonl`.
        """
        self.place, self.session, self.retrieval = place, session, retrieval
        self._localizer = lru_cache(maxsize=8)(self._create)

    def settings(self, changes: Mapping[str, Any]) -> LocalizeSettings:
        """Return the settings of the run with some changed.

        Raises:
            ManifestError: no such setting; or one that features or the map were made with.
        """
        settings = LocalizeSettings.of(self.place.settings, changes)
        before = self.place.settings
        if made := [name for name in MADE_BEFORE if getattr(settings, name) != getattr(before, name)]:
            raise ManifestError(
                f"{', '.join(made)}: found other settings than those of the run. The features and the map of the run "
                "were made with them, so that one query alone cannot be localized with others. Expected changes of "
                f"the rest (pnp, predictor, method, seed). For these: python -m toolkit run MANIFEST "
                f"--set localize.{made[0]}=..."
            )
        return settings

    def localize(self, rows: Ints, settings: LocalizeSettings) -> tuple[PoseEstimate, LocalizedQuery, float]:
        """Return the pose of a query, what it rests on, and the seconds that it took.

        Args:
            rows: of the query's images in its session.
            settings: see `settings`.

        Raises:
            ToolkitError: features, references or weights are missing, or no map has been made for the method.
        """
        localizer, references_of_image = self._localizer(settings.model_dump_json())
        turns = self.place.turns if settings.predicts else None
        started = time.perf_counter()
        query, references = stored_query(self.session, rows, references_of_image, self._stores, (), turns)
        with threadpool_limits(1, "blas"):  # sums stay in one order, as in a run
            estimate = self.place.judged(localizer.localize(query, references))
        seconds = time.perf_counter() - started
        return estimate, localized_query(query, estimate, localizer.image_names), seconds

    def _create(self, settings: str) -> tuple[Localizer, ReferencesOfImage]:
        asked = LocalizeSettings.model_validate_json(settings)
        localizer = self.place.localizer if asked == self.place.settings else create_localizer(asked, self.place)
        index_of = {name: index for index, name in enumerate(localizer.image_names)}
        return localizer, references_of_images(self.retrieval, index_of)

    @cached_property
    def _stores(self) -> list[FeatureStore]:
        """Features of the queries; a run of `feed_forward` has none."""
        if self.place.settings.method == "feed_forward" or self.place.features_dir is None:
            return []
        folder, session = self.place.features_dir, self.session.id
        return [FeatureStore.of_session(folder, session, kind.extractor.settings) for kind in self.place.kinds]
