"""Localize by map features whose place is not triangulated but lifted by depth, where triangulated ones do not suffice.

Depth comes from the capture's depth maps, else from the network that was shown the map image. What is wrong with the
depth of an image as a whole scales its points about its camera, which no reprojection error tells if all matches are
of that image: the query then moves toward the image or away from it. So that scale is an unknown of the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from toolkit import geometry
from toolkit.capture.depths import lifted
from toolkit.geometry import Floats, Ints
from toolkit.localizers.base import PoseEstimate, Prior, Query, References
from toolkit.localizers.depth_scale import DEPTH_NOISE
from toolkit.localizers.feed_forward import CameraAnswer, FeedForwardAnswer, FeedForwardLocalizer
from toolkit.localizers.local_map import LocalMap
from toolkit.localizers.matches import MappedFeatures
from toolkit.localizers.pnp import PnpLocalizer
from toolkit.localizers.rig import Matches, RigQuery, least_squares_covariance
from toolkit.manifest import PnpSettings

DEPTH_MAP_STD = 0.01  # relative, of what is common to the depth of a depth map
LEAST_LIFTED = 20  # features of a map image that its depth maps reach; with fewer, predicted depth is asked
LEAST_RATIOS = 10  # depth ratios from which on an image's predicted depth has a scale of its own
MOST_RATIOS = 10  # that count as independent: the errors of a network's depth extend over parts of an image
MAX_RATIO_SPREAD = 0.25  # relative spread of an image's ratios; beyond, its predicted depth is wrong
CONTRADICTION = 3.0  # standard deviations by axis between a pose and the predicted camera


@dataclass(frozen=True)
class Depth:
    """Depth of features of one map image."""

    depth_m: Floats
    """(n,) NaN where unknown."""
    scale_std: float
    """Relative standard deviation of what is common to them."""
    predicted: bool = False
    measured: bool = True
    """Whether the scale was compared with known points of the image itself."""


@dataclass(frozen=True)
class LiftedMap:
    """Part of a map, with points lifted by depth beside the triangulated ones."""

    local_map: LocalMap
    """The same images; points that the lifted images see."""
    triangulated: Ints
    """(T,) index of the first T points in the whole map."""
    image: Ints
    """(P,) the map image that a point was lifted from; -1: triangulated."""
    depths: dict[int, Depth]
    """Of the images lifted."""


class DepthLifter:
    """Lifts the features of one map's images, those of the first kind that `pnp` has, and localizes with them.

    Safe to use from several threads.
    """

    def __init__(self, pnp: PnpLocalizer, feed_forward: FeedForwardLocalizer) -> None:
        self._first, self._pnp, self._feed_forward = pnp.matcher.mapped[0], pnp, feed_forward

    def localize(
        self, query: Query, references: Sequence[References], answer: FeedForwardAnswer, priors: Sequence[Prior] = ()
    ) -> PoseEstimate | None:
        """Return a pose by triangulated and lifted places of the references' features; None where none can be lifted.

        It is `ok` by the rules of `PnpLocalizer`, its covariance with the unknown scale of each image's depth; and, if
        it rests on predicted depth that nothing measured, only if the predicted camera of the query agrees.

        Args:
            query, references, priors: as for `PnpLocalizer.localize`.
            answer: what `FeedForwardLocalizer` says of the query.
        """
        count = len(self._first.map.image_names)  # further images are those that only other kinds of features have
        references = [part.take(part.images < count) for part in references]
        query = replace(
            query,
            features=[kinds if isinstance(kinds, str) else kinds[:1] for kinds in query.features],
            network_matches=[kinds[:1] for kinds in query.network_matches],
        )
        images = list(dict.fromkeys(int(image) for part in references for image in part.images))
        lifted_map = self.lift(images, answer)
        if lifted_map is None:
            return None
        localizer = _LiftedLocalizer(lifted_map, self._first, self._pnp.settings, self._pnp.seed)
        estimate = localizer.localize(query, references, None, priors)
        matched = estimate.correspondences
        source = lifted_map.image[matched.point_index]
        rests_on = np.char.endswith(matched.found_by, "/guided") & (source >= 0)
        used = [lifted_map.depths[int(image)] for image in np.unique(source[rests_on])]
        whole = np.concatenate(
            [lifted_map.triangulated, np.full(len(lifted_map.image) - len(lifted_map.triangulated), -1)]
        )
        found_by = np.where(source >= 0, f"{self._first.name}/lifted", matched.found_by)
        estimate = replace(
            estimate,
            found_by="lifted+feed_forward" if any(depth.predicted for depth in used) else "lifted",
            correspondences=replace(matched, point_index=whole[matched.point_index], found_by=found_by),
        )
        guessed = any(not depth.measured for depth in used)
        if estimate.status == "ok" and guessed and not _consistent(estimate, answer.estimate):
            why = "the predicted camera contradicts the pose that its depth gives"
            return replace(estimate, status="low_confidence", reason=why)
        return estimate

    def lift(self, images: Sequence[int], answer: FeedForwardAnswer) -> LiftedMap | None:
        """Return the part of the map that images see, with points for their features that have none."""
        local_map = self._first.map
        predictions = _predictions(answer)
        points, obs, source, depths = [], [], [], {}
        for image in images:
            xy = self._first.features[local_map.image_names[image]].keypoints.astype(np.float64)
            free = np.setdiff1d(np.arange(len(xy)), local_map.observations(image)[0])
            depth = self._depth(image, xy[free], predictions.get(image))
            if depth is None:
                continue
            known = np.flatnonzero(np.isfinite(depth.depth_m))
            in_cam = lifted(local_map.cameras[image], xy[free[known]], depth.depth_m[known])
            finite = np.isfinite(in_cam).all(axis=1)
            known, in_cam = known[finite], in_cam[finite]
            if not len(known):
                continue
            points.append(geometry.transform(local_map.world_from_cams[image], in_cam))
            obs.append(np.column_stack([np.full(len(known), image), free[known]]))
            source.append(np.full(len(known), image))
            depths[image] = depth
        if not points:
            return None
        seen = [local_map.observations(image)[1] for image in images]
        triangulated = np.unique(np.concatenate(seen))
        part, image_of = local_map.part(triangulated), np.concatenate(source)
        new = np.column_stack([np.concatenate(obs), len(triangulated) + np.arange(len(image_of))])
        rows = np.concatenate([np.column_stack([part.obs_image, part.obs_keypoint, part.obs_point]), new])
        rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
        part = replace(
            part,
            points=np.concatenate([part.points, *points]),
            colors=np.concatenate([part.colors, np.full((len(image_of), 3), 128, np.uint8)]),
            obs_image=rows[:, 0],
            obs_keypoint=rows[:, 1],
            obs_point=rows[:, 2],
            noise_px=np.concatenate([part.noise_px, np.zeros(len(image_of), np.float32)]),
        )
        return LiftedMap(part, triangulated, np.concatenate([np.full(len(triangulated), -1), image_of]), depths)

    def _depth(self, image: int, xy: Floats, predicted: tuple[CameraAnswer, int] | None) -> Depth | None:
        """Return the depth at pixels of a map image: of the capture's depth maps, else predicted."""
        seen = self._feed_forward.seen_depth(image)
        depth_m = seen.at(xy)
        if np.isfinite(depth_m).sum() >= LEAST_LIFTED:
            return Depth(depth_m, DEPTH_MAP_STD)
        if predicted is None:
            return None
        answer, view = predicted
        assert answer.prediction is not None
        assert answer.alignment is not None
        ratios = answer.depth_ratios[view - 1]
        ratios = np.log(ratios[ratios > 0])
        if len(ratios) >= LEAST_RATIOS:
            middle = float(np.median(ratios))
            spread = 1.4826 * float(np.median(np.abs(ratios - middle)))  # that of a Gaussian with this median
            if spread > MAX_RATIO_SPREAD:
                return None
            scale, std, measured = np.exp(middle), spread / np.sqrt(min(len(ratios), MOST_RATIOS)), True
        elif answer.alignment.scale_known:
            # The depth need not have the scale of the cameras quite.
            scale, measured = answer.alignment.world_from_model.scale, False
            std = float(np.hypot(answer.alignment.scale_std, DEPTH_NOISE))
        else:
            return None
        return Depth(scale * answer.prediction.depth_at(view, xy), max(std, DEPTH_MAP_STD), True, measured)


