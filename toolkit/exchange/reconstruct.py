"""Reconstruct the poses of images: structure from motion with the toolkit's features and COLMAP's mapper; and let
a reconstructed map grow: add a recording to it, whose poses are found in the model, or remove one.

The work is in `CAPTURE/reconstruction/`: features and matches, which a stopped reconstruction finds again, COLMAP's
database, and all models in COLMAP's format. The capture gets the largest model. Its sessions have the features in
`proc/features`, from where a run takes them, and `proc/reconstruction.json`, which says how good the model is.

When a map grows, poses and cameras that are there stay as they are, to the last digit. A recording is the folder, file
or video that was given; its name is the first part of the names of its images.
"""

import json
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from toolkit.capture import Capture, Session, parse_camera
from toolkit.capture.images import camera_text, default_workers, exif_key, prefetch, read_header
from toolkit.capture.names import is_linked_here, note_linked_here
from toolkit.capture.session import RECONSTRUCTION_RECORD
from toolkit.capture.tables import write_table
from toolkit.embedders.vlad import Vlad
from toolkit.errors import COMMAND, CaptureError, ManifestError, WeightsError
from toolkit.exchange.colmap_model import inverse
from toolkit.exchange.drafts import AXES, SUBSESSION, Draft, DraftImage, every_nth, list_images, start
from toolkit.exchange.georeference import place, read_positions
from toolkit.exchange.import_report import ImportReport
from toolkit.exchange.interchange import once, read_intrinsics, read_poses
from toolkit.exchange.photographs import TAKEN_SUFFIXES, Prefixes, SourceImage, gather, initial_cameras, join, read_rigs
from toolkit.features.features import KINDS, LocalFeatures, MutualMatcher, PairMatches, SiftExtractor, unit_descriptors
from toolkit.features.matching import LocalMethod, create_local_methods, epipolar_matches, resolve_auto
from toolkit.features.stores import FeatureStore, extract_session, match_sessions
from toolkit.files import (
    IMPORTED,
    MASKS,
    RAW_DATA,
    files_fingerprint,
    link_folder,
    own_name,
    read_json,
    write_csv,
    write_folder,
    write_text,
)
from toolkit.geometry import Floats, Ints, unit
from toolkit.manifest import LocalizeSettings, SiftSettings
from toolkit.pose.base import cells_of
from toolkit.scene.query import FOCAL_PRIOR
from toolkit.store.items import Items, retry_damaged
from toolkit.threads import one_thread

T = TypeVar("T")
FOLDER = "reconstruction"
UNIT_HINT = "If you know a length, give --distance or --positions, or photographs with GPS"
ALL_PAIRS = 60  # up to this number of images, all pairs are matched
NEIGHBORS, SIMILAR = 10, 20  # else each image with so many next ones in its folder, and so many that look similar
MIN_VERIFIED = 15  # of a pair that counts
MIN_MODEL = 3  # images of a model
ESCALATED = 6  # similar ones of each image that SIFT leaves out, with which learned features are tried
START = f"{FOCAL_PRIOR} times the longer side"  # a focal length that nothing tells
RATIO = 0.8  # of SIFT's matches; fewer of them are wrong than with the larger one for queries
LOSS_PX, MAX_ERROR_PX, MIN_ANGLE_DEG = 0.5, 4.0, 1.5
"""Of the last bundle adjustment: scale of the Cauchy loss and largest error of an observation, in pixels of the image
where features are detected, and smallest triangulation angle."""
FEW_PAIRS, STRONGEST = 100, 2048  # if there are more pairs, only so many SIFT features of each image are matched
CENTER_STD = 5e-3  # of principal points around the centers of images, in focal lengths; few are more than 1 % off
MAPPED_NOISE_M = 0.2  # of the positions of rough poses in COLMAP's mapper, whose loss is robust; drift adds to noise
MAX_VIEW_DEG = 60.0  # largest angle between the optical axes of images that are neighbors by rough poses
MIN_POINTS = 30  # points of an image in a model; COLMAP requires as many when it estimates a pose
_BATCH = 64  # pairs that are matched at once


@dataclass
class Reconstruction:
    """The result of `reconstruct`."""

    report: ImportReport
    camera: str = ""  # option for queries of the same camera, if the images have one

    @property
    def capture(self) -> Capture:
        """The capture with the new sessions."""
        return Capture.open(self.report.session.parents[1])


class _Mutual(MutualMatcher):
    """`MutualMatcher` of the strongest features, with a thread per core."""

    batch_size = _BATCH

    strongest: int | None = None

    @property
    def settings(self) -> dict[str, Any]:
        return {**super().settings, "strongest": self.strongest}

    def match(self, pairs: Sequence[tuple[LocalFeatures, LocalFeatures]]) -> list[PairMatches]:
        distinct = {id(one): one.descriptors[: self.strongest] for pair in pairs for one in pair}
        units = {key: unit_descriptors(descriptors, self.shorten) for key, descriptors in distinct.items()}
        return list(prefetch(lambda pair: self.match_unit(*(units[id(one)] for one in pair)), pairs, default_workers()))


