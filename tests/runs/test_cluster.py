"""Work done by the workers of a cluster: the same results as of one process, whatever becomes of a worker."""

import logging
import os
import pickle
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from tests.other_kind import add_other_kind
from tests.rendered import copy_shared
from toolkit.capture import Capture
from toolkit.capture.names import ALLOW_OUTSIDE
from toolkit.embed import embed_sessions
from toolkit.errors import DamagedError, ImageError, ManifestError, ToolkitError
from toolkit.features.features import SiftExtractor
from toolkit.features.stores import FeatureStore, extract_session
from toolkit.files import Remade, SceneFiles
from toolkit.localize import localize_pairs
from toolkit.manifest import MapSettings
from toolkit.mapping import build as mapping
from toolkit.mapping.build import build_map
from toolkit.retrieve import retrieve_pairs
from toolkit.runs import cluster as clusters
from toolkit.runs.cluster import ADDRESS, Cluster, current_cluster, open_cluster
from toolkit.store import items as item_store
from toolkit.store.items import Items

LIST = "keyframes_pruned_subsampled"


class Here(Cluster):
    """Does the shares in this process, in another order, the first one twice, from what a worker would be sent."""

    size = 2

    def __init__(self) -> None:
        self.labels: list[str] = []

    def run(self, function: Callable[..., None], shares: Sequence[tuple[Any, ...]], sizes: Sequence[int], label: str,
            unit: str) -> None:  # fmt: skip
        self.labels.append(label.split()[0])
        for share in [*shares[::-1], shares[0]]:
            function(*pickle.loads(pickle.dumps(share)))


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    """A cluster for all that asks for one, but for what is done for it."""
    cluster = Here()

    def current() -> Cluster | None:
        frame = sys._getframe(1)
        while frame is not None:
            if frame.f_code.co_name.endswith("_share"):
                return None
            frame = frame.f_back  # type: ignore[assignment]
        return cluster

    for module in ("toolkit.store.items", "toolkit.mapping.build"):
        monkeypatch.setattr(f"{module}.current_cluster", current)
    return cluster


# -------------------------------------------------------------------------------------------------------- shares


def items_of(numbers: Sequence[int]) -> list[tuple[str, str, int]]:
    return [(f"{number}", f"from {number}", number) for number in numbers]


def write(items: Items, todo: Sequence[tuple[str, str, int]], fail_at: int | None = None) -> None:
    for name, source, number in todo:
        if number == fail_at:
            raise ImageError("no more")
        items.add(name, source, {"value": np.array([number])}, number)


def do_share(folder: Path, numbers: Sequence[int], fail_at: int | None = None, since: int = 0) -> None:
    item_store._do_share(folder, {"by": 1}, since, items_of(numbers), write, (fail_at,))


def notes(items: Items) -> dict[str, int]:
    return {name: items.note(name) for name in items}


@pytest.mark.parametrize("skip_existing", [True, False])
def test_workers_write_to_the_same_folder(tmp_path: Path, here: Here, skip_existing: bool) -> None:
    with Items(tmp_path, {"by": 1}) as items:
        items.add("0", "old", {"value": np.array([-1])}, -1)
        items.add("1", "from 1", {"value": np.array([-1])}, -1)
    with Items(tmp_path, {"by": 1}, skip_existing=skip_existing) as items:
        assert items.distribute(write, items.left(items_of(range(20))), (), "write", "item") == []
        assert notes(items) == {str(item): item for item in range(20)} | ({"1": -1} if skip_existing else {})
        assert {name: int(arrays["value"][0]) for name, arrays in items.items()} == notes(items)
    assert all(path.suffix == ".shard" for path in tmp_path.iterdir())


def test_a_share_goes_on_where_it_was_and_leaves_others_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    do_share(tmp_path, range(5))
    with pytest.raises(ImageError):
        do_share(tmp_path, range(5, 10), fail_at=8)
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    do_share(tmp_path, range(5, 10), fail_at=7)  # which is there
    now = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert now.items() > before.items()
    assert sorted(notes(Items(tmp_path)).values()) == list(range(10))


@pytest.mark.parametrize(("items", "multiple", "lengths"), [(0, 1, []), (3, 1, [1] * 3), (20, 1, [3] * 6 + [2]),
                                                            (20, 8, [8, 8, 4]), (100, 8, [16] * 6 + [4])])  # fmt: skip
