"""Let a reconstructed map grow: add a recording to it, whose poses are found in the model, or remove one.

Poses and cameras that are there stay as they are, to the last digit. A recording is the folder, file or video that was
given; its name is the first part of the names of its images.
"""

import json
import shutil
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from tqdm.auto import tqdm

from toolkit.capture import Session
from toolkit.capture.images import exif_key, read_header
from toolkit.capture.names import is_linked_here, note_linked_here
from toolkit.capture.session import RAW_DATA
from toolkit.capture.tables import write_table
from toolkit.errors import CaptureError
from toolkit.exchange.drafts import Draft
from toolkit.exchange.import_report import ImportReport
from toolkit.exchange.photographs import Photograph, gather, initial_cameras
from toolkit.exchange.reconstruct import FOLDER, RATIO, RECORD, _hand_over, _Mutual, _quiet, _reasons, _Work, add_posed
from toolkit.features.features import KINDS
from toolkit.features.matching import LocalMethod
from toolkit.features.sift import SiftExtractor
from toolkit.files import IMPORTED, MASKS, own_name, read_json, write_atomic, write_folder, write_text
from toolkit.geometry import Ints
from toolkit.store.items import heals


@heals
def add_recording(
    sources: Sequence[str | Path], capture: str | Path, device: str = "ios", fps: float | None = None
) -> ImportReport:
    """Register photographs into the model of a capture and add them to its map session, both made by `reconstruct`.

    Raises:
        CaptureError: the session was not reconstructed, all photographs are in it already, or none fits into its model.
    """
    folder, session = Path(capture) / FOLDER, Path(capture) / "sessions" / f"{device}_map"
    base = _model(folder, session)
    old = _photographs(base, folder, session)
    known = {item.path.resolve() for item in old.values()}
    gathered, unreadable = gather(list(map(Path, sources)), folder / "images", fps, prefixed=True)
    new = [item for item in gathered if item.path.resolve() not in known]
    names = {item.name for item in old.values()}
    if not new or any(item.name in names for item in new):
        raise CaptureError(f"{sources[0]}: its photographs, or others of these names, are in {session} already.")
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
    item_of = dict(zip(work.names, work.photographs, strict=True))
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
    """Remove the images whose names start with a recording's name from the map session; return what was done, in words.

    Raise CaptureError if the session was not reconstructed, no image has such a name, or all have.
    """
    folder, session = Path(capture) / FOLDER, Path(capture) / "sessions" / f"{device}_map"
    model, opened = _model(folder, session), Session.open(session)
    gone = {one for one in opened.image_names if own_name(one).startswith(f"{name}/")}
    if not 0 < len(gone) < len(opened.image_names):
        recordings = sorted({own_name(one).partition("/")[0] for one in opened.image_names if "/" in own_name(one)})
        found = f"{len(gone)} of {len(opened.image_names)} images of recording {name!r}"
        raise CaptureError(f"{session}: found {found}. Recordings: {', '.join(recordings) or 'one, without a name'}.")
    keys = {(str(row["timestamp"]), row["sensor_id"]) for row, one in
            zip(opened.images.to_dict("records"), opened.image_names, strict=True) if one in gone}  # fmt: skip
    with write_folder(session, replace=True, keep=True) as changed:
        for path in (changed / "images.txt", changed / "trajectories.txt"):
            rows = ((line, line.split(",")) for line in path.read_text(encoding="utf-8").splitlines())
            kept = [line for line, cells in rows if line.startswith("#") or (*map(str.strip, cells[:2]),) not in keys]
            write_table(path, None, kept)
        for one in gone:
            (changed / RAW_DATA / one.partition(f"/{RAW_DATA}/")[2]).unlink(missing_ok=True)
        table = pd.read_csv(changed / "proc" / "import.csv", dtype=str, keep_default_na=False)
        with write_atomic(changed / "proc" / "import.csv") as temporary:
            table[~table["image"].str.startswith(f"{name}/")].to_csv(temporary, index=False)
        if is_linked_here(session):
            note_linked_here(changed)
    for image in [image for image in model.images.values() if image.name in gone and image.has_pose]:
        model.deregister_frame(image.frame_id)
    _finish(folder, session, model)
    return f"{len(gone)} images of {name} removed from {session}, which has {len(opened.image_names) - len(gone)} now"


def _model(folder: Path, session: Path) -> pycolmap.Reconstruction:
    path = folder / "models" / "0"
    if not (session / RECORD).is_file() or not path.is_dir():
        raise CaptureError(f"{session} exists, but was not reconstructed here, so nothing can be added to its model.")
    model = pycolmap.Reconstruction(str(path))
    if any(rig.num_sensors() > 1 for rig in model.rigs.values()):
        raise CaptureError(f"{session} has rigs, so it does not grow. Reconstruct all its photographs with --replace.")
    return model


def _photographs(base: pycolmap.Reconstruction, folder: Path, session: Path) -> dict[int, Photograph]:
    """Return the photographs of a model, with their masks, by the number of the image."""
    photographs, sessions = {}, folder / "sessions"
    for number in sorted(base.reg_image_ids()):
        name = base.image(number).name
        path, mask = (sessions / name).resolve(), session / MASKS / f"{IMPORTED}{own_name(name)}.png"
        photographs[number] = Photograph(
            own_name(name), path, read_header(path)[1], None, mask.resolve() if mask.is_file() else None
        )
    return photographs


def _keep_cameras(work: _Work, base: pycolmap.Reconstruction, number_of: dict[str, int]) -> None:
    """Give images of the model their numbers and cameras; start those of equal size and EXIF at the same intrinsics."""
    fresh = [item for item in work.photographs if item.name not in number_of]
    camera_of, cameras = initial_cameras(fresh, {})
    keys = {}
    for item in work.photographs:
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
    for item in work.photographs:
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
    record = read_json(session / RECORD)
    table = pd.read_csv(session / "proc" / "import.csv")
    record |= {"photographs": len(table), "registered": model.num_reg_images(), "points": model.num_points3D()}
    write_text(session / RECORD, json.dumps(record, indent=1) + "\n")
