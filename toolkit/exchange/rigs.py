"""Rigs of a reconstruction: photographs with equal names in several folders, taken at the same time."""

from collections.abc import Sequence
from pathlib import Path

import pycolmap

from toolkit.errors import CaptureError
from toolkit.exchange.photographs import Photograph

FOLDERS = "folders"
"""What is given instead of a file if all folders with photographs are the cameras of one rig."""
Prefixes = list[list[str]]
"""For each rig, how the names of the photographs of each camera begin; the reference camera is the first."""


def read_rigs(rig: str | Path, photographs: Sequence[Photograph]) -> Prefixes:
    """Return the rigs of `FOLDERS`, or of a file in COLMAP's format `rig_config.json`.

    Poses of cameras in the rig are not taken from the file, but found.

    Raises:
        CaptureError: the file cannot be read, or a rig does not have two cameras, each with photographs.
    """
    if str(rig) == FOLDERS:
        found = [sorted({f"{Path(item.name).parent.as_posix()}/" for item in photographs})]
    else:
        try:
            configs = pycolmap.read_rig_config(rig)
        except (RuntimeError, ValueError) as error:
            raise CaptureError(f"{rig}: no configuration of rigs that COLMAP reads ({error}).") from None
        cameras = [sorted(config.cameras, key=lambda camera: not camera.ref_sensor) for config in configs]
        found = [[camera.image_prefix for camera in each] for each in cameras]
    for prefixes in found:
        counts = {prefix: sum(item.name.startswith(prefix) for item in photographs) for prefix in prefixes}
        if len(prefixes) < 2 or not all(counts.values()):
            example = photographs[0].name
            expected = "two cameras or more, each with photographs in its folder"
            raise CaptureError(f"rig: {rig}: found {counts}, expected {expected}. A photograph: {example}.")
    return found


def join(model: pycolmap.Reconstruction, database: Path, rigs: Prefixes, folder: str) -> None:
    """Join the images of a model to frames of rigs, whose extrinsics follow from the poses of the images.

    Args:
        database: COLMAP's, which gets the rigs, too.
        folder: of the images, in COLMAP's names.

    Raises:
        CaptureError: no frame has poses for the reference camera and another one.
    """
    configs = []
    for prefixes in rigs:
        cameras = [
            pycolmap.RigConfigCamera(ref_sensor=at == 0, image_prefix=folder + prefix)
            for at, prefix in enumerate(prefixes)
        ]
        configs.append(pycolmap.RigConfig(cameras=cameras))
    with pycolmap.Database.open(str(database)) as opened:
        try:
            pycolmap.apply_rig_config(configs, opened, model)
        except (RuntimeError, ValueError) as error:
            do = "Are the names equal, and the first camera in the model?"
            raise CaptureError(f"rig: cameras {rigs} do not join to a rig ({error}). {do}") from None
