"""Images/s and memory of MegaLoc from JPEG files to descriptors on disk, beside the official code.

    python benchmarks/embed.py [--official CHECKOUT] [--checkpoint FILE] [--capture PATH] [--threads 2] [--out FILE]

Both embed the same files with the same weights on the same cores, one right after the other, each in a fresh process;
the cosines between their descriptors show that they did the same work. Loading the network and one warm-up batch of
black images are timed on their own. The toolkit's part is the embed stage as notebooks call it, with images as they
are (not turned upright); the official network runs in a plain loop that decodes a batch, then forwards it, in
float32. Wall seconds mean little while others use the machine; CPU seconds mean more. Without a checkpoint, weights
are random; without a capture, one is rendered.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from common import add_out, check_out, in_own_process, limit_cores, markdown_table, write_out
from megaloc_worker import clocks, load_official, peak_allocated_mb, peak_mb, read
from numpy.typing import NDArray

OFFICIAL_WORKER = Path(__file__).with_name("megaloc_worker.py")
GPU_BATCHES = (1, 32, 128)
DECODE_SIZES = ((1920, 1440), (4000, 3000))
DECODE_IMAGES = 8
MEMORY_IMAGES = (200, 2000)
# The smallest size that the embedder takes: memory beside the images is what counts here.
MEMORY_IMAGE_SIZE = 126


@dataclass
class Job:
    """What both are asked."""

    sessions_root: Path
    weights: Path
    image_size: int
    batch_size: int
    threads: int
    device: str


@dataclass
class Measurement:
    """What one took."""

    precision: str
    """Type that the network computed in."""
    images: int
    seconds: float
    """Wall seconds from the files to the descriptors on disk, without `load_seconds`."""
    cpu: float
    """CPU seconds of all threads in that time."""
    decode: float
    """Seconds to decode and resize all images in one thread."""
    load_seconds: float
    """Wall seconds to load the network and to embed one batch of black images."""
    peak_mb: float
    load: list[float]
    """Load averages of one minute before and after."""
    cosines: list[float] | None = None
    """Of each image, with the official descriptor."""

    @property
    def rate(self) -> float:
        """Images a second."""
        return self.images / self.seconds

    @property
    def decode_share(self) -> float:
        """Part of the CPU seconds that decoding takes."""
        return self.decode / self.cpu


def describe_machine(threads: int, device: str) -> dict[str, Any]:
    """Return what the results depend on besides the code."""
    import torch

    from toolkit.models.compute import cpu_multiplies_bfloat16, resolve_device, resolve_precision

    torch.set_num_threads(threads)
    chosen = resolve_device(device)
    return {
        "torch": torch.__version__,
        "cpu": _cpu_name(),
        "cpu has bfloat16": cpu_multiplies_bfloat16(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "device": str(chosen),
        "auto": str(resolve_precision("auto", chosen)).removeprefix("torch."),
    }


def _cpu_name() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown CPU")


def write_random_weights(path: Path, seed: int = 0) -> None:
    """Write weights of the official names and shapes that keep activations finite."""
    import torch
    from safetensors.torch import save_file

    from toolkit.models.megaloc import MegaLoc

    with torch.device("meta"):
        shapes = {name: tensor.shape for name, tensor in MegaLoc().state_dict().items()}
    generator = torch.Generator().manual_seed(seed)
    state = {}
    for name, shape in shapes.items():
        if name.endswith("gamma"):
            state[name] = torch.full(shape, 0.03)
        elif name.endswith("dust_bin") or (".norm" in name and name.endswith("weight")):
            state[name] = torch.ones(shape)
        elif name.endswith(("pos_embed", "cls_token")):
            state[name] = 0.02 * torch.randn(shape, generator=generator)
        elif len(shape) > 1:
            state[name] = torch.randn(shape, generator=generator) / shape[1:].numel() ** 0.5
        else:
            state[name] = torch.zeros(shape)
    save_file(state, path)


def write_capture(folder: Path, images: list[Path], size: tuple[int, int]) -> Path:
    """Write a capture of one session with copies of images; return its `sessions` folder."""
    from toolkit.capture import write_session

    session = folder / "sessions" / "ios_map"
    (session / "raw_data" / "images").mkdir(parents=True)
    rows = []
    for index, image in enumerate(images):
        rows.append((index, "camera", f"images/{index:05d}.jpg"))
        shutil.copyfile(image, session / "raw_data" / rows[-1][2])
    width, height = size
    camera = ("camera", "phone", "camera", "PINHOLE", width, height, width, width, width / 2, height / 2)
    write_session(session, [camera], None, None, rows)
    return folder / "sessions"


def choose_images(capture: Path, count: int) -> list[Path]:
    """Return at most so many JPEG files of a capture's cameras, spread evenly."""
    from toolkit.capture import Capture
    from toolkit.errors import ToolkitError

    try:
        opened = Capture.open(capture)
        sessions = [opened[name] for name in opened.session_ids]
        paths = [session.image_path(row) for session in sessions for row in session.camera_rows.tolist()]
    except ToolkitError as error:
        sys.exit(str(error))
    jpegs = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg") and path.is_file()]
    if not jpegs:
        sys.exit(f"{capture} has {len(paths)} camera images, none of them a JPEG file; name another capture.")
    return [jpegs[index] for index in np.linspace(0, len(jpegs) - 1, min(count, len(jpegs))).astype(int).tolist()]


