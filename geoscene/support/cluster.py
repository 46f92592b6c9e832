"""Runs tasks on the workers of an existing Dask cluster, which may be on other machines."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from geoscene import __version__
from geoscene.errors import InputError, WorkersLostError, need
from geoscene.support.digests import file_digest, sources_digest
from geoscene.support.files import write_atomically

log = logging.getLogger(__name__)

_SECONDS = 20
"""To wait for the scheduler, and then for its first worker."""

Task = TypeVar("Task")
Result = TypeVar("Result")


class DaskCluster:
    """A connection to a Dask scheduler; `connect` makes it."""

    def __init__(self, client: Any, *, address: str) -> None:
        self._client, self._address = client, address
        log.info("the workers' progress: %s", client.dashboard_link)

    def check(self, out: Path, *, inputs: Sequence[Path] = ()) -> None:
        """Check that all workers have this version and see what this process sees.

        out    : folder to write to
        inputs : files to read

        Raises InputError for one that does not.
        """
        probe = out / f"{secrets.token_hex(8)}.part"
        write_atomically(probe, secrets.token_bytes(16))
        wanted = {path: file_digest(path) for path in (probe, *inputs)}
        try:
            found = self._client.run(_worker_sees, list(wanted))
        except ModuleNotFoundError as error:
            raise InputError(
                f"`scheduler` {self._address}: its workers have no module {error.name};"
                f" install geoscene {__version__} where they run"
            ) from error
        finally:
            probe.unlink()
        for worker, (version, sources, digests) in sorted(found.items()):
            if sources != sources_digest("geoscene"):
                raise InputError(
                    f"`scheduler` {self._address}: the sources of geoscene {version} of worker {worker}"
                    f" are not those of this program, {__version__}; install the same version"
                )
            for path, seen in zip(wanted, digests, strict=True):
                if seen != wanted[path]:
                    raise InputError(
                        f"{out if path == probe else path}: worker {worker} of the cluster does not see it;"
                        " workers need inputs and outputs under the same paths as this program (a shared file"
                        " system)"
                    )

    def run_tasks(self, work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[Result]:
        """Yields the results of ``work`` for all tasks, in the order of their completion.

        The tasks of workers that are lost go to others; without workers they wait for the next one. Tasks
        that have not begun are dropped when the iterator is closed or raises.

        Raises the errors of ``work``, and WorkersLostError if the scheduler ends, or several workers in
        succession die of the same task.
        """
        distributed = need("distributed", "cluster")
        futures = [self._client.submit(work, task, pure=False) for task in tasks]
        try:
            for future in distributed.as_completed(futures, loop=self._client.loop):
                yield cast("Result", future.result())
                future.release()
        except distributed.KilledWorker as error:
            raise WorkersLostError(
                "several workers of the cluster died of one task, perhaps out of memory; the finished part is"
                " kept: repeat the command with workers that have more memory"
            ) from error
        except distributed.CancelledError as error:
            raise WorkersLostError(
                f"`scheduler` {self._address}: the connection is lost; the finished part is kept: repeat the"
                " command"
            ) from error
        finally:
            self._client.cancel(futures)


@contextmanager
def connect(address: str) -> Iterator[DaskCluster]:
    """Yield a connection to the Dask scheduler at ``address``, such as ``tcp://HOST:8786``.

    Raises InputError if none answers or it has no workers, and MissingExtraError without Dask.
    """
    distributed = need("distributed", "cluster")
    try:
        client = distributed.Client(address, timeout=_SECONDS, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(
            f"`scheduler` {address}: no Dask scheduler answers there ({line}); start one with: dask scheduler"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=_SECONDS)
        except TimeoutError as error:
            raise InputError(
                f"`scheduler` {address}: it has no workers; start some with: dask worker {address}"
            ) from error
        yield DaskCluster(client, address=address)


def _worker_sees(paths: Sequence[Path]) -> tuple[str, str, list[str]]:
    """Version of this package, digest of its sources, and digests of files; run by workers."""
    return __version__, sources_digest("geoscene"), [file_digest(path) for path in paths]
