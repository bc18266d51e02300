"""Runs on a Dask cluster: every worker does one at a time, on as many threads as it was given."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from types import ModuleType

from greenough.instrument.errors import InputError

from .runs import Outcome, Run, execute
from .study import Execute
from .threads import threads_limited

TIMEOUT_S = 30
"""How long the scheduler has to answer, and the first worker to be there."""

_one_at_a_time = threading.Lock()
"""Of this process: Mitsuba's scenes and Dr.Jit's threads are those of the whole process."""


def on_cluster(address: str) -> Execute:
    """How to do runs on the workers of the scheduler at ``address``, for example ``tcp://host:8786``.

    A run whose worker dies is given to another. Results come back to this process, so that no folder is shared.

    Raises
    ------
    InputError
        If Dask is not installed, and from the runs: if the scheduler or its workers do not answer, if the scheduler is
        lost, and, when all others are done, if runs were given up because their workers kept dying.
    """
    distributed = dask()

    def execute_all(runs: Sequence[Run]) -> Iterator[tuple[Run, Outcome]]:
        try:
            client = distributed.Client(address, timeout=TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {address}: {error}") from None
        lost = []
        with closing(client):
            try:
                client.wait_for_workers(1, timeout=TIMEOUT_S)
            except TimeoutError:
                raise InputError(
                    f"the scheduler at {address} has no workers: start some with dask worker {address} --nthreads 1"
                ) from None
            waiting = {client.submit(execute_in_worker, run, key=run.digest): run for run in runs}
            try:
                for future in distributed.as_completed(waiting, loop=client.loop):
                    run = waiting.pop(future)
                    if isinstance(future.exception(), distributed.KilledWorker):
                        lost.append(run)
                    else:
                        yield run, future.result()
            except (distributed.comm.CommClosedError, distributed.client.FutureCancelledError):
                raise InputError(f"the scheduler at {address} was lost: give the same command again to go on") from None
        if lost:
            names = ", ".join(f"{run.case} of seed {run.seed}" for run in lost)
            raise InputError(f"workers died of {names}: give them more memory, and the same command again to go on")

    return execute_all


def dask() -> ModuleType:
    """The package ``distributed``; raises InputError where it is not installed."""
    try:
        import distributed
    except ModuleNotFoundError:
        raise InputError(
            "clusters need Dask, which is not installed: pip install 'greenough[cluster]' here and on every worker"
        ) from None
    return distributed


def execute_in_worker(run: Run) -> Outcome:
    """Do one run in a worker of Dask, on the worker's number of threads.

    Raises InputError as ``runs.execute`` does.
    """
    from distributed import get_worker

    with _one_at_a_time, threads_limited(get_worker().state.nthreads):
        return execute(run)
