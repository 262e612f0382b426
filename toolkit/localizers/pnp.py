"""Localize by matching a query's features to triangulated map points, and PnP for single cameras and rigs.

Several kinds of features can be used together: their matches are pooled, and a pose is sought that explains them all.

In two steps. First, descriptors alone: the query against its retrieved references, then LO-RANSAC. Then, with that
pose, the points of all covisible map images are projected into the query and matched only near where they should be,
which finds several times as many and makes the pose more precise.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

from toolkit import geometry
from toolkit.capture.cameras import in_view, projection_jacobian, view_bounds
from toolkit.features.features import LocalFeatures
from toolkit.features.matching import unit_descriptors
from toolkit.localizers.mapped import Known, MappedFeatures
from toolkit.localizers.mapping import LocalMap
from toolkit.manifest import PnpSettings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


_RANSAC_CONFIDENCE = 0.9999

# PoseLib's solver for rigs draws from the C library's generator, which threads share: without a seed of its own, or two
# at once, equal seeds would give poses that are unequal in their last digits.
_RIG_RANSAC = Lock()

CONFIRMED = (5.0, 0.5)  # degrees, meters: further apart, two answers contradict each other


@dataclass(frozen=True)
class PoseEstimate:
    """The answer for one query device: a pose, or why there is none."""

    status: str
    """`ok`, `low_confidence`, or `failed: <reason>`."""
    world_from_rig: Floats | None = None
    """(4, 4); for a single camera the rig is the camera."""
    covariance: Floats | None = None
    """(6, 6) of a small motion of the rig in its own frame: rotation, radians, then translation, meters."""
    num_matches: int = 0
    """2D-3D matches found from descriptors alone."""
    num_inliers: int = 0
    """Of these, within `ransac_max_error_deg` of the final pose."""
    num_guided: int = 0
    """Matches that the final pose rests on, within `max_error_deg`."""
    rmse_px: float = float("nan")
    rival_support: float = 0.0
    """Guided matches of the best clearly different pose, relative to this one's; 0 where there is none."""
    references: tuple[int, ...] = ()
    """Map images that the matches came from."""
    camera_index: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(num_guided,) camera of the rig."""
    pixels: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    """(num_guided, 2)."""
    point_index: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(num_guided,) map point; -1: a place that was lifted by depth."""
    found_by: str = "pnp"
    """What the pose rests on: `pnp`, `pnp+vggt` (found from a prior), `lifted` (map features lifted by a capture's
    depth maps), `lifted+vggt` (by predicted depth, too), `vggt` (a prediction), `nearest`."""
    scale_std: float = float("nan")
    """Relative standard deviation of a prediction's scale; inf if unknown, NaN without a prediction."""
    rejected: tuple[int, ...] = ()
    """References whose predicted places contradict the others'."""
    reason: str = ""
    """Of a prediction: what was left out or is unknown."""

    @property
    def position_std_m(self) -> float:
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]))) if self.covariance is not None else float("nan")

    @property
    def rotation_std_deg(self) -> float:
        if self.covariance is None:
            return float("nan")
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))

    @property
    def inlier_ratio(self) -> float:
        return self.num_inliers / self.num_matches if self.num_matches else 0.0


@dataclass(frozen=True)
class _Matches:
    """K matches of query pixels to map points."""

    camera: Ints
    """(K,) camera of the rig."""
    pixels: Floats
    """(K, 2)."""
    point: Ints
    """(K,) map point."""

    @classmethod
    def pooled(cls, parts: "Sequence[_Matches]") -> "_Matches":
        """Return the matches of all parts."""
        return cls(
            np.concatenate([np.zeros(0, np.int64), *(part.camera for part in parts)]),
            np.concatenate([np.zeros((0, 2)), *(part.pixels for part in parts)]),
            np.concatenate([np.zeros(0, np.int64), *(part.point for part in parts)]),
        )

    def rows(self) -> NDArray[np.void]:
        """Return the matches (K,) as values that can be compared."""
        rows = np.ascontiguousarray(np.column_stack([self.camera, self.point, self.pixels]))
        return rows.view([("", rows.dtype)] * rows.shape[1])[:, 0]

    def __len__(self) -> int:
        return len(self.point)

    def __getitem__(self, part: NDArray[np.bool_]) -> "_Matches":
        return _Matches(self.camera[part], self.pixels[part], self.point[part])