def prepare(folder: Path, capture: Path | None, count: int, checkpoint: Path | None) -> dict[str, Any]:
    """Make the capture to embed and the weights; returns the fields of a `Job`, and what the images are."""
    from PIL import Image

    from toolkit.synthetic import render_capture

    source = capture
    if source is None:
        source = render_capture(folder / "RENDERED", rooms=1, frames=max(4, count // 6), seed=0, progress=False)
    images = choose_images(source.resolve(), count)
    sizes = []
    for path in images:
        with Image.open(path) as image:
            sizes.append(image.size)
    weights = checkpoint or folder / "model.safetensors"
    if checkpoint is None:
        write_random_weights(weights)
    extent = " to ".join(f"{width} x {height}" for width, height in dict.fromkeys((min(sizes), max(sizes))))
    return {
        "sessions_root": write_capture(folder / "BENCHMARK", images, sizes[0]),
        "weights": weights,
        "described": f"{len(images)} images of {capture.resolve().name if capture else 'rendered rooms'}, {extent}",
    }


def run_toolkit(job: Job, out: Path, precision: str) -> dict[str, Any]:
    """Run the embed stage in this process, which should be a fresh one; returns the fields of a `Measurement`."""
    import torch

    from toolkit import embed
    from toolkit.capture import Capture
    from toolkit.capture.images import read_image

    torch.set_num_threads(job.threads)
    before = os.getloadavg()[0]
    load_seconds = load_cpu = 0.0
    embedder: Any = None
    create = embed.create_embedder

    def create_and_warm(name: str, **options: Any) -> Any:
        nonlocal load_seconds, load_cpu, embedder
        wall, cpu = clocks()
        embedder = create(name, **options)
        embedder.embed([np.zeros((job.image_size, job.image_size, 3), np.uint8)] * job.batch_size)
        ended = clocks()
        load_seconds, load_cpu = ended[0] - wall, ended[1] - cpu
        return embedder

    # The stage is run as it is; what it loads is timed to tell it apart.
    embed.create_embedder = create_and_warm
    wall, cpu = clocks()
    settings = {
        "model": "megaloc",
        "checkpoint": str(job.weights),
        "compute_device": job.device,
        "dtype_compute": precision,
        "image_size": job.image_size,
        "batch_size": job.batch_size,
        "upright": False,
    }
    table = embed.embed_sessions(job.sessions_root, out, settings)
    ended = clocks()
    peak = peak_mb()
    session = Capture.from_sessions_root(job.sessions_root)["ios_map"]
    decode = time.perf_counter()
    for row in session.camera_rows.tolist():
        embedder.prepare(read_image(session.image_path(row), min_side=embedder.min_side))
    return {
        "precision": embedder.settings["dtype_compute"],
        "images": int(table["embedded"].sum()),
        "seconds": ended[0] - wall - load_seconds,
        "cpu": ended[1] - cpu - load_cpu,
        "decode": time.perf_counter() - decode,
        "load_seconds": load_seconds,
        "peak_mb": peak,
        "load": [before, os.getloadavg()[0]],
    }


def measure_toolkit(job: Job, out: Path, precision: str, official: NDArray[np.float32] | None) -> Measurement:
    """Measure the embed stage in a process of its own."""
    measured = Measurement(**in_own_process(run_toolkit, job, out, precision))
    if official is not None:
        from toolkit.embedders import load_embeddings

        ours, table = load_embeddings(out / "ios_map")
        rows = [int(Path(path).stem) for path in table["abs_path"]]  # the files are named by their place
        if rows != list(range(len(official))):
            sys.exit(f"The toolkit embedded {len(rows)} of {len(official)} images; the others cannot be read.")
        measured.cosines = _cosines(ours, official).tolist()
    return measured


def _cosines(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float64]:
    a, b = (x.astype(np.float64) / np.linalg.norm(x.astype(np.float64), axis=1, keepdims=True) for x in (a, b))
    return (a * b).sum(axis=1)


def measure_official(checkout: str, job: Job, folder: Path) -> tuple[Measurement, NDArray[np.float32]]:
    """Measure the official code in a process of its own; returns its descriptors too."""
    folder.mkdir()
    fields = vars(job) | {
        "sessions_root": str(job.sessions_root),
        "weights": str(job.weights),
        "files": [str(path) for path in sorted(job.sessions_root.glob("ios_map/raw_data/images/*"))],
        "out": str(folder / "descriptors.npy"),
    }
    (folder / "job.json").write_text(json.dumps(fields))
    files = [str(folder / name) for name in ("job.json", "result.json")]
    if subprocess.run([sys.executable, str(OFFICIAL_WORKER), checkout, *files], check=False).returncode:
        sys.exit("The official code failed; see above.")
    measured = Measurement(precision="float32", **json.loads((folder / "result.json").read_text()))
    return measured, np.load(fields["out"])


def aggregation_memory(checkout: str, job: Job) -> dict[str, float]:
    """Return the MB that each aggregation holds at most for a batch, in float32 on the CPU, above its inputs."""
    import torch

    from toolkit.models.megaloc import PATCH, MegaLoc

    torch.set_num_threads(job.threads)
    side = job.image_size // PATCH
    generator = torch.Generator().manual_seed(0)
    patches = torch.randn(job.batch_size, side * side, 768, generator=generator)
    cls_token = torch.randn(job.batch_size, 768, generator=generator)
    ours = MegaLoc.from_checkpoint(job.weights).aggregator
    with torch.inference_mode():
        found = {"toolkit": peak_allocated_mb(lambda: ours(patches, cls_token))}
        if checkout:
            official = load_official(checkout, str(job.weights), "cpu").aggregator
            grid = patches.transpose(1, 2).unflatten(2, (side, side))
            found["official"] = peak_allocated_mb(lambda: official((grid, cls_token)))
            outputs = ours(patches, cls_token), official((grid, cls_token))
            found["cosine"] = float(_cosines(*(output.numpy() for output in outputs)).min())
    return found


def embed_shallow(folder: Path, count: int, threads: int) -> dict[str, float]:
    """Embed so many small images with a network of the official sizes but depth 1; returns peak memory, seconds."""
    import torch
    from PIL import Image

    from toolkit import embed
    from toolkit.embedders.megaloc import MegaLocEmbedder
    from toolkit.models.megaloc import MegaLoc

    torch.set_num_threads(threads)
    image = folder / "image.jpg"
    folder.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    Image.fromarray(pixels).resize((160, 120)).save(image)
    torch.manual_seed(0)
    model = MegaLoc(depth=1)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    embedder = MegaLocEmbedder(model, device="cpu", dtype_compute="float32", image_size=MEMORY_IMAGE_SIZE)
    made: Any = lambda *_, **__: embedder  # noqa: E731
    embed.create_embedder = made
    sessions_root = write_capture(folder / "MANY", [image] * count, (160, 120))
    started = time.perf_counter()
    embed.embed_sessions(sessions_root, folder / "out", settings={"model": "megaloc", "upright": False})
    return {"peak_mb": peak_mb(), "seconds": time.perf_counter() - started}


def decode_rows(job: Job, folder: Path) -> list[dict[str, Any]]:
    """Return images/s from JPEG files to what the network takes, decoded whole and as small as it allows.

    The photographs of the capture are enlarged for that, to sizes that cameras have.
    """
    import torch
    from PIL import Image

    from toolkit.capture.images import read_image
    from toolkit.embedders.megaloc import MegaLocEmbedder

    torch.set_num_threads(job.threads)
    files = sorted(job.sessions_root.glob("ios_map/raw_data/images/*"))[:DECODE_IMAGES]
    embedder = MegaLocEmbedder(job.weights, job.device, "float32", job.image_size)
    rows = []
    for size in DECODE_SIZES:
        paths = [folder / f"{size[0]}-{file.name}" for file in files]
        for file, path in zip(files, paths, strict=True):
            with Image.open(file) as image:
                image.convert("RGB").resize(size, Image.Resampling.BICUBIC).save(path, quality=92)
        whole = None
        for min_side in (None, embedder.min_side):
            row: dict[str, Any] = {"size": f"{size[0]} x {size[1]}"}
            row["decoded"] = "{1} x {0}".format(*read_image(paths[0], min_side=min_side).shape)
            prepare = partial(_decoded, image_size=job.image_size, min_side=min_side)
            many = (paths * DECODE_IMAGES)[: 4 * DECODE_IMAGES]
            for name, pool in (
                ("one", ThreadPoolExecutor(1)),
                ("threads", ThreadPoolExecutor(job.threads)),
                ("processes", ProcessPoolExecutor(job.threads, mp_context=get_context("spawn"))),
            ):
                with pool:
                    list(pool.map(prepare, many))
                    started = time.perf_counter()
                    list(pool.map(prepare, many, chunksize=4))
                    row[name] = len(many) / (time.perf_counter() - started)
            descriptors = embedder.embed([prepare(path) for path in paths])
            whole = descriptors if whole is None else whole
            row["cosines"] = _cosines(descriptors, whole).tolist()
            rows.append(row)
    return rows


def _decoded(path: Path, image_size: int, min_side: int | None) -> NDArray[np.uint8]:
    """Return what `MegaLocEmbedder.prepare` makes of a file, without a network: for processes of their own."""
    from PIL import Image

    from toolkit.capture.images import read_image

    image = Image.fromarray(read_image(path, min_side=min_side))
    return np.asarray(image.resize((image_size, image_size), Image.Resampling.BILINEAR))


def gpu_rows(checkout: str, job: Job, precisions: tuple[str, ...], batches: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return images/s of the network on a GPU by batch and precision, beside the official forward under autocast."""
    import torch

    from toolkit.capture.images import read_image
    from toolkit.embedders.megaloc import MegaLocEmbedder

    torch.set_num_threads(job.threads)
    files = sorted(job.sessions_root.glob("ios_map/raw_data/images/*"))
    embedder = MegaLocEmbedder(job.weights, job.device, precisions[0], job.image_size)
    started = time.perf_counter()
    images = [embedder.prepare(read_image(path, min_side=embedder.min_side)) for path in files]
    decode = (time.perf_counter() - started) / len(files)
    official: dict[int, float] = {}
    if checkout:
        model = load_official(checkout, str(job.weights), job.device)
        inputs = torch.stack([read(str(path), job.image_size) for path in files])
        for batch in batches:
            normalized = inputs[torch.arange(batch) % len(inputs)].to(job.device)
            with torch.inference_mode(), torch.autocast(torch.device(job.device).type, torch.bfloat16):
                official[batch] = batch / _seconds(lambda x: model(x).cpu(), normalized)
        del model
    rows = []
    for precision in precisions:
        embedder = MegaLocEmbedder(job.weights, job.device, precision, job.image_size)
        for batch in batches:
            chosen = [images[index % len(images)] for index in range(batch)]
            seconds = _seconds(embedder.embed, chosen) / batch
            row = {"precision": precision, "batch": batch, "rate": 1 / seconds, "decode": decode}
            row |= {"decode_share": decode / (decode + seconds), "official_rate": official.get(batch)}
            rows.append(row)
    return rows


def _seconds(run: Callable[[Any], Any], argument: Any, least: float = 2.0) -> float:
    """Return the mean seconds of a call, warm, over some seconds; it shall return numbers on the host."""
    run(argument)
    run(argument)
    started, count = time.perf_counter(), 0
    while time.perf_counter() - started < least:
        run(argument)
        count += 1
    return (time.perf_counter() - started) / count


def markdown(document: dict[str, Any], ours: list[Measurement], official: Measurement | None) -> str:
    """Return the tables of a benchmark."""
    machine = document["machine"]
    native = "multiplies bfloat16 natively" if machine["cpu has bfloat16"] else "has no native bfloat16"
    rows = []
    named = [("toolkit", measured) for measured in ours] + ([("official", official)] if official else [])
    for name, measured in named:
        cosines = measured.cosines or []
        rows.append(
            [
                f"{name}, {measured.precision}",
                f"{measured.rate:.2f}",
                f"{measured.rate / official.rate:.2f}" if official else "–",
                f"{measured.seconds / measured.images:.3f}",
                f"{measured.cpu / measured.images:.3f}",
                f"{1000 * measured.decode / measured.images:.1f}",
                f"{100 * measured.decode_share:.1f}",
                f"{min(cosines):.6f}, {np.mean(cosines):.6f}" if cosines else "–",
                f"{measured.load_seconds:.1f}",
                f"{measured.peak_mb:.0f}",
                f"{measured.load[0]:.1f}, {measured.load[1]:.1f}",
            ]
        )
    header = ["", "images/s", "x official", "s an image", "CPU s an image", "decode ms an image", "decode % of CPU"]
    header += ["cosine to official: min, mean", "load and warm-up s", "peak MB", "load before, after"]
    text = [
        f"{document['images']}, at {document['image_size']} x {document['image_size']} in batches of "
        f"{document['batch_size']}, {document['weights']}, on {machine['device']}, {document['threads']} threads, "
        f"torch {machine['torch']}:",
        "",
        markdown_table(header, rows),
        "",
        f"- `dtype_compute: auto` is {machine['auto']} here; the CPU ({machine['cpu']}) {native}.",
    ]
    if document["other_images"] is not None:
        text.append(
            "- For comparison with the cosines: official descriptors of different images have "
            f"{document['other_images'][0]:.6f} at most, {document['other_images'][1]:.6f} in the mean."
        )
    memory = document["aggregation_mb"]
    line = f"- Aggregation of a batch of {document['batch_size']} in float32, peak memory above weights and inputs: "
    line += f"toolkit {memory['toolkit']:.1f} MB"
    if official:
        ratio = memory["toolkit"] / memory["official"]
        line += f", official {memory['official']:.1f} MB, ratio {ratio:.3f}; cosine at least {memory['cosine']:.6f}"
    text.append(line + ".")
    if document["growth"]:
        few, many = document["growth"]
        growth = many["peak_mb"] - few["peak_mb"]
        text.append(
            f"- Peak memory of embedding {few['images']} images {few['peak_mb']:.0f} MB, {many['images']} images "
            f"{many['peak_mb']:.0f} MB: ratio {many['peak_mb'] / few['peak_mb']:.3f}, {growth:.0f} MB more (the "
            f"descriptors themselves would be {document['growth_of_descriptors_mb']:.0f} MB more). Network of the "
            f"official sizes but depth 1, random weights, images of 160 x 120 at {MEMORY_IMAGE_SIZE} x "
            f"{MEMORY_IMAGE_SIZE}."
        )
    rows = [
        [
            row["size"],
            row["decoded"],
            f"{1000 / row['one']:.1f}",
            *(f"{row[name]:.1f}" for name in ("one", "threads", "processes")),
            f"{1 - np.mean(row['cosines']):.1e}, {1 - min(row['cosines']):.1e}",
        ]
        for row in document["decode"]
    ]
    count = document["threads"]
    header = ["JPEG", "decoded at", "ms an image", "images/s, 1 thread", f"{count} threads", f"{count} processes"]
    text += [
        "",
        f"From JPEG files to what the network takes, of {DECODE_IMAGES} of these photographs, enlarged:",
        "",
        markdown_table([*header, "1 - cosine to the whole: mean, largest"], rows),
        "",
    ]
    if document["gpu"]:
        rows = [
            [
                row["precision"],
                str(row["batch"]),
                f"{row['rate']:.1f}",
                f"{row['official_rate']:.1f}" if row["official_rate"] else "–",
                f"{row['rate'] / row['official_rate']:.2f}" if row["official_rate"] else "–",
                f"{100 * row['decode_share']:.1f}",
            ]
            for row in document["gpu"]
        ]
        header = ["precision", "batch", "toolkit images/s", "official images/s", "ratio", "decode %"]
        text += [
            "",
            f"On {machine['gpu']}: the toolkit from decoded images on the host to descriptors there, the official "
            "forward under bfloat16 autocast from normalized images on the GPU to descriptors on the host. Decoding "
            f"takes {1000 * document['gpu'][0]['decode']:.1f} ms an image in one thread; its share is of a plain "
            "loop of one decoder and the network.",
            "",
            markdown_table(header, rows),
        ]
    else:
        reason = f"this was run on {machine['device']}" if machine["gpu"] else "torch sees none here"
        text.append(f"- No GPU was measured: {reason}.")
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--official", help="checkout of gmberton/MegaLoc, to run the official code too")
    parser.add_argument("--checkpoint", type=Path, help="the official model.safetensors; default: random weights")
    parser.add_argument("--images", type=int, default=32, help="how many, at most (default: %(default)s)")
    parser.add_argument("--capture", type=Path, help="capture folder to copy images from; default: render some")
    parser.add_argument("--threads", type=int, default=2, help="cores for each (default: %(default)s)")
    parser.add_argument("--batch-size", type=int, default=8, help="images a batch (default: %(default)s)")
    parser.add_argument("--image-size", type=int, default=322, help="a multiple of 14 (default: %(default)s)")
    precisions = ("auto", "float32", "bfloat16", "float16")
    precision_help = "dtype_compute; repeatable; default: auto, and float32 where auto is not that"
    parser.add_argument("--precision", action="append", choices=precisions, help=precision_help)
    parser.add_argument("--device", default="auto", help="compute_device (default: %(default)s)")
    parser.add_argument("--memory", action="store_true", help="also peak memory of embedding 200 and 2,000 images")
    parser.add_argument("--repeat", type=int, default=1, help="runs in turn; the fastest of each counts")
    add_out(parser)
    options = parser.parse_args()
    check_out(parser, options.out)
    if min(options.images, options.threads, options.batch_size, options.repeat) < 1:
        parser.error("--images, --threads, --batch-size and --repeat are at least 1.")
    if options.image_size < MEMORY_IMAGE_SIZE or options.image_size % 14:
        parser.error(f"--image-size {options.image_size}: expected a multiple of 14, at least {MEMORY_IMAGE_SIZE}.")
    if options.checkpoint and not (options.checkpoint.is_file() and options.checkpoint.suffix == ".safetensors"):
        parser.error(f"--checkpoint {options.checkpoint}: expected a file .safetensors, which both can read.")
    limit_cores(options.threads)
    checkout = str(Path(options.official).resolve()) if options.official else ""
    if checkout and subprocess.run([sys.executable, OFFICIAL_WORKER, checkout], check=False).returncode:
        sys.exit(1)
    from toolkit.errors import ToolkitError

    try:
        text, document = benchmark(options, checkout)
    except ToolkitError as error:
        sys.exit(str(error))
    print(text)
    write_out(options.out, text, document)


def benchmark(options: argparse.Namespace, checkout: str) -> tuple[str, dict[str, Any]]:
    """Measure what was asked; returns the tables, and all numbers."""
    machine = in_own_process(describe_machine, options.threads, options.device)
    precisions = options.precision or list(dict.fromkeys(["auto", *["float32"][: machine["auto"] != "float32"]]))
    checkpoint = options.checkpoint.resolve() if options.checkpoint else None
    ours: dict[str, list[Measurement]] = {precision: [] for precision in precisions}
    theirs: list[Measurement] = []
    descriptors = None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepared = in_own_process(prepare, folder, options.capture, options.images, checkpoint)
        described = prepared.pop("described")
        sizes = (options.image_size, options.batch_size, options.threads)
        job = Job(prepared["sessions_root"], prepared["weights"], *sizes, machine["device"])
        for turn in range(options.repeat):
            if checkout:
                measured, descriptors = measure_official(checkout, job, folder / f"official{turn}")
                theirs.append(measured)
                print(f"official {measured.rate:.2f} images/s", file=sys.stderr)
            for precision in precisions:
                measured = measure_toolkit(job, folder / f"{precision}{turn}", precision, descriptors)
                ours[precision].append(measured)
                print(f"toolkit, {precision} {measured.rate:.2f} images/s", file=sys.stderr)
        memory = in_own_process(aggregation_memory, checkout, job)
        decode = in_own_process(decode_rows, job, folder)
        gpu = []
        if machine["gpu"] and job.device.startswith("cuda"):
            gpu = in_own_process(gpu_rows, checkout, job, ("bfloat16", "float32"), GPU_BATCHES)
        growth = []
        for count in MEMORY_IMAGES if options.memory else ():
            found = in_own_process(embed_shallow, folder / f"memory{count}", count, options.threads)
            growth.append({"images": count} | found)
            print(f"{count} images {found['peak_mb']:.0f} MB, {found['seconds']:.0f} s", file=sys.stderr)
    best = [min(measured, key=lambda one: one.seconds) for measured in ours.values()]
    official = min(theirs, key=lambda one: one.seconds) if theirs else None
    other = None
    if descriptors is not None and len(descriptors) > 1:
        products = descriptors @ descriptors.T
        others = products[~np.eye(len(products), dtype=bool)]
        other = [float(others.max()), float(others.mean())]
    document: dict[str, Any] = {
        "machine": machine,
        "images": described,
        "image_size": options.image_size,
        "batch_size": options.batch_size,
        "threads": options.threads,
        "weights": f"weights of {checkpoint.name}" if checkpoint else "random weights",
        "other_images": other,
        "aggregation_mb": memory,
        "growth": growth,
        "growth_of_descriptors_mb": (MEMORY_IMAGES[1] - MEMORY_IMAGES[0]) * 8448 * 4 / 2**20,
        "decode": decode,
        "gpu": gpu,
    }
    text = markdown(document, best, official)
    document["toolkit"] = [vars(measured) | {"rate": measured.rate} for measured in best]
    document["official"] = vars(official) | {"rate": official.rate} if official else None
    return text, document


if __name__ == "__main__":
    main()