class _LiftedLocalizer(PnpLocalizer):
    """Localizes in a lifted map; the common scale of each image's depth is unknown within its standard deviation."""

    def __init__(self, lifted_map: LiftedMap, mapped: MappedFeatures, settings: PnpSettings, seed: int) -> None:
        features = MappedFeatures(lifted_map.local_map, mapped.features, mapped.kind, mapped.matcher, mapped.name)
        super().__init__([features], settings, seed)
        self._lifted_map = lifted_map

    def _covariance(self, query: RigQuery, rig_from_world: Floats, matches: Matches) -> Floats | None:
        lifted_map, local_map = self._lifted_map, self._lifted_map.local_map
        source = lifted_map.image[matches.point]
        images = np.unique(source[source >= 0])
        if not len(images):
            return super()._covariance(query, rig_from_world, matches)
        of_pose, of_point = query.jacobians(rig_from_world, matches, local_map.points)
        of_scales = np.zeros((len(matches), 2, len(images)))
        for number, image in enumerate(images):
            mine = source == image
            # A change s of the scale moves a point by s times its place relative to the image's camera.
            arm = local_map.points[matches.point[mine]] - local_map.world_from_cams[image, :3, 3]
            of_scales[mine, :, number] = np.einsum("okj,oj->ok", of_point[mine], arm)
        noise = self._noise_of_points(query, matches, of_point)
        noise[source >= 0] = 0  # what is a lifted point's own shows in its error
        information = np.zeros((6 + len(images),) * 2)
        information[6:, 6:] = np.linalg.inv(_scale_covariance([lifted_map.depths[int(image)] for image in images]))
        # Rotations, places and scales are of like size; what is not determined shows in the whole.
        covariance = least_squares_covariance(
            np.concatenate([of_pose, of_scales], axis=2),
            query.errors_px(rig_from_world, matches, local_map.points),
            noise,
            information,
        )
        return None if covariance is None else covariance[:6, :6]