@dataclass(frozen=True)
class _Hypothesis:
    """A pose and the guided matches that it rests on."""

    rig_from_world: Floats
    matches: _Matches

    @property
    def world_from_rig(self) -> Floats:
        return geometry.invert(self.rig_from_world)


@dataclass(frozen=True)
class Prior:
    """A pose to look for, from elsewhere than matches."""

    world_from_rig: Floats
    """(4, 4)"""
    images: Ints
    """Map images that see what the query sees."""
    radius_deg: float
    """How far from where the pose puts a map point its feature may be."""


class PnpLocalizer:
    """Localizes queries in one map. Safe to use from several threads; the map is never changed."""

    def __init__(
        self,
        local_map: LocalMap,
        features: Mapping[str, LocalFeatures],
        settings: PnpSettings | None = None,
        seed: int = 0,
    ):
        """
        Args:
            local_map: a map triangulated from SIFT features; see `of` for others.
            features: of its images, by name.
        """
        self._use([MappedFeatures(local_map, features)], settings, seed)

    @classmethod
    def of(cls, mapped: Sequence[MappedFeatures], settings: PnpSettings | None = None, seed: int = 0) -> "PnpLocalizer":
        """Return a localizer that uses several kinds of features together, each with a map of the same session."""
        localizer = cls.__new__(cls)
        localizer._use(mapped, settings, seed)
        return localizer

    def _use(self, mapped: Sequence[MappedFeatures], settings: PnpSettings | None, seed: int) -> None:
        self.mapped = list(mapped)
        self.map = LocalMap.pooled([one.map for one in mapped])
        """All kinds' points, one kind after the other."""
        self.settings = settings or PnpSettings()
        self.seed = seed
        self._first_point = np.cumsum([0, *(len(one.map.points) for one in mapped)])

    def localize(
        self,
        cameras: Sequence[pycolmap.Camera],
        rig_from_cams: Floats,
        features: Sequence[LocalFeatures | Sequence[LocalFeatures]],
        references: Sequence[Sequence[int]],
        priors: Sequence[Prior] = (),
        known: Sequence[Sequence[Known | None]] = (),
    ) -> PoseEstimate:
        """Return one pose for the cameras of a rig, or for a single camera.

        Args:
            cameras: C cameras.
            rig_from_cams: (C, 4, 4); the identity for a single camera.
            features: for each camera its local features, of several kinds a sequence in the order of `mapped`.
            references: for each camera, indices of map images to match it with, best first.
            priors: poses that are hypotheses too. One wins if clearly more guided matches support it; one that
                confirms an `ok` pose changes nothing.
            known: for each camera and kind, matches with references that were made before; none where not given.
        """
        if not any(len(refs) for refs in references):
            return PoseEstimate("failed: no references")
        kinds = [[one] if isinstance(one, LocalFeatures) else list(one) for one in features]
        query = _Query(list(cameras), np.asarray(rig_from_cams, np.float64), kinds)
        matches = self._match(query, references, known)
        distinct = len(np.unique(matches.point))
        hypotheses = self._hypotheses(query, matches, references) if distinct >= 4 else []
        if distinct < 4:
            found = PoseEstimate("failed: too few matches", num_matches=len(matches))
        elif not hypotheses:
            found = PoseEstimate("failed: no consistent pose", num_matches=len(matches))
        else:
            found = self._estimate(query, matches, hypotheses, references)
        for prior in priors:
            found = self._compare(query, matches, hypotheses, found, references, prior)
        return found

    def _compare(
        self,
        query: "_Query",
        matches: "_Matches",
        hypotheses: "list[_Hypothesis]",
        found: PoseEstimate,
        references: Sequence[Sequence[int]],
        prior: Prior,
    ) -> PoseEstimate:
        """Return the estimate that was found without a prior, or the one found with it if it is better supported."""
        if found.status == "ok" and agree(found.world_from_rig, prior.world_from_rig):
            return found  # each confirms the other
        near = self._match_guided(
            query, geometry.invert(prior.world_from_rig), self._seeing_the_same(prior.images), prior.radius_deg
        )
        start = self._ransac(query, near, self.settings.ransac_max_error_deg) if len(near) else None
        if start is None:
            return found
        hypothesis = self._improve(query, start, near)
        same = bool(hypotheses) and not _differ(hypotheses[0], hypothesis)
        support = len(hypotheses[0].matches) if hypotheses else 0
        mine = len(hypothesis.matches)
        clearly_more = support <= self.settings.ok_rival_support * mine  # a tie is no reason to change
        if (mine >= support and found.status != "ok") if same else clearly_more:
            # Judged by the matches about the prior, which is as independent of the pose as descriptors alone are.
            estimate = self._estimate(query, near, [hypothesis, *hypotheses], [prior.images.tolist()])
            known = found.world_from_rig is not None
            if estimate.world_from_rig is not None and (not same or not known or estimate.status == "ok"):
                return replace(estimate, found_by="pnp+vggt")
            return found
        if same or found.world_from_rig is None:
            return found
        rivals = sorted([*hypotheses, hypothesis], key=lambda one: -len(one.matches))
        return self._estimate(query, matches, rivals, references)

    def _seeing_the_same(self, images: Ints) -> Ints:
        """Return the map images that see the most of what the given ones see."""
        points = [self.map.observations(int(image))[1] for image in images]
        return self._covisible(np.unique(np.concatenate([np.zeros(0, np.int64), *points])))

    def _hypotheses(
        self, query: "_Query", matches: "_Matches", references: Sequence[Sequence[int]]
    ) -> "list[_Hypothesis]":
        """Return refined poses, best supported first.

        Repeated structure (a row of like windows) gives several poses that many descriptors agree with, and
        RANSAC may take one of them or something in between. So unless the first is clear, others are sought, with a
        tighter limit, among the matches that the first leaves over and among those of single references, and the
        guided matches decide: only the right pose puts the rest of the map where it is seen.
        """
        settings = self.settings
        start = self._ransac(query, matches, settings.ransac_max_error_deg)
        if start is None:
            return []
        found = [self._improve(query, start, matches)]
        inliers = self._inliers(query, found[0].rig_from_world, matches)
        share = float(inliers.mean())
        if share > settings.clear_inlier_ratio:
            return found
        if share < settings.contested_inlier_ratio:
            start = self._ransac(query, matches, settings.max_error_deg)
            if start is not None:
                found.append(self._improve(query, start, matches))
                inliers |= self._inliers(query, found[1].rig_from_world, matches)
        rest = matches[~inliers]
        # No need to look for less than half of the support.
        start = self._ransac(query, rest, settings.ransac_max_error_deg, least_inliers=int(inliers.sum() / 2))
        if start is not None:
            support = self._inliers(query, start, rest).sum()
            if share < settings.contested_inlier_ratio or support >= inliers.sum() / 2:
                found.append(self._improve(query, start, matches))
        if share < settings.contested_inlier_ratio:
            self._add_by_reference(query, matches, references, found)
        return sorted(found, key=lambda hypothesis: -len(hypothesis.matches))

    def _add_by_reference(
        self,
        query: "_Query",
        matches: "_Matches",
        references: Sequence[Sequence[int]],
        found: "list[_Hypothesis]",
    ) -> None:
        """Add the poses that matches with single references agree on, where they are clearly others."""
        every = dict.fromkeys(int(index) for of_camera in references for index in of_camera)
        shown = {index: np.isin(matches.point, self.map.observations(index)[1]) for index in every}
        best = sorted(shown, key=lambda index: -int(shown[index].sum()))
        for index in best[: self.settings.contested_references]:
            start = self._ransac(query, matches[shown[index]], self.settings.ransac_max_error_deg, least_inliers=5)
            if start is not None and not any(agree(one.world_from_rig, geometry.invert(start)) for one in found):
                found.append(self._improve(query, start, matches))

    def _inliers(self, query: "_Query", rig_from_world: Floats, matches: "_Matches") -> NDArray[np.bool_]:
        errors = query.errors_deg(rig_from_world, matches, self.map.points)
        return errors < self.settings.ransac_max_error_deg

    def _improve(self, query: "_Query", rig_from_world: Floats, matches: "_Matches") -> "_Hypothesis":
        """Match again around a pose and refine it, as long as that finds support."""
        best = _Hypothesis(rig_from_world, matches[self._inliers(query, rig_from_world, matches)])
        least = max(4, 0.5 * len(np.unique(best.matches.point)))
        for radius in self.settings.guided_radii_deg:
            images = self._covisible(np.unique(best.matches.point))
            near = self._match_guided(query, best.rig_from_world, images, radius)
            pose = self._refine(query, best.rig_from_world, near) if len(near) >= least else None
            if pose is None:
                break
            near = near[query.errors_deg(pose, near, self.map.points) < self.settings.max_error_deg]
            pose = self._refine(query, pose, near) if len(near) >= least else None
            if pose is None:
                break
            best = _Hypothesis(pose, near)
        return best

    def _estimate(
        self,
        query: "_Query",
        matches: "_Matches",
        hypotheses: "list[_Hypothesis]",
        references: Sequence[Sequence[int]],
    ) -> PoseEstimate:
        """Judge the best pose by the matches that were made without it, and by its rivals."""
        settings = self.settings
        rig_from_world, guided = hypotheses[0].rig_from_world, hypotheses[0].matches
        inliers = matches[self._inliers(query, rig_from_world, matches)]
        # A point matched in several ways, or several points on one keypoint, are one piece of evidence.
        keypoints = np.column_stack([inliers.camera, inliers.pixels])
        independent = min(len(np.unique(inliers.point)), len(np.unique(keypoints, axis=0)))
        if independent < settings.min_inliers:
            reason = f"failed: too few inliers ({independent} within {settings.ransac_max_error_deg} deg)"
            return PoseEstimate(reason, num_matches=len(matches), num_inliers=independent)
        errors = query.errors_px(rig_from_world, guided, self.map.points)
        # Guided matches follow the pose that they were sought about: of how exact it is, those tell that were found
        # without it.
        found_twice = guided[np.isin(guided.rows(), inliers.rows())]
        asked = np.unique(np.concatenate([np.asarray(refs, np.int64) for refs in references]))
        seen = self.map.images_seeing(np.unique(inliers.point))
        estimate = PoseEstimate(
            status="ok",
            world_from_rig=geometry.invert(rig_from_world),
            covariance=self._covariance(query, rig_from_world, found_twice),
            num_matches=len(matches),
            num_inliers=independent,
            num_guided=len(guided),
            rmse_px=float(np.sqrt(np.mean(errors**2))) if len(errors) else float("nan"),
            rival_support=self._rival_support(hypotheses),
            references=tuple(int(index) for index in asked[seen[asked] > 0]),
            camera_index=guided.camera,
            pixels=guided.pixels,
            point_index=guided.point,
        )
        certain = (
            independent >= settings.ok_inliers
            and estimate.position_std_m <= settings.ok_position_std_m  # False where unknown
            and estimate.rival_support <= settings.ok_rival_support
        )
        return estimate if certain else replace(estimate, status="low_confidence")

    def _covariance(self, query: "_Query", rig_from_world: Floats, matches: _Matches) -> Floats | None:
        """Return the covariance (6, 6) of a pose that rests on matches; None where it is not defined."""
        of_pose, of_point = query.jacobians(rig_from_world, matches, self.map.points)
        errors = query.errors_px(rig_from_world, matches, self.map.points)
        return least_squares_covariance(of_pose, errors, self._noise_of_points(query, matches, of_point))

    def _noise_of_points(self, query: "_Query", matches: _Matches, of_point: Floats) -> Floats:
        """Return the covariance (K, 2, 2) of projections that comes from their points, square pixels; NaN if unknown.

        Args:
            query, matches: K matches.
            of_point: (K, 2, 3), how projections move with their points.
        """
        noise = of_point @ self.map.point_covariances(matches.point) @ of_point.transpose(0, 2, 1)
        # A match counts only where its point is seen near where it should be: no more of the point's noise is in it.
        limit_px = np.tan(np.radians(self.settings.max_error_deg)) * query.focals_px[matches.camera]
        share = limit_px**2 / np.maximum(np.trace(noise, axis1=1, axis2=2), 1e-12)
        return np.asarray(noise * np.minimum(share, 1)[:, None, None], np.float64)

    def _rival_support(self, hypotheses: "list[_Hypothesis]") -> float:
        """Return the support of the best pose that is another one, relative to the best pose's."""
        first = hypotheses[0]
        for other in hypotheses[1:]:
            if _differ(first, other):
                return len(other.matches) / max(len(first.matches), 1)
        return 0.0

    def _match(
        self, query: "_Query", references: Sequence[Sequence[int]], known: Sequence[Sequence[Known | None]]
    ) -> _Matches:
        """Match each camera to its references by descriptors, those of each kind alone."""
        limits = self.settings.max_query_features, self.settings.max_map_features
        found = []
        for number, (mapped, first_point) in enumerate(zip(self.mapped, self._first_point[:-1], strict=True)):
            rows = []
            for camera, refs in enumerate(references):
                names = [self.map.image_names[int(index)] for index in refs]
                before = known[camera][number] if known else None
                keypoint, point = mapped.match(query.features[camera][number], names, *limits, before)
                rows.append(np.column_stack([np.full(len(point), camera), keypoint, point + first_point]))
            camera_index, keypoint, point = np.unique(np.concatenate(rows), axis=0).T
            found.append(_Matches(camera_index, query.pixels(camera_index, keypoint, number), point))
        return _Matches.pooled(found)

    def _ransac(
        self, query: "_Query", matches: _Matches, max_error_deg: float, least_inliers: int = 0
    ) -> Floats | None:
        """Return rig_from_world by LO-RANSAC (PoseLib), or None; one with fewer than `least_inliers` may be missed."""
        if len(np.unique(matches.point)) < 4:
            return None
        if len(matches) > self.settings.max_ransac_matches:
            chosen = np.random.default_rng(self.seed).permutation(len(matches))
            kept = np.zeros(len(matches), bool)
            kept[chosen[: self.settings.max_ransac_matches]] = True
            least_inliers = least_inliers * self.settings.max_ransac_matches // len(matches)
            matches = matches[kept]
        least = np.clip(least_inliers / len(matches), 1e-3, 0.99)
        trials = np.log(1 - _RANSAC_CONFIDENCE) / np.log1p(-(least**3))  # to draw three inliers once
        options = {
            "success_prob": _RANSAC_CONFIDENCE,
            "dyn_num_trials_mult": 1.0,
            "min_iterations": 100,
            "max_iterations": int(np.clip(trials, 100, self.settings.ransac_max_trials)),
            "seed": self.seed,
        }
        return query.ransac(matches, self.map.points, max_error_deg, options)

    def _refine(self, query: "_Query", rig_from_world: Floats, matches: _Matches) -> Floats | None:
        """Minimize the reprojection error of all matches, robustly (Cauchy, 1 px)."""
        options = pycolmap.AbsolutePoseRefinementOptions()
        points, mask = self.map.points[matches.point], np.ones(len(matches), bool)
        if len(query.cameras) == 1:
            start = pycolmap.Rigid3d((geometry.invert(query.rig_from_cams[0]) @ rig_from_world)[:3])
            answer = pycolmap.refine_absolute_pose(start, matches.pixels, points, mask, query.cameras[0], options)
            return None if answer is None else query.rig_from_cams[0] @ _matrix(answer["cam_from_world"])
        answer = pycolmap.refine_generalized_absolute_pose(
            pycolmap.Rigid3d(rig_from_world[:3]),
            matches.pixels,
            points,
            mask,
            matches.camera.tolist(),
            query.cams_from_rig,
            query.cameras,
            options,
        )
        return None if answer is None else _matrix(answer["rig_from_world"])

    def _covisible(self, points: Ints) -> Ints:
        """Return the map images that see the most of the points, in a fixed order."""
        seen = self.map.images_seeing(points)
        order = np.argsort(-seen, kind="stable")[: self.settings.guided_images]
        return order[seen[order] > 0]

    def _match_guided(self, query: "_Query", rig_from_world: Floats, images: Ints, radius_deg: float) -> _Matches:
        """Match the points of map images near where the pose puts them, those of each kind alone."""
        names = [self.map.image_names[int(index)] for index in images]
        return _Matches.pooled(
            [
                part
                for number in range(len(self.mapped))
                for part in self._match_kind_guided(number, query, rig_from_world, names, radius_deg)
            ]
        )

    def _match_kind_guided(
        self, number: int, query: "_Query", rig_from_world: Floats, names: Sequence[str], radius_deg: float
    ) -> Iterator[_Matches]:
        """Yield the guided matches of each camera, of one kind of features."""
        mapped, first_point = self.mapped[number], int(self._first_point[number])
        local_map = mapped.map
        images = [index for name in names if (index := local_map.index_of.get(name)) is not None]
        if not images:
            return
        members = [mapped.image(index, self.settings.max_map_features) for index in images]
        point = np.concatenate([member.points for member in members])
        image = np.concatenate([np.full(len(m.points), i) for m, i in zip(members, images, strict=True)])
        descriptors = np.concatenate([member.features.descriptors for member in members])
        depth = np.einsum("oj,oj->o", local_map.cams_from_world[image, 2, :3], local_map.points[point])
        depth += local_map.cams_from_world[image, 2, 3]
        # Size of the feature on the surface, meters: it looks that large from everywhere.
        size = np.concatenate([member.features.scales for member in members]) * depth / local_map.focals_px[image]
        for camera, kinds in enumerate(query.features):
            features = kinds[number]
            radius = np.tan(np.radians(radius_deg)) * query.focals_px[camera]
            cam_from_world = geometry.invert(query.rig_from_cams[camera]) @ rig_from_world
            in_cam = geometry.transform(cam_from_world, local_map.points[point])
            visible = np.flatnonzero(in_view(in_cam[None], query.bounds[camera][None])[0])
            if not len(visible) or not len(features):
                continue
            projected = np.asarray(query.cameras[camera].img_from_cam(in_cam[visible]))
            finite = np.isfinite(projected).all(axis=1)
            visible, projected = visible[finite], projected[finite]
            tree = query.trees[camera][number]
            near = KDTree(projected).sparse_distance_matrix(tree, radius, output_type="ndarray")
            order = np.lexsort((near["j"], near["i"]))
            observed, keypoint = visible[near["i"][order]], near["j"][order]
            expected = size[observed] * query.focals_px[camera] / in_cam[observed, 2]
            octaves = np.abs(np.log2(features.scales[keypoint] / np.maximum(expected, 1e-6)))
            similar = octaves < mapped.kind.scale_octaves
            observed, keypoint = observed[similar], keypoint[similar]
            score = np.einsum(
                "od,od->o",
                unit_descriptors(descriptors[observed]),
                unit_descriptors(features.descriptors[keypoint]),
            )
            order = np.argsort(-score, kind="stable")
            order = order[score[order] > mapped.kind.guided_min_score]
            candidate, keypoint = point[observed[order]], keypoint[order]
            # Best first: the first of each keypoint and of each point, where they are the same match.
            first_of_keypoint = np.unique(keypoint, return_index=True)[1]
            first_of_point = np.unique(candidate, return_index=True)[1]
            mutual = np.intersect1d(first_of_keypoint, first_of_point)[: self.settings.max_guided_matches]
            pixels = features.keypoints[keypoint[mutual]].astype(np.float64)
            yield _Matches(np.full(len(mutual), camera), pixels, candidate[mutual] + first_point)


