"""The mechanics of a run, on tiny notebooks: what is executed, reused, refused, and what a failure leaves."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import pytest
import torch
from nbformat.v4 import new_code_cell, new_notebook, new_output
from safetensors.torch import save_file

from toolkit import notebook, pipeline
from toolkit.errors import COMMAND_VARIABLE, CaptureError, ManifestError, WeightsError
from toolkit.files import SceneFiles, write_sidecar, write_text
from toolkit.manifest import (
    STAGES,
    LocalizeSettings,
    RerankSettings,
    RetrieveSettings,
    VisualizeSettings,
    load_manifest,
)
from toolkit.pipeline import StageError

DEFAULT = ("explore", "embed", "retrieve", "localize", "evaluate", "visualize")
KERNEL = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
EMBED = """
from pathlib import Path
from toolkit import notebook
out = Path(out_dir)
out.mkdir(parents=True, exist_ok=True)
(out / "log.txt").open("a").write(f"{settings.get('model', model)} {skip_existing}\\n")
notebook.finish(images=4)
"""
RETRIEVE = """
from pathlib import Path
from toolkit.errors import CaptureError
topk = settings.get("topk", topk)
if topk > 50:
    raise CaptureError("images.txt, line 3: found a dragon.")
out = Path(out_jsonl)
out.mkdir(parents=True, exist_ok=True)
(out / f"P_map_{map_device}_query_{query_device}.jsonl").write_text(str(topk))
"""


def write_notebook(folder: Path, stage: str, parameters: str, code: str) -> None:
    first, work = new_code_cell(parameters), new_code_cell(code)
    first.metadata["tags"] = ["parameters"]
    number = {"rerank": "03b", "sequence": "04b"}.get(stage) or f"{DEFAULT.index(stage) + 1:02d}"
    nbformat.write(new_notebook(cells=[first, work], metadata=KERNEL), folder / f"{number}_{stage}.ipynb")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a capture `P`, tiny notebooks of which two are run, and a manifest `run.yaml`."""
    notebooks = tmp_path / "notebooks"
    notebooks.mkdir()
    for stage in STAGES:
        write_notebook(notebooks, stage, "samples = 1\nthresholds = []", "")
    parameters = 'sessions_root = None\nout_dir = None\nmodel = "vlad"\nskip_existing = True\nsettings = {}'
    write_notebook(notebooks, "embed", parameters, EMBED)
    parameters = 'out_jsonl = None\ntopk = 10\nmap_device = "all"\nquery_device = "all"\npairs = None\nsettings = {}'
    write_notebook(notebooks, "retrieve", parameters, RETRIEVE)
    monkeypatch.setattr(notebook, "NOTEBOOKS", notebooks)
    monkeypatch.setattr(pipeline, "STAGES", ("embed", "retrieve"))
    monkeypatch.setattr(pipeline, "_write_report", lambda run_dir: None)
    monkeypatch.setattr(pipeline, "_code_fingerprint", lambda: "the same")
    for session in ("ios_map", "ios_query", "hl_map", "hl_query"):
        folder = tmp_path / "P" / "sessions" / session
        folder.mkdir(parents=True)
        (folder / "images.txt").write_text("# timestamp, sensor_id, image_path\n")
    (tmp_path / "run.yaml").write_text("captures: [P]\noutput_root: runs\n")
    return tmp_path


def execute_here(
    path: Path, output: Path, parameters: dict[str, Any], progress: object = None, kernels: object = None
) -> tuple[Any, float]:
    """Do what `pipeline.execute` does, without the seconds that a kernel takes to start."""
    notebook.check_parameters(path, parameters)
    content = nbformat.read(path, as_version=4)
    defaults, work = content.cells
    variables: dict[str, Any] = {}
    exec(defaults.source, variables)
    variables |= parameters
    with pytest.MonkeyPatch.context() as patch:
        outputs = work.outputs
        patch.setattr(
            "IPython.display.display", lambda data, raw: outputs.append(new_output("display_data", data=data))
        )
        exec(work.source, variables)
    output.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(content, output)
    return content, 1.0


