"""The notebooks as committed: clean, in step with the stages and the manifest; and a whole run of them."""

import ast
import importlib
import inspect
import json
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import nbformat
import pandas as pd
import pytest
from typer.testing import CliRunner

from tests.unattended import no_kernels
from toolkit import notebook, pipeline
from toolkit.__main__ import app
from toolkit.errors import ArtifactError, ManifestError, StageError
from toolkit.manifest import OPTIONAL, STAGES, Manifest, RerankSettings, RetrieveSettings, Settings
from toolkit.notebook import StatusLine, notebook_parameters, notebook_path
from toolkit.runs.folder import LOG_VARIABLE, swept_runs

# What the pipeline sets for a run, so that a manifest has it once and not in a section.
OF_THE_RUN = {
    *("sessions_root", "out_dir", "map_feats_root", "out_jsonl", "retrieval_dir", "features_dir", "map_dir"),
    *("poses_dir", "device", "subsession", "map_device", "query_device", "queries"),
    *("skip_existing", "pairs", "reranked_dir", "inspect", "run"),
}
FUNCTIONS = {
    "embed": "toolkit.embed:embed_sessions",
    "retrieve": "toolkit.retrieve:retrieve_pairs",
    "rerank": "toolkit.rerank:rerank_pairs",
    "localize": "toolkit.localize:localize_pairs",
    "evaluate": "toolkit.evaluate:evaluate_scene",
    "visualize": "toolkit.visualize:visualize_scene",
}


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


@pytest.mark.parametrize("stage", STAGES)
def test_notebooks_are_committed_clean(stage: str) -> None:
    path = notebook_path(stage)
    content = nbformat.read(path, as_version=4)
    nbformat.validate(content)
    assert content.metadata.kernelspec.name == "python3"
    code = [cell for cell in content.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code), "clear the outputs before committing"
    assert content.cells[0].source.startswith("# ")
    assert content.cells[1].metadata.tags == ["parameters"]
    assert content.cells[2].metadata.tags == ["setup"]
    assert "notebook.finish(" in content.cells[-1].source
    for cell in code:
        listing = cell.metadata.get("tags") == ["parameters"]  # a line each
        assert listing or len(cell.source.splitlines()) <= 18, f"{path.name}: a cell is long; put it in toolkit/"
        assert "sys.path" not in cell.source
    assert [cell.id for cell in content.cells] == [
        f"{path.name.partition('_')[0]}-{i:02d}" for i in range(len(content.cells))
    ]