class _Work:
    """Images with features and verified matches, in the folder of the reconstruction."""

    def __init__(
        self, folder: Path, device: str, items: list[SourceImage], known: Mapping[str, pycolmap.Camera],
        prior: Mapping[str, Floats] | None = None, rigs: Prefixes | None = None,
    ) -> None:  # fmt: skip
        self.folder, self.items, self.rigs = folder, items, rigs or []
        self.camera_of, self.cameras = initial_cameras(items, known, self.rigs)
        self.known = {number for number, item in zip(self.camera_of, items, strict=True) if item.name in known}
        """Numbers of the cameras whose intrinsics stay as they are."""
        self.exif_px = {number: camera.params[0] for number, camera in enumerate(self.cameras)
                        if camera.has_prior_focal_length and number not in self.known}  # fmt: skip
        """Focal lengths from EXIF, by number of the camera; all are used, or none if no model fits them."""
        self.exif_used = True
        session = folder / "sessions" / f"{device}_map"
        shutil.rmtree(session, ignore_errors=True)
        draft = Draft(session, folder, sources={item.name: item.path for item in items})
        for item, number in zip(items, self.camera_of, strict=True):
            draft.images.append(
                DraftImage(item.name, self.cameras[number], f"{SUBSESSION}/cam_{number + 1}", item.name)
            )
        draft.mask_files = {item.name: item.mask for item in items if item.mask is not None}
        draft.leave_out()
        self.unusable = {row["image"]: row["status"] for row in draft.rows}
        draft.write()
        self.session = Session.open(session)
        index = {item.name: number for number, item in enumerate(items)}
        self.item_of = [index[name.partition(IMPORTED)[2]] for name in self.session.image_names]
        order = np.argsort(self.item_of)
        self.names = [self.session.image_names[row] for row in order]
        """Names of the images in the stores, in the order of `items`."""
        self.items = [items[self.item_of[row]] for row in order]
        self.camera_of = [self.camera_of[self.item_of[row]] for row in order]
        self.prior = np.stack([(prior or {}).get(item.name, np.full((4, 4), np.nan)) for item in self.items])
        """Rough world_from_cam (N, 4, 4), meters; NaN where there is none."""
        self.kinds: list[tuple[LocalMethod, FeatureStore]] = []
        self.pairs: list[dict[tuple[int, int], Ints]] = []
        """For each kind, the verified matches (K, 2) of pairs of images."""
        self.matched: dict[tuple[int, int], int] = {}
        """Number of matches of each pair before verification."""
        self.image_ids = list(range(1, len(self) + 1))
        self.camera_ids = list(range(1, len(self.cameras) + 1))
        """Those in COLMAP's database."""
        self.in_model: dict[int, Floats] = {}
        """Keypoints (N, 2) of images of an earlier model, which may have had more kinds, by image id."""

    def __len__(self) -> int:
        return len(self.names)

    def extract(self, method: LocalMethod, images: Sequence[int]) -> None:
        rows = np.array([self.session.row_of_name[self.names[image]] for image in images])
        turns = np.zeros(len(self.session.images), np.int64)
        turns[rows] = [self.items[image].quarter_turns for image in images]
        store = extract_session(
            self.session, self.folder / "features", method.extractor, rows, default_workers(), turns=turns
        )
        for name, reason in store.failed.items():
            self.unusable[name.partition(IMPORTED)[2]] = reason
        self.kinds.append((method, store))
        self.pairs.append({})

    def keypoints(self, image: int, kind: int) -> Floats:
        store = self.kinds[kind][1]
        name = self.names[image]
        return np.asarray(store[name].keypoints, np.float64) if name in store else np.zeros((0, 2))

    @cached_property
    def similarity(self) -> Floats:
        """(N, N) similarity of images by VLAD, -1 on the diagonal and for images without features."""
        store = self.kinds[0][1]
        rows = [row for row, name in enumerate(self.names) if name in store]
        names = [self.names[row] for row in rows]
        vlad = Vlad.learn(
            lambda: tqdm((store[name] for name in names), "vocabulary", len(names), unit="image"), len(names)
        )
        vectors = np.zeros((len(self), vlad.dim), np.float32)
        vectors[rows] = list(prefetch(lambda name: vlad.embed([store[name]])[0], names, default_workers()))
        vectors = unit(vectors, 1e-9)
        similarity = (vectors @ vectors.T).astype(np.float64)
        np.fill_diagonal(similarity, -1)
        return similarity

    def choose_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs to match: all, or those of neighbors and of images that look similar."""
        count = len(self)
        if count <= ALL_PAIRS:
            return [*combinations(range(count), 2)]
        folders = [Path(item.name).parent for item in self.items]
        near = (range(i + 1, min(i + 1 + NEIGHBORS, count)) for i in range(count))
        pairs = {(i, j) for i, others in enumerate(near) for j in others if folders[i] == folders[j]}
        for i, similar in enumerate(np.argsort(-self.similarity, axis=1, kind="stable")[:, :SIMILAR].tolist()):
            pairs |= {(min(i, j), max(i, j)) for j in similar}
        for i, apart in enumerate(self._apart_by_prior()):
            pairs |= {(min(i, j), max(i, j)) for j in np.argsort(apart, kind="stable")[:SIMILAR] if apart[j] < np.inf}
        return sorted(pairs)

    def _apart_by_prior(self) -> Floats:
        """(N, N) distances, meters, of images that look into similar directions by rough poses; else inf."""
        centers, axes = self.prior[:, :3, 3], self.prior[:, :3, 2]
        apart = np.linalg.norm(centers[:, None] - centers, axis=2)
        apart[~(axes @ axes.T > np.cos(np.radians(MAX_VIEW_DEG)))] = np.inf  # NaN, too
        np.fill_diagonal(apart, np.inf)
        return apart

    def hold_to_prior(self, model: pycolmap.Reconstruction, noise_m: float) -> None:
        """Adjust a model, in the world of rough poses, to their positions, too, which have this standard deviation."""
        options, config = self._adjustment(), self._of_model(model)
        found = pycolmap.PosePriorBundleAdjustmentOptions()
        found.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
        registered = set(model.reg_image_ids())
        priors = [prior for prior in self._position_priors(noise_m) if prior.pose_prior_id in registered]
        with _quiet():
            pycolmap.create_pose_prior_bundle_adjuster(options, found, config, priors, model).solve()

    def match(self, kind: int, pairs: Sequence[tuple[int, int]]) -> None:
        """Match pairs and keep the matches that agree with one relative pose of their cameras."""
        method, store = self.kinds[kind]
        named = [(self.names[i], self.names[j]) for i, j in pairs]
        stored = match_sessions((store, store), named, method.matcher, self.folder / "matches", (self.session.id,) * 2)
        keypoints = lru_cache(512)(lambda image: self.keypoints(image, kind))

        def verify(pair: tuple[int, int]) -> tuple[int, Ints]:
            names = [self.names[image] for image in pair]
            if not all(name in store for name in names):
                return 0, np.zeros((0, 2), np.int64)
            matches = stored[names[0], names[1]]
            cameras = [self.cameras[self.camera_of[image]] for image in pair]
            sizes = [(camera.width, camera.height) for camera in cameras]
            a, b = (keypoints(image)[indices] for image, indices in zip(pair, matches.indices.T, strict=True))
            verified = epipolar_matches(sizes[0], a, sizes[1], b, matches.scores, tests=len(pairs))
            return len(matches), matches.indices[verified]

        with one_thread():
            bar = tqdm(prefetch(verify, pairs, default_workers()), "verify", len(pairs), unit="pair")
            for pair, (count, verified) in zip(pairs, bar, strict=True):
                self.matched[pair] = max(count, self.matched.get(pair, 0))
                if len(verified) >= MIN_VERIFIED:
                    self.pairs[kind][pair] = verified

    def _position_priors(self, noise_m: float) -> list[pycolmap.PosePrior]:
        """Return the positions of rough poses, with the number of the image as that of the prior."""
        priors = []
        for image in np.flatnonzero(np.isfinite(self.prior).all(axis=(1, 2))).tolist():
            number, camera_id = self.image_ids[image], self.camera_ids[self.camera_of[image]]
            prior = pycolmap.PosePrior(position=self.prior[image, :3, 3], position_covariance=noise_m**2 * np.eye(3))
            prior.pose_prior_id, prior.coordinate_system = number, pycolmap.PosePriorCoordinateSystem.CARTESIAN
            prior.corr_data_id = pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), number)
            priors.append(prior)
        return priors

    def verified(self) -> Ints:
        """(N, N) numbers of verified matches."""
        counts = np.zeros((len(self), len(self)), np.int64)
        for found in self.pairs:
            for (i, j), indices in found.items():
                counts[i, j] += len(indices)
        return counts + counts.T

    def write_database(self) -> Path:
        """Write COLMAP's database: cameras, images, keypoints and verified matches of all kinds."""
        path = self.folder / "database.db"
        path.unlink(missing_ok=True)
        offsets = np.zeros((len(self.kinds) + 1, len(self)), np.int64)
        with pycolmap.Database.open(str(path)) as database:
            for camera_id, camera in zip(self.camera_ids, self.cameras, strict=True):
                camera.camera_id = camera_id
                database.write_camera(camera, True)
                rig = pycolmap.Rig(rig_id=camera_id)
                rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
                database.write_rig(rig, True)
            for image, (number, name) in enumerate(zip(self.image_ids, self.names, strict=True)):
                camera_id = self.camera_ids[self.camera_of[image]]
                database.write_image(pycolmap.Image(name=name, camera_id=camera_id, image_id=number), True)
                frame = pycolmap.Frame(frame_id=number, rig_id=camera_id)
                frame.add_data_id(pycolmap.data_t(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id), number))
                database.write_frame(frame, True)
                keypoints = [self.keypoints(image, kind) for kind in range(len(self.kinds))]
                offsets[1:, image] = np.cumsum([len(part) for part in keypoints])
                points = self.in_model.get(number, np.concatenate(keypoints))
                database.write_keypoints(number, points.astype(np.float32))
            for prior in self._position_priors(MAPPED_NOISE_M):
                database.write_pose_prior(prior, True)
            both: dict[tuple[int, int], list[Ints]] = {}
            for kind, found in enumerate(self.pairs):
                for pair, indices in found.items():
                    both.setdefault(pair, []).append(indices + offsets[kind, list(pair)])
            for (i, j), parts in both.items():
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
                geometry.inlier_matches = np.concatenate(parts).astype(np.uint32)
                ids = self.image_ids[i], self.image_ids[j]
                database.write_matches(*ids, geometry.inlier_matches)
                database.write_two_view_geometry(*ids, geometry)
        return path

    def map(self, mapper: str, before: Sequence[pycolmap.Reconstruction] = ()) -> list[pycolmap.Reconstruction]:
        """Return models whose focal lengths start as in EXIF or, if there is no such model, as if EXIF had none.

        If the models `before`, of fewer features, start without EXIF, one with it must be as large as their largest.
        """
        least = before[0].num_reg_images() if before and not self.exif_used else 1
        models = list[pycolmap.Reconstruction]()
        for used in (True, False) if self.exif_px else (True,):
            self.exif_used = used
            for number, focal_px in self.exif_px.items():
                camera = self.cameras[number]
                start_px = focal_px if used else FOCAL_PRIOR * max(camera.width, camera.height)
                camera.params, camera.has_prior_focal_length = [start_px, *camera.params[1:]], used
            models = self._models(mapper)
            if models and models[0].num_reg_images() >= least:
                break
        return models

    def _models(self, mapper: str) -> list[pycolmap.Reconstruction]:
        """Return the models, the largest first; of the others, those that have an image that it lacks."""
        database, out = self.write_database(), self.folder / "models"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        images = self.session.path.parent
        with tqdm(total=len(self), desc="map", unit="image") as bar, _quiet():
            if mapper == "global":
                chosen = pycolmap.GlobalPipelineOptions(min_model_size=MIN_MODEL, random_seed=0)
                models = pycolmap.global_mapping(database, images, out, chosen)
            else:
                options = self._incremental_options()
                models = pycolmap.incremental_mapping(
                    database, images, out, options,
                    initial_image_pair_callback=lambda: bar.update(2), next_image_callback=bar.update,
                )  # fmt: skip
            ordered = sorted(models.values(), key=lambda model: -model.num_reg_images())
            inside = {image for model in ordered[:1] for image in model.reg_image_ids()}
            kept = ordered[:1] + [model for model in ordered[1:] if not {*model.reg_image_ids()} <= inside]
            for model in tqdm(kept, "refine", unit="model"):
                self._refine(model)
            if self.rigs and kept:
                join(kept[0], database, self.rigs, self.names[0].removesuffix(self.items[0].name))
                self._refine(kept[0])
        return [model for model in kept if model.num_reg_images() >= MIN_MODEL]

    def _incremental_options(self) -> pycolmap.IncrementalPipelineOptions:
        """Return options that are less precise on the way than COLMAP's, in half of the time, as `_refine` follows."""
        options = pycolmap.IncrementalPipelineOptions(min_model_size=MIN_MODEL, random_seed=0)
        options.num_threads = default_workers()
        options.structure_less_registration_fallback = False
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.ba_global_function_tolerance = options.ba_local_function_tolerance = 1e-4
        options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
        if np.isfinite(self.prior).any():
            options.use_prior_position = options.use_robust_loss_on_prior_position = True
        if len(self.known) == len(self.cameras):  # else `_refine` restores them: COLMAP's `constant_cameras` move
            options.ba_refine_focal_length = options.ba_refine_extra_params = False
            options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
        return options

    def _refine(self, model: pycolmap.Reconstruction, fixed: Collection[int] = ()) -> None:
        """Adjust poses, points and cameras under a robust loss, which halves errors (STRECHA), and drop outliers.

        Images `fixed`, by their ids, keep their poses and cameras.
        """
        scale = self._image_scale
        for number in self.known:
            if (camera_id := self.camera_ids[number]) in model.cameras:
                model.cameras[camera_id].params = self.cameras[number].params.tolist()
        for centered in (False, True):
            if centered and not fixed:
                self._move_centers(model)
            pycolmap.create_default_bundle_adjuster(self._adjustment(), self._of_model(model, fixed), model).solve()
            pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR_PX * scale, MIN_ANGLE_DEG)
            for frame in list(model.frames.values()):  # a wrong pose keeps few points
                images = [model.image(data.id) for data in frame.image_ids]
                few = sum(image.num_points3D for image in images) < MIN_POINTS
                if frame.has_pose and few and not any(image.image_id in fixed for image in images):
                    model.deregister_frame(frame.frame_id)

    def _move_centers(self, model: pycolmap.Reconstruction) -> None:
        """Move the principal points, all by one share of the way to where they fit the observations best.

        The share minimizes the squared errors, which grow with the square of the rest of the way, plus a normal prior
        around the image centers (`CENTER_STD`). Errors in one cell of an image are alike, for what the camera model
        lacks, so those of a cell count as one: without this, principal points go where they imitate such errors.
        """
        images = [model.image(number) for number in model.reg_image_ids()]
        seen = [[point.xy for point in image.points2D if point.has_point3D()] for image in images]
        index = np.repeat(np.arange(len(images)), [len(pixels) for pixels in seen])
        if not (observations := len(index)):
            return
        pixels = np.array([xy for of_image in seen for xy in of_image])
        cells = len(np.unique(cells_of(index, pixels, [model.cameras[image.camera_id] for image in images])))
        cameras = list(model.cameras.values())
        before, focals_px = _centers(cameras), np.array([[camera.mean_focal_length()] for camera in cameras])
        options = self._adjustment()
        options.refine_principal_point = True
        options.ceres.solver_options.max_num_iterations = 15
        solver: Any = pycolmap.create_default_bundle_adjuster(options, self._of_model(model), model)
        costs = getattr(solver.solve(), "ceres_summary", None)
        if costs is None:  # no point has enough observations
            return
        freedom = 2 * observations - 3 * model.num_points3D() - 6 * model.num_reg_images()
        variance = max(2 * costs.final_cost / max(freedom, 1) * observations / cells, 1e-12)
        gain, std = 2 * (costs.initial_cost - costs.final_cost) / variance, CENTER_STD * focals_px
        way = (_centers(cameras) - before) / std
        from_middle = (before - np.array([(camera.width / 2, camera.height / 2) for camera in cameras])) / std
        share = np.clip((gain - (from_middle * way).sum()) / max(gain + (way**2).sum(), 1e-12), 0, 1)
        for camera, (x, y) in zip(cameras, before + share * way * std, strict=True):
            camera.principal_point_x, camera.principal_point_y = x, y

    @property
    def _image_scale(self) -> float:
        """Size of the largest image over that where features are detected."""
        return max(1.0, max(max(camera.width, camera.height) for camera in self.cameras) / SiftSettings().max_long_side)

    def _adjustment(self) -> pycolmap.BundleAdjustmentOptions:
        options = pycolmap.BundleAdjustmentOptions(print_summary=False, min_track_length=2)
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = LOSS_PX * self._image_scale
        options.ceres.solver_options.max_num_iterations = 50
        options.ceres.solver_options.function_tolerance = 1e-6
        return options

    def _of_model(self, model: pycolmap.Reconstruction, fixed: Collection[int] = ()) -> pycolmap.BundleAdjustmentConfig:
        """Return what is adjusted: all of a model but poses and cameras of images `fixed`, and known cameras.

        The gauge is free: fixed by two cameras that are those of a rig with one center, it bends the model (STRECHA).
        """
        config = pycolmap.BundleAdjustmentConfig()
        for number in model.reg_image_ids():
            config.add_image(number)
        for number in fixed:
            config.set_constant_rig_from_world_pose(model.image(number).frame_id)
        kept = {self.camera_ids[number] for number in self.known} | {model.image(number).camera_id for number in fixed}
        for camera_id in kept & {model.image(number).camera_id for number in model.reg_image_ids()}:
            config.set_constant_cam_intrinsics(camera_id)
        return config


