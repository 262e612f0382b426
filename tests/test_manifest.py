"""The manifest: what is accepted, and that what is wrong is named with its place and the nearest key."""

import re
from pathlib import Path

import pytest
import yaml

from toolkit.errors import ManifestError
from toolkit.manifest import (
    STAGES,
    LocalizeSettings,
    Manifest,
    MapSettings,
    MatcherSettings,
    PnpSettings,
    PredictorSettings,
    RetrieveSettings,
    Settings,
    describe,
    load_manifest,
)
from toolkit.manifest import settings as settings_module
from toolkit.manifest.settings import nested_model

REPOSITORY = Path(__file__).resolve().parents[1]
MANIFESTS = sorted((REPOSITORY / "data_manifests").glob("*.yaml"))


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_paths_are_relative_to_the_manifest_and_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATA", "/data/sets")
    monkeypatch.setenv("HOME", "/home/me")
    path = write(tmp_path, "captures: [../here, $DATA/there, ~/home]\noutput_root: out\n")
    manifest = load_manifest(path)
    assert manifest.captures == [str(tmp_path.parent / "here"), "/data/sets/there", "/home/me/home"]
    assert manifest.output_root == str(tmp_path / "out")
    assert manifest.name == "mine"
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    changed = load_manifest(path, ["retrieve.mask.poses=rough.txt", "output_root=~/out"])
    assert changed.retrieve.mask.poses == str(tmp_path / "elsewhere" / "rough.txt"), "as the shell completes it"
    assert changed.output_root == "/home/me/out"
    assert changed.captures == manifest.captures


def write_files(folder: Path, **texts: str) -> Path:
    """Write `mine.yaml` and others, `__` in a name standing for `/`; return the former."""
    for name, text in texts.items():
        path = folder / f"{name.replace('__', '/')}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return folder / "mine.yaml"


def test_what_is_inherited_is_merged_and_lists_are_replaced(tmp_path: Path) -> None:
    path = write_files(
        tmp_path,
        mine="inherits: base.yaml\nretrieve: {topk: 3}\nevaluate: {thresholds: [[1, 0.1]]}",
        base="inherits: root.yaml\ncaptures: [a]\nretrieve: {topk: 5, use_faiss: true}\nseed: 2",
        root="captures: [x, y]\nseed: 1\nembed: {model: vlad}\nevaluate: {thresholds: [[1, 1], [2, 2]]}\nname: kept",
    )
    manifest = load_manifest(path, ["retrieve.use_faiss=false"])
    assert manifest.captures == [str(tmp_path / "a")]
    assert manifest.seed == 2
    assert manifest.name == "kept"
    assert manifest.embed.given() == {"model": "vlad"}
    assert manifest.retrieve.given() == {"topk": 3, "use_faiss": False}
    assert manifest.evaluate.given() == {"thresholds": [[1.0, 0.1]]}


def test_of_several_bases_the_later_wins(tmp_path: Path) -> None:
    path = write_files(
        tmp_path,
        mine="inherits: [a.yaml, b.yaml]",
        a="inherits: root.yaml\nseed: 1\nretrieve: {topk: 5}\ncaptures: [a]",
        b="inherits: root.yaml\nseed: 2\ncaptures: [b]",
        root="description: shared by both",
    )
    manifest = load_manifest(path)
    assert (manifest.seed, manifest.retrieve.topk, manifest.description) == (2, 5, "shared by both")
    assert manifest.captures == [str(tmp_path / "b")]
    assert manifest.name == "mine"


def test_the_default_output_folder_counts_from_the_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_files(tmp_path, mine="captures: [a]")
    monkeypatch.chdir("/")
    assert load_manifest(path).output_root == str(tmp_path.parent / "runs")


