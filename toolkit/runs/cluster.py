"""Work spread over the workers of a Dask cluster (https://distributed.dask.org), on this machine or on many.

A stage cuts its work into shares and has them done before it does it itself: each worker writes files of its own, as a
run that was stopped leaves them (`features.groups.GroupWriter`), and the stage goes on from there. So it gives the same
results, and a share of a worker that died is done by another, from where it was. All processes see the same files,
under the same paths.
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

from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from toolkit import __version__
from toolkit.capture.devices import EXTRA_DEVICES
from toolkit.capture.images import WORKERS, default_workers
from toolkit.capture.names import ALLOW_OUTSIDE
from toolkit.errors import ManifestError, ToolkitError, first_line

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger(__name__)

ADDRESS = "TOOLKIT_CLUSTER"
"""Environment variable: the address of the scheduler whose workers stages use."""
MISSING = (
    "--cluster needs Dask, which is not installed here. To add it, where the toolkit was installed from: "
    "pip install -e '.[cluster]'"
)
SHARES_A_WORKER = 4
"""Work is cut into about so many shares a worker: all end at about the same time, and little is lost with one."""
QUEUES = ("HTCondor", "LSF", "Moab", "OAR", "PBS", "SGE", "SLURM")
"""The schedulers of clusters that `dask-jobqueue` knows, as its classes spell them."""
_CONNECT_S = 30
_WAIT_S = 600
"""Longest time that a scheduler takes to answer, and a worker to start."""
_CHECK_S = 60
"""How long nothing may happen before it is asked whether there are workers."""
_ONE_SHARE = threading.Lock()
"""Held while a share is done: folder, environment, BLAS's threads, streams and what is made once are a process's."""


class Cluster:
    """The workers that a stage can use."""

    def __init__(self, client: "Client") -> None:
        self._client = client

    @property
    def size(self) -> int:
        """Number of workers."""
        return max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def cut(self, items: Sequence[Any], multiple: int = 1) -> list[Sequence[Any]]:
        """Cut work into shares of successive items, of a multiple of `multiple` but for the last."""
        length = -(-len(items) // (SHARES_A_WORKER * self.size * multiple)) * multiple
        return [items[start : start + length] for start in range(0, len(items), length)] if length else []

    def run(self, function: Callable[..., None], shares: Sequence[tuple[Any, ...]], sizes: Sequence[int], label: str,
            unit: str) -> None:  # fmt: skip
        """Call a function of the toolkit for each share on some worker, and return when all are done.

        Args:
            function: what does a share; it may be called twice for one whose worker died.
            shares: its arguments.
            sizes: how many units each share has, for the bar.
            label, unit: of the bar.

        Raises:
            ToolkitError: a share killed several workers, or none is left; else what the function raised.
        """
        from distributed import CancelledError, KilledWorker, wait

        environment = {name: os.environ[name] for name in (EXTRA_DEVICES, ALLOW_OUTSIDE) if name in os.environ}
        here = os.getcwd()  # noqa: PTH109 - as text
        # As bytes: a scheduler that reads a share would make what only workers need, such as networks.
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
                        self._await_worker(label)
                        continue
                    for future in done:
                        future.result()
                        bar.update(futures[future])
        except KilledWorker as error:
            raise ToolkitError(
                f"{label}: several workers died of one share ({first_line(error)}). Most likely it needs more memory "
                "than a worker has."
            ) from None
        except CancelledError as error:  # the client gives up its shares when it loses the scheduler
            raise ToolkitError(
                f"{label}: the cluster's scheduler is gone ({first_line(error)}). What was done is kept: the same "
                "command goes on from here, with or without a cluster."
            ) from None
        finally:
            self._client.cancel(list(futures))

    def _await_worker(self, label: str) -> None:
        try:
            self._client.wait_for_workers(1, timeout=_WAIT_S)
        except TimeoutError:
            raise ToolkitError(
                f"{label}: no worker is left, and none came for {_WAIT_S} s. What was done is kept."
            ) from None


def _run_share(here: str, environment: Mapping[str, str], pickled: bytes) -> None:
    """Do a share, a pickled function and its arguments, with the folder and the settings of who asks for it."""
    with _ONE_SHARE:  # a worker may have several threads: `dask worker` starts one a core
        os.chdir(here)
        for name in (EXTRA_DEVICES, ALLOW_OUTSIDE):
            os.environ.pop(name, None)
        # No worker asks other workers: they could all wait for each other.
        os.environ.pop(ADDRESS, None)
        os.environ.update(environment)
        # A worker's own threads are the parallel dimension, whatever the environment says: BLAS's would wait for each
        # other.
        with threadpool_limits(1, "blas"), open(os.devnull, "w") as nowhere, redirect_stderr(nowhere):
            function, share = pickle.loads(pickled)
            function(*share)  # the one bar is that of who asks


def current_cluster() -> Cluster | None:
    """Return the cluster that this process is to use; None: it does its work itself.

    Raises:
        ToolkitError: the cluster does not answer.
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
        raise ToolkitError(
            f"The cluster at {address} has no worker that answers ({first_line(error)}). Is its scheduler running, "
            "and does it have workers?"
        ) from None
    try:
        found = set(client.run(_version).values())
    except ImportError as error:
        raise ToolkitError(
            f"The workers at {address} cannot import the toolkit ({first_line(error)}). Install it where they run."
        ) from None
    if found != {__version__}:
        raise ToolkitError(
            f"The workers at {address} have the toolkit's version {', '.join(sorted(found))}, this is {__version__}. "
            "Install the same on all machines."
        )
    return client