def _centers(cameras: Sequence[pycolmap.Camera]) -> Floats:
    """Return the principal points (C, 2) of cameras, pixels."""
    return np.array([(camera.principal_point_x, camera.principal_point_y) for camera in cameras])


@contextmanager
def _quiet() -> Iterator[None]:
    """Print only errors of COLMAP."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@retry_damaged
def reconstruct(
    sources: Sequence[str | Path], capture: str | Path, device: str = "ios", fps: float | None = None,
    camera: str | None = None, distance: tuple[str, str, float] | None = None, mapper: str = "incremental",
    table: str | Path | None = None, poses_prior: str | Path | None = None,
    rig: str | Path | None = None, **options: Any,
) -> Reconstruction:  # fmt: skip
    """Make a map session from images without poses, and with `hold_out` a query session with ground truth.

    Args:
        sources: image files, folders of images and videos.
        capture: folder of the capture; created if it does not exist.
        device: the sessions are `<device>_map` and `<device>_query`.
        fps: frames per second of videos; None: chosen by motion.
        camera: intrinsics of all images, `MODEL, width, height, parameter, ...`, kept as they are; None:
            estimated, from EXIF if it has a focal length.
        table: intrinsics of images, see `interchange.read_intrinsics`, kept as they are; those that are not in it
            have those of `camera`.
        poses_prior: rough poses of images, a table as of `interchange.read_poses` in meters: world_from_cam of a
            device's tracking, with the camera axes of the option `axes`. They tell which images are neighbors,
            and the world of the model.
        distance: two points, `IMAGE:x,y` in pixels, or images for the centers of their cameras, and the meters
            between.
        mapper: COLMAP's `incremental` or `global` mapper.
        rig: `folders` if the folders are the cameras of one rig, whose images with equal names were taken at the
            same time, or COLMAP's rig_config.json, see `photographs.read_rigs`; each folder is one camera then.
        options: see `drafts.Options`; GPS in EXIF is used in any case.

    Raises:
        CaptureError: no image, no two that fit together, a session that exists, or a malformed file.
        ManifestError: a malformed argument.
    """
    if mapper not in ("incremental", "global"):
        raise ManifestError(f"mapper: found {mapper!r}, expected incremental or global.")
    folder = Path(capture) / FOLDER
    positions, masks = options.pop("positions", None), options.pop("masks", None)
    axes = options.pop("axes", "opencv")
    if poses_prior is not None and (distance is not None or positions is not None):
        raise ManifestError("poses-prior: found together with distance or positions. Give one of them.")
    draft = start(capture, device, "map", folder, **options)
    masks = None if masks is None else Path(masks)
    items, unreadable = gather(list(map(Path, sources)), folder / "images", fps, masks)
    known = read_positions(Path(positions)) if positions is not None else None
    given = None
    if camera is not None:
        try:
            given = parse_camera("camera", camera)
        except ValueError as error:
            raise ManifestError(f"camera: {error}") from None
    if len(items) < MIN_MODEL:
        why = "".join(f" {name}: {reason}." for name, reason in [*unreadable.items()][:1])
        raise CaptureError(f"{sources[0]}: {len(items)} photographs can be read, expected {MIN_MODEL} or more.{why}")
    cameras = dict.fromkeys((item.name for item in items), given) if given is not None else {}
    tabled = _of_items(read_intrinsics(Path(table)), items, table) if table is not None else {}
    cameras |= tabled
    prior = read_poses(Path(poses_prior), "world_from_cam")[1] if poses_prior is not None else {}
    prior = {name: pose @ AXES[axes] for name, pose in prior.items()}
    prior = _of_items(prior, items, poses_prior) if prior else prior
    rigs = read_rigs(rig, items) if rig is not None else []
    work = _Work(folder, device, items, cameras, prior, rigs)
    draft.frames_are_names = not rigs
    held = every_nth([item.name for item in work.items], draft.hold_out)
    work.unusable |= unreadable
    matcher = _Mutual(RATIO, shorten=KINDS["sift"].shorten)
    work.extract(LocalMethod("sift", SiftExtractor(), matcher), range(len(work)))
    pairs = work.choose_pairs()
    matcher.strongest = STRONGEST if len(pairs) > FEW_PAIRS else None
    work.match(0, pairs)
    models = work.map(mapper)
    notes = _escalate(work, models)
    if len(work.kinds) > 1 and any(work.pairs[1]):
        models = work.map(mapper, models)
    if not models:
        worst = "; ".join(f"{name}: {reason}" for name, reason in list(_reasons(work, models).items())[:3])
        raise CaptureError(f"{sources[0]}: no two of {len(work)} photographs fit together. {worst}.")
    model = models[0]
    geo = {item.name: item.geo for item in work.items if item.geo is not None}
    placed = place(model, {item.name: item.quarter_turns for item in work.items}, geo, distance, known, prior)
    if placed.prior_noise_m is not None and not rigs:  # COLMAP's position priors are of single cameras
        work.hold_to_prior(model, placed.prior_noise_m)
    paths = [folder / "models" / str(number) for number in range(len(models))]
    shutil.rmtree(folder / "models")
    for path, each in zip(paths, models, strict=True):
        path.mkdir(parents=True)
        each.write(str(path))
    sensors = {number: f"{SUBSESSION}/cam_{at}" for at, number in enumerate(sorted(model.cameras), start=1)}
    images = {image.name: image for image in model.images.values() if image.has_pose}
    for name, item, number in zip(work.names, work.items, work.camera_of, strict=True):
        if name in images:
            dropped = ", as the focal length in EXIF fits no model" if number in work.exif_px else ""
            origin = f"estimated, started at {'EXIF' if work.exif_used and dropped else START + dropped}"
            if number in work.known:
                origin = f"given by {'--table' if item.name in tabled else '--camera'}"
            add_posed(draft, item, images[name], sensors[images[name].camera_id], origin)
    draft.rows += [{"image": name, "status": reason} for name, reason in _reasons(work, models).items()]
    sizes, error_px = [each.num_reg_images() for each in models], model.compute_mean_reprojection_error()
    record = {
        "photographs": len(items) + len(unreadable), "registered": sizes[0], "other models": sizes[1:],
        "mapper": mapper, "features": [method.name for method, _ in work.kinds],
        "points": model.num_points3D(), "track length": model.compute_mean_track_length(),
        "reprojection error, px": error_px, **placed.record,
        "given intrinsics": sorted({camera_text(work.cameras[number]) for number in work.known}),
    }  # fmt: skip
    draft.record |= {"source": ", ".join(map(str, sources)), **placed.record}
    draft.notes += [f"{sizes[0]} of {record['photographs']} photographs in the model, {record['points']} points, "
                    f"reprojection error {error_px:.2f} px", *notes]  # fmt: skip
    if sizes[1:]:
        where = ", ".join(f"{size} in {path}" for size, path in zip(sizes[1:], paths[1:], strict=True))
        draft.notes.append(f"not connected to it, so not used: models of {where}; IMAGES: {folder / 'sessions'}")
    if work.exif_px and not work.exif_used:
        count = sum(number in work.exif_px for number in work.camera_of)
        draft.notes.append(f"the focal length in EXIF of {count} photographs is not used, as no model fits it")
    draft.notes += placed.notes
    report = draft.finish(None if rigs else {name for name in held if name in draft.poses})
    for one in filter(None, (report, report.held_out)):
        write_text(one.session / RECONSTRUCTION_RECORD, json.dumps(record, indent=1) + "\n")
        _hand_over(work, one.session)
    option = f" --camera '{camera_text(next(iter(model.cameras.values())))}'" if len(model.cameras) == 1 else ""
    return Reconstruction(report, option)


def model_points(capture: str | Path) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the points (P, 3) of the model that a capture was reconstructed as, in the world, and their RGB (P, 3)."""
    points = pycolmap.Reconstruction(str(Path(capture) / FOLDER / "models" / "0")).points3D.values()
    xyz, rgb = np.array([point.xyz for point in points]), np.array([point.color for point in points], np.uint8)
    return xyz.reshape(-1, 3), rgb.reshape(-1, 3)


