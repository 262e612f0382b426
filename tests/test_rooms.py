"""Imports point down: what stands on what in `toolkit/`. CONTRIBUTING draws the same picture."""

import ast
import shutil
import subprocess
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

TOOLKIT = Path(__file__).resolve().parents[1] / "toolkit"
STAGES = ("embed", "retrieve", "rerank", "localize", "sequence", "evaluate", "visualize")
# From the ground up. A row may import from the rows above it, and within a name; not from its neighbors in the row.
LEVELS: list[tuple[str, ...]] = [
    ("__init__",),
    ("errors",),
    ("files", "geometry", "threads"),
    ("capture",),
    ("models",),
    ("manifest",),
    ("runs",),
    ("store",),
    ("features",),
    ("embedders",),
    ("alignment",),
    ("mapping",),
    ("pose",),
    ("prediction",),
    ("results",),
    ("sequences",),
    ("figures",),
    ("viewer", "report"),
    ("scene",),
    ("exchange", "synthetic"),
    ("datasets",),
    STAGES,
    ("notebook",),
    ("pipeline",),
    ("__main__",),
]
LEVEL = {name: level for level, names in enumerate(LEVELS) for name in names}


def module_name(path: Path) -> str:
    parts = path.relative_to(TOOLKIT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {module_name(path): path for path in sorted(TOOLKIT.rglob("*.py"))}


@cache
def imports_of(path: Path) -> set[str]:
    """Return the modules of the toolkit that a file imports anywhere, at the top or inside a function."""
    imported: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            first, _, rest = name.partition(".")
            if first != "toolkit":
                continue
            while rest and rest not in MODULES:
                rest = rest.rpartition(".")[0]
            imported.add(rest or "__init__")
    return imported


def room(module: str) -> str:
    return module.partition(".")[0]


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_down(module: str) -> None:
    assert room(module) in LEVEL, f"{module}: tell in LEVELS where it stands"
    for other in imports_of(MODULES[module]):
        below = LEVEL[room(other)] < LEVEL[room(module)]
        assert below or room(other) == room(module), f"toolkit.{module} imports toolkit.{other}, which stands above it"


def test_no_module_imports_itself_through_others() -> None:
    graph = {module: imports_of(path) - {module} for module, path in MODULES.items()}
    # A room's face imports its modules, so a module of the room that imports the face is a circle too.
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for other in graph[module]:
                visit(other, (*way, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def test_the_top_level_is_a_table_of_contents() -> None:
    files = {path.stem for path in TOOLKIT.glob("*.py")} - {"__init__"}
    assert files == {"__main__", "pipeline", "notebook", *STAGES, "geometry", "files", "threads", "errors"}


def test_no_room_is_large() -> None:
    """At most 12 % of the lines each, so that a newcomer can read the one that a change is in."""
    lines = Counter[str]()
    for path in MODULES.values():
        lines[path.relative_to(TOOLKIT).parts[0]] += len(path.read_text(encoding="utf-8").splitlines())
    shares = {name: count / lines.total() for name, count in lines.items()}
    assert {name: f"{share:.1%}" for name, share in shares.items() if share > 0.12} == {}


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_each_test_is_of_one_kind() -> None:
    """Of `make test-numbers`, `-faults` and `-notebooks`; those for a browser or a GPU have targets of their own."""
    ask = ["make", "-n", "test-numbers", "test-faults", "test-notebooks"]
    said = subprocess.run(ask, cwd=TOOLKIT.parent, capture_output=True, text=True, check=True).stdout
    named = [word.removeprefix("tests/") for word in said.split() if word.startswith("tests/")]
    places = {
        path.name for path in (TOOLKIT.parent / "tests").iterdir()
        if path.name.startswith("test_") or (path.is_dir() and any(path.glob("test_*.py")))
    }  # fmt: skip
    assert sorted(named) == sorted(places - {"browser", "gpu"})
