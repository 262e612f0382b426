"""hloc's `reconstruction` of a folder of photographs; runs under an interpreter of its own, without the toolkit.

    python benchmarks/hloc_reconstruct.py HLOC IMAGES WORK THREADS

Conf "sift" with "NN-ratio", all pairs, a camera per folder; the rest are hloc's defaults. Writes WORK/poses.json:
cam_from_world (3, 4) by name, wall and CPU seconds without imports.
"""

import json
import sys
from pathlib import Path

from hloc_worker import CONFS, Clock, import_hloc


def main() -> None:
    checkout, images, work, threads = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])
    import_hloc(checkout, "sift")
    import pycolmap
    import torch
    from hloc import extract_features, match_features, pairs_from_exhaustive, reconstruction

    torch.set_num_threads(threads)
    extractor, matcher = CONFS["sift"]
    clock, pairs, matches = Clock(), work / "pairs.txt", work / "matches.h5"
    with clock("all"):
        features = extract_features.main(extract_features.confs[extractor], images, work)
        pairs_from_exhaustive.main(pairs, features=features)
        match_features.main(match_features.confs[matcher], pairs, features, matches=matches)
        mapper = {"min_model_size": 3, "num_threads": threads}
        mode = pycolmap.CameraMode.PER_FOLDER
        model = reconstruction.main(work / "sfm", images, pairs, features, matches, mode, mapper_options=mapper)
    posed = [] if model is None else [image for image in model.images.values() if image.has_pose]
    poses = {image.name: image.cam_from_world().matrix().tolist() for image in posed}
    answer = {"poses": poses, "wall_s": clock.seconds["all"], "cpu_s": clock.cpu["all"]}
    (work / "poses.json").write_text(json.dumps(answer))


if __name__ == "__main__":
    main()
