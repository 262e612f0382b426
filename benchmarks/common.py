"""What several benchmarks do alike: cores, fresh processes, parts of captures, tables, results in files."""

import argparse
import json
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from toolkit.synthetic.capture import Device


def limit_cores(threads: int) -> None:
    """Keep this process and its children to so many cores, and say so to their libraries."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    os.environ["TQDM_DISABLE"] = "1"
    os.environ["KINETO_LOG_LEVEL"] = "99"  # torch's profiler announces itself


def in_own_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a function returns in a fresh process, so that memory and warm caches are its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def part_of_capture(capture: Path, mapped: str, asked: str, folder: Path) -> Path:
    """Return a capture of the same name with the map of one device and the queries of one, or of `all`, as links."""
    sessions = folder / capture.name / "sessions"
    sessions.mkdir(parents=True)
    for session in (capture / "sessions").iterdir():
        device, _, split = session.name.rpartition("_")
        if {"map": mapped, "query": asked}.get(split, "all") in ("all", device):
            (sessions / session.name).symlink_to(session)
    return sessions.parent


def scaled(device: "Device", scale: float) -> "Device":
    """Return a rendered device with pinhole cameras whose images have `scale` times the width and height."""
    sensors = (
        replace(
            sensor,
            size=(round(scale * sensor.size[0]), round(scale * sensor.size[1])),
            params=tuple(scale * param for param in sensor.params),
        )
        for sensor in device.sensors
    )
    return replace(device, sensors=tuple(sensors))


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """Return a markdown table with columns of even width."""
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    lines = [header, ["-" * width for width in widths], *rows]
    return "\n".join("| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in lines)


def add_out(parser: argparse.ArgumentParser) -> None:
    """Add the option --out, which takes the files that `write_out` writes."""
    parser.add_argument("--out", type=Path, action="append", default=[], help="write FILE.md or FILE.json; repeatable")


def check_out(parser: argparse.ArgumentParser, paths: list[Path]) -> None:
    """Refuse files of another kind, before anything is measured."""
    for path in paths:
        if path.suffix not in (".md", ".json"):
            parser.error(f"--out {path}: expected a name that ends in .md or .json.")


def write_out(paths: list[Path], text: str, document: dict[str, Any]) -> None:
    """Write the tables to each FILE.md, and all numbers to each FILE.json."""
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text if path.suffix == ".md" else json.dumps(document, indent=1) + "\n", encoding="utf-8")
