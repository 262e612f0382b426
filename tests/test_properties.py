"""What holds for every input: readers and writers, manifests, geometry, alignment and search.

The examples are the same each time; `HYPOTHESIS_PROFILE=thorough` tries more of them.
"""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
import pytest
import yaml
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from tests.conftest import REPOSITORY
from tests.fuzz.targets import ODD, SESSION_FILES, use_session
from tests.localized import read_queries, stored
from toolkit import geometry
from toolkit.alignment.similarity import Sim3, align_to_map
from toolkit.capture import Session, Trajectory, camera_text, parse_camera, read_depth, write_depth, write_session
from toolkit.capture.names import is_bad_name
from toolkit.capture.tables import COLUMNS, KeyIndex, read_query_table, read_table
from toolkit.embedders.search import search
from toolkit.errors import ArtifactError, CaptureError, ManifestError, ToolkitError
from toolkit.exchange.submission import Submission
from toolkit.files import read_references
from toolkit.manifest import STAGES, Manifest, load_manifest
from toolkit.pose.base import Correspondences
from toolkit.results.pair import query_group
from toolkit.store.hdf5 import write_groups
from toolkit.store.items import Items

settings.register_profile("quick", derandomize=True, database=None, deadline=None, max_examples=10)
settings.register_profile("thorough", derandomize=True, database=None, deadline=None, max_examples=100)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))
# A test that gets one folder for all of its examples overwrites what is in it.
same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])

reals = st.floats(-1e6, 1e6)
times = st.integers(-(2**63), 2**63 - 1)
odd_texts = st.sampled_from([odd.decode("utf-8", "replace") for odd in ODD])
# What an id may have: no comma, line break or control character, no space at its ends, nothing that leads elsewhere.
plain = st.characters(exclude_categories=["C", "Z"], exclude_characters=",#")
ids = st.text(plain, min_size=1, max_size=12).filter(lambda name: not is_bad_name(name))
values = st.one_of(
    ids,
    odd_texts,
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(["", "cam", "rig", "10", "20", "1", "0"]),
)
lines = st.one_of(st.lists(values, max_size=12).map(", ".join), st.text(max_size=30), odd_texts, st.just("# comment"))
texts = st.one_of(
    st.binary(max_size=60),
    st.builds(
        lambda parts, end, last: end.join([*parts, last]).encode("utf-8", "surrogatepass"),
        st.lists(lines, max_size=6), st.sampled_from(["\n", "\r\n", "\r"]), lines,
    ),
)  # fmt: skip