def test_work_is_cut_into_successive_shares(items: int, multiple: int, lengths: list[int]) -> None:
    parts = Here().cut(range(items), multiple)
    assert [len(part) for part in parts] == lengths
    assert [item for part in parts for item in part] == list(range(items))


def test_what_is_costly_is_made_once_in_a_process(monkeypatch: pytest.MonkeyPatch, small_capture: Path) -> None:
    extractor, session = SiftExtractor(), Capture.open(small_capture)["ios_map"]
    first, again = (pickle.loads(pickle.dumps(extractor)) for _ in range(2))
    assert first is again
    assert first.settings == extractor.settings
    assert pickle.loads(pickle.dumps(session)) is pickle.loads(pickle.dumps(session))
    assert len(pickle.dumps(session)) < 500
    error = pickle.loads(pickle.dumps(DamagedError(Path("a.h5"), "torn")))
    assert (error.path, str(error)) == (Path("a.h5"), "torn")


class AutoPrecision(Remade):
    """Stands for a network whose precision is that of the machine."""

    precision = "float32"

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": "network", "dtype_compute": self.precision}


def test_a_worker_that_would_compute_in_another_precision_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    pickled = pickle.dumps(AutoPrecision())
    assert pickle.loads(pickled).settings["dtype_compute"] == "float32"
    monkeypatch.setattr(AutoPrecision, "precision", "bfloat16")
    with pytest.raises(ToolkitError, match="dtype_compute: bfloat16 here, float32 there"):
        pickle.loads(pickled)


# -------------------------------------------------------------------------------------------------------- stages


@pytest.mark.slow
def test_features_and_maps_are_those_of_one_process(small_capture: Path, tmp_path: Path, here: Here) -> None:
    session, settings = Capture.open(small_capture)["ios_map"], MapSettings(tile_images=3)
    made = {}
    for name in ("cluster", "alone"):
        if name == "alone":
            here.labels, labels = [], here.labels
            clusters_off = pytest.MonkeyPatch()
            for module in (item_store, mapping):
                clusters_off.setattr(module, "current_cluster", lambda: None)
        features = extract_session(session, tmp_path / name)
        build_map(session, features, tmp_path / name / "ios_map.npz", settings)
        made[name] = features
    clusters_off.undo()
    assert labels == ["sift", "match", "match", "triangulate"]
    assert here.labels == []
    assert made["cluster"].fingerprint == made["alone"].fingerprint
    for image in made["alone"]:
        np.testing.assert_array_equal(made["cluster"][image].descriptors, made["alone"][image].descriptors)
    maps = [(tmp_path / name / "ios_map.npz").read_bytes() for name in ("cluster", "alone")]
    assert maps[0] == maps[1]
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.slow
@pytest.mark.parametrize("escalation", [[], ["other"]])
def test_poses_are_those_of_one_process(
    small_capture: Path, small_embedded: Path, tmp_path: Path, here: Here, monkeypatch: pytest.MonkeyPatch,
    escalation: list[str],
) -> None:  # fmt: skip
    add_other_kind(monkeypatch)
    settings = {"features": {"kinds": ["sift"], "escalation": escalation}, "pnp": {"ok_probability": 1.0}}
    files = SceneFiles(tmp_path / "run", small_capture.name)
    copy_shared(small_embedded, files.root)
    sessions = small_capture / "sessions"
    retrieve_pairs(sessions, files.embeddings, map_device="ios", out_jsonl=files.retrieval_dir, queries=LIST)
    found = {}
    for name in ("cluster", "alone"):
        place = SceneFiles(tmp_path / name, small_capture.name)
        with pytest.MonkeyPatch.context() as patch:
            if name == "alone":
                for module in ("toolkit.store.items", "toolkit.mapping.build"):
                    patch.setattr(f"{module}.current_cluster", lambda: None)
            folders = files.retrieval_dir, place.poses_dir, files.features, place.maps
            localize_pairs(sessions, *folders, settings, map_device="ios")
        found[name] = {path.name: path.read_bytes() for path in sorted(place.poses_dir.glob("*.txt"))}
    assert here.labels.count("localize") == 3 * (1 + len(escalation))
    assert len(found["alone"]) == 3
    assert found["cluster"] == found["alone"]


