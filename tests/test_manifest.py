"""The manifest: what is accepted, and that what is wrong is named with its place and the nearest key."""

from pathlib import Path

import pytest
import yaml

from toolkit.errors import ManifestError
from toolkit.manifest import STAGES, Manifest, load_manifest

REPOSITORY = Path(__file__).resolve().parents[1]
MANIFESTS = sorted((REPOSITORY / "data_manifests").glob("*.yaml"))


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_paths_are_relative_to_the_manifest_and_expanded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATA", "/data/sets")
    monkeypatch.setenv("HOME", "/home/me")
    path = write(tmp_path, "captures: [../here, $DATA/there, ~/home]\noutput_root: out\n")
    manifest = load_manifest(path)
    assert manifest.captures == [str(tmp_path.parent / "here"), "/data/sets/there", "/home/me/home"]
    assert manifest.output_root == str(tmp_path / "out")
    assert manifest.name == "mine"


def test_overrides_are_yaml_and_win(tmp_path: Path) -> None:
    path = write(tmp_path, "captures: [a]\nretrieve: {topk: 20}\n")
    manifest = load_manifest(path, ["retrieve.topk=5", "seed=3", "evaluate.thresholds=[[1, 0.1]]"])
    assert manifest.retrieve.given() == {"topk": 5}
    assert manifest.seed == 3
    assert manifest.evaluate.given() == {"thresholds": [[1.0, 0.1]]}
    assert manifest.embed.given() == {}, "what is not said is left to the notebook's defaults"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("captures: [a]\nretrieve: {topK: 5}", "unknown key 'retrieve.topK'. Did you mean 'topk'?"),
        ("captures: [a]\nretreive: {}", "unknown key 'retreive'. Did you mean 'retrieve'?"),
        ("demo_data: {room: 1}", "unknown key 'demo_data.room'. Did you mean 'rooms'?"),
        ("captures: [a]\nretrieve: {topk: ten}", "retrieve.topk: found 'ten'"),
        ("captures: [a]\nretrieve: {topk: 0}", "retrieve.topk: found 0. Input should be greater than 0"),
        ("captures: [a]\nseed: 1.5", "seed: found 1.5"),
        ("captures: [a]\npairs: [[ios, tango]]", "pairs: found 'tango'. Known: hl, ios, spot."),
        ("captures: [a]\npairs: [[ios]]", "pairs.0: found ['ios']"),
        ("captures: [a]\ndevices: ios", "devices: found 'ios'"),
        ("captures: [a]\nname: ../up", "name: found '../up'"),
        ("name: x", "give either `captures`"),
        ("captures: [a]\ndemo_data: {}", "give either `captures`"),
        ("captures: [x/a, y/a]", "two folders are called 'a'"),
        ("captures: [$NO_SUCH_VARIABLE/a]", "$NO_SUCH_VARIABLE, which is not set"),
        ("captures: a: b", "not valid YAML"),
        ("captures: [a]\nworld_up: [0, 0, 0]", "expected three finite numbers"),
        ("captures: [a]\nworld_up: [0, .nan, 1]", "expected three finite numbers"),
        ("captures: [a]\nembed: {image_size: 100}", "embed.image_size"),
        ("captures: [a]\nembed: {image_size: 300}", "multiple of 14"),
        ("captures: [a]\nembed: {compute_device: gpu}", "embed.compute_device"),
        ("- a", "expected `key: value` lines"),
        ("", "expected `key: value` lines"),
    ],
)
def test_wrong_manifests_say_what_is_wrong(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(ManifestError) as error:
        load_manifest(write(tmp_path, text))
    assert "mine.yaml" in str(error.value)
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("retrieve.topk", "expected key=value"),
        ("retrieve.topk=[", "not valid YAML"),
        ("retrieve.k=5", "unknown key 'retrieve.k'"),
        ("retrieve.topk=many", "found 'many'"),
    ],
)
def test_wrong_overrides_are_named(tmp_path: Path, override: str, expected: str) -> None:
    with pytest.raises(ManifestError) as error:
        load_manifest(write(tmp_path, "captures: [a]"), [override])
    assert f"--set {override}" in str(error.value)
    assert expected in str(error.value)


def test_a_missing_manifest_is_named(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="no such manifest"):
        load_manifest(tmp_path / "none.yaml")


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_the_manifests_of_the_repository_are_valid(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAPTURES", "/data")
    assert load_manifest(path).name == path.stem


def test_there_is_a_section_for_each_stage() -> None:
    assert set(STAGES) <= set(Manifest.model_fields)
    assert yaml.safe_load((REPOSITORY / "data_manifests" / "demo.yaml").read_text())["demo_data"]


def test_the_checkpoint_is_found_from_the_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WEIGHTS", "/models")
    for text, expected in {
        "w/m.safetensors": str(tmp_path / "w/m.safetensors"),
        "$WEIGHTS/m.safetensors": "/models/m.safetensors",
    }.items():
        path = write(tmp_path, f"captures: [a]\nembed: {{checkpoint: {text}}}")
        assert load_manifest(path).embed.checkpoint == expected
