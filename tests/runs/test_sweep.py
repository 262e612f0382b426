"""Runs of a sweep: their names and settings, and what they take over from each other."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from toolkit.errors import ManifestError
from toolkit.files import SceneFiles, write_text
from toolkit.manifest import STAGES, Manifest, load_manifest
from toolkit.pipeline import sweep
from toolkit.runs.folder import RunLog, changed_keys, swept_runs, take_over, variant_name
from toolkit.store.items import Items


def test_a_run_a_value() -> None:
    runs = swept_runs("demo", ["localize.pnp.min_inliers=10, 20,40"])
    assert list(runs) == ["demo-min_inliers-10", "demo-min_inliers-20", "demo-min_inliers-40"]
    assert runs["demo-min_inliers-20"] == ["localize.pnp.min_inliers=20"]


def test_two_keys_are_their_product() -> None:
    runs = swept_runs("demo", ["retrieve.topk=5,10", "localize.method=pnp,nearest"])
    assert list(runs.values()) == [
        ["retrieve.topk=5", "localize.method=pnp"], ["retrieve.topk=5", "localize.method=nearest"],
        ["retrieve.topk=10", "localize.method=pnp"], ["retrieve.topk=10", "localize.method=nearest"],
    ]  # fmt: skip
    assert list(runs)[3] == "demo-topk-10-method-nearest"


def test_values_are_yaml() -> None:
    runs = swept_runs("x", ["embed.model=vlad,[megaloc, vlad],null"])
    values = [yaml.safe_load(overrides[0].partition("=")[2]) for overrides in runs.values()]
    assert values == ["vlad", ["megaloc", "vlad"], None]
    assert list(runs) == ["x-model-vlad", "x-model-megaloc-vlad", "x-model-null"]


def test_keys_of_one_last_part_are_told_apart() -> None:
    (name,) = swept_runs("x", ["embed.dtype_compute=auto", "localize.dtype_compute=auto"])
    assert name == "x-embed.dtype_compute-auto-localize.dtype_compute-auto"


@pytest.mark.parametrize(
    ("sweeps", "said"),
    [
        (["retrieve.topk"], "expected key=value,value"),
        (["retrieve.topk="], "expected key=value,value"),
        (["=1,2"], "expected key=value,value"),
        (["retrieve.topk=[1"], "expected key=value,value"),
        (["retrieve.topk=1", "retrieve.topk=2"], "twice"),
        (["embed.model=[a b],a b"], "the same folder name"),
        (["retrieve.topk=1,2", "demo_data.seed=0,1"], r"--sweep demo_data\.seed: .* --set demo_data\.seed="),
        (["captures=[a],[b]"], "--sweep captures: "),
        ([f"seed={','.join(map(str, range(101)))}"], "found 101 runs"),
    ],
)
def test_what_is_no_sweep_is_refused(sweeps: list[str], said: str) -> None:
    with pytest.raises(ManifestError, match=said):
        swept_runs("x", sweeps)


def manifest(root: Path, name: str, **sections: Any) -> Manifest:
    """The manifest of a run; its record as well."""
    content = Manifest.of({"name": name, "captures": ["P"], "output_root": str(root), **sections})
    write_text(root / name / "run.json", json.dumps({"manifest": content.model_dump(mode="json", exclude_none=True)}))
    return content


def test_the_record_of_a_run_that_reranks_is_read_again(tmp_path: Path) -> None:
    """Retrieval finds what reranking asks for; the record once said `topk: 10`, which the manifest then refused."""
    settings = {"captures": ["P"], "output_root": str(tmp_path), "seed": 5, "rerank": {"topn": 30}}
    donor = SceneFiles(tmp_path / "a", "P")
    donor.poses_dir.mkdir(parents=True)
    RunLog(donor.run, Manifest.of({"name": "a", **settings}), {}, "code").write()
    own = Manifest.of({"name": "b", **settings, "visualize": {"samples": 6}})
    take_over([donor.run], own)
    assert SceneFiles(tmp_path / "b", "P").poses_dir.is_dir()


@pytest.mark.parametrize("null", [{"unit": None}, {"localize": {"map": None}}])
def test_the_record_of_a_run_says_what_is_null(tmp_path: Path, null: dict[str, Any]) -> None:
    """As `visloc new` writes it for an unknown unit; the record once had the default, so nothing was taken over."""
    settings = {"name": "a", "captures": ["P"], "output_root": str(tmp_path), **null}
    donor = SceneFiles(tmp_path / "a", "P")
    donor.poses_dir.mkdir(parents=True)
    RunLog(donor.run, Manifest.of(settings), {}, "code").write()
    record = Manifest.of(json.loads((donor.run / "run.json").read_text())["manifest"])
    assert all(record.stage(stage) == Manifest.of(settings).stage(stage) for stage in STAGES)
    take_over([donor.run], Manifest.of({**settings, "name": "b", "visualize": {"samples": 6}}))
    assert SceneFiles(tmp_path / "b", "P").poses_dir.is_dir()


def test_a_run_takes_over_what_is_made_before_the_swept_stage(tmp_path: Path) -> None:
    donor = SceneFiles(tmp_path / "a", "P")
    made_before = donor.embeddings, donor.retrieval_dir, donor.features, donor.maps
    for folder in (*made_before, donor.poses_dir, donor.evaluation):
        folder.mkdir(parents=True)
        (folder / "made.txt").write_text("a")
        (folder / "made.h5").write_text("a")
    manifest(tmp_path, "a")
    far = manifest(tmp_path, "far", embed={"model": "megaloc"})
    take_over([tmp_path / far.name, donor.run], manifest(tmp_path, "b", localize={"method": "nearest"}))
    mine = SceneFiles(tmp_path / "b", "P")
    assert sorted(path.name for path in mine.root.iterdir()) == ["embeddings", "features", "map", "retrieval"]
    assert (mine.features / "made.h5").samefile(donor.features / "made.h5")
    assert (mine.embeddings / "made.txt").samefile(donor.embeddings / "made.txt")
    take_over([donor.run], manifest(tmp_path, "c", evaluate={"thresholds": [[1, 1]]}))
    assert sorted(path.name for path in (tmp_path / "c" / "P").iterdir()) == [
        "embeddings", "features", "map", "poses", "retrieval"
    ]  # fmt: skip
    for name, sections in (("d", {"embed": {"model": "megaloc"}}), ("e", {"queries": "all"})):
        take_over([donor.run], manifest(tmp_path, name, **sections))
        assert sorted(path.name for path in (tmp_path / name / "P").iterdir()) == ["features", "map"]


def test_a_run_that_is_there_is_left_as_it_is(tmp_path: Path) -> None:
    donor, mine = SceneFiles(tmp_path / "a", "P"), SceneFiles(tmp_path / "b", "P")
    donor.embeddings.mkdir(parents=True)
    mine.root.mkdir(parents=True)
    manifest(tmp_path, "a")
    take_over([donor.run], manifest(tmp_path, "b"))
    assert not mine.embeddings.exists()


def test_what_is_added_to_a_linked_file_is_not_in_the_other_run(tmp_path: Path) -> None:
    donor, mine = SceneFiles(tmp_path / "a", "P"), SceneFiles(tmp_path / "b", "P")
    with Items(donor.features / "made") as items:
        items.add("first", "source", {"values": np.zeros(3)})
    (shard,) = (donor.features / "made").iterdir()
    before = shard.read_bytes()
    take_over([donor.run], manifest(tmp_path, "b"))
    with Items(mine.features / "made") as items:
        assert list(items) == ["first"]
        items.add("first", "source", {"values": np.ones(3)})
        items.add("second", "source", {"values": np.ones(3)})
    assert shard.read_bytes() == before
    assert list((donor.features / "made").iterdir()) == [shard]


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        (["output_root=elsewhere", "tolerate_failed.pairs=0.5"], "x"),
        (["localize.method=pnp"], "x"),  # the default
        (["localize.method=nearest"], "x-method-nearest"),
        (["localize.pnp.min_inliers=30", "retrieve.topk=2"], "x-min_inliers-30-topk-2"),
        (["rerank.topn=30"], "x-topn-30"),
        (["captures=[b]"], "x-captures-b"),
    ],
)
def test_a_run_is_named_after_what_differs(tmp_path: Path, overrides: list[str], name: str) -> None:
    (tmp_path / "x.yaml").write_text("captures: [a]\n")
    plain, changed = load_manifest(tmp_path / "x.yaml"), load_manifest(tmp_path / "x.yaml", overrides)
    assert variant_name("x", changed_keys(plain, changed, overrides)) == name


def test_a_long_name_is_cut_and_still_its_own() -> None:
    names = [variant_name("x", {"captures": "/a/long/path" * 20 + end}) for end in "ab"]
    assert max(map(len, names)) <= 100
    assert len(set(names)) == 2


@pytest.mark.parametrize(("swept", "only", "said"), [
    ("localize.method=pnp,nearest", "retreive", "no such stage"),
    ("localize.method=pnp,nearest", "rerank", "so the stage is off"),
    ("retrieve.topk=3,five", None, r"retrieve\.topk: found 'five'"),
    ("embed.model=vlad,vald", None, r"x\.yaml: embed: Unknown embedder 'vald'\. Did you mean 'vlad'\?"),
])  # fmt: skip
def test_a_sweep_that_cannot_run_is_refused_before_any_work(
    swept: str, only: str | None, said: str, tmp_path: Path
) -> None:
    (tmp_path / "x.yaml").write_text(f"captures: [a]\noutput_root: {tmp_path}/runs\n")
    with pytest.raises(ManifestError, match=said):
        sweep(tmp_path / "x.yaml", [swept], only=only)
    assert not (tmp_path / "runs").exists()
