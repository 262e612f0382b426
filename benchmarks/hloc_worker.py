"""hloc on a job that localize.py writes; runs under an interpreter of its own, without the toolkit.

    python benchmarks/hloc_worker.py HLOC FEATURES [JOB RESULT]

HLOC is a checkout of cvg/Hierarchical-Localization, FEATURES is sift or aliked, JOB and RESULT are JSON files; without
them, only what hloc needs is checked. Everything that is timed is hloc's own public functions with its own settings:
conf "sift" with "NN-ratio", or "aliked-n16" with "aliked+lightglue"; pairs from poses, triangulation from known poses,
PnP for every query image.
"""

import json
import resource
import sys
import time
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# From 4.2.1 on COLMAP passes over matches without a two-view configuration. hloc sets none: its map would be empty.
PYCOLMAP = "4.2.0"
CONFS = {"sift": ("sift", "NN-ratio"), "aliked": ("aliked-n16", "aliked+lightglue")}
"""hloc's confs of extraction and matching, by features."""


class Clock:
    """Adds up wall and CPU seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start, cpu = time.perf_counter(), cpu_seconds()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
        self.cpu[stage] = self.cpu.get(stage, 0.0) + cpu_seconds() - cpu


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def import_hloc(checkout: str, kind: str) -> None:
    """Put hloc on the path and import what is used of it; exits with a sentence where that is not possible."""
    sys.path.insert(0, checkout)
    try:
        import kornia.feature.laf  # noqa: F401
    except ImportError as error:
        if kind == "aliked":
            sys.exit(f"{sys.executable}: {error}. benchmarks/README.md has the needs of hloc with ALIKED.")
        # SIFT's descriptors need none of it
        laf: Any = types.ModuleType("kornia.feature.laf")
        laf.extract_patches_from_pyramid = laf.laf_from_center_scale_ori = None
        for name in ("kornia", "kornia.feature"):
            sys.modules[name] = types.ModuleType(name)
        sys.modules["kornia.feature.laf"] = laf
    try:
        import pycolmap
        from hloc import extract_features, localize_sfm, match_features, pairs_from_poses, triangulation  # noqa: F401

        if kind == "aliked":
            import hloc_aliked

            sys.modules["lightglue"] = hloc_aliked
            from hloc.extractors import aliked  # noqa: F401
            from hloc.matchers import lightglue  # noqa: F401
        else:
            from hloc.extractors import dog  # noqa: F401
            from hloc.matchers import nearest_neighbor  # noqa: F401
    except ImportError as error:
        sys.exit(f"{sys.executable} cannot import hloc from {checkout}: {error}. benchmarks/README.md has its needs.")
    if pycolmap.__version__ != PYCOLMAP:
        sys.exit(
            f"{sys.executable} has pycolmap {pycolmap.__version__}; hloc needs {PYCOLMAP} (with 4.2.1 its map is "
            "empty without an error). Name an interpreter that has it by --hloc-python; see benchmarks/README.md."
        )


def write_model(path: Path, images: list[dict[str, Any]]) -> None:
    """Write a COLMAP model of posed images without points."""
    import numpy as np
    import pycolmap

    model = pycolmap.Reconstruction()
    for index, image in enumerate(images, start=1):
        model.add_camera_with_trivial_rig(pycolmap.Camera(**image["camera"], camera_id=index))
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=image["name"], camera_id=index, image_id=index),
            pycolmap.Rigid3d(np.array(image["cam_from_world"])),
        )
    path.mkdir(parents=True)
    model.write(path)


def build_map(
    job: dict[str, Any], device: str, matcher: str, features: Path, out: Path, clock: Clock
) -> tuple[Any, int]:
    """Match and triangulate one map; returns the reconstruction and how many pairs were matched."""
    from hloc import match_features, pairs_from_poses, triangulation

    folder = out / f"{device}_map"
    model, pairs, matches = folder / "model", folder / "pairs.txt", folder / "matches.h5"
    write_model(model, job["maps"][device])
    with clock("map: match"):
        pairs_from_poses.main(model, pairs, min(job["map_pairs"], len(job["maps"][device]) - 1))
        match_features.main(match_features.confs[matcher], pairs, features, matches=matches)
    with clock("map: triangulate"):
        reconstruction = triangulation.main(folder / "sfm", model, Path(job["image_dir"]), pairs, features, matches)
    if not reconstruction.num_points3D():
        sys.exit(f"hloc triangulated no point in {device}_map; is this pycolmap {PYCOLMAP}?")
    listed = {tuple(sorted(line.split())) for line in pairs.read_text().splitlines()}
    return reconstruction, len(listed)


def localize(
    pair: dict[str, Any], reconstruction: Any, matcher: str, features: Path, out: Path, clock: Clock
) -> dict[str, dict[str, Any]]:
    """Localize each query image, as hloc.localize_sfm.main does; it would name poses by file name alone."""
    import pycolmap
    from hloc import match_features
    from hloc.localize_sfm import QueryLocalizer, pose_from_cluster

    pairs, matches = out / f"{pair['name']}.txt", out / f"{pair['name']}.h5"
    pairs.write_text("\n".join(f"{query['name']} {name}" for query in pair["queries"] for name in query["references"]))
    with clock("localize: match"):
        match_features.main(match_features.confs[matcher], pairs, features, matches=matches)
    poses = {}
    with clock("localize: pose"):
        ids = {image.name: index for index, image in reconstruction.images.items()}
        localizer = QueryLocalizer(reconstruction, {"estimation": {"ransac": {"max_error": 12}}})
        for query in pair["queries"]:
            references = [ids[name] for name in query["references"]]
            if not references:
                continue
            camera = pycolmap.Camera(**query["camera"])
            answer, _ = pose_from_cluster(localizer, query["name"], camera, references, features, matches)
            if answer is None:  # hloc then takes the pose of the nearest image
                answer = {"cam_from_world": reconstruction.images[references[0]].cam_from_world(), "num_inliers": 0}
            poses[query["name"]] = {
                "cam_from_world": answer["cam_from_world"].matrix().tolist(),
                "num_inliers": int(answer["num_inliers"]),
            }
    return poses


def main() -> None:
    if len(sys.argv) == 1:
        print(__doc__)
        return
    clock = Clock()
    checkout, kind = sys.argv[1:3]
    with clock("imports"):
        import_hloc(checkout, kind)
    if len(sys.argv) == 3:
        return
    import torch
    from hloc import extract_features

    job, result = json.loads(Path(sys.argv[3]).read_text()), Path(sys.argv[4])
    extractor, matcher = CONFS[kind]
    if kind == "aliked":
        import hloc_aliked

        hloc_aliked.WEIGHTS.update(job["weights"])
    out = result.parent / "hloc"
    out.mkdir()
    torch.set_num_threads(job["threads"])
    with clock("local features"):
        features = extract_features.main(
            extract_features.confs[extractor], Path(job["image_dir"]), out, image_list=job["extract"]
        )
    maps = {device: build_map(job, device, matcher, features, out, clock) for device in job["maps"]}
    poses = {
        pair["name"]: localize(pair, maps[pair["map"]][0], matcher, features, out, clock) for pair in job["pairs"]
    }
    counts = {
        "images extracted": len(job["extract"]),
        "map pairs": sum(pairs for _, pairs in maps.values()),
        "map points": sum(reconstruction.num_points3D() for reconstruction, _ in maps.values()),
    }
    report = {
        "seconds": clock.seconds,
        "cpu": clock.cpu,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "peak_child_mb": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024,
        "counts": counts,
        "poses": poses,
    }
    result.write_text(json.dumps(report))


if __name__ == "__main__":
    main()