def agree(world_from_rig: Floats | None, other: Floats | None) -> bool:
    """Tell whether two poses are near enough that one confirms the other."""
    if world_from_rig is None or other is None:
        return False
    rotation_deg, distance_m = geometry.pose_error(world_from_rig, other)
    return bool(rotation_deg <= CONFIRMED[0] and distance_m <= CONFIRMED[1])


def _differ(one: _Hypothesis, other: _Hypothesis) -> bool:
    """Tell whether two hypotheses are clearly different poses."""
    rotation_deg, distance_m = geometry.pose_error(one.world_from_rig, other.world_from_rig)
    return bool(rotation_deg > 1.0 or distance_m > 0.1)


def _matrix(rigid: pycolmap.Rigid3d) -> Floats:
    return np.vstack([rigid.matrix(), [0.0, 0.0, 0.0, 1.0]])


def least_squares_covariance(
    of_unknowns: Floats, errors_px: Floats, noise_px2: Floats, known: Floats | None = None
) -> Floats | None:
    """Return the covariance (U, U) of unknowns that least squares found from K projections; None where undefined.

    The sandwich N^-1 M N^-1 (Huber 1967): N is how well unit noise would determine the unknowns, M the noise that there
    is: the spread of the errors, and `noise_px2`. The spread holds a part of the latter already; that it counts twice
    stands for what is not known, as the errors of the map's poses.

    Args:
        of_unknowns: (K, 2, U), how projections move with the unknowns.
        errors_px: (K,).
        noise_px2: (K, 2, 2), covariance of each projection that comes from its point; not finite: the point tells
            nothing.
        known: (U, U), information on the unknowns from elsewhere.
    """
    told = np.isfinite(noise_px2).all(axis=(1, 2))
    of_unknowns, errors_px, noise_px2 = of_unknowns[told], errors_px[told], noise_px2[told]
    if len(errors_px) < 4:
        return None
    # Two coordinates a point, six parameters of the pose.
    variance = float((errors_px**2).sum()) / max(2 * len(errors_px) - 6, 1)
    known = np.zeros((of_unknowns.shape[2],) * 2) if known is None else known
    information = np.einsum("oki,okj->ij", of_unknowns, of_unknowns) + variance * known
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e14:
        return None
    noise = noise_px2 + variance * np.eye(2)
    middle = np.einsum("oki,okl,olj->ij", of_unknowns, noise, of_unknowns) + variance**2 * known
    inverse = np.linalg.inv(information)
    return np.asarray(inverse @ middle @ inverse, np.float64)