def _of_items(found: dict[str, T], items: Sequence[SourceImage], table: object) -> dict[str, T]:
    """Return what a table says of images, by their names; those that were converted have `.png` added."""
    names = {name: item.name for item in items for name in (item.name.removesuffix(".png"), item.name)}
    kept = {names[name]: value for name, value in found.items() if name in names}
    if not kept:
        first = f"found {next(iter(found), 'no image')!r}, expected {items[0].name!r}"
        raise CaptureError(f"{table}: none of the photographs is in it: {first} and others.")
    return kept


def add_posed(draft: Draft, item: SourceImage, image: pycolmap.Image, sensor: str, origin: str) -> None:
    """Add an image with its camera and pose in a model to a session."""
    draft.convention, draft.unit_hint = "found by structure from motion", UNIT_HINT
    assert image.camera is not None
    frame = image.frame
    assert frame is not None
    assert frame.rig is not None
    assert frame.rig_from_world is not None
    in_rig = frame.rig.num_sensors() > 1
    key, rig = (f"{frame.frame_id}", f"{SUBSESSION}/rig_{frame.rig_id}") if in_rig else (item.name, None)
    draft.images.append(DraftImage(item.name, image.camera, sensor, key, rig, origin))
    draft.poses[key] = inverse(frame.rig_from_world)
    if rig is not None and all(row[:2] != (rig, sensor) for row in draft.rigs):
        draft.rigs.append((rig, sensor, inverse(image.cam_from_world() * frame.rig_from_world.inverse())))
    draft.sources[item.name] = item.path
    if item.mask is not None:
        draft.mask_files[item.name] = item.mask