def test_inherited_paths_count_from_the_file_that_has_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setenv("DATA", "/data")
    monkeypatch.setenv("HERE", "near")
    path = write_files(
        tmp_path,
        mine="inherits: bases/base.yaml\nembed: {checkpoint: mine.pt}",
        bases__base="captures: [here, $DATA/a, ~/b, $HERE/c]\noutput_root: out\nlocalize: {"
        "predictor: {checkpoint: its.pt}, features: {checkpoint: features.pt}, matcher: {checkpoint: ~/matcher.pt}}\n"
        "rerank: {features: {checkpoint: {aliked: aliked.pth}}}\nretrieve: {mask: {poses: rough.txt}}",
    )
    manifest = load_manifest(path)
    bases = tmp_path / "bases"
    assert manifest.captures == [str(bases / "here"), "/data/a", "/home/me/b", str(bases / "near/c")]
    assert manifest.output_root == str(bases / "out")
    assert manifest.localize.predictor.checkpoint == str(bases / "its.pt")
    assert manifest.localize.features.checkpoint == str(bases / "features.pt")
    assert manifest.localize.matcher.checkpoint == "/home/me/matcher.pt"
    assert manifest.rerank is not None
    assert manifest.rerank.features.checkpoint == {"aliked": str(bases / "aliked.pth")}
    assert manifest.retrieve.mask.poses == str(bases / "rough.txt")
    assert manifest.embed.checkpoint == str(tmp_path / "mine.pt")
    path = write_files(tmp_path, mine="inherits: bases/base.yaml\ncaptures: [a]", bases__base="captures: [$UNSET/a]")
    assert load_manifest(path).captures == [str(tmp_path / "a")], "what is replaced need not be known"


def test_a_wrong_base_is_named_with_its_heir(tmp_path: Path) -> None:
    def message(**texts: str) -> str:
        with pytest.raises(ManifestError) as error:
            load_manifest(write_files(tmp_path, **texts))
        return str(error.value)

    base, mine = str(tmp_path / "base.yaml"), str(tmp_path / "mine.yaml")
    text = message(mine="inherits: base.yaml\nseeds: 3", base="captures: [a]\nretrieve: {topK: 5}\nseed: x")
    assert text.startswith(f"{mine}:")
    assert "unknown key 'retrieve.topK'. Did you mean 'topk'?" in text
    assert text.count(f"(in {base}, which it inherits)") == 2
    (line,) = (line for line in text.splitlines() if "'seeds'" in line)
    assert base not in line
    text = message(mine="inherits: base.yaml", base="captures: a: b")
    assert f"{base}: not valid YAML" in text
    text = message(mine="inherits: none.yaml")
    assert text.startswith(f"{mine}: inherits {tmp_path / 'none.yaml'}: no such manifest")
    text = message(mine="inherits: base.yaml", base="inherits: mine.yaml")
    assert text.startswith(f"{mine} inherits {base} inherits {mine}: a manifest cannot inherit from itself")
    text = message(mine="inherits: mine.yaml")
    assert text.startswith(f"{mine} inherits {mine}: a manifest cannot inherit from itself")
    text = message(mine="inherits: base.yaml", base="captures: [$UNSET/a]")
    assert text.startswith(f"{mine}: captures: found the variable $UNSET")
    text = message(mine="inherits: {a: b}")
    assert "inherits: found {'a': 'b'}, expected a file name or a list of them" in text


