"""The official VGGT on a job that vggt.py writes: its forward as it comes. Without the toolkit.

    python benchmarks/vggt_worker.py OFFICIAL [JOB RESULT]

OFFICIAL is a checkout of facebookresearch/vggt, JOB and RESULT are JSON files; without them, only the import is
checked. The job says which heads run, of camera, depth and points. The track head is not built, as it runs only when
asked for points to follow; what it alone imports (einops) is not needed.
"""

import gc
import json
import os
import sys
import types
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from megaloc_worker import clocks, peak_bytes

HEADS = ("camera", "depth", "point")
OUTPUTS = ("pose_enc", "depth", "world_points")
"""That are compared, where their heads run."""


def measure(run: Callable[[], Any], device: str) -> tuple[Any, dict[str, float]]:
    """Run once; return what it returns, and its seconds and `peak_mb`: the most memory it holds above what was there.

    On the CPU each allocation and release by torch is followed, those inside of operators as well; this costs some
    microseconds an operator.
    """
    import torch

    gc.collect()
    if device.startswith("cuda"):
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        wall, cpu = clocks()
        result = run()
        torch.cuda.synchronize()
        ended = clocks()
        peak = torch.cuda.max_memory_allocated() - before
    else:
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
            wall, cpu = clocks()
            result = run()
            ended = clocks()
        peak = peak_bytes(profile)
    return result, {"seconds": ended[0] - wall, "cpu": ended[1] - cpu, "peak_mb": peak / 1e6}


def import_official(checkout: str) -> Any:
    """Return the class of the official network; exits with a sentence where that is not possible."""
    if not (Path(checkout) / "vggt/models/vggt.py").is_file():
        sys.exit(f"No file {Path(checkout) / 'vggt/models/vggt.py'}; expected a checkout of facebookresearch/vggt.")
    track: Any = types.ModuleType("vggt.heads.track_head")
    track.TrackHead = None
    sys.modules["vggt.heads.track_head"] = track
    sys.path.insert(0, checkout)
    # This script's folder has a vggt.py of its own, which would be found first by its name.
    own = str(Path(__file__).resolve().parent)
    sys.path[:] = [path for path in sys.path if path != own]
    try:
        from vggt.models.vggt import VGGT
    except ImportError as error:
        sys.exit(f"{sys.executable} cannot import the official VGGT in {checkout}: {error}.")
    return VGGT


def load_official(checkout: str, weights: str, device: str, heads: Sequence[str] = HEADS) -> Any:
    """Return the official network with the weights of a safetensors file, float32, and these heads."""
    import torch
    from safetensors.torch import load_file
    from torch.nn import init

    official = import_official(checkout)
    # What the constructor draws at random is replaced at once; drawing a billion numbers takes a minute.
    drawn = {name: getattr(init, name) for name in ("trunc_normal_", "normal_", "kaiming_uniform_", "uniform_")}
    for name in drawn:
        setattr(init, name, lambda tensor, *_, **__: tensor)
    enabled = {f"enable_{head}": head in heads for head in (*HEADS, "track")}
    model = official(**enabled)
    for name, function in drawn.items():
        setattr(init, name, function)
    left_out = tuple(f"{head}_head." for head in (*HEADS, "track") if head not in heads)
    state = {key: value for key, value in load_file(weights).items() if not key.startswith(left_out)}
    model.load_state_dict(state, strict=True, assign=True)
    return model.eval().requires_grad_(False).to(torch.device(device))


def autocast(device: str, precision: str) -> AbstractContextManager[Any]:
    """Return the context in which the official code runs in a precision: as its README does, heads in float32."""
    import torch

    if precision == "float32":
        return nullcontext()
    return torch.autocast(torch.device(device).type, torch.bfloat16)


def main() -> None:
    if len(sys.argv) == 1:
        print(__doc__)
        return
    if len(sys.argv) == 2:
        import_official(sys.argv[1])
        return
    import torch

    job, result = json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3])
    torch.set_num_threads(job["threads"])
    device, precision = job["device"], job["precision"]
    model = load_official(sys.argv[1], job["weights"], device, job["heads"])
    before = os.getloadavg()[0]
    images = torch.load(job["images"]).to(device)
    with torch.inference_mode():
        for warm in (images[..., :28, :28], images)[: 1 + device.startswith("cuda")]:
            with autocast(device, precision):
                model(warm)

        def run() -> Any:
            # The heads turn autocast off for CUDA alone: on a CPU it would reach into them.
            with autocast(device, precision):
                output = model(images)
            return {name: output[name].float().cpu() for name in OUTPUTS if name in output}

        found = [measure(run, device) for _ in range(job["repeat"])]
    output, best = min(found, key=lambda one: one[1]["seconds"])
    torch.save(output, job["out"])
    result.write_text(json.dumps(best | {"precision": precision, "load": [before, os.getloadavg()[0]]}))


if __name__ == "__main__":
    main()