def reconstruct_once(
    photographs: str | Path, capture: str | Path, device: str = "ios", hold_out: int = 0, camera: str | None = None
) -> str:
    """Reconstruct an image file, a folder of images or a video, unless it was done before. Return a message to show.

    Raises:
        CaptureError: the session was made from other input (the message names it); or as for `reconstruct`.
        ManifestError: as for `reconstruct`.
    """
    source = Path(photographs)
    inputs = inputs_of([source], hold_out=hold_out, camera=camera)
    session = Path(capture) / "sessions" / f"{device}_map"
    return once(
        session, inputs,
        lambda record: reconstruct([source], capture, device, camera=camera, hold_out=hold_out, record=record).report,
    )  # fmt: skip


def inputs_of(sources: Sequence[Path], **options: Any) -> dict[str, Any]:
    """Return what a reconstruction is made from, as `proc/import.json` has it."""
    names = [list_images(source, TAKEN_SUFFIXES) if source.is_dir() else [""] for source in sources]
    paths = [source / name for source, inside in zip(sources, names, strict=True) for name in inside]
    told = {name: one if one is None or isinstance(one, int | float) else str(one) for name, one in options.items()}
    places = ", ".join(str(source.resolve()) for source in sources)
    return {"photographs": places, **told, "files of photographs": files_fingerprint(paths)}


