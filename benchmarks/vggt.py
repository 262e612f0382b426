"""VGGT on a query and its references: seconds and memory, beside the official forward.

    python benchmarks/vggt.py [--official CHECKOUT] [--checkpoint FILE] [--views 6] [--size 294x518] [--threads 2]

On equal terms, both compute all encodings and the same heads: the camera head alone, and those of camera, depth and
points, as the official forward has them. A last row keeps encodings, as localization does: one new query is encoded,
its references' encodings are from earlier queries, and the camera head alone runs (in localization, that of depth,
too). Both get the same images and weights on the same cores, one right after the other, each in a process of its own;
the difference between their outputs shows that they did the same work. The official code runs in float32 on a CPU. Wall
seconds mean little while others use the machine; CPU seconds mean more. Peak memory is what is held at most above the
weights and the input. Without a checkpoint, weights are random (4.4 GB in the folder for temporary files).
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

from common import add_out, check_out, in_own_process, limit_cores, markdown_table, write_out
from embed import describe_machine
from vggt_worker import HEADS, OUTPUTS, measure

WORKER = Path(__file__).with_name("vggt_worker.py")
GPU_VIEWS = (6, 11)
GPU_BATCHES = (1, 8)


def write_images(path: Path, batch: int, views: int, size: tuple[int, int]) -> None:
    """Write smooth random images (batch, views, 3, H, W) in [0, 1], all different."""
    import torch
    import torch.nn.functional as F

    coarse = torch.rand(batch * views, 3, 12, 16, generator=torch.Generator().manual_seed(0))
    fine = F.interpolate(coarse, size, mode="bicubic").clamp(0, 1)
    torch.save(fine.unflatten(0, (batch, views)), path)


def write_random_weights(path: Path) -> None:
    """Write weights of the official names and shapes, of the heads that are compared, that keep activations finite."""
    import torch
    from safetensors.torch import save_file

    from toolkit.models.vggt import VGGT

    with torch.device("meta"):
        shapes = {name: tensor.shape for name, tensor in VGGT().state_dict().items()}
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in shapes.items():
        if name.endswith("gamma"):
            state[name] = torch.full(shape, 0.03)
        elif "norm" in name and name.endswith("weight"):
            state[name] = torch.ones(shape)
        elif name.endswith("bias"):
            state[name] = torch.zeros(shape)
        else:
            fan_in = shape[1:].numel() if name.endswith("weight") else 100
            state[name] = torch.randn(shape, generator=generator) / fan_in**0.5
    # Four steps add up to about w = 1 of the quaternion (x, y, z, w) and fields of view of 1 rad.
    state["camera_head.pose_branch.fc2.weight"] *= 0.1
    state["camera_head.pose_branch.fc2.bias"][6:] = 0.25
    save_file(state, path)


def run_toolkit(job: dict[str, Any]) -> dict[str, Any]:
    """Predict in this process, which should be a fresh one: `measure`, precision, load; writes the outputs."""
    import torch

    from toolkit.models.compute import resolve_precision
    from toolkit.models.vggt import VGGT

    torch.set_num_threads(job["threads"])
    device = torch.device(job["device"])
    dtype = resolve_precision(job["precision"], device)
    model = VGGT.from_checkpoint(job["weights"], heads=job["heads"], compute_dtype=dtype).to(device)
    before = os.getloadavg()[0]
    images = torch.load(job["images"]).to(device)
    with torch.inference_mode():
        kept = torch.stack([model.encode(group[1:]) for group in images]) if job["kept"] else None

        def run() -> Any:
            tokens = None
            if kept is not None:
                tokens = torch.cat([model.encode(images[:, 0])[:, None], kept], dim=1)
            output = model(images, patch_tokens=tokens)
            return {name: output[name].cpu() for name in OUTPUTS if name in output}

        model(images[..., :28, :28])
        if device.type == "cuda":
            run()
        found = [measure(run, job["device"]) for _ in range(job["repeat"])]
    output, best = min(found, key=lambda one: one[1]["seconds"])
    torch.save(output, job["out"])
    precision = str(dtype).removeprefix("torch.")
    return best | {"precision": precision, "load": [before, os.getloadavg()[0]]}


def run_official(checkout: str, job: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Run the official forward in a process of its own: `measure`, precision, load; writes its outputs."""
    files = [folder / "job.json", folder / "result.json"]
    files[0].write_text(json.dumps(job))
    if subprocess.run([sys.executable, WORKER, checkout, *files], check=False).returncode:
        sys.exit("The official code failed; see above.")
    result: dict[str, Any] = json.loads(files[1].read_text())
    return result