def test_null_turns_a_part_off_and_leaves_a_section_as_it_is(tmp_path: Path) -> None:
    manifest = load_manifest(write(tmp_path, "captures: [a]\nretrieve:\nlocalize: {map: null, pnp: null}\n"))
    assert manifest.localize.map is None
    assert (manifest.retrieve, manifest.localize.pnp) == (RetrieveSettings(), PnpSettings())


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
        (
            "captures: [here]\nlocalize: {pnp: {guided_images: 9}}",
            "guided_images': it is no setting any more, but MAX_GUIDED_IMAGES in toolkit/pose/map_matching.py.",
        ),
        ("demo_data: {room: 1}", "unknown key 'demo_data.room'. Did you mean 'rooms'?"),
        ("captures: [a]\nretrieve: {topk: ten}", "retrieve.topk: found 'ten'"),
        ("captures: [a]\nretrieve: {topk: 0}", "retrieve.topk: found 0. Input should be greater than 0"),
        ("captures: [a]\nseed: 1.5", "seed: found 1.5"),
        ("captures: [a]\nseed: 2147483648", "seed: found 2147483648"),
        ("captures: [a]\nseed: 1\nseed: 1", "line 3"),
        ("captures: [a]\nretrieve: {topk: 5}\nretrieve: {}", "line 3"),
        ("captures: [a]\nretrieve:\n  topk: 5\n  topk: 6", "line 4"),
        ("captures: [a]\npairs: [[ios, tango]]", "pairs: found 'tango'. Known: hl, ios, spot."),
        ("captures: [a]\npairs: [[ios]]", "pairs.0: found ['ios']"),
        ("captures: [a]\ndevices: ios", "devices: found 'ios'"),
        ("captures: [a]\nname: ../up", "name: found '../up'"),
        ("name: x", "give either `captures`"),
        ("captures: [a]\ndemo_data: {}", "give either `captures`"),
        ("captures: [x/a, y/a]", "two folders called 'a'"),
        ("captures: [$NO_SUCH_VARIABLE/a]", "$NO_SUCH_VARIABLE, which is not set"),
        ("captures: a: b", "not valid YAML"),
        ("captures: [a]\nworld_up: [0, 0, 0]", "expected three finite numbers"),
        ("captures: [a]\nworld_up: [0, .nan, 1]", "expected three finite numbers"),
        ("captures: [a]\nembed: {image_size: 100}", "embed.image_size"),
        ("captures: [a]\nembed: {image_size: 300}", "multiple of 14"),
        ("captures: [a]\nembed: {compute_device: gpu}", "embed.compute_device"),
        ("captures: [a]\ndataset: {page: p, license: l, sessions: [ios_map], sources: {a: {hub: x}}}", "a.hub: found"),
        (
            "captures: [a]\ndataset: {page: p, license: l, sessions: [ios_map], sources: {a: {hubs: o/n}}}",
            "unknown key 'dataset.sources.a.hubs'. Did you mean 'hub'?",
        ),
        (
            "captures: [a]\ndataset: {page: p, license: l, sessions: [ios_map], sources: {a: {}}}",
            "either `hub` (owner/name) or `urls`",
        ),
        ("captures: [a]\ndataset: {page: p, license: l, sessions: [tango_map], sources: {}}", "found 'tango_map'"),
        ("captures: [a]\ndataset: {page: p, license: l, sessions: [], sources: {}}", "dataset: sessions is empty"),
        ("captures: [a]\ndataset: {page: p, license: l, sessions: 3, sources: {}}", "dataset.sessions: found 3"),
        ("captures: [a]\ndataset: {page: p, sessions: [ios_map], sources: {}}", "dataset.license: not given"),
        (
            "captures: [a]\ndataset: {page: p, license: l, sessions: {ios_map: map}, sources: {a: {hub: o/n}}}",
            "works with archives (`urls`) only",
        ),
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
        ("localize.method=vggtt", "localize.method: found 'vggtt'. Known: feed_forward"),
        ("captures.ios=here", "captures: found {'ios': 'here'}"),
        ("localize.predictor=[vggt]", "localize.predictor.name: found ['vggt']"),
    ],
)
def test_wrong_overrides_are_named(tmp_path: Path, override: str, expected: str) -> None:
    with pytest.raises(ManifestError) as error:
        load_manifest(write(tmp_path, "captures: [a]"), [override])
    assert f"--set {override}" in str(error.value)
    assert expected in str(error.value)


def test_the_old_name_of_a_method_is_read_on(tmp_path: Path) -> None:
    manifest = load_manifest(write(tmp_path, "captures: [a]"), ["localize.method=vggt"])
    assert manifest.localize.method == "feed_forward"