@pytest.mark.slow
def test_all_of_this_with_many_examples() -> None:
    environment = os.environ | {"HYPOTHESIS_PROFILE": "thorough", "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=REPOSITORY, check=False)
    assert done.returncode == 0, done.stdout[-4000:]


def outcome(action: Callable[[], Any], error_type: type[ToolkitError]) -> tuple[Any, str]:
    """Return what an action returns, or None and the message with which it refuses; other errors are raised."""
    try:
        return action(), ""
    except error_type as error:
        return None, str(error)


# Text files


IMAGE_COLUMNS = dict(COLUMNS["images.txt"])


@pytest.mark.parametrize("kind", COLUMNS)
@given(content=texts)
@example(content=b"\xef\xbb\xbf")
@same_folder
def test_every_line_of_a_text_file_is_a_row_or_a_problem(kind: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    path.write_bytes(content)
    table = read_table(path, COLUMNS[kind], strict=False)
    numbers = [*table.lines.tolist(), *(line for line, _ in table.problems)]
    assert len(set(numbers)) == len(numbers), "a line is one thing"
    with_text = [
        number
        for number, line in enumerate(content.removeprefix(b"\xef\xbb\xbf").split(b"\n"), 1)
        if line.strip(b" \t\r\v\f") and not line.strip(b" \t\r\v\f").startswith(b"#")
    ]
    # A problem may be of a file as a whole, or of what would be a comment if it were text.
    assert set(with_text) <= set(numbers) or 0 in numbers
    strict, error = outcome(lambda: read_table(path, COLUMNS[kind]), CaptureError)
    assert (strict is None) == bool(table.problems)
    assert strict is None or len(strict) == len(table)
    assert strict is not None or (str(path) in error and ("line " in error or 0 in numbers))


@pytest.fixture(scope="module")
def session_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("P") / "sessions" / "ios_map"
    for name, content in SESSION_FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


@pytest.mark.parametrize("file", SESSION_FILES)
@given(content=texts)
def test_any_text_is_a_session_or_an_error_with_its_file(file: str, content: bytes, session_folder: Path) -> None:
    use_with(session_folder, file, content)


@pytest.mark.parametrize("file", SESSION_FILES)
@given(data=st.data())
def test_any_value_is_of_a_session_or_an_error_with_its_file(
    file: str, data: st.DataObject, session_folder: Path
) -> None:
    rows = [line.split(", ") for line in SESSION_FILES[file].splitlines() if not line.startswith("#")]
    row = rows[data.draw(st.integers(0, len(rows) - 1))]
    row[data.draw(st.integers(0, len(row) - 1))] = data.draw(values)
    use_with(session_folder, file, "\n".join(map(", ".join, rows)).encode())


def use_with(session: Path, file: str, content: bytes) -> None:
    """Ask a session for all that the stages ask, with another content of one of its files; errors name a file."""
    path = session / file
    path.write_bytes(content)
    _, error = outcome(lambda: use_session(Session.open(session)), CaptureError)
    path.write_text(SESSION_FILES[file])
    assert not error or any(name in error for name in (path.name, "images.txt", "sensors.txt"))


poses = arrays.arrays(np.float64, st.tuples(st.integers(0, 5), st.just(7)), elements=st.floats(-1e9, 1e9))


@given(qt=poses, data=st.data())
@same_folder
def test_trajectories_come_back_as_they_were_written(qt: np.ndarray, data: st.DataObject, tmp_path: Path) -> None:
    assume((np.linalg.norm(qt[:, :4], axis=1) > 1e-5).all())
    keys = data.draw(st.lists(st.tuples(times, ids), min_size=len(qt), max_size=len(qt)))
    covariances = None
    if data.draw(st.booleans()):
        covariances = data.draw(arrays.arrays(np.float64, (len(qt), 6, 6), elements=st.floats(-1e6, 1e6)))
        covariances[data.draw(st.lists(st.booleans(), min_size=len(qt), max_size=len(qt)))] = np.nan
    timestamps, devices = [key[0] for key in keys], [key[1] for key in keys]
    Trajectory(timestamps, devices, qt, covariances).write(tmp_path / "t.txt")
    back = Trajectory.read(tmp_path / "t.txt")
    np.testing.assert_array_equal(back.timestamps, np.array(timestamps, np.int64))
    assert back.device_ids.tolist() == devices
    np.testing.assert_array_equal(back.qt, qt)
    if covariances is not None and np.isfinite(covariances).all(axis=(1, 2)).any():
        np.testing.assert_array_equal(back.covariances, covariances)
    else:
        assert back.covariances is None


awkward = st.text(st.sampled_from("ab,#/. \n\r\t") | st.characters(codec="utf-8"), max_size=6)


@given(
    sensors=st.lists(st.tuples(ids | awkward, awkward), max_size=2),
    images=st.lists(st.tuples(times, ids | awkward, ids | awkward), max_size=2),
)
@example(sensors=[("#a", "b")], images=[])
@example(sensors=[("a", "b\rc")], images=[])
@same_folder
def test_a_session_comes_back_or_is_refused(
    sensors: list[tuple[str, str]], images: list[tuple[int, str, str]], tmp_path: Path
) -> None:
    rows = [(sensor, name, "camera", "SIMPLE_PINHOLE", 8, 6, 7.0, 4.0, 3.0) for sensor, name in sensors]
    try:
        write_session(tmp_path / "ios_map", rows, None, None, images)
    except ValueError:
        return
    written = {"sensors.txt": (sensors, ["sensor_id", "name"]), "images.txt": (images, [*IMAGE_COLUMNS])}
    for file, (expected, columns) in written.items():
        names = [*(name for _, *names in images for name in names), *(sensor for sensor, _ in sensors)]
        if not any(map(is_bad_name, names)):
            table = read_table(tmp_path / "ios_map" / file, COLUMNS[file]).frame(*columns)
            assert list(table.itertuples(index=False, name=None)) == expected
        else:  # an empty id, or another that the reader refuses
            with pytest.raises(CaptureError, match="line"):
                [read_table(tmp_path / "ios_map" / name, COLUMNS[name]) for name in written]


@given(rows=st.lists(st.tuples(st.integers(-3, 3), st.sampled_from("abc")), max_size=12), data=st.data())
def test_rows_are_found_by_key(rows: list[tuple[int, str]], data: st.DataObject) -> None:
    index = KeyIndex(np.array([row[0] for row in rows], np.int64), [row[1] for row in rows])
    asked = data.draw(st.lists(st.tuples(st.integers(-4, 4), st.sampled_from("abcd")), max_size=6))
    keys = np.array([key[0] for key in asked], np.int64), [key[1] for key in asked]
    all_rows = [[i for i, row in enumerate(rows) if row == key] for key in asked]
    assert [found.tolist() for found in index.find_all(*keys)] == all_rows
    assert index.find(*keys).tolist() == [found[0] if found else -1 for found in all_rows]


@given(
    model=st.sampled_from(sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"})),
    size=st.tuples(st.integers(1, 100_000), st.integers(1, 100_000)),
    numbers=st.lists(st.floats(1e-6, 1e6), min_size=16, max_size=16),
)
def test_cameras_come_back(model: str, size: tuple[int, int], numbers: list[float]) -> None:
    count = len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)
    for place, side in zip(pycolmap.Camera(model=model).principal_point_idxs(), size, strict=False):
        numbers[place] = numbers[place] / 1e6 * side
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=numbers[:count])
    back = parse_camera("camera", camera_text(camera))
    assert (back.model, back.width, back.height, back.params.tolist()) == (camera.model, *size, numbers[:count])


@given(text=st.one_of(st.text(max_size=40), st.lists(st.one_of(values, st.just("PINHOLE")), max_size=9).map(", ".join)))
def test_any_camera_is_taken_or_refused(text: str) -> None:
    try:
        camera = parse_camera("camera", text)
    except ValueError:
        return
    assert np.isfinite(camera.params).all()


@given(depth=arrays.arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 4)), elements=st.floats()))
@same_folder
def test_depths_come_back_to_half_a_millimeter(depth: np.ndarray, tmp_path: Path) -> None:
    write_depth(tmp_path / "d.png", depth)
    back = read_depth(tmp_path / "d.png")
    known = (depth >= 0) & (depth < 65.535)
    np.testing.assert_allclose(back[known], depth[known], atol=5.01e-4)
    assert (back[~(depth >= -5e-4) | (depth > 65.5356)] == 0).all()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
