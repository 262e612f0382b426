"""What is fuzzed: for each kind of file from elsewhere, its seeds, and a check that takes the bytes of one input.

The first byte of an input says which file the rest becomes. A check passes if the readers take the file or refuse it
with a `ToolkitError` that names it; any other exception, and whatever ends or stalls the process, is a finding.
"""

import io
import pickle
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pycolmap
from PIL import Image

from tests.localized import read_queries, stored
from toolkit.capture import Capture, Session
from toolkit.capture.check import check_capture
from toolkit.capture.tables import read_query_table
from toolkit.errors import ToolkitError
from toolkit.exchange.export import import_features
from toolkit.exchange.interchange import import_colmap, import_images
from toolkit.files import read_references
from toolkit.manifest import load_manifest
from toolkit.pose.base import Correspondences, QueryResult
from toolkit.store.hdf5 import write_groups


@dataclass(frozen=True)
class Target:
    """A kind of files."""

    seeds: Callable[[], list[bytes]]
    check: Callable[[bytes], None]


@cache
def workplace() -> Path:
    """A folder in memory, where the system has one."""
    memory = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="fuzz-", dir=memory if memory.is_dir() else None))


def refused(action: Callable[[], object], *names: str) -> bool:
    """Tell whether an action refuses what it is given, with a message that has one of these names in it."""
    try:
        action()
    except ToolkitError as error:
        if not any(name in str(error) for name in names):
            raise AssertionError(f"the message names none of {names}: {error}") from error
        return True
    return False


# Text


SESSION_FILES = {
    "sensors.txt": "# sensor_id, name, sensor_type, [sensor_params]+\ncam, , camera, PINHOLE, 8, 6, 7, 7, 4, 3\n"
    "dep, , depth, PINHOLE, 8, 6, 7, 7, 4, 3\nimu, , imu\n",
    "rigs.txt": "# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz\nrig, cam, 1, 0, 0, 0, 0.1, 0, 0\n",
    "images.txt": "# timestamp, sensor_id, image_path\n10, cam, a/1.png\n20, cam, a/2.png\n",
    "depths.txt": "10, dep, a/1.depth.png\n",
    "trajectories.txt": f"10, rig, 1, 0, 0, 0, 1, 2, 3\n20, rig, 0, 1, 0, 0, 1, 2, 3{', 0.5' * 36}\n",
    "proc/alignment_trajectories.txt": "10, rig, 1, 0, 0, 0, 1, 2, 3\n",
    "proc/subsessions.txt": "a\n",
    "proc/keyframes_pruned_subsampled.txt": "10, rig\n",
}
TABLES = {
    "table.csv": "image,qw,qx,qy,qz,tx,ty,tz,model,width,height,params\n1.png,1,0,0,0,1,2,3,PINHOLE,8,6,7 7 4 3\n",
    "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE 8 6 7 7 4 3\n",
    "pair.jsonl": '{"timestamp": "10", "sensor_id": "cam", "device_id": "rig", "Trs": [], "topk": [{"path": "x"}]}\n',
    "pair.csv": "timestamp,device_id,status\n10,rig,ok\n",
    "run.yaml": "captures: [P]\nlocalize: {method: pnp, features: [sift]}\nrerank: {topn: 20}\npairs: [[ios, hl]]\n",
}
TEXTS = [*SESSION_FILES, *TABLES]
ODD = [
    b"\xef\xbb\xbf", b"\r\n", b"\r", b"\x00", b"\xff\xfe", b"nan, inf, -inf, 1e999", b"0x10", b"9223372036854775808",
    b"1e308", b'"', b"#", b",,,,,,,,,,", b"\t \t", "日本 é".encode(), b"../../x", b"/etc/passwd", b"&a [*a]",
    b"!!python/tuple []",
]  # fmt: skip


def text_seeds() -> list[bytes]:
    contents = SESSION_FILES | TABLES
    whole = [bytes([number]) + contents[name].encode() for number, name in enumerate(TEXTS)]
    whole += [bytes([number + len(TEXTS) * 10]) + whole[number][1:] for number in range(len(SESSION_FILES))]
    return [*whole, *(seed + odd for seed in whole for odd in ODD), *(seed.replace(b"\n", b"\r\n") for seed in whole)]


