"""A run that is killed again and again ends with the files of one that was left alone."""

import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from itertools import chain, product, repeat
from pathlib import Path
from typing import Any

import h5py
import pandas as pd
import pytest

from tests.conftest import REPOSITORY
from tests.test_damage import exactly
from tests.viewer.test_sessions import read_back
from toolkit.store.items import Items

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="needs fork and SIGKILL")]

STAGES = ("embed", "retrieve", "rerank", "localize", "evaluate", "visualize")
ROUNDS = [(signal.SIGKILL, signal.SIGKILL), (signal.SIGTERM, signal.SIGKILL), (signal.SIGKILL, signal.SIGKILL)]
"""In a round every stage is stopped twice, the second time as it goes on: 30 kills, and 6 friendly requests."""


class Runs:
    """Runs of one manifest, each in a process of its own that can be killed."""

    def __init__(self, manifest: Path) -> None:
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self.log = manifest.with_suffix(".log")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.unattended", str(manifest)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY, env=environment,
        )  # fmt: skip

    def run(self, **asked: Any) -> dict[str, Any]:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


@pytest.fixture
def runs(tmp_path: Path, made_once: Any) -> Iterator[Runs]:
    from toolkit.synthetic import render_capture

    def make(folder: Path) -> None:
        render_capture(folder / "TINY", rooms=1, frames=3, seed=0, progress=False)

    capture = made_once("killed", make) / "TINY"
    manifest = tmp_path / "run.yaml"
    # SIFT alone: networks do not work in forked processes.
    manifest.write_text(
        f"captures: ['{capture}']\noutput_root: {tmp_path}\npairs: [[ios, spot]]\n"
        "rerank: {features: sift}\nlocalize: {features: [sift]}\nvisualize: {samples: 1}\n"
    )
    started = Runs(manifest)
    yield started
    started.close()


def recorded(path: Path) -> dict[str, list[str]]:
    """Return what a recording holds; its start and the order of its chunks change from run to run."""
    return {
        entity: sorted(map(repr, entries)) for entity, entries in read_back(path).items() if entity != "/__properties"
    }


def arrays_of(path: Path) -> dict[str, object]:
    """Return arrays and attributes of an HDF5 file."""
    with h5py.File(path) as file:
        found: dict[str, object] = {"": repr(sorted(file.attrs.items()))}

        def add(name: str, item: h5py.Dataset | h5py.Group) -> None:
            found[name] = repr(sorted(item.attrs.items()))
            if isinstance(item, h5py.Dataset):
                found[name] = (found[name], exactly(item[()]))

        file.visititems(add)
    return found


def products(run: Path) -> dict[str, object]:
    """Return the content of every end product of a run by its path, without what tells the time."""
    found: dict[str, object] = {}
    for path in sorted(run.rglob("*")):
        name = path.relative_to(run).as_posix()
        if path.is_dir() or path.suffix in (".ipynb", ".html", ".tex") or path.name.endswith((".meta.json", ".lock")):
            continue
        if name in ("run.json", "run.log") or "/.stages/" in name:
            continue
        if path.suffix == ".shard":  # kills change which item is in which
            items = {item: {key: exactly(array) for key, array in arrays.items()}
                     for item, arrays in Items(path.parent).items()}  # fmt: skip
            found[path.parent.relative_to(run).as_posix()] = items
        elif path.suffix == ".rrd":
            found[name] = recorded(path)
        elif path.suffix == ".h5":
            found[name] = arrays_of(path)
        elif path.suffix == ".csv" and (path.parent.name == "poses" or path.name.startswith("report-")):
            table = pd.read_csv(path)
            found[name] = table.drop(columns=[column for column in table if "seconds" in column]).to_csv()
        else:
            found[name] = path.read_bytes()
    return found


def test_thirty_kills_at_random_moments_leave_the_same_files(runs: Runs, tmp_path: Path) -> None:
    run, rng = tmp_path / "run", random.Random(0)
    whole = runs.run()
    assert whole["status"] == 0, runs.log.read_text()
    expected = products(run)
    assert len(expected) > 20
    stops = event = 0
    for number, signals in enumerate(chain(ROUNDS, repeat(ROUNDS[0]))):
        if number >= len(ROUNDS) and stops >= 36:
            break
        run.rename(tmp_path / f"whole-{number}")
        for stage, (again, how) in product(STAGES, enumerate(signals)):
            last = whole["events"][stage]
            event = rng.randint(1, max(1, (last - event) // 2) if again else last)
            delay_s = rng.choice([0.0, rng.uniform(0.0, 0.3)])
            ended = runs.run(stage=stage, event=event, delay_s=delay_s, signal=how)
            if ended["status"] == 0:
                break  # the signal came after the end; or there was less to do, as a stopped run had done some of it
            assert ended["stopped"], runs.log.read_text()
            stops += 1
        assert runs.run()["status"] == 0, runs.log.read_text()
        found = products(run)
        assert found.keys() == expected.keys()
        different = [name for name in expected if found[name] != expected[name]]
        assert not different, f"round {number}"
        assert json.loads((run / "run.json").read_text())["status"] == "done"