class _Query:
    """The cameras of a query device, with what the steps above ask of them."""

    def __init__(self, cameras: list[pycolmap.Camera], rig_from_cams: Floats, features: list[list[LocalFeatures]]):
        self.cameras = cameras
        self.rig_from_cams = rig_from_cams
        self.features = features  # of each camera, of each kind
        self.cams_from_rig = [pycolmap.Rigid3d(pose[:3]) for pose in geometry.invert(rig_from_cams)]
        self.focals_px = np.array([camera.mean_focal_length() for camera in cameras])
        self.bounds = np.stack([view_bounds(camera) for camera in cameras])
        self.trees = [
            [KDTree(f.keypoints) if len(f) else KDTree(np.zeros((1, 2)) - 1e9) for f in kinds] for kinds in features
        ]

    def pixels(self, camera: Ints, keypoint: Ints, kind: int) -> Floats:
        """Return the places (K, 2) of keypoints of one kind."""
        pixels = np.zeros((len(camera), 2))
        for index, kinds in enumerate(self.features):
            pixels[camera == index] = kinds[kind].keypoints[keypoint[camera == index]]
        return pixels

    def ransac(
        self, matches: _Matches, points: Floats, max_error_deg: float, options: Mapping[str, Any]
    ) -> Floats | None:
        """Return the pose rig_from_world (4, 4) that the most matches to points (P, 3) agree with; None without any.

        Errors are those on the plane at depth 1, where no lens bends anything, times one focal length.
        """
        focal_px = float(self.focals_px.mean())
        options = {**options, "max_reproj_error": float(np.tan(np.radians(max_error_deg)) * focal_px)}
        plane, seen, cameras = [], [], []
        for index, camera in enumerate(self.cameras):
            part = matches.camera == index
            xy = np.asarray(camera.cam_from_img(matches.pixels[part])).reshape(-1, 2)
            finite = np.isfinite(xy).all(axis=1)
            plane.append(focal_px * xy[finite])
            seen.append(points[matches.point[part][finite]])
            params = [focal_px, 0.0, 0.0]
            cameras.append(
                {"model": "SIMPLE_PINHOLE", "width": camera.width, "height": camera.height, "params": params}
            )
        if sum(map(len, seen)) < 4:
            return None
        if len(self.cameras) == 1:
            found, info = poselib.estimate_absolute_pose(plane[0], seen[0], cameras[0], options)
        else:
            places = [poselib.CameraPose() for _ in self.cameras]
            for place, cam_from_rig in zip(places, self.cams_from_rig, strict=True):
                place.Rt = cam_from_rig.matrix()
            with _RIG_RANSAC:
                pycolmap.set_random_seed(options["seed"])  # that of the C library, too
                found, info = poselib.estimate_generalized_absolute_pose(plane, seen, places, cameras, options)
        if info["num_inliers"] < 4 or not np.isfinite(found.Rt).all():
            return None
        pose = np.vstack([found.Rt, [0.0, 0.0, 0.0, 1.0]])
        return np.asarray(self.rig_from_cams[0] @ pose if len(self.cameras) == 1 else pose, np.float64)

    def errors_px(self, rig_from_world: Floats, matches: _Matches, points: Floats) -> Floats:
        """Return the reprojection errors (K,) of matches to points (P, 3), inf behind a camera."""
        errors = np.full(len(matches), np.inf)
        for index in np.unique(matches.camera):
            part = matches.camera == index
            cam_from_world = geometry.invert(self.rig_from_cams[index]) @ rig_from_world
            in_cam = geometry.transform(cam_from_world, points[matches.point[part]])
            projected = np.asarray(self.cameras[index].img_from_cam(in_cam))
            error = np.linalg.norm(projected - matches.pixels[part], axis=1)
            errors[part] = np.where((in_cam[:, 2] > 1e-3) & np.isfinite(error), error, np.inf)
        return errors

    def errors_deg(self, rig_from_world: Floats, matches: _Matches, points: Floats) -> Floats:
        """Return the reprojection errors (K,) as angles."""
        errors = self.errors_px(rig_from_world, matches, points)
        return np.degrees(np.arctan(errors / self.focals_px[matches.camera]))

    def jacobians(self, rig_from_world: Floats, matches: _Matches, points: Floats) -> tuple[Floats, Floats]:
        """Return how the projections of matches move, in pixels.

        With a small motion d of the rig: (K, 2, 6), d = rotation (radians), translation (meters) in the rig's frame,
        world_from_rig @ Exp(d), as the benchmark's covariances have it; with a motion of the point in the world:
        (K, 2, 3).
        """
        of_pose, of_point = np.zeros((len(matches), 2, 6)), np.zeros((len(matches), 2, 3))
        for index in np.unique(matches.camera):
            part = matches.camera == index
            cam_from_rig = geometry.invert(self.rig_from_cams[index])
            in_rig = geometry.transform(rig_from_world, points[matches.point[part]])
            in_cam = geometry.transform(cam_from_rig, in_rig)
            # A motion d of the rig moves a point in it by -(rotation x point) - translation.
            x, y, z = in_rig.T
            zero = np.zeros_like(x)
            skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
            moved = np.concatenate([skew, np.broadcast_to(-np.eye(3), skew.shape)], axis=2)
            projection = projection_jacobian(in_cam, np.full(len(in_cam), self.focals_px[index]))
            of_pose[part] = projection @ (cam_from_rig[:3, :3] @ moved)
            of_point[part] = projection @ (cam_from_rig[:3, :3] @ rig_from_world[:3, :3])
        return of_pose, of_point