def photograph(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(path)


@cache
def text_capture() -> Path:
    """A small capture; each check replaces one of its files."""
    session = workplace() / "text" / "P" / "sessions" / "ios_map"
    for name, content in SESSION_FILES.items():
        (session / name).parent.mkdir(parents=True, exist_ok=True)
        (session / name).write_text(content)
    for name in ("1.png", "2.png"):
        photograph(session / "raw_data" / "a" / name)
    return session.parents[1]


def check_text(data: bytes) -> None:
    if not data:
        return
    name = TEXTS[data[0] % len(TEXTS)]
    if name not in SESSION_FILES:
        check_table(name, data[1:])
        return
    capture = text_capture()
    path = capture / "sessions" / "ios_map" / name
    path.write_bytes(data[1:])
    try:
        refused(lambda: use_session(Capture.open(capture)["ios_map"]), str(path), path.name, "ios_map")
        if data[0] >= 128:  # slower than the rest together
            check_capture(capture).text()
    finally:
        path.write_text(SESSION_FILES[name])


def use_session(session: Session) -> None:
    """Ask for all that the stages ask of a session."""
    for sensor in session.images["sensor_id"]:
        if session.has_sensor(sensor) and session.sensors["sensor_type"].iloc[session._sensor_row(sensor)] == "camera":
            session.camera(sensor)
    _ = session.camera_rows, session.subsessions, session.subsession_of(), session.depths, session.device_ids
    for name in (*session.keyframe_files, "all"):
        session.rows_of_keyframes(session.keyframes(name))
    for sensor in session.sensors["sensor_id"]:
        session.poses_of_sensor(sensor)
    session.rig_from_cam()
    for truth in (False, True):
        session.world_from_cam(ground_truth=truth)
    for trajectory in (session.trajectory, session.ground_truth):
        if trajectory is not None:
            _ = trajectory.covariances
    _ = session.files_fingerprint, session.depths_fingerprint, session.row_of_name


def check_table(name: str, content: bytes) -> None:
    folder = workplace() / "tables"
    folder.mkdir(exist_ok=True)
    path = folder / name
    path.write_bytes(content)
    if name == "pair.jsonl":
        refused(lambda: read_references(path, "device_id"), name)
    elif name == "pair.csv":
        refused(lambda: read_query_table(path, ["status"]), name)
    elif name == "run.yaml":
        refused(lambda: load_manifest(path), name)
    else:
        if not (folder / "images").exists():
            photograph(folder / "images" / "1.png")
        given = {"table" if name == "table.csv" else "cameras": path}
        try:
            refused(lambda: import_images(folder / "images", folder / "C", **given), name, "1.png", "images")
        finally:
            shutil.rmtree(folder / "C", ignore_errors=True)


# HDF5


HDF5_NAMES = ("10/rig", "20/rig")
HDF5_ARRAYS = (
    "camera", "pixels", "points", "point_index", "agrees", "found_by", "found_by_labels", "view_of", "view_reference",
    "view_pixels", "images", "references", "rejected", "keypoints", "scales", "scores", "descriptors", "image_size",
)  # fmt: skip


def localized_query() -> QueryResult:
    found = Correspondences(
        np.zeros(3, np.int64), np.ones((3, 2)), np.ones((3, 3)), np.arange(3), np.ones(3, bool),
        np.array(["sift/guided"] * 3), np.arange(3), np.zeros(3, np.int64), np.ones((3, 2)),
    )  # fmt: skip
    return stored(["q/1.png"], ["m/1.png"], [], found)


def write_queries(path: Path) -> bytes:
    """Write a file with the arrays of localized queries and of features; return its bytes."""
    arrays = localized_query().arrays()
    features = {"keypoints": np.ones((4, 2), np.float32), "descriptors": np.ones((8, 4), np.float32)}
    features |= {"scales": np.ones(4, np.float32), "scores": np.ones(4, np.float32), "image_size": np.array([8, 6])}
    groups = ((name, arrays | features) for name in HDF5_NAMES)
    write_groups(path, groups, {"maps": '["ios_map.npz"]', "top_left_pixel_center": 0.0})
    with h5py.File(path, "a") as file:  # a file made by somebody else has no checksums, or right ones
        for name in HDF5_NAMES:
            file[name].attrs.clear()
    return path.read_bytes()


def hdf5_seeds() -> list[bytes]:
    whole = write_queries(workplace() / "seed.h5")
    edits = [bytes([1, array, edit, array]) for array in range(len(HDF5_ARRAYS)) for edit in range(len(EDITS))]
    return [b"\0" + whole, b"\0" + whole[: len(whole) // 2], *edits]


def edit_nothing(group: h5py.Group, name: str, size: int) -> None:
    del group[name]


def edit_scalar(group: h5py.Group, name: str, size: int) -> None:
    del group[name]
    group[name] = [0, -1, 1e308, float("nan"), "text", b"\xff\xfe", True, 2**63][size % 8]


def edit_shape(group: h5py.Group, name: str, size: int) -> None:
    values = group[name][()]
    del group[name]
    shape = [(0,), (0, 0), (size,), (size, 1), (1, size), (2, 2, 2)][size % 6]
    group[name] = np.zeros(shape, values.dtype if values.dtype != object else np.float32)


def edit_huge(group: h5py.Group, name: str, size: int) -> None:
    del group[name]
    shape = [(1 << 40,), (1 << 20, 1 << 20), (1 << 62,), (1 << 33, 2)][size % 4]
    group.create_dataset(name, shape, "f4", chunks=tuple(min(64, side) for side in shape))


def edit_type(group: h5py.Group, name: str, size: int) -> None:
    shape = group[name].shape
    del group[name]
    kinds = ["S5", "c8", "u1", "f2", "i8", [("a", "i4"), ("b", "f8")], "V7", h5py.string_dtype(), "?", h5py.ref_dtype]
    kind = kinds[size % len(kinds)]
    group.create_dataset(name, shape, kind)


def edit_link(group: h5py.Group, name: str, size: int) -> None:
    del group[name]
    links = [h5py.ExternalLink("/etc/passwd", "/x"), h5py.SoftLink("/nowhere"), h5py.SoftLink(f"{group.name}/{name}")]
    group[name] = [*links, h5py.ExternalLink("seed.h5", f"/10/rig/{name}")][size % 4]


def edit_group(group: h5py.Group, name: str, size: int) -> None:
    del group[name]
    group.create_group(name)


def edit_values(group: h5py.Group, name: str, size: int) -> None:
    values = group[name][()]
    if values.dtype != object and values.size:
        values.flat[size % values.size] = [255, 1, 0, 127][size % 4]
        group[name][()] = values


def edit_parent(group: h5py.Group, name: str, size: int) -> None:
    """Turn the whole query, or the time above it, into something else."""
    file, place = group.file, group.name if size % 2 else group.parent.name
    del file[place]
    file[place] = np.zeros(3)
    file[["x/y", "10/rig/more/levels", "-5/rig", "１/rig"][size % 4]] = np.zeros(2)


EDITS = (
    edit_nothing, edit_scalar, edit_shape, edit_huge, edit_type, edit_link, edit_group, edit_values, edit_parent,
)  # fmt: skip


@cache
def healthy_hdf5() -> bytes:
    return write_queries(workplace() / "healthy.h5")


def check_hdf5(data: bytes) -> None:
    if not data:
        return
    path = workplace() / "queries.h5"
    path.write_bytes(data[1:] if data[0] % 2 == 0 else healthy_hdf5())
    if data[0] % 2:
        with h5py.File(path, "a") as file:
            for array, edit, size in zip(data[1::3], data[2::3], data[3::3], strict=False):
                name, place = HDF5_ARRAYS[array % len(HDF5_ARRAYS)], HDF5_NAMES[array // 128]
                try:
                    EDITS[edit % len(EDITS)](file[place], name, size)
                except (KeyError, TypeError, ValueError, OSError, RuntimeError, AttributeError, MemoryError):
                    continue  # an earlier edit has taken it away
    refused(lambda: use_queries(path), path.name)
    refused(lambda: use_features(path), path.name)


def use_queries(path: Path) -> None:
    read = read_queries(path)
    for key in ((10, "rig"), (20, "rig")):
        check_query(read(*key))


def check_query(query: QueryResult) -> None:
    """What readers rely on."""
    found = query.correspondences
    count, views = len(found.camera), len(found.view_of)
    assert found.pixels.shape == (count, 2)
    assert found.points.shape == (count, 3)
    assert all(len(column) == count for column in (found.point_index, found.agrees, found.found_by))
    assert found.view_pixels.shape == (views, 2)
    assert len(found.view_reference) == views
    assert all(isinstance(name, str) for name in (*query.images, *query.references, *query.rejected))


def use_features(path: Path) -> None:
    shutil.rmtree(workplace() / "features", ignore_errors=True)
    store = import_features(path, workplace() / "features")
    for name in store:
        features = store[name]
        count = len(features.keypoints)
        assert features.keypoints.shape == (count, 2)
        assert len(features.descriptors) == len(features.scores) == len(features.scales) == count


# COLMAP models


COLMAP_FILES = ("cameras", "images", "points3D", "rigs", "frames")


@cache
def colmap_model() -> tuple[Path, Path]:
    """A model as binary and as text files, and its images."""
    folder = workplace() / "colmap"
    for name in ("1.png", "2.png"):
        photograph(folder / "images" / name)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[7, 7, 4, 3], camera_id=1)
    )
    for number in (1, 2):
        image = pycolmap.Image(f"{number}.png", np.ones((2, 2)), 1, number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([number, 0, 0.0])))
    model.add_point3D(
        np.ones(3), pycolmap.Track([pycolmap.TrackElement(1, 0), pycolmap.TrackElement(2, 0)]), np.zeros(3, np.uint8)
    )
    for kind in ("bin", "txt"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder / "bin"))
    model.write_text(str(folder / "txt"))
    return folder, folder / "images"


