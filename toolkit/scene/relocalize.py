"""Localize queries of a finished run again with other settings, from the features and references of the run."""

import time
from collections.abc import Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from toolkit.capture import Session
from toolkit.capture.upright import Turns
from toolkit.errors import ArtifactError, ManifestError
from toolkit.features.stores import FeatureStore, features_path
from toolkit.geometry import Ints
from toolkit.manifest import LocalizeSettings
from toolkit.pose.base import Localizer, PoseEstimate
from toolkit.pose.correspondences import LocalizedQuery
from toolkit.pose.stored_queries import ReferencesOfImage, localized_query, references_of_images, stored_query
from toolkit.scene.map import Map, create_localizer
from toolkit.threads import fixed_sums

MADE_BEFORE = ("features", "matcher", "map", "unit", "world_up")
"""Settings that the stored features and map points depend on, so they cannot change."""
WITHOUT_FEATURES = ("feed_forward", "nearest")
"""Methods that need no features of the queries."""


class LocalizeAgain:
    """Localizes queries of one pair like the localize stage, without writing; the map stays open."""

    def __init__(self, map_: Map, session: Session, retrieval: Path) -> None:
        """Take an open map, a query session, and the file with the pair's references, `<pair>.jsonl`."""
        self.map, self.session, self.retrieval = map_, session, retrieval
        self._localizer = lru_cache(maxsize=8)(self._create)

    def settings(self, changes: Mapping[str, Any]) -> LocalizeSettings:
        """Return the settings of the run with changes.

        Raises:
            ManifestError: a setting is unknown, or the stored features or the map depend on it.
        """
        settings = LocalizeSettings.of(self.map.settings, changes)
        before = self.map.settings
        if fixed := [name for name in MADE_BEFORE if getattr(settings, name) != getattr(before, name)]:
            raise ManifestError(
                f"{', '.join(fixed)}: found other settings than those of the run. The stored features and the map "
                "depend on them, so they cannot change for one query. Settings that can: pnp, predictor, method, seed. "
                f"To change these: python -m toolkit run MANIFEST --set localize.{fixed[0]}=..."
            )
        return settings

    @fixed_sums
    def localize(self, rows: Ints, settings: LocalizeSettings) -> tuple[PoseEstimate, LocalizedQuery, float]:
        """Return the estimate of a query, its correspondences, and the seconds that localization took.

        Args:
            rows: rows of the query's images in its session.
            settings: see `settings`.

        Raises:
            ToolkitError: features, references or weights are missing, or the run has no map for the method.
        """
        localizer, references_of_image, turns = self._localizer(settings.model_dump_json())
        stores = [] if settings.method in WITHOUT_FEATURES else self._stores
        started = time.perf_counter()
        query, references = stored_query(self.session, rows, references_of_image, stores, (), turns)
        estimate = self.map.judged(localizer.localize(query, references))
        seconds = time.perf_counter() - started
        return estimate, localized_query(query, estimate, localizer.image_names), seconds

    def _create(self, settings_json: str) -> tuple[Localizer, ReferencesOfImage, Turns | None]:
        settings = LocalizeSettings.model_validate_json(settings_json)
        localizer = self.map.localizer if settings == self.map.settings else create_localizer(settings, self.map)
        index_of = {name: index for index, name in enumerate(localizer.image_names)}
        return localizer, references_of_images(self.retrieval, index_of), self.map.turns_for(settings)

    @cached_property
    def _stores(self) -> list[FeatureStore]:
        """Features of the queries."""
        if self.map.features_dir is None:
            return []
        folder, session = self.map.features_dir, self.session.id
        paths = [features_path(folder, session, kind.extractor.settings) for kind in self.map.kinds]
        if missing := [path for path in paths if not path.exists()]:
            raise ArtifactError(
                f"{missing[0]}: no features of the queries. A run with the method `feed_forward` extracts none. To "
                "change its method: python -m toolkit run MANIFEST --set localize.method=hybrid"
            )
        return [FeatureStore.open(path) for path in paths]