def test_the_first_notebook_has_short_cells_with_a_text_above_each() -> None:
    content = nbformat.read(notebook_path("start"), as_version=4)
    nbformat.validate(content)
    code = [cell for cell in content.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert all(len(cell.source.splitlines()) <= 7 for cell in code)
    assert all("  # " in line for line in content.cells[1].source.splitlines())
    kinds = [cell.cell_type for cell in content.cells[3:]]
    assert kinds == ["markdown", "code"] * (len(kinds) // 2)


@pytest.mark.slow
def test_the_first_notebook_runs_on_any_run(small_run: Path, tmp_path: Path, released_weights: None) -> None:
    notebook.execute(notebook_path("start"), tmp_path / "start.ipynb", {"run": str(small_run), "map_device": "hl"})
    shown = nbformat.read(tmp_path / "start.ipynb", as_version=4)
    outputs = {cell.id: [*output.data] for cell in shown.cells for output in cell.get("outputs", [])
               if "data" in output}  # fmt: skip
    pictures = {name for name, kinds in outputs.items() if any(kind.startswith("image/") for kind in kinds)}
    assert pictures == {"map", "pose-3d", "photo"}, "3D views keep a picture"
    assert {name for name, kinds in outputs.items() if "text/html" in kinds} >= {
        *("setup", "query", "references", "matches", "pose", "worst", "what-if", "report")
    }


def test_counts_that_do_not_balance_end_a_notebook() -> None:
    notebook.finish(queries=3, ok=1, low_confidence=1, failed=1)
    with pytest.raises(AssertionError, match=r"queries were lost: 2 of 3"):
        notebook.finish(queries=3, ok=1, low_confidence=1, failed=0)


def test_a_notebook_by_hand_takes_what_the_run_has_and_writes_beside_it(
    small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "fox"
    (run / small_capture.name / "embeddings").mkdir(parents=True)
    (run / small_capture.name / "embeddings" / "marker").write_text("of the run")
    stages = [{"parameters": {"sessions_root": str(small_capture / "sessions")}}]
    (run / "run.json").write_text(json.dumps({"scenes": [small_capture.name], "stages": stages}))
    made: list[str] = []
    monkeypatch.setattr(notebook, "_run_stage", lambda stage, *more: made.append(stage))
    folders = notebook.start("retrieve", run=str(run), map_feats_root=None, out_jsonl=None)
    assert folders.sessions_root == small_capture / "sessions"
    assert (folders.map_feats_root / "marker").read_text() == "of the run"
    assert folders.out_jsonl == tmp_path / "fox-by-hand" / small_capture.name / "retrieval"
    assert made == []
    with pytest.raises(ArtifactError, match=r"^run: .*fos: no such run.*fox"):
        notebook.start("retrieve", run=str(tmp_path / "fos"), map_feats_root=None, out_jsonl=None)


BY_HAND: dict[str, dict[str, Any]] = {
    "explore": {"samples": 1},
    "embed": {"settings": {"seed": 1}},
    "retrieve": {"topk": 2},
    "rerank": {"topn": 5, "topk": 3},
    "localize": {"method": "nearest"},
    "sequence": {"position_drift": 0.1, "map_device": "hl"},
    "evaluate": {"thresholds": [[2, 0.2]]},
    "visualize": {"samples": 0, "map_device": "hl"},
    "own_images": {"device": "own"},
    "compare": {"pictures": 1},
    "start": {"map_device": "hl"},
}
"""Notebooks, and a parameter that is not as in the run; one map is enough where all take long."""
WITH_KERNELS = ("rerank", "sequence", "visualize")
"""Notebooks that have kernels by hand: the optional ones, and one of a run; the others have them in other tests."""


@pytest.mark.slow
def test_all_notebooks_by_hand_leave_a_finished_run_as_it_is(
    small_run: Path, tmp_path: Path, released_weights: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Path(shutil.copytree(small_run, tmp_path / "run"))
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert len(before) > 100
    assert {notebook_path(name) for name in BY_HAND} == set(notebook_path("start").parent.glob("*.ipynb"))
    places = {"own_images": {"out_dir": str(tmp_path / "own")}, "compare": {"others": [str(small_run)]}}
    for name, other in BY_HAND.items():
        if name == "sequence":
            pytest.importorskip("gtsam")
        parameters = {"run": str(run)} | other | places.get(name, {})
        with nullcontext() if name in WITH_KERNELS else no_kernels():
            pipeline.execute(notebook_path(name), tmp_path / f"{name}.ipynb", parameters)
        assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before, name
    own = tmp_path / "run-by-hand" / "SMALL"
    for name in ("retrieval/SMALL_map_ios_query_hl.jsonl", "poses/SMALL_map_ios_query_hl.txt"):
        assert (own / name).read_bytes() != (run / "SMALL" / name).read_bytes(), "it did as it was told, elsewhere"


@pytest.mark.slow
def test_the_notebook_localizes_by_hand_as_the_run_did(small_capture: Path, tmp_path: Path) -> None:
    """Its own `method = "pnp"`, keyframes and references of notebook 03 stood above the run's manifest."""
    manifest = tmp_path / "near.yaml"
    manifest.write_text(f"captures: ['{small_capture}']\noutput_root: .\nqueries: all\npairs: [[ios, hl]]\n"
                        "rerank: {topn: 6, topk: 3}\nlocalize: {method: nearest}\n")  # fmt: skip
    with no_kernels():
        pipeline.run(manifest, "embed,retrieve,rerank,localize", say=lambda *a, **k: None)
    chosen = {"run": str(tmp_path / "near"), "pairs": [["ios", "hl"]]}
    notebook.execute(notebook_path("localize"), tmp_path / "04.ipynb", chosen)
    poses = "SMALL/poses/SMALL_map_ios_query_hl.txt"
    assert (tmp_path / "near-by-hand" / poses).read_bytes() == (tmp_path / "near" / poses).read_bytes()
    assert re.search(r"method +nearest +run", (tmp_path / "04.ipynb").read_text())


def test_a_run_validates_the_settings_of_a_stage_twice(
    small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the manifest is loaded, and in the notebook of the stage; those of localize were five times. What is read
    back from results is not counted."""
    pytest.importorskip("gtsam")
    given: dict[str, dict[str, Any]] = {
        "explore": {"samples": 1}, "embed": {"batch_size": 2}, "retrieve": {"index": "Flat"}, "rerank": {"topn": 12},
        "localize": {"method": "nearest"}, "sequence": {"relocalize": False}, "evaluate": {"thresholds": [[1, 0.1]]},
        "visualize": {"samples": 1, "recordings": False, "session_recordings": False},
    }  # fmt: skip
    assert set(given) == set(STAGES)
    content = {"captures": [str(small_capture)], "output_root": ".", "pairs": [["ios", "hl"]]} | given
    (tmp_path / "counted.yaml").write_text(json.dumps(content))
    counts, validate = Counter[str](), Settings.model_validate.__func__  # type: ignore[attr-defined]

    def counted(model: type[Settings], raw: Any) -> Settings:
        caller = sys._getframe(2)
        if caller.f_globals["__name__"] != "toolkit.results.pair" and caller.f_code.co_name != "read":
            counts.update(given.keys() & raw.keys() if model is Manifest else [model.__name__])
        settings: Settings = validate(model, raw)
        return settings

    monkeypatch.setattr(Settings, "model_validate", classmethod(counted))
    with no_kernels():
        pipeline.run(tmp_path / "counted.yaml", say=lambda *a, **k: None)
    models = {stage: type(Manifest.defaults(stage)).__name__ for stage in STAGES}
    assert {stage: (counts[stage], counts[models[stage]]) for stage in STAGES} == dict.fromkeys(STAGES, (1, 1))


@pytest.mark.parametrize("stage", STAGES)
def test_every_parameter_has_a_comment(stage: str) -> None:
    lines = nbformat.read(notebook_path(stage), as_version=4).cells[1].source.splitlines()
    assert lines[0] == "# Change these first."
    assert lines.count("# The rest.") == 1
    assert 1 <= lines.index("# The rest.") - 2 <= 8, "parameters to change first"
    assert all("  # " in line for line in lines if line and not line.startswith("# "))


@pytest.mark.parametrize("stage", [*STAGES, "own_images", "compare", "start"])
def test_every_parameter_has_an_effect(stage: str) -> None:
    """03 had `run` in its parameters and did not hand it on: it always took the demo."""
    cells = nbformat.read(notebook_path(stage), as_version=4).cells
    code = "\n".join(cell.source for cell in cells[2:] if cell.cell_type == "code")
    used = {node.id for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Name)}
    of_stage = {"settings", *type(Manifest.defaults(stage)).model_fields} if stage in STAGES else set[str]()
    used |= set(re.findall(r"folders\.(queries|pairs|device)\b", code))
    assert notebook_parameters(notebook_path(stage)).keys() <= used | of_stage


def test_tables_link_to_their_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the names that the tables of a run have. The session was missing from the links, which led nowhere."""
    monkeypatch.chdir(tmp_path)
    for path in ("hl_query/raw_data/a b.jpg", "hl_query/raw_data/import/images/<c>.jpg"):
        (tmp_path / "P/sessions" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "P/sessions" / path).touch()
    table = pd.DataFrame({"status": ["failed: <none>"], "image": ["a b.jpg;<c>.jpg;gone.jpg"]}, ["hl in ios"])
    html = notebook.linked(table, tmp_path / "P/sessions").to_html()
    assert "href='P/sessions/hl_query/raw_data/a%20b.jpg'" in html
    assert "href='P/sessions/hl_query/raw_data/import/images/%3Cc%3E.jpg'" in html
    assert all(text in html for text in ("hl in ios", "failed: &lt;none&gt;", "&lt;c&gt;.jpg</a> gone.jpg"))
    long = f"failed: no readable image (Image cannot be decoded (9 bytes): {tmp_path}/{'long/' * 20}torn.jpg)"
    table = pd.DataFrame({"status": [long], "image": [f"{'long/' * 20}torn.jpg"]}, ["hl in ios"])
    html = notebook.linked(table, tmp_path / "P/sessions").to_html()
    assert ">failed: no readable image<" in html, "which made the column so wide that names of images were cut off"
    assert ">…/torn.jpg<" in html
    roots = [tmp_path / "P/sessions", None]
    table = pd.DataFrame({"pair": "hl in ios", "image": ["a b.jpg", None], "sessions_root": roots})
    html = notebook.linked(table).to_html()
    assert html.count("href='P/sessions/hl_query/raw_data/a%20b.jpg'") == 1
    assert "sessions_root" not in html


@pytest.mark.slow
def test_tables_of_a_run_link_to_files_that_exist(small_run: Path) -> None:
    (executed,) = (small_run / "notebooks").glob("*05_evaluate.ipynb")
    links = re.findall(r"<a href='([^']+)' target", executed.read_text())
    assert len(links) >= 12
    assert all((executed.parent / unquote(link)).is_file() for link in links)


@pytest.mark.parametrize("stage", STAGES)
def test_parameters_are_of_the_run_or_settings_that_are_as_in_the_run(stage: str) -> None:
    parameters = notebook_parameters(notebook_path(stage))
    assert parameters.pop("settings") == {}, "the door to all other settings"
    chosen = {name: value for name, value in parameters.items() if name not in OF_THE_RUN}
    assert chosen.keys() <= type(Manifest.defaults(stage)).model_fields.keys()
    assert {*chosen.values(), parameters.get("queries")} == {None}, "None: as in the run"


@pytest.mark.parametrize("stage", STAGES)
def test_the_setup_cell_shows_the_value_of_each_parameter_that_is_as_in_the_run(
    stage: str, small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are None in the cell above, so no one saw which values hold."""
    parameters = notebook_parameters(notebook_path(stage))
    monkeypatch.setattr(notebook, "_user_names", lambda: parameters)
    manifest = Manifest.of({"name": "x", "captures": ["x"]})
    folders = notebook.Folders(stage, manifest, sessions_root=small_capture / "sessions")
    assert set(folders.values["from"]) <= {"default"}
    names = parameters.keys() & {*type(Manifest.defaults(stage)).model_fields, "queries", "pairs", "device"}
    assert [*folders.values.index] == [name for name in parameters if name in names]
    assert all(f"<th>{name}</th>" in folders._repr_html_() for name in names)


def test_values_are_from_the_notebook_the_run_or_default(small_capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names: dict[str, Any] = {"topk": 3, "settings": {"mask": {"gps": True}}, "map_device": "all", "query_device": "hl"}
    monkeypatch.setattr(notebook, "_user_names", lambda: names)
    of_run = {"topk": 7, "index": "HNSW32"}
    content = {"name": "x", "captures": ["x"], "pairs": [["ios", "hl"], ["ios", "ios"]], "retrieve": of_run}
    folders = notebook.Folders("retrieve", Manifest.of(content), Path("x"), sessions_root=small_capture / "sessions")
    assert dict(zip(folders.values.index, folders.values.to_numpy().tolist(), strict=True)) == {
        "topk": ["3", "notebook"], "pairs": ["[['ios', 'hl']]", "notebook"],
        "queries": [manifest_default("queries"), "default"],
        "index": ["HNSW32", "run"], "mask.gps": ["True", "notebook"],
    }  # fmt: skip
    names["topk"] = None
    assert folders.values.loc["topk"].tolist() == ["7", "run"], "the cell has run again"
    monkeypatch.setenv(LOG_VARIABLE, "run.log")
    assert folders.values.loc["mask.gps", "from"] == "run", "which fills its notebooks in"


def test_a_section_that_is_null_is_one_value(small_capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = dict[str, Any]()
    monkeypatch.setattr(notebook, "_user_names", lambda: names)
    for of_run, given, source in (({"map": None}, {}, "run"), ({}, {"map": None}, "notebook")):
        names["settings"] = given
        manifest = Manifest.of({"name": "x", "captures": ["x"], "localize": of_run})
        folders = notebook.Folders("localize", manifest, Path("x"), sessions_root=small_capture / "sessions")
        assert folders.values.loc["map"].tolist() == ["None", source]


def manifest_default(name: str) -> Any:
    return Manifest.model_fields[name].default


def test_devices_and_pairs_by_hand_are_those_of_the_run(small_capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All nine pairs were localized after a run of two."""
    names: dict[str, Any] = {"map_device": "all", "query_device": "all", "pairs": None, "device": "auto"}
    monkeypatch.setattr(notebook, "_user_names", lambda: names)
    pairs = [["ios", "hl"], ["ios", "ios"]]
    content = {"name": "x", "captures": ["x"], "pairs": pairs, "evaluate": {"thresholds": [[2, 0.2]]}}
    root = small_capture / "sessions"
    folders = notebook.Folders("retrieve", Manifest.of(content), Path("x"), sessions_root=root)
    assert folders.pairs == pairs
    assert folders.device == ["ios", "hl"]
    assert folders.thresholds == [[2.0, 0.2]], "which notebook 04b took at their defaults"
    names |= {"query_device": "hl", "device": "spot"}
    assert (folders.pairs, folders.device) == ([["ios", "hl"]], "spot")
    names["query_device"] = "spot"
    assert folders.pairs is None, "a person may ask for what the run left out"
    names["pairs"] = [["spot", "hl"]]
    assert folders.pairs == [["spot", "hl"]]
    everything = Manifest.of({"name": "x", "captures": ["x"]})
    folders = notebook.Folders("embed", everything, Path("x"), sessions_root=root)
    names |= {"pairs": None, "device": "auto"}
    assert (folders.pairs, folders.device) == (None, "auto")


def test_a_change_is_tried_with_all_queries_by_the_command_that_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "data_manifests").mkdir()
    (tmp_path / "data_manifests" / "mine.yaml").touch()
    (tmp_path / "lab").mkdir()
    monkeypatch.chdir(tmp_path / "lab")
    names: dict[str, Any] = {"run": "runs/mine"}
    monkeypatch.setattr(notebook, "_user_names", lambda: names)
    manifest = Manifest.of({"name": "mine", "captures": ["x"], "localize": {"matcher": "mutual"}})
    folders = notebook.Folders("localize", manifest)
    words = shlex.split(folders.command({"localize.matcher": "lightglue", "retrieve.topk": 3}))
    assert words[1:3] == ["run", str(tmp_path / "data_manifests" / "mine.yaml")]
    assert words[3:] == ["--sweep", "localize.matcher=mutual,lightglue", "--sweep", "retrieve.topk=10,3"]
    (*_, features) = shlex.split(folders.command({"localize.features": ["sift", "aliked"]}))
    assert swept_runs("mine", [features]) == {
        "mine-features-auto": ["localize.features=[auto]"],
        "mine-features-sift-aliked": ["localize.features=[sift, aliked]"],
    }
    names["run"] = "runs/other"
    assert folders.command({"localize.pnp.max_error_deg": 0.1}).endswith(
        " run MANIFEST --sweep localize.pnp.max_error_deg=0.17,0.1"
    )


def test_a_stage_gets_the_parameters_of_its_notebook_and_then_its_dict(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {"topk": 3, "index": "a variable of the user", "settings": {"mask": {"gps": True}}}
    monkeypatch.setattr(notebook, "_user_names", lambda: names)
    content = {"name": "x", "captures": ["x"], "queries": "all", "retrieve": {"topk": 7, "index": "HNSW32"}}
    manifest = Manifest.of(content)
    folders = notebook.Folders("retrieve", manifest)
    assert folders.settings == RetrieveSettings.of({"topk": 3, "index": "HNSW32", "mask": {"gps": True}})
    assert folders.queries == "all"
    names["settings"] = {"topk": 4}  # the cell has run again, with another value
    assert folders.settings.topk == 4
    names |= {"topk": None, "settings": {}, "queries": "original"}
    assert folders.settings == manifest.retrieve
    assert folders.queries == "original"
    names["settings"] = {"topk": "many"}
    with pytest.raises(ManifestError, match=r"topk: found 'many'"):
        folders.settings  # noqa: B018


@pytest.mark.parametrize("name", [*STAGES, "own_images", "compare"])
def test_a_wrong_parameter_is_named_as_in_its_cell(name: str) -> None:
    """In one line, whatever the path of its setting in the tree is, and however many types it may have."""
    parameters = notebook_parameters(notebook_path(name))
    for key, default in parameters.items():
        may_be_none = default is None or key in ("settings", "unit_m")
        number = isinstance(default, float) or key in ("position_drift", "rotation_drift_deg")
        for wrong in ({"nonsense": 1}, [[["nonsense"]]], *([] if number else [3.5]), None):
            if wrong is None and may_be_none:
                continue
            with pytest.raises(ManifestError, match=rf"^{key}: ") as caught:
                notebook.check_values(name, parameters | {key: wrong})
            assert not re.search(r"\n|Settings:|lax-or-strict", str(caught.value))


@pytest.mark.parametrize(("name", "wrong", "named"), [
    ("localize", {"features": 3}, r"^features: found 3\. .* Meaning: Kinds of local features"),
    ("localize", {"features": ["sift"], "matcher": "mutuel"}, r"^matcher: .*'mutuel'. Did you mean 'mutual'"),
    ("localize", {"settings": {"pnp": {"min_inliers": "x"}}}, r"^settings: pnp\.min_inliers: found 'x'"),
    ("embed", {"device": 3}, r"^device: found 3\. .* a valid list or a valid string\. Meaning: one of"),
    ("own_images", {"poses_are": "cam"}, r"^poses_are: found 'cam'\. .*Known: cam_from_world, rotation_of"),
    ("start", {"photo": "gone.jpg"}, r"^photo: found 'gone.jpg', which does not exist\."),
    ("own_images", {"map_images": 3}, r"^map_images: found 3\. .* Meaning: folder of your map images"),
    ("rerank", {"topn": 5, "topk": 6}, "expected topk to be at most topn"),
    ("retrieve", {"topk": "ten"}, "topk"),
    ("retrieve", {"map_device": 3}, "map_device: found 3"),
    ("retrieve", {"sessions_root": 5}, "sessions_root: found 5"),
    ("localize", {"skip_existing": "yes"}, "skip_existing: found 'yes'"),
    ("localize", {"settings": [1]}, r"\[1\]"),
    ("localize", {"method": "pmp"}, "method: found 'pmp'. Did you mean 'pnp'. Known: feed_forward, hybrid"),
    ("localize", {"settings": {"predictor": {"num_references": "five"}}}, "num_references: found 'five'"),
    ("localize", {"features": "sfit"}, "'sfit'. Did you mean 'sift'. Known: aliked, auto"),
    ("localize", {"features": "auto", "matcher": "mutuel"}, "'mutuel'. Did you mean 'mutual'. Known: lightglue"),
    ("rerank", {"matcher": "mutuel"}, "Did you mean 'mutual'"),
    ("embed", {"model": "vald"}, "'vald'. Did you mean 'vlad'. Known: auto, megaloc"),
    ("embed", {"settings": {"model": ["vlad", "megalok"]}}, "Did you mean 'megaloc'"),
    ("embed", {"compute_device": "cude"}, "found 'cude'. Meaning: Device of the network: auto, cpu, cuda"),
    ("retrieve", {"settings": {"index": "IVF4096,Flot"}}, "index: found 'IVF4096,Flot', expected Flat"),
    ("evaluate", {"pairs": "ios"}, "pairs: found 'ios'"),
    ("evaluate", {"pairs": [["ios"]]}, "pairs"),
    ("embed", {"batch_size": 0.5}, "batch_size"),
    ("own_images", {"device": 5}, "device.*: found 5"),
    ("own_images", {"unit_m": "cm"}, "unit_m: found 'cm'"),
    ("own_images", {"unit_m": True}, "unit_m: found True"),
    ("compare", {"others": "../runs/a"}, "others: found '../runs/a'"),
    ("compare", {"others": [5]}, r"others.*: found 5"),
    ("compare", {"run": 5}, "run: found 5"),
    ("compare", {"pictures": "two"}, "pictures: found 'two'"),
    ("compare", {"seed": -1}, "seed: found -1"),
])  # fmt: skip
def test_what_a_wrong_parameter_means_is_said(name: str, wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(ManifestError, match=named):
        notebook.check_values(name, wrong)


def test_values_that_fit_each_other_need_not_fit_the_defaults() -> None:
    notebook.check_values("rerank", {"topn": 5, "topk": 3})
    notebook.check_values("rerank", {"topk": 50}, RerankSettings(topn=60))


def test_a_notebook_shows_an_error_without_frames_of_the_toolkit() -> None:
    cell = compile("from toolkit.notebook import notebook_path\nnotebook_path('nonsense')", "<cell>", "exec")
    with pytest.raises(ManifestError) as caught:
        exec(cell, {})
    sentence, *lines = caught.value._render_traceback_()
    assert str(caught.value) in sentence
    assert lines[-1].startswith("  cell, line 2")
    assert not any("toolkit/notebook.py" in line for line in lines)


@pytest.mark.slow
def test_an_error_of_the_user_is_a_sentence_in_the_notebook_and_a_traceback_in_the_log(
    small_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(LOG_VARIABLE, str(tmp_path / "run.log"))
    parameters = {"sessions_root": str(small_capture / "sessions"), "query_device": "drone"}
    with pytest.raises(StageError, match=r"^query_device: No query session of device 'drone'"):
        notebook.execute(notebook_path("retrieve"), tmp_path / "out.ipynb", parameters)
    cells = nbformat.read(tmp_path / "out.ipynb", as_version=4).cells
    (shown,) = [o for cell in cells for o in cell.get("outputs", []) if o.output_type == "error"]
    assert shown.ename == "CaptureError"
    assert "query_device: No query session" in shown.traceback[0]
    assert len(shown.traceback) == 2
    assert "notebook.start(" in shown.traceback[1]
    assert "in _check_devices_and_queries" in (tmp_path / "run.log").read_text()


@pytest.mark.parametrize("stage", FUNCTIONS)
def test_parameters_of_the_run_are_arguments_of_the_stage(stage: str) -> None:
    module, _, name = FUNCTIONS[stage].partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    signature = inspect.signature(function).parameters
    for name, default in notebook_parameters(notebook_path(stage)).items():
        if name not in OF_THE_RUN or (stage, name) == ("rerank", "map_dir"):  # of the table of overlaps alone
            continue
        if name in ("inspect", "run"):  # what is shown in the end; where folders that are not given are taken from
            continue
        assert name in signature
        if default is not None and signature[name].default is not inspect.Parameter.empty:
            assert plain(default) == plain(signature[name].default), name


@pytest.mark.slow
def test_a_capture_goes_from_files_to_a_report(small_run: Path) -> None:
    assert (small_run / "report.html").is_file()
    record = json.loads((small_run / "run.json").read_text())
    assert [row["stage"] for row in record["stages"]] == [stage for stage in STAGES if stage not in OPTIONAL]
    assert {row["status"] for row in record["stages"]} == {"done"}
    counts = {row["stage"]: row["counts"] for row in record["stages"]}
    assert counts["embed"]["images"] == counts["embed"]["embedded"] + counts["embed"]["unreadable"]
    assert len(list((small_run / "SMALL" / "poses").glob("*.txt"))) == 9


@pytest.mark.slow
def test_a_capture_without_truth_has_a_report_too(small_capture: Path, small_run: Path, tmp_path: Path) -> None:
    capture = shutil.copytree(small_capture, tmp_path / small_capture.name)
    for truth in capture.glob("sessions/*_query/proc/alignment_trajectories.txt"):
        truth.unlink()
    quick = "{samples: 1, recordings: false, session_recordings: false}"
    (tmp_path / "untrue.yaml").write_text(f"captures: ['{capture}']\noutput_root: runs\nvisualize: {quick}\n")
    run = tmp_path / "runs" / "untrue"
    shutil.copytree(small_run / "SMALL", run / "SMALL", ignore=shutil.ignore_patterns(".stages", "evaluation"))
    with no_kernels():
        pipeline.run(tmp_path / "untrue.yaml", say=lambda *a, **k: None)
    rows = {row["stage"]: row for row in json.loads((run / "run.json").read_text())["stages"]}
    assert {row["status"] for row in rows.values()} == {"done"}
    assert set(pd.read_csv(run / "SMALL" / "evaluation" / "losses.csv")["state"]) == {"no ground truth"}
    assert (run / "report.html").is_file()


@pytest.mark.slow
def test_a_run_with_all_stages_is_reused(
    small_capture: Path, small_run: Path, tmp_path: Path, released_weights: None
) -> None:
    manifest = tmp_path / "small.yaml"
    sections = "rerank: {}\nsequence: {}\nvisualize: {samples: 1, session_recordings: false}\n"
    manifest.write_text(f"captures: ['{small_capture}']\noutput_root: runs\n{sections}")
    run = tmp_path / "runs" / "small"
    # What the stages have made is taken over, but for what reranking changes.
    shutil.copytree(small_run / "SMALL", run / "SMALL", ignore=shutil.ignore_patterns(".stages"))
    with no_kernels():  # the optional notebooks have them in the test by hand, the others in the small run
        first = CliRunner().invoke(app, ["run", str(manifest)])
    assert first.exit_code == 0, first.output
    rows = {row["stage"]: row for row in json.loads((run / "run.json").read_text())["stages"]}
    assert list(rows) == list(STAGES)
    assert rows["retrieve"]["parameters"]["settings"]["topk"] == 30
    assert rows["localize"]["parameters"]["retrieval_dir"].endswith("reranked")
    assert rows["rerank"]["counts"]["pairs"] == 9
    table = (run / "SMALL" / "evaluation" / "overlap.csv").read_text()
    assert "reranked_mean" in table
    assert rows["sequence"]["counts"]["frames"] == rows["sequence"]["counts"]["ok"] == 3 * 3 * 3
    assert "<h3>Sequences</h3>" in (run / "report.html").read_text()
    steps = pd.read_csv(run / "SMALL" / "evaluation" / "sequence.csv")["step"].value_counts()
    assert set(steps) == {9}
    assert {"single", "graph", "online 10 s", "sequence"} <= set(steps.index)
    assert len(list((run / "SMALL" / "visualization").glob("*_sequence.png"))) == 9
    assert len(list((run / "SMALL" / "poses").glob("*.txt"))) == 18

    again = CliRunner().invoke(app, ["run", str(manifest)])
    assert again.stdout.count("reused") == len(STAGES), again.output


def test_a_table_on_a_page_has_medians_first_and_says_nothing_twice() -> None:
    row = {"map_device": "ios", "query_device": "hl", "state": "evaluated", "queries": 3, "localized": 2, "ok": 2}
    row |= {"recall@(1deg,0.1m)": 0.5, "median_rotation_deg": 0.1, "median_translation_m": 0.2, "path": "/a/b"}
    shown = notebook.readable(pd.DataFrame([row | {"reason": "", "still": "/a/b/c.png", "error_rotation_deg": 1.0}]))
    names = ["median_deg", "median_cm", "recall 1°, 0.1\N{NO-BREAK SPACE}m [%]", "queries", "ok", "still", "error_deg"]
    assert shown.columns.tolist() == names
    assert shown.loc["hl\N{NO-BREAK SPACE}in\N{NO-BREAK SPACE}ios"].tolist() == ["0.10", "20", "50", 3, 2, "c.png", "1"]
    left_out = notebook.readable(pd.DataFrame([row | {"state": "left out: x", "reason": "x"}]))
    assert {"state", "reason"} <= set(left_out.columns)
    unknown = pd.DataFrame([row | {"threshold": float("nan")}, row | {"threshold": "(1deg,0.1m)"}])
    assert notebook.readable(unknown)["threshold"].fillna("").tolist() == ["", "1°, 0.1\N{NO-BREAK SPACE}m"], "no truth"
    sessions = pd.DataFrame({"session": ["ios_map"], "images": [3], "path": ["p"]})
    assert notebook.readable(sessions).columns.tolist() == ["session", "images"]


def test_a_notebook_starts_without_nbformat() -> None:
    """Its schemas take two seconds to import, in each kernel."""
    code = (
        "import sys; from toolkit.notebook import notebook_parameters, notebook_path;"
        "notebook_parameters(notebook_path('localize')); sys.exit('nbformat' in sys.modules)"
    )
    root = notebook_path("localize").parents[1]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_a_log_is_told_the_share_that_is_done_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(notebook.time, "monotonic", lambda: now[0])
    said: list[str] = []
    line = StatusLine("[4/6] localize demo", lambda text, **_: said.append(text))
    for seconds, done in ((1, 2), (29, 10), (31, 20), (40, 30), (62, 50)):
        now[0] = seconds
        line.write(f"\rlocalize:  {done}%|##   | {done}/100 [00:0{done}<01:00]")
    line.write("a warning of the kernel\n")
    line.end("100 queries")
    assert said[0] == "[4/6] localize demo ..."
    assert [text.split()[:3] for text in said[1:-1]] == [["localize:", "20%", "20/100"], ["localize:", "50%", "50/100"]]
    assert said[-1].strip() == "100 queries"
