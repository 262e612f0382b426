"""Spread a stage's work over the workers of a Dask cluster (https://distributed.dask.org), on one machine or many.

A stage cuts its work into shares and submits them before it runs itself. Workers write to the same folders as the stage
(`store.items`), which then makes what is left. So the results do not change, and if a worker dies, another one
continues its share. All processes must see the same files under the same paths.
"""

import logging
import os
import pickle
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm.auto import tqdm

from toolkit import __version__
from toolkit.capture.images import WORKERS, default_workers
from toolkit.capture.names import ALLOW_OUTSIDE, EXTRA_DEVICES
from toolkit.errors import ManifestError, ToolkitError, first_line, optional
from toolkit.files import environment_variable
from toolkit.threads import fixed_sums

if TYPE_CHECKING:
    from distributed import Client


ADDRESS = "TOOLKIT_CLUSTER"
"""Environment variable with the address of the scheduler whose workers the stages use."""
SHARES_A_WORKER = 4
"""Shares per worker: small enough that all workers end at about the same time, and that a lost share costs little."""
QUEUES = ("HTCondor", "LSF", "Moab", "OAR", "PBS", "SGE", "SLURM")
"""Queue systems that `dask-jobqueue` supports, spelled as in its class names."""
_CONNECT_S = 30
"""Timeout for a scheduler to answer, in seconds."""
_WAIT_S = 600
"""Timeout for a worker to start, in seconds."""
_CHECK_S = 60
"""After this many seconds without a finished share, check that workers are left."""
_ONE_SHARE = threading.Lock()
"""Held while a share runs: working folder, environment, BLAS threads, streams and caches belong to the process."""


