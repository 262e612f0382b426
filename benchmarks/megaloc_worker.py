"""The official MegaLoc on a job that embed.py writes: a plain loop that decodes, then forwards. Without the toolkit.

    python benchmarks/megaloc_worker.py OFFICIAL [JOB RESULT]

OFFICIAL is a checkout of gmberton/MegaLoc, JOB and RESULT are JSON files; without them, only the import is checked.
The network is the official file as it comes. torchvision is not needed: it only resizes images whose sides are no
multiple of 14, and a stand-in does that where it is absent.
"""

import importlib.util
import json
import os
import resource
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any


def clocks() -> tuple[float, float]:
    """Return the wall clock and the CPU seconds of all threads of this process."""
    return time.perf_counter(), time.process_time()


def peak_mb() -> float:
    """Return the most memory that this process has held, MB."""
    status = Path("/proc/self/status")
    if status.exists():  # what getrusage says may be that of the process that started this one
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    unit = 1024**2 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def peak_allocated_mb(run: Callable[[], Any]) -> float:
    """Return the most memory (MB) that a call holds on the CPU at once, above what was there before.

    Follows each allocation and release by torch, those inside of operators as well. The first call is not counted.
    """
    import torch

    run()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        run()
    return peak_bytes(profile) / 1e6


def peak_bytes(profile: Any) -> int:
    """Return the most bytes that torch held on the CPU at once in a profile, above what was there before."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        profile.export_chrome_trace(str(path))
        events = json.loads(path.read_text())["traceEvents"]
    changes = [event for event in events if event["name"] == "[memory]" and event["args"]["Device Type"] == 0]
    held = peak = 0
    for event in sorted(changes, key=lambda event: (event["ts"], event["args"]["Ev Idx"])):
        held += event["args"]["Bytes"]
        peak = max(peak, held)
    return peak


def import_official(checkout: str) -> Any:
    """Return the module of the official network; exits with a sentence where that is not possible."""
    path = Path(checkout) / "megaloc_model.py"
    if not path.is_file():
        sys.exit(f"No file {path}; expected a checkout of github.com/gmberton/MegaLoc.")
    if importlib.util.find_spec("torchvision") is None:
        functional: Any = types.ModuleType("torchvision.transforms.functional")
        functional.resize = _resize
        for name in ("torchvision", "torchvision.transforms"):
            sys.modules[name] = types.ModuleType(name)
        sys.modules["torchvision.transforms"].functional = functional  # type: ignore[attr-defined]
        sys.modules["torchvision.transforms.functional"] = functional
    spec = importlib.util.spec_from_file_location("megaloc_model", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except ImportError as error:
        sys.exit(f"{sys.executable} cannot import {path}: {error}.")
    return module


def load_official(checkout: str, weights: str, device: str) -> Any:
    """Return the official network with the weights of a safetensors file."""
    from safetensors.torch import load_file

    model = import_official(checkout).MegaLoc()
    model.load_state_dict(load_file(weights))
    return model.eval().to(device)


def read(path: str, size: int) -> Any:
    """Return an image (3, S, S), float32, ImageNet-normalized."""
    import numpy as np
    import torch
    from PIL import Image

    with Image.open(path) as image:
        square = image.convert("RGB").resize((size, size), Image.Resampling.BILINEAR)
    pixels = torch.from_numpy(np.array(square)).permute(2, 0, 1).float() / 255
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    return (pixels - mean[:, None, None]) / std[:, None, None]


def _resize(images: Any, size: list[int], antialias: bool = True) -> Any:
    import torch.nn.functional as F

    return F.interpolate(images, size, mode="bilinear", antialias=antialias)


def main() -> None:
    if len(sys.argv) == 1:
        print(__doc__)
        return
    if len(sys.argv) == 2:
        import_official(sys.argv[1])
        return
    import numpy as np
    import torch

    job, result = json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3])
    torch.set_num_threads(job["threads"])
    before = os.getloadavg()[0]
    start = time.perf_counter()
    model = load_official(sys.argv[1], job["weights"], job["device"])
    size, batch_size = job["image_size"], job["batch_size"]
    descriptors = []
    decode = 0.0
    with torch.inference_mode():
        model(torch.zeros(batch_size, 3, size, size, device=job["device"])).cpu()
        load_seconds = time.perf_counter() - start
        wall, cpu = clocks()
        for first in range(0, len(job["files"]), batch_size):
            began = time.perf_counter()
            batch = torch.stack([read(path, size) for path in job["files"][first : first + batch_size]])
            decode += time.perf_counter() - began
            descriptors.append(model(batch.to(job["device"])).cpu().numpy())
        np.save(job["out"], np.concatenate(descriptors))
    ended = clocks()
    report = {
        "images": len(job["files"]),
        "seconds": ended[0] - wall,
        "cpu": ended[1] - cpu,
        "decode": decode,
        "load_seconds": load_seconds,
        "peak_mb": peak_mb(),
        "load": [before, os.getloadavg()[0]],
    }
    result.write_text(json.dumps(report))


if __name__ == "__main__":
    main()