rows = st.fixed_dictionaries(
    {}, optional=dict.fromkeys(("timestamp", "sensor_id", "topk", "path"), json_values)
) | st.fixed_dictionaries(
    {"timestamp": times.map(str), "sensor_id": ids, "topk": st.lists(st.fixed_dictionaries({"path": ids}), max_size=3)}
)


@given(
    content=st.one_of(
        texts, st.lists(st.one_of(rows, json_values).map(json.dumps), max_size=4).map("\n".join).map(str.encode)
    )
)
@example(content=b"[" * 100_000)
@example(content=b'{"timestamp": ' + b"9" * 5000 + b', "sensor_id": "", "topk": []}')
@example(content=b'{"timestamp": 1, "sensor_id": "", "topk": {}}')
@example(content=b'{"timestamp": [], "sensor_id": "", "topk": []}')
@same_folder
def test_any_text_is_a_list_of_references_or_an_error_with_its_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "pair.jsonl"
    path.write_bytes(content)
    found, error = outcome(lambda: read_references(path), ArtifactError)
    assert not error or re.search(r"pair\.jsonl, line \d+", error)
    for row in found or []:
        assert isinstance(row["topk"], list)
        int(row["timestamp"])


@given(content=st.lists(rows, max_size=4))
@same_folder
def test_references_come_back(content: list[dict[str, Any]], tmp_path: Path) -> None:
    assume(all({"timestamp", "sensor_id", "topk"} == row.keys() for row in content))
    path = tmp_path / "pair.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in content))
    found, _ = outcome(lambda: read_references(path), ArtifactError)
    assert found == content or any(not isinstance(row["timestamp"], str) for row in content)