def colmap_places() -> list[str]:
    return [f"{kind}/{name}.{kind}" for kind in ("bin", "txt") for name in COLMAP_FILES]


def colmap_seeds() -> list[bytes]:
    folder, _ = colmap_model()
    return [bytes([number]) + (folder / place).read_bytes() for number, place in enumerate(colmap_places())]


def check_colmap(data: bytes) -> None:
    if not data:
        return
    folder, images = colmap_model()
    place = colmap_places()[data[0] % (2 * len(COLMAP_FILES))]
    kind = place.partition("/")[0]
    model, capture = folder / "damaged", folder / "C"
    shutil.rmtree(model, ignore_errors=True)
    shutil.copytree(folder / kind, model)
    (model / place.partition("/")[2]).write_bytes(data[1:])
    try:
        if not refused(lambda: import_colmap(model, images, capture), "damaged", "images"):
            use_session(Capture.open(capture)["ios_map"])
    finally:
        shutil.rmtree(capture, ignore_errors=True)


# Checkpoints


def small_network():
    import torch

    return torch.nn.Linear(3, 2)


def checkpoint_seeds() -> list[bytes]:
    import torch
    from safetensors.torch import save

    state = small_network().state_dict()
    files = [b"\0" + save(state), b"\0" + save({f"module.{name}": value for name, value in state.items()})]
    for options in ({}, {"_use_new_zipfile_serialization": False}):
        for content in (state, {"model": state, "epoch": 3}, [1, 2], {"weight": 1}):
            stream = io.BytesIO()
            torch.save(content, stream, **options)
            files.append(b"\1" + stream.getvalue())
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(print))
        archive.writestr("archive/version", "3")
    return [*files, b"\1" + stream.getvalue(), b"\1" + pickle.dumps({"a": print})]


def check_checkpoint(data: bytes) -> None:
    from toolkit.models.weights import VGGT, check_weights, load_checkpoint

    if not data:
        return
    path = workplace() / ("model.safetensors" if data[0] % 2 == 0 else "model.pt")
    path.write_bytes(data[1:])
    refused(lambda: load_checkpoint(small_network(), path), path.name)
    refused(lambda: check_weights(replace(VGGT, tensor="weight"), path), path.name)


TARGETS = {
    "text": Target(text_seeds, check_text),
    "hdf5": Target(hdf5_seeds, check_hdf5),
    "colmap": Target(colmap_seeds, check_colmap),
    "checkpoint": Target(checkpoint_seeds, check_checkpoint),
}


def found_inputs() -> Iterator[tuple[str, Path]]:
    """Yield target and file of every input that was once a finding."""
    for path in sorted((Path(__file__).parent / "found").glob("*/*")):
        yield path.parent.name, path