def _escalate(work: _Work, models: Sequence[pycolmap.Reconstruction]) -> list[str]:
    """Match the images that are in no model with learned features, each with those that look similar.

    These are matched with each other, too, where SIFT has: only points of two other images tell a pose.
    """
    inside = {image.name for model in models for image in model.images.values() if image.has_pose}
    left = [image for image, name in enumerate(work.names) if name not in inside and name in work.kinds[0][1]]
    if not left:
        return []
    settings = resolve_auto(LocalizeSettings())
    names = [*settings.features.kinds, *settings.features.escalation]
    if "aliked" not in names:
        return ["ALIKED is not on this machine, so photographs that SIFT leaves out were not tried with it"]
    try:
        (method,) = create_local_methods(settings, ["aliked"])
    except WeightsError as error:
        return [f"photographs that SIFT leaves out were not tried with ALIKED: {error}"]
    pairs = set[tuple[int, int]]()
    for image in left:
        others = np.argsort(-work.similarity[image], kind="stable")[:ESCALATED].tolist()
        pairs |= {(min(image, other), max(image, other)) for other in others if other != image}
        pairs |= {pair for pair in work.pairs[0] if {*pair} <= {*others}}
    work.extract(method, sorted({image for pair in pairs for image in pair}))
    work.match(1, sorted(pairs))
    return [f"{len(left)} photographs that SIFT left out were tried with ALIKED: {len(work.pairs[1])} pairs match"]