@pytest.fixture
def go(place: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, str]]:
    monkeypatch.setattr(pipeline, "execute", execute_here)

    def run(*overrides: str, **options: object) -> dict[str, str]:
        """Run the manifest and return what became of each stage."""
        lines: list[str] = []
        pipeline.run(
            place / "run.yaml", overrides=overrides, say=lambda *a, **k: lines.append(a[0]), in_place=True, **options
        )
        record = json.loads((place / "runs/run/run.json").read_text())
        assert record["status"] == "done"
        assert lines
        return {row["stage"]: row["status"] for row in record["stages"]}

    return run


def test_stages_are_executed_in_kernels_and_recorded(place: Path) -> None:
    pipeline.run(place / "run.yaml", say=lambda *a, **k: None)
    record = json.loads((place / "runs/run/run.json").read_text())
    assert [row["status"] for row in record["stages"]] == ["done", "done"]
    assert record["stages"][0]["counts"] == {"images": 4}
    assert record["stages"][0]["peak_memory_mb"] > 10
    assert record["scenes"] == ["P"]
    assert (place / "runs/run" / record["stages"][1]["notebook"]).is_file()
    assert (place / "runs/run/P/retrieval/P_map_all_query_all.jsonl").read_text() == "10"
    assert (place / "runs/run/P/embeddings/log.txt").read_text() == "vlad True\n"


def test_a_stage_runs_again_only_when_something_has_changed(place: Path, go: Callable[..., dict[str, str]]) -> None:
    done, reused = "done", "reused"
    assert go() == {"embed": done, "retrieve": done}
    jsonl = place / "runs/run/P/retrieval/P_map_all_query_all.jsonl"
    assert jsonl.read_text() == "10"

    assert go() == {"embed": reused, "retrieve": reused}
    assert go("retrieve.topk=3") == {"embed": reused, "retrieve": done}
    assert jsonl.read_text() == "3"
    jsonl.unlink()
    assert go("retrieve.topk=3", only="retrieve") == {"embed": reused, "retrieve": done}
    # What is built on a stage that ran again runs again too.
    assert go("retrieve.topk=3", force=True, only="embed") == {"embed": done, "retrieve": reused}
    assert (place / "runs/run/P/embeddings/log.txt").read_text() == "vlad True\nvlad False\n"
    assert go("retrieve.topk=3") == {"embed": reused, "retrieve": done}
    (place / "P/sessions/ios_map/images.txt").write_text("# changed\n")
    assert go("retrieve.topk=3", only="embed")["embed"] == done
    assert go("retrieve.topk=2", only="retrieve, embed") == {"embed": reused, "retrieve": done}


