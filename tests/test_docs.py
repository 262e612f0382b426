"""The documentation: its links, commands and examples, and its pictures, as far as they need no browser."""

import io
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import typer
import yaml
from PIL import Image

import toolkit
from docs import chromium, make_images, site_hooks
from tests.rendered import copy_shared
from tests.test_rooms import LEVELS
from toolkit.__main__ import app
from toolkit.embed import embed_sessions
from toolkit.files import SceneFiles
from toolkit.geometry import pose_error
from toolkit.localize import localize_pairs
from toolkit.manifest import STAGES, Manifest, load_manifest
from toolkit.manifest.settings import nested_model
from toolkit.notebook import notebook_parameters
from toolkit.retrieve import retrieve_pairs

ROOT = Path(__file__).resolve().parents[1]


def png(pixels: np.ndarray) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(stream, "PNG")
    return stream.getvalue()


def test_an_empty_viewer_is_no_scene() -> None:
    flat = np.full((200, 300, 3), 20)
    panels = flat.copy()
    panels[:, 100:] = 40
    panels[50:60, ::7] = 230  # text
    grays = np.broadcast_to(np.arange(300)[None, :, None] % 256, (200, 300, 3))
    for empty in (flat, panels, grays):
        assert not chromium.is_scene(png(empty))
    speck = flat.copy()
    speck[:30, :30] = np.random.default_rng(0).integers(0, 256, (30, 30, 3))
    assert not chromium.is_scene(png(speck)), "many colors, on 1.5 % of the pixels"


def test_points_and_pictures_are_a_scene() -> None:
    rng = np.random.default_rng(0)
    scene = np.full((200, 300, 3), 20)
    scene[rng.random((200, 300)) < 0.2] = [200, 120, 40]
    scene[100:, 150:] = rng.integers(0, 256, (100, 150, 3))
    assert chromium.is_scene(png(scene))


def test_colors_counts_and_shares() -> None:
    pixels = np.zeros((10, 10, 3))
    pixels[:2] = [255, 0, 0]
    pixels[2] = [250, 5, 3]  # the same to 16 steps a channel
    assert chromium.colors(png(pixels)) == (2, pytest.approx(0.3))


def test_a_copied_notebook_works_on_the_run(tmp_path: Path) -> None:
    results = tmp_path / "run" / "PLACE" / "visualization"
    results.mkdir(parents=True)
    (results / "a.png").touch()
    name = chromium.copy_notebook("visualize", tmp_path / "run", tmp_path / "PLACE" / "sessions", tmp_path / "copies")
    parameters = notebook_parameters(tmp_path / "copies" / name)
    assert parameters["sessions_root"] == str(tmp_path / "PLACE" / "sessions")
    assert parameters["poses_dir"] == str(tmp_path / "run" / "PLACE" / "poses")
    assert parameters["out_dir"] == str(tmp_path / "copies" / "results")
    assert (tmp_path / "copies" / "results" / "a.png").is_file()
    assert parameters["map_device"] == "all"


def test_what_is_missing_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert chromium.find_chromium() is None
    assert "make browser-setup" in chromium.why_missing()
    monkeypatch.setenv("CHROMIUM", "/opt/browser")
    assert chromium.find_chromium() == "/opt/browser"


def test_pictures_are_made_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make_images, "ROOT", tmp_path)
    smooth = np.linspace(0, 255, 400 * 300 * 3).reshape(300, 400, 3)
    monkeypatch.setattr(make_images, "LARGEST", 20_000)
    make_images.save(png(smooth), tmp_path / "images" / "a.png")
    assert (tmp_path / "images" / "a.png").stat().st_size <= 20_000
    assert Image.open(tmp_path / "images" / "a.png").size == (400, 300)
    make_images.save(png(smooth), tmp_path / "images" / "a.webp")
    written = Image.open(tmp_path / "images" / "a.webp")
    assert (written.format, written.size) == ("WEBP", (400, 300))
    assert np.abs(np.asarray(written, float) - smooth).mean() < 3, "no palette"


def is_animated(picture: Path) -> bool:
    with Image.open(picture) as opened:
        return getattr(opened, "n_frames", 1) > 1


def test_pictures_are_small() -> None:
    pictures = {target for _, target in links() if target.suffix in (".png", ".webp")}
    assert len(pictures) == 7
    assert all(picture.stat().st_size <= 300_000 for picture in pictures if not is_animated(picture))
    assert all(picture.stat().st_size <= 700_000 for picture in pictures)