def _reasons(work: _Work, models: Sequence[pycolmap.Reconstruction]) -> dict[str, str]:
    """Return why each image that is not in the largest model is left out, by name."""
    numbered = reversed([*enumerate(models)])  # the largest comes last, and wins
    member = {image.name: number for number, model in numbered for image in model.images.values() if image.has_pose}
    shared, reasons = work.verified(), dict(work.unusable)
    inside = np.array([member.get(name) == 0 for name in work.names])
    for image, (name, item) in enumerate(zip(work.names, work.items, strict=True)):
        if inside[image] or item.name in reasons:
            continue
        if name in member:
            size = models[member[name]].num_reg_images()
            reason = f"not connected: in model {member[name]}, of {size} photographs"
        elif not shared[image].any():
            most = max((count for pair, count in work.matched.items() if image in pair), default=0)
            reason = f"no matches: at most {most} with another photograph, and these agree with no motion of the camera"
        elif not shared[image][inside].any():
            count, other = np.count_nonzero(shared[image]), work.items[int(shared[image].argmax())].name
            reason = f"not connected: matches {count} photographs, as {other}, none in the model"
        else:
            reason = f"no pose: its {shared[image][inside].max()} matches with the model's photographs agree with none"
        dropped = not work.exif_used and work.camera_of[image] in work.exif_px and shared[image].any()
        reasons[item.name] = f"{reason}, also without its focal length in EXIF" if dropped else reason
    return reasons


def _hand_over(work: _Work, session: Path) -> None:
    """Give the features of a session's images to the session, where `extract_session` finds them."""
    for _, store in work.kinds:
        target = session / "proc" / "features" / store.path.name
        if session.name == work.session.id and not target.exists():
            link_folder(store.path, target)
            continue
        with Items(store.path) as source, Items(target, source.made_by) as items:
            for name in Session.open(session).image_names:
                made = f"{work.session.id}/{name.partition('/')[2]}"
                if made in store and not items.is_current(name, store_source := source.source(made)):
                    items.add(name, store_source, source[made])


# A map that grows


@retry_damaged
def add_recording(
    sources: Sequence[str | Path], capture: str | Path, device: str = "ios", fps: float | None = None
) -> ImportReport:
    """Register images into the model of a capture and add them to its map session, both made by `reconstruct`.

    Raises:
        CaptureError: the session was not reconstructed, all images are in it already, or none fits into its model.
    """
    folder, session = Path(capture) / FOLDER, Path(capture) / "sessions" / f"{device}_map"
    base = _model(folder, session)
    old = _items_of(base, folder, session)
    known = {item.path.resolve() for item in old.values()}
    gathered, unreadable = gather(list(map(Path, sources)), folder / "images", fps, prefixed=True)
    new = [item for item in gathered if item.path.resolve() not in known]
    names = {item.name for item in old.values()}
    if not new or any(item.name in names for item in new):
        do = f"To finish a map whose making was stopped: {COMMAND} run MANIFEST --only map."
        raise CaptureError(f"{sources[0]}: its photographs, or others of these names, are in {session} already. {do}")
    work = _Work(folder, device, [*old.values(), *new], {})
    _keep_cameras(work, base, {item.name: number for number, item in old.items()})
    work.extract(LocalMethod("sift", SiftExtractor(), _Mutual(RATIO, shorten=KINDS["sift"].shorten)), range(len(work)))
    fixed = set(base.reg_image_ids())
    is_new = [number not in fixed for number in work.image_ids]
    work.match(0, [(i, j) for i, j in work.choose_pairs() if is_new[i] or is_new[j]])
    work.pairs[0] |= _matches(base, work.image_ids)
    model = _register(work, base, fixed)
    added = [image for image in model.images.values() if image.has_pose and image.image_id not in fixed]
    reasons = {name: why for name, why in _reasons(work, [model]).items() if name not in names} | unreadable
    if not added:
        raise CaptureError(f"{sources[0]}: no photograph fits into the model. {next(iter(reasons.items()))}.")
    item_of = dict(zip(work.names, work.items, strict=True))
    draft = Draft(session, folder, add=True, record={"source": ", ".join(map(str, sources))})
    for image in sorted(added, key=lambda image: image.image_id):
        add_posed(draft, item_of[image.name], image, f"{image.camera_id}", "estimated with the model")
    draft.rows = [{"image": name, "status": why} for name, why in reasons.items()]
    draft.follow()
    draft.leave_out()
    report = draft.write()
    _finish(folder, session, model)
    _hand_over(work, session)
    return report


def remove_recording(name: str, capture: str | Path, device: str = "ios") -> str:
    """Remove the images of a recording, or one image, by name from the map session; return what was done, in words.

    Raise CaptureError if the session was not reconstructed, no image has such a name, or all have.
    """
    folder, session = Path(capture) / FOLDER, Path(capture) / "sessions" / f"{device}_map"
    model, opened = _model(folder, session), Session.open(session)
    gone = {one for one in opened.image_names if f"{own_name(one)}/".startswith(f"{name}/")}
    if not 0 < len(gone) < len(opened.image_names):
        recordings = sorted({own_name(one).partition("/")[0] for one in opened.image_names if "/" in own_name(one)})
        found = f"{len(gone)} of {len(opened.image_names)} images of recording {name!r}"
        raise CaptureError(f"{session}: found {found}. Recordings: {', '.join(recordings) or 'one, without a name'}.")
    rows_of_images = [*zip(opened.images.to_dict("records"), opened.image_names, strict=True)]
    keys = {(str(row["timestamp"]), row["sensor_id"]) for row, one in rows_of_images if one in gone}
    kept_sensors = {row["sensor_id"] for row, one in rows_of_images if one not in gone}
    keys |= {(sensor, "") for _, sensor in keys if sensor not in kept_sensors}  # id and name in sensors.txt
    with write_folder(session, replace=True, keep=True) as changed:
        for path in (changed / "images.txt", changed / "trajectories.txt", changed / "sensors.txt"):
            rows = ((line, line.split(",")) for line in path.read_text(encoding="utf-8").splitlines())
            kept = [line for line, cells in rows if line.startswith("#") or (*map(str.strip, cells[:2]),) not in keys]
            write_table(path, None, kept)
        for old in (f"{RAW_DATA}/{IMPORTED}{name}", f"{MASKS}/{IMPORTED}{name}", f"{MASKS}/{IMPORTED}{name}.png"):
            (shutil.rmtree if (changed / old).is_dir() else Path.unlink)(changed / old, True)
        table = pd.read_csv(changed / "proc" / "import.csv", dtype=str, keep_default_na=False)
        write_csv(changed / "proc" / "import.csv", table[~(table["image"] + "/").str.startswith(f"{name}/")])
        if is_linked_here(session):
            note_linked_here(changed)
    for image in [image for image in model.images.values() if image.name in gone and image.has_pose]:
        model.deregister_frame(image.frame_id)
    _finish(folder, session, model)
    return f"{len(gone)} images of {name} removed from {session}, which has {len(opened.image_names) - len(gone)} now"


