"""python -m benchmarks: list them.  python -m benchmarks NAME [ARGS]: run one.  all: run each that needs no folder."""

import ast
import subprocess
import sys
from pathlib import Path

NAMES = (
    "capture", "embed", "search", "index", "cluster", "matching", "vggt", "alignment", "localize", "latency",
    "confidence", "scale", "paper",
)  # fmt: skip
NEED_A_FOLDER = ("confidence", "paper")
SCRIPTS = {name: Path(__file__).with_name(f"{name}.py") for name in NAMES}


def main() -> int:
    name, arguments = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 1 else ("", [])
    if name != "all" and name not in SCRIPTS:
        print(f"{__doc__}\n")
        for known, script in SCRIPTS.items():
            described = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
            print(f"  {known:10s} {described.splitlines()[0]}")
        return int(name not in ("", "-h", "--help"))
    for chosen in [one for one in NAMES if one not in NEED_A_FOLDER] if name == "all" else [name]:
        print(f"== {chosen}", flush=True)
        if status := subprocess.run([sys.executable, SCRIPTS[chosen], *arguments], check=False).returncode:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