def compare(
    checkout: str, job: dict[str, Any], precisions: list[str], official: str, folder: Path
) -> list[dict[str, Any]]:
    """Return rows of each set of heads: the official forward, if there is a checkout, and each precision of ours."""
    import torch

    rows = []
    for title, heads in (("all heads", HEADS), ("camera head", HEADS[:1])):
        base = None
        if checkout:
            theirs = job | {"out": str(folder / "official.pt"), "precision": official, "heads": heads}
            base = {"name": f"official, {title}", **run_official(checkout, theirs, folder)}
            rows.append(base)
            print(f"{base['name']} {base['seconds']:.3f} s", file=sys.stderr)
        for precision, kept in product(precisions, (False, True) if heads == HEADS[:1] else (False,)):
            ours = job | {"out": str(folder / "toolkit.pt"), "precision": precision, "heads": heads, "kept": kept}
            name = f"toolkit, {title}{', references kept' if kept else ''}"
            row = {"name": name, **in_own_process(run_toolkit, ours)}
            print(f"{name}, {precision} {row['seconds']:.3f} s", file=sys.stderr)
            if base:
                found, expected = torch.load(ours["out"]), torch.load(folder / "official.pt")
                row["relative_difference"] = max(
                    float((found[output] - expected[output]).norm() / expected[output].norm()) for output in expected
                )
                for measured in ("seconds", "cpu", "peak_mb"):
                    row[f"{measured}_ratio"] = row[measured] / base[measured]
            rows.append(row)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows of one comparison as a markdown table."""
    columns = {
        "s": ("seconds", "{:.2f}"),
        "ratio": ("seconds_ratio", "{:.2f}"),
        "CPU s": ("cpu", "{:.1f}"),
        "CPU ratio": ("cpu_ratio", "{:.2f}"),
        "peak MB": ("peak_mb", "{:.0f}"),
        "peak ratio": ("peak_mb_ratio", "{:.2f}"),
        "largest relative difference": ("relative_difference", "{:.1e}"),
    }
    lines = []
    for row in rows:
        shown = [form.format(row[key]) if key in row else "–" for key, form in columns.values()]
        lines.append([f"{row['name']}, {row['precision']}", *shown])
    return markdown_table(["", *columns], lines)


def benchmark(options: argparse.Namespace, checkout: str) -> tuple[str, dict[str, Any]]:
    """Measure what was asked; returns the tables, and all numbers."""
    machine = in_own_process(describe_machine, options.threads, options.device)
    precisions = list(dict.fromkeys(options.precision or ["float32", machine["auto"]]))
    height, width = options.size
    document: dict[str, Any] = {"machine": machine, "threads": options.threads, "size": [height, width], "rows": []}
    weights = f"weights of {options.checkpoint.name}" if options.checkpoint else "random weights"
    text = [f"{width} x {height} images, {weights}, {machine['device']} ({machine['gpu'] or machine['cpu']}), "
            f"{options.threads} threads, torch {machine['torch']}."]  # fmt: skip
    on_gpu = machine["device"].startswith("cuda")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        checkpoint = options.checkpoint.resolve() if options.checkpoint else folder / "model.safetensors"
        if not options.checkpoint:
            in_own_process(write_random_weights, checkpoint)
        for views in (options.views,) if options.views or not on_gpu else GPU_VIEWS:
            for batch in GPU_BATCHES if on_gpu else (1,):
                count = views or 6
                write_images(folder / "images.pt", batch, count, options.size)
                job = {"weights": str(checkpoint), "images": str(folder / "images.pt"), "threads": options.threads}
                job |= {"device": machine["device"], "repeat": options.repeat}
                official = "bfloat16" if on_gpu else "float32"
                rows = compare(checkout, job, ["bfloat16"] if on_gpu else precisions, official, folder)
                document["rows"].append({"views": count, "batch": batch, "rows": rows})
                text += ["", f"A query and {count - 1} references, {batch} at a time:", "", table(rows)]
                if on_gpu:
                    rates = [
                        f"{row['name']} {batch / row['seconds']:.2f} queries/s, "
                        f"{1000 * row['seconds'] / batch:.1f} ms a query"
                        for row in rows
                    ]
                    text += ["", "; ".join(rates) + "."]
    return "\n".join(text) + "\n", document


def _size(text: str) -> tuple[int, int]:
    height, width = (int(part) for part in text.split("x"))
    if min(height, width) < 28 or height % 14 or width % 14:
        raise ValueError
    return height, width


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--official", help="checkout of facebookresearch/vggt, to run the official code too")
    parser.add_argument("--checkpoint", type=Path, help="official weights as .safetensors; default: random ones")
    parser.add_argument("--views", type=int, help="a query and its references (default: 6; on a GPU 6, and 11)")
    parser.add_argument("--size", type=_size, default=(294, 518), help="HxW, multiples of 14 (default: 294x518)")
    parser.add_argument("--threads", type=int, default=2, help="cores for each (default: %(default)s)")
    precision_help = "of the toolkit on a CPU; repeatable; default: float32, and what auto is"
    parser.add_argument("--precision", action="append", choices=("auto", "float32", "bfloat16"), help=precision_help)
    parser.add_argument("--device", default="auto", help="compute_device (default: %(default)s)")
    parser.add_argument("--repeat", type=int, default=1, help="runs; the fastest counts")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    if min(options.threads, options.repeat) < 1 or (options.views is not None and options.views < 2):
        parser.error("--threads and --repeat are at least 1, --views at least 2.")
    if options.checkpoint and not (options.checkpoint.is_file() and options.checkpoint.suffix == ".safetensors"):
        parser.error(f"--checkpoint {options.checkpoint}: expected a file .safetensors, which both can read.")
    limit_cores(options.threads)
    checkout = str(Path(options.official).resolve()) if options.official else ""
    if checkout and subprocess.run([sys.executable, WORKER, checkout], check=False).returncode:
        sys.exit(1)
    from toolkit.errors import ToolkitError

    try:
        text, document = benchmark(options, checkout)
    except ToolkitError as error:
        sys.exit(str(error))
    print(text)
    write_out(options.out, text, document)


if __name__ == "__main__":
    main()
