"""Ask further kinds of local features where a pose is not sure without them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from toolkit.capture.images import pixels_of
from toolkit.features.features import LocalFeatures, extract_turned
from toolkit.features.stores import as_stored
from toolkit.localizers.base import Localizer, PoseEstimate, Query, References
from toolkit.localizers.on_demand import OnDemandLocalizer


class EscalatingLocalizer:
    """Asks one localizer first, and where its pose is not `ok` another that has more kinds of features.

    A query that already has features of all kinds is one that the first was asked about before.
    """

    def __init__(self, first: Localizer, second: OnDemandLocalizer, names: str) -> None:
        """The second's kinds of features begin with the first's; `names` are the others."""
        self.first, self.second, self._names = first, second, names

    @property
    def image_names(self) -> list[str]:
        return self.first.image_names

    @property
    def batch_size(self) -> int:
        return self.first.batch_size

    def predict(self, queries: Sequence[tuple[Query, Sequence[References]]]) -> list[Any]:
        """Return what the first's network says of each query; see `Localizer`."""
        return self.first.predict(queries)

    def localize(self, query: Query, references: Sequence[References], prediction: Any = None) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera; see `Localizer`.

        `found_by` names the further kinds if the pose rests on the matches of all kinds.
        """
        kinds = len(self.second.mapped) + len(self.second.on_demand)
        has_all = any(not isinstance(features, str) and len(features) == kinds for features in query.features)
        estimate = None
        if not has_all:
            estimate = self.first.localize(query, references, prediction)
            if estimate.status == "ok":
                return estimate
            query = self._with_all_features(query)
        escalated = self.second.localize(query, references)
        if escalated.world_from_rig is not None:
            return replace(escalated, found_by=f"{escalated.found_by}+{self._names}")
        return self.first.localize(query, references, prediction) if estimate is None else estimate

    def _with_all_features(self, query: Query) -> Query:
        """Extract the features that the query lacks."""
        features: list[list[LocalFeatures] | str] = []
        for view, known in zip(query.views, query.features, strict=True):
            if isinstance(known, str):
                features.append(known)
                continue
            missing = [method.extractor for method, _ in self.second.on_demand[len(known) - len(self.second.mapped) :]]
            found = [
                extract_turned(extractor, [pixels_of(view.image, not extractor.color)], [view.turns])[0]
                for extractor in missing
            ]
            features.append([*known, *map(as_stored, found)])
        return replace(query, features=features, network_matches=[])