@given(content=st.one_of(texts, st.lists(st.lists(values, max_size=4).map(",".join), max_size=4).map(
    lambda lines: "\n".join(["timestamp,device_id,status", *lines]).encode()
)))  # fmt: skip
@example(content=b"timestamp\n18446744073709551616")
@same_folder
def test_any_text_is_a_table_of_queries_or_an_error_with_its_file(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "pair.csv"
    path.write_bytes(content)
    table, error = outcome(lambda: read_query_table(path, ["status"]), ArtifactError)
    assert "pair.csv" in error or table["timestamp"].dtype == np.int64


@given(qt=poses, data=st.data())
@same_folder
def test_a_submission_holds_the_poses(qt: np.ndarray, data: st.DataObject, tmp_path: Path) -> None:
    assume((np.linalg.norm(qt[:, :4], axis=1) > 1e-5).all())
    keys = data.draw(st.lists(st.tuples(times, ids), min_size=len(qt), max_size=len(qt)))
    if not keys:
        return
    trajectory = Trajectory([key[0] for key in keys], [key[1] for key in keys], qt)
    queries = pd.DataFrame(keys, columns=["timestamp", "device_id"]).assign(file="P.txt", pose="ok", reason="")
    pairs = pd.DataFrame([{"file": "P.txt"}])
    path = Submission(tmp_path / "s.zip", "mine\n", {"P.txt": trajectory}, queries, pairs).write()
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        (tmp_path / "back.txt").write_bytes(archive.read("P.txt"))
    back = Trajectory.read(tmp_path / "back.txt")
    np.testing.assert_array_equal(back.qt, qt)
    assert back.device_ids.tolist() == [key[1] for key in keys]


@given(data=st.data(), keys=st.lists(st.tuples(st.integers(0, 2**63 - 1), ids), max_size=3, unique=True))
@same_folder
def test_correspondences_come_back(data: st.DataObject, keys: list[tuple[int, str]], tmp_path: Path) -> None:
    queries = {}
    for key in keys:
        count, views = data.draw(st.integers(0, 3)), data.draw(st.integers(0, 3))
        names = st.lists(ids, max_size=2)
        queries[key] = stored(
            data.draw(names), data.draw(names), data.draw(names),
            Correspondences(
                np.arange(count), np.full((count, 2), 1.5), np.full((count, 3), 1 / 3), np.arange(count) - 1,
                np.arange(count) % 2 == 0, np.array(["sift/guided", "sift/lifted", "x"][:count], "U11"),
                np.arange(views), np.arange(views), np.full((views, 2), 2.5),
            ),
        )  # fmt: skip
    shutil.rmtree(tmp_path / "items", ignore_errors=True)
    with Items(tmp_path / "items") as items:  # as the localize stage does: one by one, and then as one file
        for key in keys:
            items.add(query_group(*key), "", queries[key].arrays())
    write_groups(tmp_path / "pair.h5", items.items(), {})
    read = read_queries(tmp_path / "pair.h5")
    for key, query in queries.items():
        back = read(*key)
        assert (back.images, back.references, back.rejected) == (query.images, query.references, query.rejected)
        for name, array in vars(query.correspondences).items():
            np.testing.assert_array_equal(getattr(back.correspondences, name), array)


# Manifests


keys = st.sampled_from([*Manifest.model_fields, *STAGES, "inherits", "method", "name", "topk", "features"]) | st.text(
    max_size=5
)
yaml_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.dates()
    | odd_texts
    | st.sampled_from(["ios", "pnp", "sift", "auto", "all", "~", "$HOME", "$NOWHERE", "mine.yaml"]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(keys, inner, max_size=4)
        | st.dictionaries(st.integers(), inner, max_size=2)
    ),
    max_leaves=12,
)
ODD_YAML = [
    "captures: [P]\nname: 2024-99-99",
    "captures: [P]\ninherits: mine.yaml",
    "captures: &a [*a]",
    "a: &a {b: *a}",
    "[" * 5000,
    "? [a]\n: 1",
    "? {}\n: 1",
    "captures: [P]\n1: 2",
    "captures: [P]\nlocalize: {1: 2}",
    "=: 1",
    "<<: 1",
    "!!python/object:os.system x",
    "captures: [P]\npairs: [[ios]]",
    "captures: [\0]",
    'captures: ["a\\0b"]',
    'captures: [P]\noutput_root: "a\\0b"',
    'captures: [P]\ninherits: "a\\0b"',
    "captures: [~nobody-at-all/x]",
    "inherits: .",
    "captures: [P]\nretrieve: {topk: 1.0e+400}",
    "captures: [P]\nretrieve: {topk: " + "9" * 5000 + "}",
    "--- 1\n--- 2",
    "captures: [P]\nname: ../x",
    "!!int ''",
    "!!float ''",
    "!!binary x",
    "captures: [P]\nname: 'a/b'",
    "a: !!timestamp x",
    "captures: [P]\ninherits: " + "x" * 300,
    "captures: [" + "x" * 5000 + "]",
    "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\nlocalize: {features: *c}",
    "\n".join(["a0: &a0 [x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))]),
]


@given(
    text=st.one_of(
        yaml_values.map(lambda value: yaml.safe_dump(value, allow_unicode=True).encode()),
        texts,
        st.sampled_from(ODD_YAML).map(str.encode),
    )
)
@same_folder
def test_any_yaml_is_a_manifest_or_an_error_with_its_file(text: bytes, tmp_path: Path) -> None:
    read_manifest(text, tmp_path)


@pytest.mark.parametrize("text", ODD_YAML, ids=range(len(ODD_YAML)))
def test_odd_yaml_is_a_manifest_or_an_error_with_its_file(text: str, tmp_path: Path) -> None:
    read_manifest(text.encode(), tmp_path)


def read_manifest(text: bytes, folder: Path) -> None:
    path = folder / "mine.yaml"
    path.write_bytes(text)
    manifest, error = outcome(lambda: load_manifest(path), ManifestError)
    assert isinstance(manifest, Manifest) or "mine.yaml" in error


@given(
    override=st.one_of(
        st.text(max_size=20),
        st.builds(
            "{}={}".format,
            st.sampled_from(
                ["name", "embed", "embed.model", "localize.pnp.seed", "captures", "a.b.c.d", ".", "embed."]
            ),
            st.text(max_size=8),
        ),
    )
)
@same_folder
def test_any_override_is_taken_or_refused(override: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("captures: [P]\n")
    manifest, error = outcome(lambda: load_manifest(path, [override]), ManifestError)
    assert isinstance(manifest, Manifest) or "--set" in error


# Geometry


quaternions = arrays.arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 1e-3)
points = arrays.arrays(np.float64, (3, 3), elements=st.floats(-1e3, 1e3))
rigid = st.builds(
    lambda q, t: geometry.make_pose(geometry.quaternion_to_rotation(q), t),
    quaternions, arrays.arrays(np.float64, 3, elements=st.floats(-1e3, 1e3)),
)  # fmt: skip


@given(a=rigid, b=rigid, c=rigid, x=points)
def test_poses_are_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray, x: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-9)
    np.testing.assert_allclose(geometry.invert(a) @ a, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(a @ geometry.invert(a), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(geometry.invert(geometry.invert(a)), a, atol=1e-9)
    np.testing.assert_allclose(geometry.invert(a @ b), geometry.invert(b) @ geometry.invert(a), atol=1e-9)
    np.testing.assert_allclose(geometry.transform(a @ b, x), geometry.transform(a, geometry.transform(b, x)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(a[:3, :3]), 1, atol=1e-12)
    for first, second in zip(geometry.pose_error(a, b), geometry.pose_error(b, a), strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-5)
    assert 0 <= geometry.rotation_angle_deg(a[:3, :3]) <= 180


@given(pose=rigid, scale=st.floats(1e-6, 1e6), sign=st.sampled_from([-1, 1]))
def test_quaternions_stand_for_rotations(pose: np.ndarray, scale: float, sign: int) -> None:
    qt = geometry.qt_from_pose(pose)
    assert qt[0] >= 0
    np.testing.assert_allclose(np.linalg.norm(qt[:4]), 1, atol=1e-12)
    np.testing.assert_allclose(geometry.pose_from_qt(qt), pose, atol=1e-12)
    scaled = np.concatenate([sign * scale * qt[:4], qt[4:]])
    np.testing.assert_allclose(geometry.pose_from_qt(scaled), pose, atol=1e-9)
    again = geometry.qt_from_pose(geometry.pose_from_qt(qt))
    np.testing.assert_allclose(min(np.abs(again[:4] - qt[:4]).max(), np.abs(again[:4] + qt[:4]).max()), 0, atol=1e-9)


# Alignment


@given(
    seed=st.integers(0, 2**32 - 1),
    q=quaternions,
    count=st.integers(4, 12),
    wrong=st.integers(0, 2),
    log_scale=st.floats(-4, 4),
    spread_m=st.floats(0.5, 20),
    place=arrays.arrays(np.float64, 3, elements=st.floats(-1e3, 1e3)),
)
def test_a_known_similarity_is_found(
    seed: int, q: np.ndarray, count: int, wrong: int, log_scale: float, spread_m: float, place: np.ndarray
) -> None:
    rng = np.random.default_rng(seed)
    truth = Sim3(math.exp(log_scale), geometry.quaternion_to_rotation(q), place)
    world = geometry.make_pose(
        geometry.quaternion_to_rotation(rng.normal(size=(count, 4))), rng.normal(0, spread_m, (count, 3))
    )
    model = truth.inverse().apply_to_pose(world)
    wrong = min(wrong, (count - 3) // 2)
    model[:wrong, :3, :3] = geometry.quaternion_to_rotation(rng.normal(size=(wrong, 4)))
    model[:wrong, :3, 3] += rng.normal(0, 20 * spread_m / truth.scale, (wrong, 3))
    found = align_to_map(model, world)
    assert found.consistent[wrong:].all()
    assert not found.consistent[:wrong].any()
    np.testing.assert_allclose(found.world_from_model.rotation, truth.rotation, atol=1e-6)
    np.testing.assert_allclose(found.world_from_model.apply_to_pose(model[wrong:]), world[wrong:], atol=0.02 * spread_m)


# Search


@given(data=st.data(), dimensions=st.integers(1, 4), backend=st.sampled_from(["faiss", "torch", "numpy"]))
def test_search_is_the_sorted_product_with_ties_by_index(data: st.DataObject, dimensions: int, backend: Any) -> None:
    def vectors(most: int) -> np.ndarray:
        shape = st.tuples(st.integers(0, most), st.just(dimensions))
        return data.draw(arrays.arrays(np.float32, shape, elements=st.integers(-2, 2).map(float)))

    query, database, k = vectors(5), vectors(40), data.draw(st.integers(1, 50))
    scores, indices = search(query, database, k, backend)
    products = query.astype(np.float64) @ database.astype(np.float64).T
    expected = np.argsort(-products, axis=1, kind="stable")[:, :k]
    np.testing.assert_array_equal(indices, expected)
    np.testing.assert_array_equal(scores, np.take_along_axis(products, expected, axis=1).astype(np.float32))
