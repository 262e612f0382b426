"""Trace the way of an image from `Map.locate` to its pose: which functions of the toolkit it enters, and their lines.

    python benchmarks/way.py --run runs/demo [--scene demo] [--map ios] [--query ios] [--lines]

The map is open already, as for the second image of a session. A function counts with all of its lines, whether they run
or not, without its docstring and comments; functions within functions count once.
"""

import argparse
import ast
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType

import toolkit
from toolkit.pose.base import Query
from toolkit.scene import Map

ROOT = Path(toolkit.__file__).parent


def entered_by(call: Callable[[], object]) -> set[CodeType]:
    """Return the functions of the toolkit that a call enters, in this thread."""
    entered: set[CodeType] = set()

    def trace(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(str(ROOT)):
            entered.add(frame.f_code)

    sys.setprofile(trace)
    try:
        call()
    finally:
        sys.setprofile(None)
    return entered


def lines_of(path: Path, first_lines: set[int]) -> tuple[int, list[str]]:
    """Return the number of code lines of the functions that begin in these lines, and their names."""
    source = path.read_text(encoding="utf-8")
    text, kept, names = source.splitlines(), set[int](), list[str]()
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef):
            continue
        first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
        if first not in first_lines and node.lineno not in first_lines:
            continue
        names.append(node.name)
        body = node.body
        has_docstring = ast.get_docstring(node) is not None
        start = body[0].end_lineno + 1 if has_docstring and body[0].end_lineno else node.lineno
        head = range(first, body[0].lineno if has_docstring else start)
        rows = [*head, *range(start, (node.end_lineno or start) + 1)]
        kept |= {row for row in rows if text[row - 1].strip() and not text[row - 1].lstrip().startswith("#")}
    return len(kept), names


def way_of(scene_map: Map, query: Query) -> dict[str, tuple[int, list[str]]]:
    """Return the code lines and the functions that a query enters, by file of the toolkit."""
    of_files = defaultdict[str, set[int]](set)
    for code in entered_by(lambda: scene_map.locate(query)):
        of_files[str(Path(code.co_filename).relative_to(ROOT))].add(code.co_firstlineno)
    return {name: lines_of(ROOT / name, of_files[name]) for name in sorted(of_files)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", required=True)
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--map", default="ios")
    parser.add_argument("--query", default="ios")
    parser.add_argument("--lines", action="store_true", help="list the functions of each file")
    arguments = parser.parse_args()
    scene_map = Map.open(arguments.run, arguments.scene, arguments.map)
    session = scene_map.capture[f"{arguments.query}_query"]
    first, second = (rows for rows in session.rows_of_keyframes(session.keyframes("all"))[:2])
    scene_map.locate(scene_map.query_of_session(session, first))  # opens files, loads weights
    query = scene_map.query_of_session(session, second)
    way = way_of(scene_map, query)
    for name, (count, names) in way.items():
        listed = f": {', '.join(names)}" if arguments.lines else ""
        print(f"{count:5}  {name}{listed}")
    print(f"{sum(count for count, _ in way.values()):5}  lines in {len(way)} files")


if __name__ == "__main__":
    main()
