"""Time and memory to open a large session, beside the benchmark's own reader.

    python benchmarks/capture.py [--images 200000] [--kind hl|ios|covariance] [--reference CHECKOUT]

CHECKOUT is a checkout of cvg/crocodl-benchmark. Writes the text files of a session (no image files) to a
temporary folder, opens it in a fresh process for each reader, and prints seconds (imports not counted) and
the peak resident memory of that process. The work timed is what a stage needs: the image table, the device
of each image, and world_from_cam of all images. Kinds:

    hl          2 cameras x images/2 frames, one rig id per frame, a rig pose per frame
    ios         a sensor of its own and a pose for each image, no rig
    covariance  hl with a 6x6 covariance in each pose
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from toolkit.capture import Trajectory, write_session

RIG_FROM_SENSOR = {
    "hetlf": [0.95, 0.24, -0.148, 0.112, 0.08, -0.22, 0.31],
    "hetrf": [0.571, 0.173, -0.102, 0.795, -0.08, -0.22, 0.31],
}

OURS = """
import json, resource, sys, time
start = time.perf_counter()
from toolkit.capture import Session
imported = time.perf_counter()
session = Session.open(sys.argv[1])
opened = time.perf_counter()
images, devices = session.images, session.device_ids
poses = session.world_from_cam()
done = time.perf_counter()
assert len(images) == len(devices) == len(poses) == int(sys.argv[2]) and bool((poses == poses).all())
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps([imported - start, opened - imported, done - imported, peak, poses[::997].tolist()]))
"""

# The reader refuses images that are not on disk, so the check for existing files is taken out, in its favor.
REFERENCE = """
import json, resource, sys, time
sys.path.insert(0, sys.argv[3])
start = time.perf_counter()
import pathlib
from scantools.capture.session import Session
imported = time.perf_counter()
pathlib.Path.exists = lambda self: "raw_data" in self.parts or __import__("os").path.exists(self)
session = Session.load(pathlib.Path(sys.argv[1]))
opened = time.perf_counter()
poses = [session.get_pose(*key).to_4x4mat() for key in session.images.key_pairs()]
done = time.perf_counter()
assert len(poses) == int(sys.argv[2])
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
some = [pose.tolist() for pose in poses[::997]]
print(json.dumps([imported - start, opened - imported, done - imported, peak, some]))
"""


def write_text_session(path: Path, images: int, kind: str, seed: int = 0) -> None:
    """Write the text files of a session of `images` images."""
    rng = np.random.default_rng(seed)
    frames = images if kind == "ios" else images // 2
    timestamps = 630_003_697_552 + 33_333 * np.arange(frames)
    qt = np.hstack([rng.normal(size=(frames, 4)), rng.normal(size=(frames, 3)) * 20])
    qt[:, :4] /= np.linalg.norm(qt[:, :4], axis=1, keepdims=True)
    covariances = rng.normal(size=(frames, 6, 6)) * 1e-3 if kind == "covariance" else None
    stamps = timestamps.tolist()
    if kind == "ios":
        name = "ios_2022-05-01_10.00.00_000"
        devices = [f"{name}/cam_phone_{stamp}" for stamp in stamps]
        pinhole = ("camera", "PINHOLE", 960, 640, 921.772, 921.772, 481.8, 317.9)
        sensors = [(device, "phone camera", *pinhole) for device in devices]
        rigs = None
        rows = [(t, device, f"{name}/images/{t}.jpg") for t, device in zip(stamps, devices, strict=True)]
    else:
        name, cameras = "hl_2022-05-01-10-10-00-417", ("hetlf", "hetrf")
        devices = [f"{name}/hetrig_{stamp}" for stamp in stamps]
        pinhole = ("camera", "PINHOLE", 480, 640, 542.0, 538.0, 243.1, 316.4)
        sensors = [(f"{name}/{camera}", camera, *pinhole) for camera in cameras]
        rigs = [
            (device, f"{name}/{camera}", RIG_FROM_SENSOR[camera]) for device in devices for camera in cameras
        ]
        rows = [
            (t, f"{name}/{camera}", f"{name}/images/{camera}/{t}.jpg") for t in stamps for camera in cameras
        ]
    trajectory = Trajectory(timestamps, devices, qt, covariances)
    write_session(path, sensors, rigs, trajectory, rows, subsessions=[name])


def measure(program: str, *arguments: str) -> tuple[str, list[list[list[float]]]]:
    """Run a reader in a process of its own; return a line of numbers and some of its poses."""
    result = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True)
    if result.returncode:
        return "failed: " + result.stderr.strip().splitlines()[-1], []
    imports, opening, total, peak, poses = json.loads(result.stdout)
    return (
        f"imports {imports:5.2f} s | open {opening:6.2f} s | with poses {total:6.2f} s | peak {peak:5.0f} MB",
        poses,
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=int, default=200_000, help="images in the session")
    parser.add_argument("--kind", choices=["hl", "ios", "covariance"], default="hl")
    parser.add_argument("--reference", help="checkout of cvg/crocodl-benchmark, to time its reader too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hl_map"
        start = time.perf_counter()
        # In a process of its own: a child's peak memory counts from what its parent holds.
        with ProcessPoolExecutor(1) as pool:
            pool.submit(write_text_session, path, options.images, options.kind).result()
        size = sum(file.stat().st_size for file in path.rglob("*.txt")) / 1e6
        seconds = time.perf_counter() - start
        print(f"{options.kind}: {options.images} images, {size:.0f} MB of text ({seconds:.1f} s to write)")
        line, poses = measure(OURS, str(path), str(options.images))
        print(f"toolkit    {line}")
        if options.reference:
            line, expected = measure(REFERENCE, str(path), str(options.images), options.reference)
            print(f"benchmark  {line}")
            if expected:
                print(f"largest difference in poses: {np.abs(np.subtract(poses, expected)).max():.1e}")


if __name__ == "__main__":
    main()
