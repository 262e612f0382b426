"""Bundle adjustment of a map whose poses are noisy: the given positions are priors, intrinsics stay as they are."""

from collections.abc import Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from toolkit import geometry
from toolkit.alignment.similarity import align_to_map
from toolkit.geometry import Floats
from toolkit.mapping.local_map import LocalMap
from toolkit.mapping.pose_noise import PoseNoise

MIN_OBSERVATIONS = 12  # of an image; with fewer, its pose stays as it is
MAX_ITERATIONS = 50
PRIOR_NOISE = 3.0  # standard deviation of a given position, in multiples of the measured noise, which misses slow drift
MIN_NOISE = PoseNoise(0.02, 0.001)  # one of the two may be zero
MAX_ALIGNED = 50  # images by which the refined map is put where the given one was


def refined_poses(
    local_map: LocalMap, keypoints: Sequence[NDArray[np.float32]], noise: PoseNoise, threads: int = -1
) -> Floats:
    """Return world_from_cams (N, 4, 4) that agree best with the observations of a map.

    COLMAP's bundle adjustment with position priors, and a similarity that puts the result where the given poses are.

    Args:
        local_map: triangulated with the given poses.
        keypoints: of each image, (n, 2), pixels.
        noise: of the given poses.
        threads: of the solver; -1: all.
    """
    origin = geometry.local_origin(local_map.world_from_cams[:, :3, 3])
    given = geometry.shifted(local_map.world_from_cams, -origin)
    position_std = PRIOR_NOISE * max(noise.position, MIN_NOISE.position) * local_map.length
    model = pycolmap.Reconstruction()
    seen = np.bincount(local_map.obs_image, minlength=len(given)) >= MIN_OBSERVATIONS
    config, priors = pycolmap.BundleAdjustmentConfig(), []
    for index in np.flatnonzero(seen).tolist():
        camera = pycolmap.Camera(local_map.cameras[index].todict() | {"camera_id": index + 1})
        model.add_camera_with_trivial_rig(camera)
        xy = keypoints[index].astype(np.float64)
        image = pycolmap.Image(name=f"{index}", camera_id=index + 1, image_id=index + 1, keypoints=xy)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(geometry.invert(given[index])[:3]))
        config.add_image(index + 1)
        config.set_constant_cam_intrinsics(index + 1)
        priors.append(
            pycolmap.PosePrior(
                pose_prior_id=index + 1,
                corr_data_id=model.image(index + 1).data_id,
                position=given[index, :3, 3],
                position_covariance=position_std**2 * np.eye(3),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    for point, xyz in enumerate(local_map.points - origin):
        track = pycolmap.Track()
        for observation in local_map.by_point[slice(*local_map.point_starts[point : point + 2])].tolist():
            if seen[local_map.obs_image[observation]]:
                image_id = int(local_map.obs_image[observation]) + 1
                track.add_element(image_id, int(local_map.obs_keypoint[observation]))
        if track.length() > 1:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.num_threads = threads
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(
        options, pycolmap.PosePriorBundleAdjustmentOptions(), config, priors, model
    )
    poses, level = np.array(local_map.world_from_cams), pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value  # each step that it retries is a warning
    try:
        usable = adjuster.solve().is_solution_usable()
    finally:
        pycolmap.logging.minloglevel = level
    if usable:
        adjusted = np.flatnonzero(seen)
        cams_from_world = np.tile(np.eye(4), (len(adjusted), 1, 1))
        cams_from_world[:, :3] = [model.image(index + 1).cam_from_world().matrix() for index in adjusted.tolist()]
        refined = geometry.invert(cams_from_world)
        some = np.unique(np.linspace(0, len(adjusted) - 1, MAX_ALIGNED).astype(np.int64))
        alignment = align_to_map(
            refined[some],
            given[adjusted[some]],
            center_noise_m=np.sqrt(3) * max(noise.position, MIN_NOISE.position) * local_map.length,
            rotation_noise_deg=np.sqrt(3) * max(noise.rotation_deg, MIN_NOISE.rotation_deg),
        )
        poses[adjusted] = geometry.shifted(alignment.world_from_model.apply_to_pose(refined), origin)
    return poses
