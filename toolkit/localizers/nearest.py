"""The baseline: the pose of the best reference."""

from collections.abc import Sequence

from toolkit import geometry
from toolkit.geometry import Floats
from toolkit.localizers.base import PoseEstimate, Prior, Query, QueryInput, References


class NearestLocalizer:
    """Puts the query image with the best score where its first reference is, looking the same way."""

    batch_size = 1

    def __init__(self, image_names: list[str], world_from_cams: Floats) -> None:
        """`world_from_cams`, (N, 4, 4), are the poses of the map's N images."""
        self.image_names = image_names
        self.world_from_cams = world_from_cams

    def predict(self, queries: Sequence[QueryInput], following: Sequence[QueryInput] = ()) -> list[None]:
        """Return nothing for each query: no network is asked."""
        return [None] * len(queries)

    def localize(
        self, query: Query, references: Sequence[References], prediction: None = None, priors: Sequence[Prior] = ()
    ) -> PoseEstimate:
        """Return the pose of the best reference, never `ok`; see `Localizer`."""
        best = [(float(part.scores[0]), camera) for camera, part in enumerate(references) if len(part.images)]
        if not best:
            return PoseEstimate("failed: no references")
        camera = max(best)[1]
        reference = int(references[camera].images[0])
        world_from_rig = self.world_from_cams[reference] @ geometry.invert(query.rig_from_cams[camera])
        return PoseEstimate("low_confidence", world_from_rig, references=(reference,), found_by="nearest")
