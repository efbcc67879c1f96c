"""Workers of a Dask cluster, of this machine or of many: reached, listened to, and mourned."""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeVar

from hdmap_tools.errors import ClusterError, MissingExtraError

if TYPE_CHECKING:
    from distributed import Client

_Made = TypeVar("_Made")

_PROGRESS: Final = "hdmap-progress"
_ANSWERS_WITHIN_S: Final = 20.0
_AHEAD: Final = 3
_ENVIRONMENT: Final = "distributed.nanny.pre-spawn-environ"


@dataclass(frozen=True)
class Workers:
    """Where a build is spread.

    Attributes:
        number: Processes on this machine; 0 with a scheduler.
        scheduler: Address of a Dask scheduler that runs already, ``tcp://host:port``.
        memory: Limit of each process on this machine, as Dask writes it (``2GB``).
    """

    number: int = 0
    scheduler: str | None = None
    memory: str | None = None


@contextmanager
def connected(workers: Workers) -> Iterator[Client]:
    """A client of the cluster; that of this machine is started, and ended with the block.

    Raises:
        MissingExtraError: If Dask is not installed.
        ClusterError: If there is no scheduler at the address, or it has no workers.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise MissingExtraError(
            "Spreading work over processes needs Dask: pip install 'hdmap_tools[distributed]'."
        ) from error
    # Workers that come and go are reported as errors of the build, if they are any.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with ExitStack() as stack:
        if workers.scheduler is None:
            stack.enter_context(dask.config.set({_ENVIRONMENT: _worker_environment()}))
            cluster = LocalCluster(
                n_workers=workers.number,
                threads_per_worker=1,
                processes=True,
                memory_limit=workers.memory or "auto",
                dashboard_address="127.0.0.1:0",  # the usual port may be another build's
                silence_logs=logging.ERROR,
            )
            yield stack.enter_context(Client(stack.enter_context(cluster)))
            return
        try:
            client = stack.enter_context(Client(workers.scheduler, timeout=_ANSWERS_WITHIN_S))
        except (OSError, TimeoutError, ValueError) as error:
            raise ClusterError(
                f"No Dask scheduler answers at {workers.scheduler} ({error or type(error).__name__}); "
                "start one with `dask scheduler`, or take --workers N for processes of this machine."
            ) from error
        if not client.scheduler_info()["workers"]:
            raise ClusterError(
                f"The scheduler at {workers.scheduler} has no workers; start some with "
                f"`dask worker {workers.scheduler}`."
            )
        yield client


def _worker_environment() -> dict[str, Any]:
    """What Dask sets for workers, but for one thing: that memory is given back at each chance.

    Every array of a sweep or image would be mapped and filled with zeros by the kernel anew:
    building a point map spent a third of its time so.
    """
    import dask

    usual: dict[str, Any] = dask.config.get(_ENVIRONMENT)
    return {name: value for name, value in usual.items() if name != "MALLOC_TRIM_THRESHOLD_"}


def num_threads(client: Client) -> int:
    """Tasks that its workers do at a time; at least 1, for those that died come back."""
    threads: dict[str, int] = client.nthreads()
    return max(1, sum(threads.values()))


def queue_length(client: Client) -> int:
    """Tasks to have submitted: for each worker one at work, and two that wait while others are dealt with."""
    return _AHEAD * max(1, len(client.scheduler_info()["workers"]))


def as_they_get_done(
    client: Client, function: Callable[..., _Made], items: Iterable[tuple[Any, ...]]
) -> Iterator[_Made]:
    """What ``function(*item)`` gives for each item, computed on the workers, a few items ahead.

    Raises:
        HDMapError: Whatever a worker raised; what was submitted is then given up.
    """
    from distributed import wait

    source, doing = iter(items), set[Any]()
    try:
        while True:
            room = queue_length(client)
            while len(doing) < room and (item := next(source, None)) is not None:
                doing.add(client.submit(function, *item, pure=False))
            if not doing:
                return
            done = wait(doing, return_when="FIRST_COMPLETED").done
            doing -= done
            for future in done:
                yield future.result()
    finally:
        client.cancel(list(doing))


@contextmanager
def listening(client: Client, hear: Callable[[], object]) -> Iterator[str]:
    """Have `hear` called, in another thread, each time that a task tells (`teller`) of progress.

    Returns:
        What the tasks must give to `teller`.
    """
    name = uuid.uuid4().hex

    def received(event: Any) -> None:
        if event[1] == name:  # a scheduler may serve several builds
            hear()

    client.subscribe_topic(_PROGRESS, received)
    try:
        yield name
    finally:
        client.unsubscribe_topic(_PROGRESS)


def teller(name: str) -> Callable[[], None]:
    """In a task: what tells whoever is `listening` under that name."""
    from distributed import get_worker

    return partial(get_worker().log_event, _PROGRESS, name)


@contextmanager
def deaths_explained(kept: str) -> Iterator[None]:
    """What it means that workers die at each attempt.

    Args:
        kept: Said of what was done so far.

    Raises:
        ClusterError: Instead of Dask's own error.
    """
    from distributed.scheduler import KilledWorker

    try:
        yield
    except KilledWorker as error:
        raise ClusterError(
            "Workers died again and again on one part of the work; most often they run out of "
            f"memory: give each more, or take fewer (--workers). {kept}"
        ) from error