def test_pages_with_photographs_of_others_link_to_their_license() -> None:
    shown: dict[Path, set[str]] = {}
    for page, target in links():
        shown.setdefault(page, set()).add(target.name)
    pages = [names for names in shown.values() if names & {"street.webp", "viewer.webp"}]
    assert len(pages) == 2
    assert all("LICENSE.txt" in names for names in pages)
    assert "Copyright (c) 2014, mapillary" in (make_images.IMAGES / "LICENSE.txt").read_text()


# Pages


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "benchmarks" / "README.md"]
PAGES += sorted((ROOT / "docs").rglob("*.md"))


def links() -> list[tuple[Path, Path]]:
    """Return the page and the target of each link to a file of the repository; checks anchors."""
    found = []
    for page in PAGES:
        for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
            if re.match(r"https?://|mailto:", link):
                continue
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            assert target.exists(), f"{page.name} links to {link}"
            headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE) if anchor else []
            anchors = [re.sub(r"[^a-z0-9 -]", "", heading.lower()).replace(" ", "-") for heading in headings]
            assert not anchor or anchor in anchors, f"{page.name} links to {link}; headings: {anchors}"
            found.append((page, target))
    return found


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page whose info string is `language`."""
    return re.findall(rf"^ *```{language}\n(.*?)^ *```$", page.read_text(), re.MULTILINE | re.DOTALL)


def commands_of(page: Path) -> list[str]:
    """Return the commands of a page without comments, one line each."""
    lines = "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := re.sub(r"(^|\s)#.*", "", line).strip())]


def test_the_readme_is_one_page_and_leads_to_the_others() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 80
    assert ROOT / "docs" / "index.md" in [target for page, target in links() if page == PAGES[0]]


def test_the_site_has_each_page_once() -> None:
    """As the strict build wants it, here without MkDocs."""
    lines = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2].splitlines()
    listed = [line.rpartition(": ")[2] for line in lines if line.endswith(".md")]
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert sorted(listed) == sorted([*pages, *site_hooks.ELSEWHERE])
    assert all((ROOT / source).is_file() for source in site_hooks.ELSEWHERE.values())


def test_links_between_pages_of_the_site_and_of_the_repository() -> None:
    def link(page: str, target: str) -> str:
        return site_hooks.site_link(page, "text", target)

    assert link("results.md", "../benchmarks/README.md#indexpy") == "[text](benchmarks.md#indexpy)"
    assert link("benchmarks.md", "../docs/results.md") == "[text](results.md)"
    assert link("how/embed.md", "../learned-models.md#megaloc") == "[text](../learned-models.md#megaloc)"
    assert link("how/embed.md", "images/embed.svg") == "[text](images/embed.svg)"
    assert link("contributing.md", "docs/images/report.png") == "[text](images/report.png)"
    assert link("index.md", "../data_manifests/demo.yaml") == "text", "the site has no such page"
    assert link("index.md", "https://example.org/a.md#b") == "[text](https://example.org/a.md#b)"
    assert link("index.md", "#results") == "[text](#results)"


def test_lists_stand_apart_from_paragraphs() -> None:
    assert site_hooks.apart("Why?\n1. One\n2. Two\n") == "Why?\n\n1. One\n2. Two\n"
    assert site_hooks.apart("So:\n- one\n  more\n- two\n") == "So:\n\n- one\n  more\n- two\n"
    for same in ("A line\nand a - sign\n", "So:\n\n- one\n- two\n", "1. one\n   more\n2. two\n", "| a |\n|---|\n"):
        assert site_hooks.apart(same) == same


def test_options_stay_in_one_line() -> None:
    def kept(option: str) -> str:
        return f'<span class="option">{option}</span>'

    assert site_hooks.on_page_content("<code>a --hold-out 8</code>") == f"<code>a {kept('--hold-out')} 8</code>"
    block = '<code><a id="x--y-1"></a>python<span class="w"> </span>-m<span class="w"> </span>toolkit a-b\n--x</code>'
    expected = block.replace("-m<", f"{kept('-m')}<").replace("\n--x", f"\n{kept('--x')}")
    assert site_hooks.on_page_content(block) == expected
    assert site_hooks.on_page_content("<p>--x</p>") == "<p>--x</p>"


def test_long_names_in_tables_are_broken_between_their_parts() -> None:
    link = '<a href="a/b.html#c_d"><code>cam_from_world</code></a>'
    cell = f"<td><code>data/7scenes.txt</code>, {link}, <code>0.3 deg, a_b</code></td>"
    assert site_hooks.on_page_content(f"<p>{link}</p>") == f"<p>{link}</p>"
    expected = cell.replace("7scenes.", "7scenes.<wbr>").replace("cam_from_", "cam_<wbr>from_<wbr>")
    assert site_hooks.on_page_content(cell) == expected.replace("a_b<", "a_<wbr>b<")


def test_the_page_of_settings_has_all_of_them() -> None:
    assert site_hooks.SETTINGS in (ROOT / "docs" / "settings.md").read_text()
    rows = [line for line in site_hooks.settings_tables() if line.startswith("| `")]
    named = [re.findall(r"^\| `([\w.]+)` \| (.*?) \|", row)[0] for row in rows]
    assert ("localize.pnp.min_inliers", "`12`") in named
    assert ("rerank.topk", "`10`") in named
    assert ("localize.map", "see below") in named
    expected = {f"{stage}.{key}" for stage in STAGES for key in keys_of(type(Manifest.defaults(stage)))}
    assert expected <= {name for name, _ in named}
    assert len(named) == len({name for name, _ in named})
    text = "\n".join(site_hooks.settings_tables())
    assert "its sessions are `<key>_map` and `<key>_query`" in text, "Markdown shows &lt; in code as it stands"
    assert "cuda:&lt;number> or mps" in text
    assert not re.search("^ ", text, re.MULTILINE), "an indented paragraph is a block of code"


def test_what_a_page_fetches_from_elsewhere_is_found() -> None:
    here = '''<link rel="canonical" href="https://a.org/"><a href="https://b.org/c.png">c</a><img src="d.png">
        <script src="assets/e.js"></script><style>p { background: url(f.svg) }</style>'''
    assert site_hooks.fetched_from_elsewhere(here) == []
    for there in (
        '<script src="https://cdn.org/a.js"></script>',
        '<link rel="stylesheet" href="//fonts.org/a.css">',
        '<link rel="preconnect" href="https://fonts.org">',
        '<img srcset="a.png, https://b.org/c.png 2x">',
        '<svg><image xlink:href="http://b.org/c.png"/></svg>',
        "@import 'https://a.org/b.css';",
        "p { background: url( 'https://a.org/b.png') }",
    ):
        assert len(site_hooks.fetched_from_elsewhere(there)) == 1, there


def test_formulas_are_mathml() -> None:
    pytest.importorskip("latex2mathml", reason="latex2mathml is missing: run `make docs-setup`")
    text = site_hooks.formula("\\mathbf{x} = \\frac{a}{b}\n")
    assert text.count("<math") == 1
    fraction = ElementTree.fromstring(text).find(".//{*}mfrac")
    assert fraction is not None
    assert ["".join(part.itertext()) for part in fraction] == ["a", "b"]


def test_the_citation_is_complete() -> None:
    """What the Citation File Format 1.2.0 asks for, and the version that is installed."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert citation["version"] == toolkit.__version__
    assert citation["license"] == "Apache-2.0"
    assert citation["message"]
    assert citation["title"] == "visual-localization"
    assert all(author.get("name") or author.get("family-names") for author in citation["authors"])


