"""Work through a list of items by processes on this machine, or by the workers of a Dask cluster."""

import socket
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar
from urllib.parse import urlsplit

from cfplan.errors import CfplanError, ExitCode

SCHEDULER_PATIENCE, WORKER_PATIENCE = 10, 30  # s
Item = TypeVar("Item")
Done = TypeVar("Done")
Work = Callable[[Callable[[Any], Done], Iterable[Any]], Iterator[Done]]


class SchedulerError(CfplanError):
    """The scheduler of a cluster cannot be used."""

    exit_code = ExitCode.USAGE


@contextmanager
def pool(
    workers: int = 1, scheduler: str | None = None, *, worker_patience: float = WORKER_PATIENCE
) -> Iterator[Work[Any]]:
    """Yield a function that maps another over items in parallel and yields results as they arrive, in any order.

    One worker without a scheduler works in this process. If a worker of a cluster dies, others repeat only the items
    that it had.

    Raises:
        SchedulerError: Dask is not installed, the scheduler does not answer within SCHEDULER_PATIENCE, no worker comes
            within `worker_patience`, s, or one works at several items at a time.
    """
    from joblib import Parallel, delayed, parallel_config

    def run(function: Callable[[Item], Done], items: Iterable[Item]) -> Iterator[Done]:
        tasks = (delayed(function)(item) for item in items)
        yield from Parallel(n_jobs=n_jobs, return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")(
            tasks
        )

    if scheduler is None:
        n_jobs = workers
        with parallel_config(backend="loky", inner_max_num_threads=1):
            yield run
        return
    n_jobs = -1
    with _client(scheduler, worker_patience) as client, parallel_config(backend="dask", client=client):
        yield run


@contextmanager
def _client(scheduler: str, worker_patience: float) -> Iterator[object]:
    try:
        from distributed import Client
    except ImportError:
        raise SchedulerError(
            "Dask is not installed", where=scheduler, hint="pip install 'cfplan[cluster]', here and on the workers"
        ) from None
    _require_listening(scheduler)
    try:
        client = Client(scheduler, timeout=SCHEDULER_PATIENCE)
    except (OSError, ValueError, TimeoutError) as error:
        raise SchedulerError(
            f"no Dask scheduler answers there ({error})", where=scheduler, hint="start one with `dask scheduler`"
        ) from None
    try:
        _require_workers(client, scheduler, worker_patience)
        yield client
    finally:
        client.close()


def _require_workers(client: Any, scheduler: str, patience: float) -> None:
    """Check that there are workers, of one thread each: an item is timed by its process."""
    command = f"`dask worker --nworkers -1 --nthreads 1 {scheduler}`"
    try:
        client.wait_for_workers(1, timeout=patience)
    except TimeoutError:
        raise SchedulerError(
            f"the scheduler has no worker, after {patience:g} s",
            where=scheduler,
            hint=f"start one for each processor: {command}",
        ) from None
    threads = max(client.nthreads().values())
    if threads > 1:
        raise SchedulerError(
            f"a worker there has {threads} threads", where=scheduler, hint=f"start one for each processor: {command}"
        )


def _require_listening(scheduler: str) -> None:
    """Check that the address accepts connections: Dask would retry for long and log much."""
    parts = urlsplit(scheduler)
    try:
        if parts.scheme != "tcp" or parts.hostname is None or parts.port is None:
            raise ValueError("an address has the form tcp://host:port")
        # In a thread, because looking up a name has no timeout.
        lookup = ThreadPoolExecutor(1)
        lookup.submit(_touch, parts.hostname, parts.port).result(timeout=SCHEDULER_PATIENCE)
        lookup.shutdown(wait=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise SchedulerError(
            f"no Dask scheduler can be reached there ({error or 'no answer'})",
            where=scheduler,
            hint="start one with `dask scheduler`, and workers with `dask worker`",
        ) from None


def _touch(host: str, port: int) -> None:
    socket.create_connection((host, port), timeout=SCHEDULER_PATIENCE / 2).close()