def _model(folder: Path, session: Path) -> pycolmap.Reconstruction:
    path = folder / "models" / "0"
    if not (session / RECONSTRUCTION_RECORD).is_file() or not path.is_dir():
        raise CaptureError(f"{session} exists, but was not reconstructed here, so nothing can be added to its model.")
    model = pycolmap.Reconstruction(str(path))
    if any(rig.num_sensors() > 1 for rig in model.rigs.values()):
        raise CaptureError(f"{session} has rigs, so it does not grow. Reconstruct all its photographs with --replace.")
    return model


def _items_of(base: pycolmap.Reconstruction, folder: Path, session: Path) -> dict[int, SourceImage]:
    """Return the images of a model, with their masks, by the number of the image."""
    items, sessions = {}, folder / "sessions"
    for number in sorted(base.reg_image_ids()):
        name = base.image(number).name
        path, mask = (sessions / name).resolve(), session / MASKS / f"{IMPORTED}{own_name(name)}.png"
        items[number] = SourceImage(
            own_name(name), path, read_header(path)[1], None, mask.resolve() if mask.is_file() else None
        )
    return items


def _keep_cameras(work: _Work, base: pycolmap.Reconstruction, number_of: dict[str, int]) -> None:
    """Give images of the model their numbers and cameras; start those of equal size and EXIF at the same intrinsics."""
    fresh = [item for item in work.items if item.name not in number_of]
    camera_of, cameras = initial_cameras(fresh, {})
    keys = {}
    for item in work.items:
        if item.name in number_of:
            camera = base.cameras[base.image(number_of[item.name]).camera_id]
            keys[camera.width, camera.height, *exif_key(item.exif)] = camera
    for number, camera in enumerate(cameras):
        item = fresh[camera_of.index(number)]
        alike = keys.get((camera.width, camera.height, *exif_key(item.exif)))
        if alike is not None:
            cameras[number] = pycolmap.Camera(model=alike.model.name, width=alike.width, height=alike.height,
                                              params=alike.params.tolist())  # fmt: skip
            cameras[number].has_prior_focal_length = True
    first, first_image = max(base.cameras) + 1, max(base.images) + 1
    known = sorted(base.cameras)
    work.cameras = [base.cameras[number] for number in known] + cameras
    work.camera_ids = known + list(range(first, first + len(cameras)))
    left, work.camera_of, work.image_ids = iter(camera_of), [], []
    for item in work.items:
        if item.name in number_of:
            work.image_ids.append(number_of[item.name])
            points = base.image(number_of[item.name]).points2D
            work.in_model[number_of[item.name]] = np.array([point.xy for point in points]).reshape(-1, 2)
            work.camera_of.append(known.index(base.image(number_of[item.name]).camera_id))
        else:
            work.image_ids.append(first_image)
            work.camera_of.append(len(known) + next(left))
            first_image += 1


def _matches(base: pycolmap.Reconstruction, image_ids: Sequence[int]) -> dict[tuple[int, int], Ints]:
    """Return the matches of pairs of images in a model, from its points: COLMAP forgets images without any."""
    index, found = {number: row for row, number in enumerate(image_ids)}, dict[tuple[int, int], list[tuple[int, int]]]()
    for point in base.points3D.values():
        seen = sorted((index[one.image_id], one.point2D_idx) for one in point.track.elements)
        for (i, a), (j, b) in combinations(seen, 2):
            if i != j:
                found.setdefault((i, j), []).append((a, b))
    return {pair: np.array(matches) for pair, matches in found.items()}


def _register(work: _Work, base: pycolmap.Reconstruction, fixed: set[int]) -> pycolmap.Reconstruction:
    """Return the model with the new images; those of the numbers `fixed` keep their poses."""
    for folder in ("grown", "base"):
        shutil.rmtree(work.folder / folder, ignore_errors=True)
        (work.folder / folder).mkdir()
    before = {number: base.image(number).cam_from_world() for number in fixed}
    base.write(str(work.folder / "base"))
    options = work._incremental_options()
    options.fix_existing_frames, options.multiple_models = True, False
    options.constant_cameras, options.min_num_matches = set(base.cameras), 1
    with tqdm(total=len(work) - len(fixed), desc="map", unit="image") as bar, _quiet():
        models = pycolmap.incremental_mapping(
            work.write_database(), work.session.path.parent, work.folder / "grown", options,
            input_path=work.folder / "base", next_image_callback=bar.update,
        )  # fmt: skip
        model = max(models.values(), key=lambda one: one.num_reg_images(), default=base)
        work._refine(model, fixed)
    for number, pose in before.items():
        moved = model.image(number).cam_from_world()
        assert np.allclose(moved.matrix(), pose.matrix(), atol=1e-6), "the mapper has moved an image of the model"
    return model


def _finish(folder: Path, session: Path, model: pycolmap.Reconstruction) -> None:
    model.write(str(folder / "models" / "0"))
    record = read_json(session / RECONSTRUCTION_RECORD)
    table = pd.read_csv(session / "proc" / "import.csv")
    record |= {"photographs": len(table), "registered": model.num_reg_images(), "points": model.num_points3D()}
    write_text(session / RECONSTRUCTION_RECORD, json.dumps(record, indent=1) + "\n")