def test_commands_exist_with_their_options() -> None:
    """Each `visloc` or `python -m toolkit` command of the pages is parsed by the command line, without files."""
    main = typer.main.get_command(app)
    lines = [line for page in PAGES for line in commands_of(page)]
    lines = [re.sub(r"^(.*-m )?(toolkit|visloc) ", "toolkit ", line) for line in lines]
    calls = [shlex.split(line, comments=True) for line in lines if line.startswith("toolkit ")]
    assert len(calls) > 20
    for call in calls:
        command, words = main, call[call.index("toolkit") + 1 :]
        while commands := getattr(command, "commands", None):  # a group; newer versions of typer have their own class
            assert words[0] in commands, call
            command, words = commands[words[0]], words[1:]
        command.make_context(command.name, words)  # raises for unknown options and missing arguments


def test_settings_of_the_pages_exist() -> None:
    """Each `--set` of the pages, and each setting that the text names, is a setting of the manifest."""
    text = "\n".join(page.read_text() for page in PAGES if page.name != "CHANGELOG.md")
    overrides = re.findall(r"--set '?([^\s'`]+=(?:\[[^]]*\]|[^\s'`<]+))", text)  # not `embed.model=<name>`
    assert len(overrides) > 5
    for override in overrides:
        load_manifest(ROOT / "data_manifests" / "demo.yaml", [override])
    known: set[str] = set()
    for stage in STAGES:
        model = nested_model(Manifest.model_fields[stage].annotation)
        known |= {f"{stage}.{key}" for key in keys_of(model)}
    named = re.findall(rf"`((?:{'|'.join(STAGES)})\.(?!py`)[a-z_.]+)", text)
    assert len(named) > 10
    assert {*named} <= known


