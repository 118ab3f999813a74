"""Units of work on the machines of a Dask cluster, in the place of processes here; the results are the same.

A worker that dies loses the unit it was busy with; the scheduler gives the unit to another worker, as often as its
configuration ``distributed.scheduler.allowed-failures`` allows; after that the unit is lost. Every worker reports the
version of its code when it joins: another version would compute other results.
"""

import re
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from typing import Any, ClassVar, Self, TypeVar

from toolkit.errors import VislamError
from toolkit.experiment.outcome_store import code_digest, numeric_versions
from toolkit.experiment.workers import LostUnit, Needs, Work
from toolkit.progress import SILENT, Progress

T = TypeVar("T")
R = TypeVar("R")
Version = tuple[str, dict[str, str]]

_ADDRESS = re.compile(r"([a-z]+://)?[^\s/]+:\d+")
_CONNECT_S = 10.0
_INSTALL = "pip install 'vislam-toolkit[cluster]'"


class ClusterError(VislamError):
    """A cluster that cannot be reached, or whose workers cannot do the work."""

    exit_status: ClassVar[int] = 71


class Cluster:
    """The workers of a Dask scheduler, in the place of processes here; a context that ends the connection.

    ``count`` is how many there were at first; more may join. Raises ClusterError where the scheduler cannot be reached,
    has no worker, or one runs another version or several threads, which would share the times of one another.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        self._client = _connected(address)
        try:
            self.count = self._checked_workers()
        except BaseException:
            self._client.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def results(
        self, units: Sequence[T], work: Work[T, R], progress: Progress, _needs: Needs[T] | None = None
    ) -> Generator[tuple[int, R | LostUnit], None, None]:
        """Yield the place and the result of every unit as each is there; the scheduler chooses the workers.

        An error that the work raises ends everything and is raised here. Raises ClusterError where the scheduler goes
        away or a worker of another version joins.
        """
        from distributed import as_completed

        version = _version()
        futures = [self._client.submit(_do, work, unit, version, pure=False) for unit in units]
        places = {future.key: place for place, future in enumerate(futures)}
        progress.advance(0, len(units))
        try:
            for done, future in enumerate(as_completed(futures, loop=self._client.loop), start=1):
                yield places[future.key], self._result(future)
                future.release()
                progress.advance(done, len(units))
        finally:
            self._client.cancel([future for future in futures if not future.done()])

    def _result(self, future: Any) -> Any:
        from distributed import KilledWorker
        from distributed.comm.core import CommClosedError

        try:
            return future.result()
        except KilledWorker as error:
            return LostUnit(
                f"the workers that tried it ended before they answered ({error.allowed_failures + 1} of them)"
            )
        except (CancelledError, CommClosedError, TimeoutError) as error:
            raise ClusterError(f"the scheduler at {self._address} went away; repeat with the same --out") from error

    def _checked_workers(self) -> int:
        threads = self._client.nthreads()
        if not threads:
            raise ClusterError(f"the scheduler at {self._address} has no worker; start one: dask worker --nthreads 1")
        several = next((worker for worker, count in threads.items() if count != 1), None)
        if several is not None:
            raise ClusterError(f"the worker {several} runs several threads; start it with --nthreads 1")
        answers = self._client.run(_version, on_error="return")
        for worker, answer in answers.items():
            if isinstance(answer, Exception):
                raise ClusterError(
                    f"the worker {worker} lacks the toolkit ({answer}); install the version of this side"
                )
            _check_version(worker, answer, _version())
        return len(threads)


def _connected(address: str) -> Any:
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise ClusterError(f"a cluster needs the package {error.name}: {_INSTALL}") from error
    if not _ADDRESS.fullmatch(address):  # Dask would leave a connection behind that cannot be closed
        raise ClusterError(f"{address} is no address of a scheduler; give one like tcp://host:8786")
    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        why = " ".join(str(error).split()) or "no answer"
        raise ClusterError(f"no scheduler can be reached at {address} ({why}); check the address") from error


def _version() -> Version:
    return code_digest(), numeric_versions()


def _do(work: Callable[[T, Progress], R], unit: T, version: Version) -> R:
    _check_version("that joined", _version(), version)
    return work(unit, SILENT)


def _check_version(worker: str, theirs: Version, ours: Version) -> None:
    if theirs == ours:
        return
    packages = [
        f"{name} {theirs[1].get(name)}, not {ours[1][name]}" for name in ours[1] if theirs[1].get(name) != ours[1][name]
    ]
    what = ", ".join(packages) or "another version of the toolkit or of the estimators"
    raise ClusterError(f"the worker {worker} has {what}; install the version of this side there")