def _version() -> str:
    return __version__


@contextmanager
def open_cluster(asked: str | None, say: Callable[[str], object] = print) -> Iterator[None]:
    """Let the stages that run in this context, here and in kernels, use a cluster.

    Args:
        asked: `local` or `local:<workers>` starts workers on this machine: one a GPU, else one a core, if their number
            is not given; `tcp://<host>:<port>` uses those of a scheduler that runs; `slurm:<file>` starts them by a
            cluster's queue (also pbs, sge, lsf, ...). The YAML file has `jobs`, how many, and what the queue's class of
            dask-jobqueue takes, e.g. `queue`, `cores`, `memory`, `walltime`. None: no cluster.
        say: takes the line with the address of the dashboard.

    Raises:
        ManifestError: Dask is not installed, or an unknown or faulty cluster is asked for.
        ToolkitError: no worker started.
    """
    if asked is None:
        yield
        return
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise ManifestError(MISSING) from None
    with ExitStack() as stack:
        address, link = _start(asked, stack)
        before = os.environ.get(ADDRESS)
        os.environ[ADDRESS] = address
        try:
            cluster = current_cluster()
            assert cluster is not None
            say(f"{cluster.size} workers at {address}; what they do: {link or _client(address).dashboard_link}")
            yield
        finally:
            del os.environ[ADDRESS]
            if before is not None:
                os.environ[ADDRESS] = before
            elif _client.cache_info().currsize:
                _client(address).close()
                _client.cache_clear()


def _start(asked: str, stack: ExitStack) -> tuple[str, str]:
    """Return the address of a cluster's scheduler, started if need be, and of its dashboard if that is known."""
    kind, _, rest = asked.partition(":")
    if kind in ("tcp", "tls"):
        if not re.fullmatch(r"//(\[[\da-fA-F:.%]+\]|[^\[\]:/\s]+):\d{1,5}", rest):
            raise ManifestError(
                f"--cluster {asked}: expected {kind}://HOST:PORT; the port of Dask's scheduler is 8786 if not told."
            )
        return asked, ""
    queue = next((name for name in QUEUES if name.lower() == kind), None)
    if kind == "local" and (not rest or (rest.isdecimal() and int(rest))):
        cluster = stack.enter_context(_local_cluster(int(rest or 0)))
    elif queue and rest:
        cluster = stack.enter_context(_queued_cluster(queue, Path(rest)))
    else:
        queues = ", ".join(f"{name.lower()}:FILE" for name in QUEUES)
        raise ManifestError(f"--cluster {asked}: expected local, local:WORKERS, tcp://HOST:PORT, or one of {queues}.")
    return cluster.scheduler_address, cluster.dashboard_link


def _local_cluster(count: int) -> Any:
    """Start workers on this machine, each with its share of the cores, and with a GPU of its own as far as they go."""
    from distributed import Nanny, Scheduler, SpecCluster

    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    gpus = given.split(",") if given else [path.name[6:] for path in sorted(Path("/dev").glob("nvidia[0-9]*"))]
    count = count or len(gpus) or default_workers()
    # A worker does one share at a time, with its own threads. What it needs of memory is the toolkit's to bound.
    options = {"nthreads": 1, "memory_limit": 0, "silence_logs": logging.ERROR}
    workers = {
        number: {
            "cls": Nanny,
            "options": options
            | {
                "env": dict.fromkeys((WORKERS, "OMP_NUM_THREADS"), str(max(1, default_workers() // count)))
                | ({"CUDA_VISIBLE_DEVICES": gpus[number % len(gpus)]} if gpus else {})
            },
        }
        for number in range(count)
    }
    scheduler = {"cls": Scheduler, "options": {"host": "127.0.0.1", "dashboard_address": ":0"}}
    return SpecCluster(workers=workers, scheduler=scheduler, silence_logs=logging.ERROR)


def _queued_cluster(queue: str, path: Path) -> Any:
    """Start workers by the queue of a cluster, as a file says."""
    import yaml

    try:
        import dask_jobqueue
    except ImportError:
        raise ManifestError(MISSING) from None
    try:
        options = yaml.safe_load(path.read_text(encoding="utf-8"))
        jobs = options.pop("jobs")
        if type(jobs) is not int or jobs < 1:
            raise TypeError
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ManifestError(f"--cluster: {path} cannot be read ({first_line(error)}).") from None
    except (AttributeError, KeyError, TypeError):
        raise ManifestError(f"--cluster: {path} has no `jobs: <number>`, the workers to start.") from None
    try:
        cluster = getattr(dask_jobqueue, f"{queue}Cluster")(**options)
    except (TypeError, ValueError) as error:
        raise ManifestError(f"--cluster: {path}: {error}") from None
    cluster.scale(jobs=jobs)
    return cluster