def keys_of(model: Any) -> Iterator[str]:
    """Yield the settings of a section, and those of its own sections as `<section>.<setting>`."""
    for name, field in model.model_fields.items():
        yield name
        if inner := nested_model(field.annotation):
            yield from (f"{name}.{key}" for key in keys_of(inner))


def test_contributing_draws_the_rooms_and_names_files_that_are_there() -> None:
    page = ROOT / "CONTRIBUTING.md"
    drawn = [tuple(line.split()) for line in blocks(page, "text")[1].splitlines()]
    assert drawn == [level for level in LEVELS[::-1] if level != ("__init__",)]
    table = re.findall(r"^\| `(\w+)/` \|", page.read_text(), re.MULTILINE)
    assert {*table} == {path.parent.name for path in (ROOT / "toolkit").glob("*/__init__.py")}
    for name in re.findall(r"`([\w/.]+(?:/|\.py))`", page.read_text()):
        assert (ROOT / name).exists() or (ROOT / "toolkit" / name).exists(), name


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python.*")], ids=lambda page: page.name)
def test_python_examples_compile(page: Path) -> None:
    for block in blocks(page, "python.*"):
        compile(block, page.name, "exec")


@pytest.mark.slow
def test_python_examples_run(
    small_capture: Path, small_features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The examples of docs/api.md on the small capture, in their order; those that need weights are marked."""
    (tmp_path / "data").mkdir()
    sessions = Path(shutil.copytree(small_capture, tmp_path / "data" / "demo")) / "sessions"
    files = SceneFiles(tmp_path / "runs" / "demo", "demo")
    copy_shared(small_features, files.features)
    embed_sessions(sessions, files.embeddings, device="ios", features_dir=files.features)
    retrieve_pairs(sessions, files.embeddings, files.retrieval_dir, map_device="ios", query_device="ios")
    where = (files.retrieval_dir, files.poses_dir, files.features, files.maps)
    localize_pairs(sessions, *where, map_device="ios", query_device="ios")
    (files.run / "run.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in (*blocks(ROOT / "README.md", "python"), *blocks(ROOT / "docs" / "api.md", "python")):
        exec(compile(block, "README.md, docs/api.md", "exec"), names)
    assert names["estimate"].status == "ok"
    errors = pose_error(names["estimate"].world_from_rig, names["world_from_cam"][0])
    assert max(errors) < 0.1
    [keyframe] = names["query_keyframe"].to_dict("records")
    true = names["rig"].ground_truth.lookup([keyframe["timestamp"]], [keyframe["device_id"]])[0]
    assert max(pose_error(names["estimate_of_rig"].world_from_rig, true)) < 0.1
    assert names["stored"].correspondences.agrees.sum() > 20
    assert names["alignment"].world_from_model.scale == pytest.approx(10)
    np.testing.assert_allclose(names["world_from_query"], names["world_from_cams"][3], atol=1e-6)
    assert names["scores"].shape == (2, 3)
    assert len(names["matches"].indices) > 20
    assert np.median(names["translation_m"]) < 0.05


# Faults


def test_every_fault_of_the_page_has_a_test_that_exists() -> None:
    text = (ROOT / "docs" / "reliability.md").read_text().partition("## Artifacts that belong together")[0]
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    faults = [row for row in ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines) if row[0] != "fault"]
    assert len(faults) >= 40
    assert len({row[0] for row in faults}) == len(faults), "a fault is one row"
    for row in faults:
        assert len(row) in (3, 4), row  # imports have a column more: before
        assert all(row), row
        named = re.findall(r"`([\w/]+\.py)::(\w+)`", row[-1])
        assert named, row
        for file, name in named:
            source = ROOT / "tests" / file
            assert source.is_file(), f"{row[0]}: no file tests/{file}"
            assert re.search(rf"^def {name}\(", source.read_text(), re.MULTILINE), f"{row[0]}: {file} has no {name}"
