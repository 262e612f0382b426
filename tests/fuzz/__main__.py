"""Fuzz the readers of files from elsewhere: `python -m tests.fuzz text --seconds 3600`; needs the extra `fuzz`.

A finding ends the run with an error and leaves its input in the folder of `--keep`. When it is mended, the input goes
to `tests/fuzz/found/<target>/`, where the default tests try it. Coverage guides within the code of the toolkit; native
libraries (Arrow, HDF5, COLMAP, torch) get the mutated files all the same.
"""

import argparse
import logging
import os
import shutil
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["toolkit"], enable_loader_override=False):
    from tests.fuzz.targets import TARGETS, workplace


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--corpus", type=Path, help="folder that keeps the inputs that reached new code")
    parser.add_argument("--keep", type=Path, default=Path.cwd(), help="folder for the input of a finding")
    asked = parser.parse_args()
    target = TARGETS[asked.target]
    corpus = asked.corpus or Path(tempfile.mkdtemp(prefix="corpus-"))
    corpus.mkdir(parents=True, exist_ok=True)
    asked.keep.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds()):
        (corpus / f"seed-{number:04}").write_bytes(seed)
    options = [
        f"-max_total_time={asked.seconds}", f"-artifact_prefix={asked.keep}/{asked.target}-", "-timeout=20",
        "-rss_limit_mb=4096", "-max_len=32768", "-print_final_stats=1", "-seed=1", "-report_slow_units=30",
    ]  # fmt: skip
    logging.disable()
    place = workplace()
    # libFuzzer ends by _exit, so that nothing of ours runs after it: a child does the work.
    child = os.fork()
    if child == 0:
        atheris.Setup([sys.argv[0], *options, str(corpus)], target.check)
        atheris.Fuzz()
        os._exit(0)
    _, status = os.waitpid(child, 0)
    shutil.rmtree(place, ignore_errors=True)
    if asked.corpus is None:
        shutil.rmtree(corpus, ignore_errors=True)
    sys.exit(os.waitstatus_to_exitcode(status) and 1)


if __name__ == "__main__":
    main()
