"""The simplest method, for comparison: the query gets the pose of its best reference."""

from collections.abc import Sequence

from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.pose.base import Localizer, Prior, QueryMatches
from toolkit.pose.result import QueryResult, Status


class NearestLocalizer(Localizer):
    """Gives the query image with the best retrieval score the pose of its first reference."""

    def __init__(self, image_names: list[str], world_from_cams: Floats) -> None:
        """`world_from_cams` (N, 4, 4) are the poses of the N map images."""
        self.image_names = image_names
        self.world_from_cams = world_from_cams

    def solve(self, matches: QueryMatches, prediction: None = None, priors: Sequence[Prior] = ()) -> QueryResult:
        """Return the pose of the best reference, never `ok`; see `Localizer`."""
        query, references = matches.query, matches.references
        scores = [(float(best.scores[0]), camera) for camera, best in enumerate(references) if len(best.images)]
        if not scores:
            return QueryResult.failed("no references")
        camera = max(scores)[1]
        reference = int(references[camera].images[0])
        world_from_rig = self.world_from_cams[reference] @ geometry.invert(query.rig_from_cams[camera])
        names = (self.image_names[reference],)
        return QueryResult(Status.LOW_CONFIDENCE, "", world_from_rig, references=names, found_by="nearest")