class Cluster:
    """The Dask workers that a stage can use."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    @property
    def size(self) -> int:
        """Number of workers."""
        return max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def cut(self, items: Sequence[Any], multiple: int = 1) -> list[Sequence[Any]]:
        """Cut items into shares of successive items. Share lengths are multiples of `multiple`, except for the last."""
        length = -(-len(items) // (SHARES_A_WORKER * self.size * multiple)) * multiple
        return [items[start : start + length] for start in range(0, len(items), length)] if length else []

    def run(self, function: Callable[..., None], shares: Sequence[tuple[Any, ...]], sizes: Sequence[int], label: str,
            unit: str) -> None:  # fmt: skip
        """Call a function once per share on the workers, and return when all shares, each of `sizes` units, are done.

        If a worker dies, the function is called again for its share. Raise ToolkitError if a share killed several
        workers, or no worker is left. Errors of the function are raised too.
        """
        from distributed import CancelledError, KilledWorker, wait

        environment = {name: os.environ[name] for name in (EXTRA_DEVICES, ALLOW_OUTSIDE) if name in os.environ}
        here = os.getcwd()  # noqa: PTH109 - as text
        # Pickled here, so that the scheduler does not unpickle objects that only workers need, such as networks.
        futures = {
            self._client.submit(_run_share, here, environment, pickle.dumps((function, share)), pure=False): size
            for share, size in zip(shares, sizes, strict=True)
        }
        try:
            with (
                self._client.as_current(),
                tqdm(total=sum(sizes), desc=f"{label}, {self.size} workers", unit=unit) as bar,
            ):
                running = set(futures)
                while running:
                    try:
                        done, running = wait(running, timeout=_CHECK_S, return_when="FIRST_COMPLETED")
                    except TimeoutError:
                        self._client.wait_for_workers(1, timeout=_WAIT_S)
                        continue
                    for future in done:
                        future.result()
                        bar.update(futures[future])
        except KilledWorker as error:
            text = f"{label}: several workers died of one share ({first_line(error)})."
            raise ToolkitError(f"{text} Most likely it needs more memory than a worker has.") from None
        except CancelledError as error:  # the client cancels its shares when it loses the scheduler
            text = f"{label}: the cluster's scheduler is gone ({first_line(error)})."
            raise ToolkitError(f"{text} Finished work is kept: the same command continues from here.") from None
        except TimeoutError:
            text = f"{label}: no worker is left, and none came for {_WAIT_S} s. What was done is kept."
            raise ToolkitError(text) from None
        finally:
            self._client.cancel(list(futures))


def _run_share(here: str, environment: Mapping[str, str], pickled: bytes) -> None:
    """Run one share, a pickled (function, arguments), in the working folder and with the settings of the submitter."""
    with _ONE_SHARE:  # a worker may have several threads: `dask worker` starts one per core
        os.chdir(here)
        # Workers must not submit shares to the cluster (ADDRESS): all could end up waiting for each other.
        for name in (EXTRA_DEVICES, ALLOW_OUTSIDE, ADDRESS):
            os.environ.pop(name, None)
        os.environ.update(environment)
        # The function has threads of its own; BLAS threads on top of them would only wait for each other. Standard
        # error is dropped because the submitter already shows a progress bar.
        with fixed_sums, open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):
            function, share = pickle.loads(pickled)
            function(*share)


def current_cluster() -> Cluster | None:
    """Return the cluster that `TOOLKIT_CLUSTER` names; None without one: this process does all work itself.

    Raise ToolkitError if it does not answer.
    """
    address = os.environ.get(ADDRESS)
    return None if address is None else Cluster(_client(address))


@cache
def _client(address: str) -> "Client":
    from distributed import Client

    try:
        client = Client(address, set_as_default=False, timeout=_CONNECT_S)
        client.wait_for_workers(1, timeout=_WAIT_S)
    except (OSError, TimeoutError) as error:
        text = f"The cluster at {address} has no worker that answers ({first_line(error)})."
        raise ToolkitError(f"{text} Is its scheduler running, and does it have workers?") from None
    try:
        versions = set(client.run(_version).values())
    except ImportError as error:
        versions = {f"none ({first_line(error)})"}
    if versions != {__version__}:
        found, do = f"version {', '.join(sorted(versions))} of the toolkit", "Install it on all machines."
        raise ToolkitError.at(f"workers at {address}", found, __version__, do)
    return client


def _version() -> str:
    return __version__


@contextmanager
def open_cluster(spec: str | None, say: Callable[[str], object] = print) -> Iterator[None]:
    """Let the stages that run in this context, here and in kernels, use a cluster.

    Raise ManifestError if Dask is not installed, or `spec` is unknown or faulty; ToolkitError if no worker started.

    Args:
        spec: `local` or `local:<workers>` starts workers on this machine; without a number one per GPU, or one per core
            if there is no GPU. `tcp://<host>:<port>` uses the workers of a running scheduler. `slurm:<file>` (also pbs,
            sge, lsf, ...) starts workers through a queue; the YAML file has `jobs`, the number of workers, and
            arguments for the queue's class in dask-jobqueue, e.g. `queue`, `cores`, `memory`, `walltime`. None: no
            cluster.
        say: prints a line; called once with the number of workers and the address of the dashboard.
    """
    if spec is None:
        yield
        return
    optional("distributed")
    logging.getLogger("distributed").setLevel(logging.ERROR)  # it warns of workers that it ends itself
    with ExitStack() as stack:
        address, link = _start(spec, stack)
        try:
            with environment_variable(ADDRESS, address):
                cluster = current_cluster()
                assert cluster is not None
                say(f"{cluster.size} workers at {address}; dashboard: {link or _client(address).dashboard_link}")
                yield
        finally:
            if ADDRESS not in os.environ and _client.cache_info().currsize:
                _client(address).close()
                _client.cache_clear()


def _start(spec: str, stack: ExitStack) -> tuple[str, str]:
    """Start a scheduler if need be. Return its address and that of its dashboard ("" if unknown)."""
    kind, _, rest = spec.partition(":")
    if kind in ("tcp", "tls"):
        if not re.fullmatch(r"//(\[[\da-fA-F:.%]+\]|[^\[\]:/\s]+):\d{1,5}", rest):
            do = "The default port of Dask's scheduler is 8786."
            raise ManifestError.at(f"--cluster {spec}", expected=f"{kind}://HOST:PORT", do=do)
        return spec, ""
    queue = next((name for name in QUEUES if name.lower() == kind), None)
    if kind == "local" and (not rest or (rest.isdecimal() and int(rest))):
        cluster = stack.enter_context(_local_cluster(int(rest or 0)))
    elif queue and rest:
        cluster = stack.enter_context(_queued_cluster(queue, Path(rest)))
    else:
        queues = ", ".join(f"{name.lower()}:FILE" for name in QUEUES)
        expected = f"local, local:WORKERS, tcp://HOST:PORT, or one of {queues}"
        raise ManifestError.at(f"--cluster {spec}", expected=expected)
    return cluster.scheduler_address, cluster.dashboard_link


def _local_cluster(count: int) -> Any:
    """Start `count` workers on this machine (0: one per GPU, or per core) that share its cores and GPUs."""
    from distributed import Nanny, Scheduler, SpecCluster

    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        gpus = [path.name[6:] for path in sorted(Path("/dev").glob("nvidia[0-9]*"))]
    else:  # an empty text or -1 hides all GPUs
        gpus = [name for name in visible.split(",") if name.strip() and not name.strip().startswith("-")]
    count = count or len(gpus) or default_workers()
    # A worker runs one share at a time. The toolkit bounds its own memory, so Dask need not.
    options = {"nthreads": 1, "memory_limit": 0, "silence_logs": logging.ERROR}
    threads = dict.fromkeys((WORKERS, "OMP_NUM_THREADS"), str(max(1, default_workers() // count)))
    of_gpu = [{"CUDA_VISIBLE_DEVICES": gpu} for gpu in gpus] or [{}]
    environments = [threads | of_gpu[number % len(of_gpu)] for number in range(count)]
    workers = {number: {"cls": Nanny, "options": options | {"env": env}} for number, env in enumerate(environments)}
    scheduler = {"cls": Scheduler, "options": {"host": "127.0.0.1", "dashboard_address": ":0"}}
    return SpecCluster(workers=workers, scheduler=scheduler, silence_logs=logging.ERROR)


def _queued_cluster(queue: str, path: Path) -> Any:
    """Start workers through a queue such as SLURM, with the options in a YAML file."""
    import yaml

    dask_jobqueue = optional("dask_jobqueue")
    try:
        options = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ManifestError(f"--cluster: {path} cannot be read ({first_line(error)}).") from None
    jobs = options.pop("jobs", None) if isinstance(options, dict) else None
    if type(jobs) is not int or jobs < 1:
        raise ManifestError(f"--cluster: {path} has no `jobs: <number>`, the number of workers to start.")
    try:
        cluster = getattr(dask_jobqueue, f"{queue}Cluster")(**options)
    except (TypeError, ValueError) as error:
        raise ManifestError(f"--cluster: {path}: {error}") from None
    cluster.scale(jobs=jobs)
    return cluster