@pytest.mark.slow
def test_what_no_worker_did_is_done_here(small_capture: Path, tmp_path: Path, here: Here) -> None:
    here.run = lambda *args: None  # type: ignore[method-assign]
    session = Capture.open(small_capture)["ios_map"]
    features = extract_session(session, tmp_path)
    assert len(features) == len(session.images)
    assert isinstance(features, FeatureStore)


# ------------------------------------------------------------------------------------------------------- clusters


UNKNOWN = ("loca", "local:0", "local:two", "local:²", "slurm", "slurm:", "dask:file", "", "localhost:8786")
ADDRESSES = ("tcp://", "tcp://node", "tcp://node:port", "tls://:8786")


@pytest.mark.parametrize(
    ("asked", "named"),
    [*((asked, "tcp://HOST:PORT") for asked in UNKNOWN),
     *((asked, f"{asked}: expected {asked[:3]}://HOST:PORT") for asked in ADDRESSES)],
)  # fmt: skip
def test_an_unknown_cluster_names_the_known_ones(asked: str, named: str) -> None:
    with pytest.raises(ManifestError, match=named), open_cluster(asked):
        pass


@pytest.mark.parametrize(
    ("visible", "given"),
    [("", [None] * 4), ("-1", [None] * 4), ("2,5", ["2", "5"]), ("GPU-ab,-1", ["GPU-ab"]), (None, ["0", "1", "2"])],
)
def test_local_workers_use_the_gpus_that_are_visible(
    monkeypatch: pytest.MonkeyPatch, visible: str | None, given: list[str | None]
) -> None:
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr(Path, "glob", lambda folder, pattern: [Path(f"/dev/nvidia{number}") for number in range(3)])
    monkeypatch.setattr(clusters, "default_workers", lambda: 4)
    monkeypatch.setattr("distributed.SpecCluster", lambda workers, **_: workers)
    workers = clusters._local_cluster(0)
    assert [one["options"]["env"].get("CUDA_VISIBLE_DEVICES") for one in workers.values()] == given


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "cannot be read"), ("queue: x", "jobs: <number>"), ("- 1", "jobs: <number>"), ("a: [", "cannot be read"),
     ("{jobs: 1, coresss: 2}", "cores"), ("jobs: two", "jobs: <number>"), ("jobs: 0", "jobs: <number>")],
)  # fmt: skip
def test_a_faulty_file_of_a_queue_is_named(tmp_path: Path, content: str | None, said: str) -> None:
    path = tmp_path / "slurm.yaml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ManifestError, match=rf"slurm\.yaml.*{said}"), open_cluster(f"slurm:{path}"):
        pass


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "_CONNECT_S", 1)
    with pytest.raises(ToolkitError, match=r"tcp://127\.0\.0\.1:9"), open_cluster("tcp://127.0.0.1:9"):
        pass
    assert ADDRESS not in os.environ


COUNTED = set[int]()