def _scale_covariance(depths: Sequence[Depth]) -> Floats:
    """Return what is known of the relative errors of scale of several images' depth, (J, J).

    Those of predicted depths that nothing measured have the alignment's scale in common; a half of their variance is
    each one's own.
    """
    stds = np.array([depth.scale_std for depth in depths])
    common = stds * np.array([not depth.measured for depth in depths]) / np.sqrt(2)
    return np.diag(stds**2 - common**2) + np.outer(common, common)


def _predictions(answer: FeedForwardAnswer) -> dict[int, tuple[CameraAnswer, int]]:
    """Return for each consistent reference what was predicted of it, and its place in the prediction."""
    predictions: dict[int, tuple[CameraAnswer, int]] = {}
    for camera in answer.cameras:
        if camera.prediction is None or camera.alignment is None or camera.world_from_cam is None:
            continue
        for view, image in enumerate(camera.references, start=1):
            if camera.alignment.inliers[view - 1]:
                predictions.setdefault(int(image), (camera, view))
    return predictions


def _consistent(estimate: PoseEstimate, predicted: PoseEstimate) -> bool:
    """Tell whether a pose and a predicted one agree, as far as both are known."""
    poses = estimate.world_from_rig, predicted.world_from_rig
    covariances = estimate.covariance, predicted.covariance
    if poses[0] is None or poses[1] is None or covariances[0] is None or covariances[1] is None:
        return False
    spread = np.sqrt(np.diagonal(covariances[0] + covariances[1]).reshape(2, 3).sum(axis=1))
    rotation_deg, distance_m = geometry.pose_error(poses[0], poses[1])
    limits = CONTRADICTION / np.sqrt(3) * spread  # of lengths, that are of three axes
    return bool(np.isfinite(spread).all() and np.radians(rotation_deg) <= limits[0] and distance_m <= limits[1])
