"""Inputs that the fuzzers once found, tried again; and, slow, a minute of fuzzing."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.fuzz.targets import TARGETS, found_inputs


@pytest.mark.parametrize(("target", "path"), list(found_inputs()), ids=lambda value: getattr(value, "name", value))
def test_what_was_found_is_mended(target: str, path: Path) -> None:
    TARGETS[target].check(path.read_bytes())


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_a_minute_of_fuzzing_finds_nothing(target: str, tmp_path: Path) -> None:
    if importlib.util.find_spec("atheris") is None:
        pytest.skip("needs atheris, for Linux and macOS: pip install --editable '.[fuzz]'")
    seconds = 60 // len(TARGETS)
    command = [sys.executable, "-m", "tests.fuzz", target, "--seconds", str(seconds), "--keep", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, cwd=REPOSITORY, check=False)
    inputs = {path.name: path.read_bytes() for path in tmp_path.glob(f"{target}-*")}
    assert done.returncode == 0, f"{inputs}\n{done.stderr.decode(errors='replace')[-4000:]}"