def count_share() -> None:
    COUNTED.update(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")


def test_a_share_computes_products_by_one_thread_whatever_the_environment_says() -> None:
    with threadpool_limits(2, "blas"):
        clusters._run_share(str(Path.cwd()), {}, pickle.dumps((count_share, ())))
    assert {1} == COUNTED


AT_ONCE = [0, 0]


def slow_share() -> None:
    AT_ONCE[0] += 1
    AT_ONCE[1] = max(AT_ONCE)
    time.sleep(0.05)
    print("said", file=sys.stderr)
    AT_ONCE[0] -= 1


def test_a_worker_of_several_threads_does_one_share_at_a_time(capfd: pytest.CaptureFixture[str]) -> None:
    before = sys.stderr
    given = str(Path.cwd()), {}, pickle.dumps((slow_share, ()))
    with ThreadPoolExecutor(3) as threads:
        for future in [threads.submit(clusters._run_share, *given) for _ in range(3)]:
            future.result()
    assert AT_ONCE == [0, 1]
    assert sys.stderr is before


def note_share(folder: Path, name: str, environment: str) -> None:
    (folder / name).write_text(f"{os.getpid()} {os.environ.get(environment)} {Path.cwd()} {current_cluster()}")


def not_in(process: int, path: Path) -> Path:
    assert os.getpid() != process
    return path


class MadeByWorkers:
    """A path, which only another process can unpickle."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return not_in, (os.getpid(), self.path)


def failing_share(path: Path) -> None:
    raise DamagedError(path, "torn")


@pytest.mark.slow
def test_local_workers_have_the_settings_and_the_folder_of_who_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    said: list[str] = []
    monkeypatch.setenv(ALLOW_OUTSIDE, "1")
    monkeypatch.chdir(tmp_path)
    with open_cluster("local:2", said.append):
        cluster = current_cluster()
        assert cluster is not None
        assert cluster.size == 2
        assert "http://" in said[0]
        shares = [(MadeByWorkers(tmp_path), str(number), ALLOW_OUTSIDE) for number in range(8)]  # not by the scheduler
        cluster.run(note_share, shares, [1] * 8, "note", "file")
        notes = {tuple((tmp_path / str(number)).read_text().split()) for number in range(8)}
        assert {note[1:] for note in notes} == {("1", str(tmp_path), "None")}
        assert str(os.getpid()) not in {note[0] for note in notes}
        with pytest.raises(DamagedError) as caught:  # a stage makes anew what it names
            cluster.run(failing_share, [(tmp_path / "a.h5",)], [1], "fail", "file")
        assert caught.value.path == tmp_path / "a.h5"
        logging.getLogger("distributed.nanny").warning("Worker process still alive after 4.0 seconds, killing")
    assert current_cluster() is None
    assert not [one for one in caplog.records if one.name.startswith("distributed") and one.levelno < logging.ERROR]


def deadly_share() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_share_that_kills_its_workers_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    with open_cluster("local:1", lambda _: None):
        cluster = current_cluster()
        assert cluster is not None
        with pytest.raises(ToolkitError, match=r"workers died.*memory"):
            cluster.run(deadly_share, [()], [1], "die", "file")


@pytest.mark.slow
def test_a_cluster_that_loses_all_workers_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from distributed import LocalCluster

    monkeypatch.setattr(clusters, "_CHECK_S", 1)
    monkeypatch.setattr(clusters, "_WAIT_S", 2)
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as local,
        open_cluster(local.scheduler_address, lambda _: None),
    ):
        cluster = current_cluster()
        assert cluster is not None
        threading.Timer(1, local.scale, [0]).start()
        with pytest.raises(ToolkitError, match="no worker"):
            cluster.run(time.sleep, [(3600,)] * 2, [1] * 2, "wait", "file")


@pytest.mark.slow
def test_a_scheduler_that_dies_is_named(capfd: pytest.CaptureFixture[str]) -> None:
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    with subprocess.Popen([*command, "--host", "127.0.0.1"], stderr=subprocess.PIPE, text=True) as scheduler:
        assert scheduler.stderr is not None
        address = next(line for line in scheduler.stderr if "Scheduler at:" in line).split()[-1]
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
        with subprocess.Popen([*worker, "--no-dashboard"], stderr=subprocess.DEVNULL) as working:
            try:
                with open_cluster(address, lambda _: None):
                    cluster = current_cluster()
                    assert cluster is not None
                    threading.Timer(1, scheduler.kill).start()
                    with pytest.raises(ToolkitError, match="scheduler is gone"):
                        cluster.run(time.sleep, [(3600,)], [1], "wait", "file")
            finally:
                scheduler.kill()
                working.kill()


QUERIES = 96
"""Enough for shares that are left when a worker is killed."""


@pytest.fixture(scope="module")
def long_queries(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SceneFiles]:
    """A capture whose phone session has `QUERIES` queries, and a run of it that has retrieved their references."""
    folder = tmp_path_factory.mktemp("long")
    capture = Path(shutil.copytree(small_capture, folder / small_capture.name))
    for other in ("hl_map", "hl_query", "spot_map", "spot_query"):
        shutil.rmtree(capture / "sessions" / other)
    query = capture / "sessions" / "ios_query"
    header, *lines = (query / "images.txt").read_text().splitlines()
    rows = [line.split(", ") for line in lines]
    copies, asked = [], []
    for number in range(QUERIES):
        stamp, sensor, path = rows[number % len(rows)]
        name = path.replace(stamp, f"{int(stamp) + number}")
        if number:  # the first name stays as it is
            shutil.copyfile(query / "raw_data" / path, query / "raw_data" / name)
        copies.append(f"{int(stamp) + number}, {sensor}, {name}")
        asked.append(f"{int(stamp) + number}, {sensor}")
    (query / "images.txt").write_text("\n".join([header, *copies]) + "\n")
    (query / "proc" / f"{LIST}.txt").write_text("\n".join(asked) + "\n")
    for unneeded in ("proc/alignment_trajectories.txt", "depths.txt"):
        (query / unneeded).unlink(missing_ok=True)
    files = SceneFiles(folder / "run", capture.name)
    embed_sessions(capture / "sessions", files.embeddings, features_dir=files.features)
    retrieve_pairs(capture / "sessions", files.embeddings, out_jsonl=files.retrieval_dir)
    return capture, files


def localized(capture: Path, files: SceneFiles, out: Path) -> bytes:
    """Return the poses of all queries, localized in a folder of its own."""
    table = localize_pairs(capture / "sessions", files.retrieval_dir, out, files.features, out / "map", workers=1)
    assert table["queries"].tolist() == [QUERIES]
    assert table["ok"].tolist() == [QUERIES]
    return (out / f"{capture.name}_map_ios_query_ios.txt").read_bytes()


@pytest.mark.slow
def test_a_killed_worker_changes_no_pose(
    long_queries: tuple[Path, SceneFiles], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    alone = localized(*long_queries, tmp_path / "alone")
    killed: list[int] = []

    def kill_one() -> None:
        items = tmp_path / "cluster" / f"{long_queries[0].name}_map_ios_query_ios.items"
        while len(list(items.glob("*.shard"))) < 2:
            time.sleep(0.05)
        address = os.environ[ADDRESS]
        pids = clusters._client(address).run(os.getpid)
        killed.append(min(pids.values()))
        os.kill(killed[0], signal.SIGKILL)

    with open_cluster("local:2", lambda _: None):
        killer = threading.Thread(target=kill_one, daemon=True)
        killer.start()
        assert localized(*long_queries, tmp_path / "cluster") == alone
    assert killed
    assert not list((tmp_path / "cluster").rglob(".*"))


@contextmanager
def on_path(folder: Path, **programs: str) -> Iterator[None]:
    for name, content in programs.items():
        (folder / name).write_text(f"#!/bin/sh\n{content}\n")
        (folder / name).chmod((folder / name).stat().st_mode | stat.S_IXUSR)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
        patch.setenv("PYTHONPATH", str(Path(__file__).resolve().parent))  # the workers import this module
        yield


@pytest.mark.slow
def test_a_queue_starts_the_workers(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """By programs that take jobs as those of Slurm do, and run them at once."""
    (tmp_path / "slurm.yaml").write_text(
        f"{{jobs: 2, cores: 1, memory: 1GB, python: {sys.executable}, interface: lo, walltime: '00:05:00',"
        f" log_directory: {tmp_path / 'logs'}}}"
    )
    run = (
        f'cp "$1" {tmp_path}/job-$$.sh; setsid sh {tmp_path}/job-$$.sh >/dev/null 2>&1 & echo "Submitted batch job $!"'
    )
    with on_path(tmp_path, sbatch=run, scancel="kill -TERM -- -$1"):
        with open_cluster(f"slurm:{tmp_path / 'slurm.yaml'}", lambda _: None):
            cluster = current_cluster()
            assert cluster is not None
            shares = [(tmp_path, f"{number}.txt", ALLOW_OUTSIDE) for number in range(8)]
            cluster.run(note_share, shares, [1] * 8, "note", "file")
        assert len(list(tmp_path.glob("?.txt"))) == 8
        script = next(tmp_path.glob("job-*.sh")).read_text()
    assert "#SBATCH --mem=" in script
    assert "-t 00:05:00" in script


@pytest.mark.slow
def test_a_scheduler_that_runs_is_used(
    long_queries: tuple[Path, SceneFiles], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with open_cluster("local:2", lambda _: None):
        address = os.environ[ADDRESS]
        with open_cluster(address, lambda _: None):
            assert os.environ[ADDRESS] == address
            session = Capture.open(long_queries[0])["ios_map"]
            assert len(extract_session(session, tmp_path)) == len(session.images)