def test_a_missing_manifest_is_named(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match=r"none\.yaml"):
        load_manifest(tmp_path / "none.yaml")


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.stem)
def test_the_manifests_of_the_repository_are_valid(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAPTURES", "/data")
    assert load_manifest(path).name == path.stem


def test_public_captures_have_a_source_and_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAPTURES", "/data")
    scenes = {}
    for path in MANIFESTS:
        manifest = load_manifest(path)
        if manifest.dataset:
            names = [Path(capture).name for capture in manifest.captures]
            assert list(manifest.dataset.sources) == names
            scenes |= {name: " ".join(manifest.dataset.session_names) for name in names}
            assert manifest.dataset.license
            assert manifest.dataset.citation
    crocodl = ("HYDRO", "SUCCULENT", "ARCHE_GRANDE", "DESIGN", "ARCHE_D2", "ARCHE_B3", "ARCHE_B5")
    every = "ios_map ios_query hl_map hl_query spot_map spot_query"
    lamar = dict.fromkeys(("CAB", "HGE", "LIN"), "hl_map ios_map hl_query ios_query")
    assert scenes == dict.fromkeys(crocodl, every) | lamar


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


def test_the_printed_tree_is_accepted_and_changes_nothing(tmp_path: Path) -> None:
    text = "\n".join(describe(Manifest))
    plain = load_manifest(write(tmp_path, "captures: [here]\n"))
    printed = load_manifest(write(tmp_path, text), ["captures=[here]"])
    for stage in STAGES:
        assert printed.stage(stage) == plain.stage(stage)


def test_every_setting_has_a_meaning() -> None:
    sections: list[type[Settings]] = [Manifest]
    for section in sections:
        for name, field in section.model_fields.items():
            assert field.description, f"{section.__name__}.{name}"
            inner = nested_model(field.annotation)
            if inner and issubclass(inner, Settings) and inner not in sections:
                sections.append(inner)
    assert len(sections) > 15


def test_stages_have_few_settings_and_constants_are_where_they_are_said_to_be() -> None:
    models = [model for model in vars(settings_module).values() if isinstance(model, type)]
    sections = [model for model in models if issubclass(model, Settings)]
    assert sum(len(section.model_fields) for section in sections) <= 90
    for section in sections:
        for file, names in section.constants.items():
            code = (REPOSITORY / "toolkit" / file).read_text(encoding="utf-8")
            for setting, _, constant in (one.partition("=") for one in names.split()):
                assert setting not in section.model_fields
                assert re.search(rf"^ *{constant or setting.upper()}(:.*)? = ", code, re.MULTILINE), setting


def test_a_plain_value_stands_for_the_field_that_matters(tmp_path: Path) -> None:
    localize = "localize: {matcher: mutual, features: [sift], predictor: simulated}"
    manifest = load_manifest(write(tmp_path, f"captures: [here]\n{localize}\n"), ["localize.matcher.checkpoint=/w.pt"])
    assert manifest.localize.matcher == MatcherSettings(name="mutual", checkpoint="/w.pt")
    assert manifest.localize.features.kinds == ["sift"]
    assert manifest.localize.predictor.name == "simulated"
    assert LocalizeSettings.of({"features": ("sift",)}).features.kinds == ["sift"]
    section = {"predictor": PredictorSettings(name="da3-small"), "map": MapSettings(tile_images=9)}
    assert LocalizeSettings.of({"predictor": {"batch_size": 3}}, section) == LocalizeSettings(
        predictor=PredictorSettings(name="da3-small", batch_size=3), map=MapSettings(tile_images=9)
    )


def test_switching_a_stage_on_keeps_its_settings(tmp_path: Path) -> None:
    path = write(tmp_path, "captures: [here]\nrerank: {topn: 40}\n")
    on = load_manifest(path, ["rerank=true"]).rerank
    assert on is not None
    assert on.topn == 40
    assert load_manifest(path, ["rerank=false"]).rerank is None
    back = load_manifest(path, ["rerank=false", "rerank=true"]).rerank
    assert back is not None


def test_an_empty_section_says_nothing(tmp_path: Path) -> None:
    path = write_files(
        tmp_path, mine="inherits: base.yaml\nlocalize:\n", base="captures: [a]\nlocalize: {method: nearest}"
    )
    assert load_manifest(path).localize.method == "nearest"


@pytest.mark.parametrize("layer", [[1], 3, "pnp"])
def test_settings_are_a_mapping(layer: object) -> None:
    with pytest.raises(ManifestError, match="LocalizeSettings"):
        LocalizeSettings.of(layer)  # type: ignore[arg-type]