def test_no_kernel_is_started_for_what_is_reused(
    place: Path, go: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    left: list[int] = []

    def execute(*args: Any) -> tuple[Any, float]:
        left.append(args[4].left)
        return execute_here(*args)

    monkeypatch.setattr(pipeline, "execute", execute)
    go()
    assert left[0] == 2
    assert go("retrieve.topk=3") == {"embed": "reused", "retrieve": "done"}
    assert left[2:] == [1]


def test_a_sweep_takes_over_what_does_not_depend_on_its_keys(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "execute", execute_here)
    said: list[str] = []
    sweeps = ["embed.seed=0,1", "retrieve.topk=3,90,5"]
    folders, failed = pipeline.sweep(place / "run.yaml", sweeps, say=lambda *a, **k: said.append(a[0]))
    assert len(folders) == 4
    assert ["found a dragon" in str(error) for error in failed] == [True, True]
    runs = {path.name: path for path in (place / "runs").iterdir()}
    assert set(runs) == {f"run-seed-{seed}-topk-{k}" for seed in (0, 1) for k in (3, 90, 5)}
    for name, run in runs.items():
        record = json.loads((run / "run.json").read_text())
        assert record["status"] == ("failed" if name.endswith("90") else "done"), "one does not stop the others"
    assert (runs["run-seed-1-topk-5"] / "P/embeddings/log.txt").stat().st_nlink == 3, "of the runs with that seed"
    assert sum("found a dragon" in line for line in said) == 2


def test_a_sweep_takes_over_what_a_failed_run_came_to(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "execute", execute_here)
    folders, failed = pipeline.sweep(place / "run.yaml", ["retrieve.topk=90,5"], say=lambda *_, **__: None)
    assert (len(folders), len(failed)) == (1, 1)
    assert (folders[0] / "P/embeddings/log.txt").stat().st_nlink == 2


def test_damage_in_what_a_stage_left_makes_it_run_again(place: Path, go: Callable[..., dict[str, str]]) -> None:
    go()
    jsonl = place / "runs/run/P/retrieval/P_map_all_query_all.jsonl"
    state = jsonl.stat()
    jsonl.write_text("11")
    os.utime(jsonl, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert go() == {"embed": "reused", "retrieve": "done"}
    assert jsonl.read_text() == "10"
    assert go() == {"embed": "reused", "retrieve": "reused"}
    (place / "runs/run/notebooks/P_02_embed.ipynb").write_text("")
    assert go()["embed"] == "done"


@pytest.mark.parametrize(("stage", "name"), [("localize", "map/{}_map.npz"), ("retrieve", "index/{}_map.faiss")])
def test_a_damaged_map_or_index_makes_its_stage_run_again(place: Path, stage: str, name: str) -> None:
    files = SceneFiles(place / "runs", "P")
    job = pipeline.Job(stage, files, LocalizeSettings(), {})
    path = files.root / name.format("ios")
    write_text(path, "points")
    before = job.outputs()
    path.write_text("paints")
    assert job.outputs() != before
    path.unlink()
    assert job.outputs() != before


@pytest.mark.parametrize("name", [".csv", "_steps.csv", ".txt.meta.json"])
def test_what_the_sequence_stage_writes_is_not_of_localize(place: Path, name: str) -> None:
    files = SceneFiles(place / "runs", "A_sequence")
    localize, sequence = (pipeline.Job(stage, files, LocalizeSettings(), {}) for stage in ("localize", "sequence"))
    pair = "A_sequence_map_ios_query_hl"
    write_text(files.poses_dir / f"{pair}.txt", "single")
    before = localize.outputs(), sequence.outputs()
    write_text(files.poses_dir / f"{pair}_sequence{name}", "frames")
    assert localize.outputs() == before[0]
    assert sequence.outputs() != before[1]
    before = localize.outputs(), sequence.outputs()
    write_text(files.poses_dir / "A_sequence_map_ios.json", "the map")
    assert localize.outputs() != before[0]
    assert sequence.outputs() == before[1]


def test_a_lost_picture_of_a_recording_makes_visualize_run_again(place: Path) -> None:
    job = pipeline.Job("visualize", SceneFiles(place / "runs", "P"), VisualizeSettings(), {})
    picture = job.files.visualization / "P_map_ios_query_hl_sequence.png"
    write_text(picture, "a recording")
    before = job.outputs()
    picture.unlink()
    assert job.outputs() != before


def test_a_stage_with_something_to_try_again_is_not_reused(place: Path, go: Callable[..., dict[str, str]]) -> None:
    jsonl = place / "runs/run/P/retrieval/P_map_all_query_all.jsonl"
    write_text(jsonl, "10")
    write_sidecar(jsonl, {}, unfinished=True)  # as the stage would
    assert go() == {"embed": "done", "retrieve": "done"}
    assert go() == {"embed": "reused", "retrieve": "done"}
    write_sidecar(jsonl, {})
    assert go() == {"embed": "reused", "retrieve": "done"}
    assert go() == {"embed": "reused", "retrieve": "reused"}


def test_devices_and_pairs_select_what_stages_do(place: Path) -> None:
    spot = place / "P" / "sessions" / "spot_query"
    spot.mkdir()
    (spot / "images.txt").touch()

    def selected(*overrides: str) -> dict[str, Any]:
        return notebook.selection(load_manifest(place / "run.yaml", overrides), place / "P")

    assert selected() == {}
    assert selected("devices=[spot, ios]") == {"pairs": [["ios", "ios"], ["ios", "spot"]], "device": ["ios", "spot"]}
    # A pair that is asked for by name gets a row that says what is missing.
    assert selected("pairs=[[spot, ios], [hl, hl]]")["pairs"] == [["spot", "ios"], ["hl", "hl"]]
    assert selected("pairs=[[ios, hl], [hl, hl]]", "devices=[hl]")["pairs"] == [["hl", "hl"]]
    with pytest.raises(ManifestError, match=r"Its sessions: .*spot_query"):
        selected("devices=[spot]")
    shutil.rmtree(place / "P" / "sessions" / "ios_map")
    shutil.rmtree(place / "P" / "sessions" / "hl_map")
    assert selected("devices=[ios]") == {"pairs": [["ios", "ios"]], "device": ["ios"]}


def test_reranking_is_switched_on_by_its_section(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "STAGES", STAGES)
    parameters = "retrieval_dir = None\nreranked_dir = None\nsettings = {}"
    for stage in ("rerank", "localize", "evaluate"):
        write_notebook(place / "notebooks", stage, parameters, "")

    def asked(*overrides: str) -> dict[str, dict[str, object]]:
        manifest = load_manifest(place / "run.yaml", overrides)
        files = SceneFiles(place / "runs" / "run", "P")
        return {
            stage: (parameters := pipeline._job(manifest, stage, place / "P", files, force=False).parameters)
            | parameters.pop("settings", {})
            for stage in manifest.stages
        }

    off = asked()
    assert "rerank" not in off
    assert off["localize"]["retrieval_dir"].endswith("/retrieval")
    assert "reranked_dir" not in off["evaluate"]
    for switch in ("rerank=true", "rerank=null", "rerank={}"):
        on = asked(switch)
        assert list(on) == [stage for stage in STAGES if stage != "sequence"]
        assert on["retrieve"]["topk"] == 30  # what is verified has to be retrieved
        assert on["rerank"]["retrieval_dir"].endswith("/retrieval")
        assert on["localize"]["retrieval_dir"].endswith("/reranked")
        assert on["evaluate"]["retrieval_dir"].endswith("/retrieval")
        assert on["evaluate"]["reranked_dir"].endswith("/reranked")
    assert asked("rerank=false") == off
    more = asked("rerank.topn=50")
    assert (more["retrieve"]["topk"], more["rerank"]["topn"]) == (50, 50)
    assert asked("rerank=true", "retrieve.topk=40")["retrieve"]["topk"] == 40
    for ask, named in (
        (lambda: asked("rerank.topn=50", "retrieve.topk=40"), r"rerank\.topn.*50.*retrieve\.topk.*40"),
        (lambda: asked("rerank.top_n=50"), r"rerank\.top_n.*topn"),
        (lambda: pipeline.run(place / "run.yaml", only="rerank"), "rerank"),
    ):
        with pytest.raises(ManifestError, match=named):
            ask()


@pytest.mark.slow
def test_a_failing_cell_stops_with_its_message_and_the_notebook(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[str] = []
    monkeypatch.setattr(
        pipeline, "_write_report", lambda run: reports.append(json.loads((run / "run.json").read_text())["status"])
    )
    with pytest.raises(StageError) as error:
        pipeline.run(place / "run.yaml", overrides=["retrieve.topk=99"], only="retrieve", in_place=True)
    message, where = str(error.value).splitlines()
    assert message == "images.txt, line 3: found a dragon."
    executed = Path(where.rpartition("where: ")[2])
    assert executed == place / "runs/run/notebooks/P_03_retrieve.ipynb"
    assert "dragon" in executed.read_text()
    record = json.loads((place / "runs/run/run.json").read_text())
    assert record["status"] == "failed"
    assert [row["status"] for row in record["stages"]] == ["failed"]
    assert reports == ["failed"], "the report of an earlier run would say that all is well"
    assert not list(executed.parent.glob(".*"))


def test_unknown_parameters_are_refused(place: Path) -> None:
    with pytest.raises(ManifestError, match=r"top_k.*topk"):
        pipeline.execute(place / "notebooks/03_retrieve.ipynb", place / "out.ipynb", {"top_k": 5})


def test_parameters_must_be_literals(tmp_path: Path) -> None:
    write_notebook(tmp_path, "embed", "a = 1\nb = a + 1", "")
    with pytest.raises(ManifestError, match=r"02_embed\.ipynb"):
        notebook.notebook_parameters(tmp_path / "02_embed.ipynb")


@pytest.mark.parametrize(("options", "error", "expected"), [
    ({"only": "embedd"}, ManifestError, "embed"),
    ({"overrides": ["captures=[Q]"]}, CaptureError, "Q"),
    ({"overrides": ["devices=[spot]"]}, ManifestError, "devices"),
    ({"overrides": ["embed.model=megalok"]}, ManifestError, "megalok.*megaloc"),
    ({"overrides": ["output_root=run.yaml/runs"]}, ManifestError, r"output_root: .*run\.yaml/runs"),
])  # fmt: skip
def test_what_cannot_run_is_refused(
    place: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object], error: type[Exception], expected: str
) -> None:
    monkeypatch.chdir(place)
    with pytest.raises(error, match=expected):
        pipeline.run(place / "run.yaml", **options)


def test_another_python_is_told_which_to_take() -> None:
    """Messages say `python -m toolkit`; without the packages of the environment this was a traceback."""
    command = [sys.executable, "-S", "-m", "toolkit", "check"]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == 1
    assert re.fullmatch(r"Error: .* has no package typer\. .*: \.venv/bin/python -m toolkit, .*\n", done.stderr)


@pytest.mark.parametrize(
    ("start", "called"),
    [
        (["-m", "toolkit"], "python -m toolkit"),
        (["-c", "import sys; sys.argv[0] = 'bin/visloc'; from toolkit.__main__ import main; main()"], "visloc"),
    ],
)
def test_commands_are_printed_as_they_are_called(start: list[str], called: str, tmp_path: Path) -> None:
    command = [sys.executable, *start, "new", "p", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True)
    assert done.stdout.endswith(f"Run it: {called} run {tmp_path}/p.yaml\n")
    assert f"then: {called} run" in (tmp_path / "p.yaml").read_text()


def test_a_kernel_prints_commands_as_its_run_is_called() -> None:
    environment = {**os.environ, COMMAND_VARIABLE: "python -m toolkit"}
    ask = [sys.executable, "-c", "from toolkit.errors import COMMAND; print(COMMAND)"]
    done = subprocess.run(ask, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "python -m toolkit\n"


def test_the_command_line_prints_errors_without_traceback(tmp_path: Path) -> None:
    started = time.perf_counter()
    result = subprocess.run(
        [sys.executable, "-m", "toolkit", "run", str(tmp_path / "no.yaml")], capture_output=True, text=True
    )
    assert result.returncode == 1
    assert result.stderr.startswith("Error: ")
    assert "no such manifest" in result.stderr
    assert "Traceback" not in result.stderr
    assert time.perf_counter() - started < 20


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_run_is_taken_up_again(place: Path, go: Callable[..., dict[str, str]]) -> None:
    slow = f"{RETRIEVE}\nimport time\ntime.sleep(0 if Path(out_jsonl, 'again').exists() else 600)"
    parameters = 'out_jsonl = None\ntopk = 10\nmap_device = "all"\nquery_device = "all"\nsettings = {}'
    write_notebook(place / "notebooks", "retrieve", parameters, slow)
    script = (
        "from pathlib import Path; from toolkit import notebook, pipeline;"
        f"notebook.NOTEBOOKS = Path({str(place / 'notebooks')!r}); pipeline.STAGES = ('embed', 'retrieve');"
        "pipeline._code_fingerprint = lambda: 'the same';"
        f"pipeline.run({str(place / 'run.yaml')!r})"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL)
    retrieval = place / "runs/run/P/retrieval"
    deadline = time.monotonic() + 120
    while not retrieval.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.1)
    process.send_signal(signal.SIGKILL)
    process.wait()
    (retrieval / "again").touch()
    assert go() == {"embed": "reused", "retrieve": "done"}


def test_a_stage_that_was_stopped_is_not_taken_for_the_one_before(
    go: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    assert go() == {"embed": "done", "retrieve": "done"}
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "execute", stop)
        with pytest.raises(KeyboardInterrupt):
            go(force=True, only="retrieve")
    assert go() == {"embed": "reused", "retrieve": "done"}, "its notebook is not of a whole execution any more"


@pytest.mark.usefixtures("no_hub")
def test_without_weights_nothing_is_run(place: Path, go: Callable[..., dict[str, str]]) -> None:
    with pytest.raises(WeightsError):
        go("embed.model=megaloc")
    assert not (place / "runs/run/run.json").exists()
    assert go("embed.model=auto") == {"embed": "done", "retrieve": "done"}
    assert (place / "runs/run/P/embeddings/log.txt").read_text() == "vlad True\n"
    # What is up to date needs no weights any more.
    assert go("embed.model=megaloc", only="retrieve")["retrieve"] == "reused"


@pytest.mark.usefixtures("no_hub")
def test_missing_weights_are_told_before_a_capture_is_rendered(
    place: Path, go: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "_captures", lambda manifest: pytest.fail("rendered"))
    with pytest.raises(WeightsError):
        go("embed.model=megaloc")


def test_other_weights_in_the_same_place_are_noticed(place: Path, go: Callable[..., dict[str, str]]) -> None:
    parameters = 'sessions_root = None\nout_dir = None\nmodel = "vlad"\nskip_existing = True\nsettings = {}'
    write_notebook(place / "notebooks", "embed", parameters, EMBED)
    weights = place / "weights" / "model.safetensors"
    weights.parent.mkdir()
    weights.write_bytes(b"some")
    options = ("embed.model=megaloc", f"embed.checkpoint={weights.parent}")
    assert go(*options)["embed"] == "done"
    assert go(*options)["embed"] == "reused"
    weights.write_bytes(b"other")
    assert go(*options)["embed"] == "done"


def test_the_weights_of_every_network_of_a_stage_are_asked_for() -> None:
    def needed(**settings: object) -> list[tuple[list[str], object]]:
        found = pipeline._weights_needed("localize", LocalizeSettings.of(settings))
        return [([release.model for release in (source, *source.others)], place) for source, place in found]

    assert needed() == needed(features=["sift"]) == needed(method="nearest", features=["superpoint"]) == []
    assert needed(features=["sift", "superpoint"], matcher={"checkpoint": "/w/lg"}) == [
        (["SuperPoint"], None), (["LightGlue"], "/w/lg")
    ]  # fmt: skip
    features = {"kinds": ["superpoint"], "checkpoint": "sp"}
    assert needed(features=features, matcher="mutual") == [(["SuperPoint"], "sp")]
    both = needed(method="hybrid", features=["superpoint"], predictor={"checkpoint": "vggt.pt"})
    assert both[0] == (["VGGT-1B", "VGGT-1B-Commercial"], "vggt.pt")
    assert [models for models, _ in both[1:]] == [["SuperPoint"], ["LightGlue"]]
    reranking = pipeline._weights_needed("rerank", RerankSettings.of({"features": "superpoint"}))
    settings = [source.setting for source, _ in reranking]
    assert settings == ["rerank.features.checkpoint", "rerank.matcher.checkpoint"]
    assert pipeline._weights_needed("rerank", RerankSettings()) == []


def test_rough_poses_are_an_input_of_retrieval(tmp_path: Path) -> None:
    rough = tmp_path / "rough.txt"
    rough.write_text("1, cam, 1, 0, 0, 0, 0, 0, 0\n")
    settings = RetrieveSettings.of({"mask": {"poses": rough}})
    job = pipeline.Job("retrieve", SceneFiles(tmp_path / "run", "HERE"), settings, {})
    before = pipeline._inputs_of(job, "")
    assert before == pipeline._inputs_of(job, "")
    rough.write_text("1, cam, 1, 0, 0, 0, 0, 0, 10\n")
    assert before != pipeline._inputs_of(job, "")


@pytest.mark.parametrize("content", ["another model", "torn"])
def test_weights_of_another_network_are_refused_before_anything_runs(tmp_path: Path, content: str) -> None:
    path = tmp_path / "weights.safetensors"
    save_file({"module.encoder.conv_blocks.0.conv_a.weight": torch.zeros(2)}, path)
    settings = LocalizeSettings.of({"features": {"kinds": ["superpoint"], "checkpoint": path}})
    pipeline._require_weights("localize", LocalizeSettings.of(settings, {"matcher": "mutual"}))
    if content == "torn":
        path.write_bytes(path.read_bytes()[:-1])
        message = r"weights\.safetensors .*get it again"
    else:
        message = "(?s)LightGlue.*`localize.matcher.checkpoint`.*`sift`"
    with pytest.raises(WeightsError, match=message):
        pipeline._require_weights("localize", LocalizeSettings.of(settings, {"matcher": {"checkpoint": path}}))
