"""Calls spread over processes of this machine (joblib's loky), or of a cluster (Dask): results as they come."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from hil.errors import UserError

T = TypeVar("T")


def default_jobs() -> int:
    """One per core that this process may use."""
    return len(os.sched_getaffinity(0))


def parallel(function: Callable[..., T], calls: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[T]:
    """Results of ``function(*call)`` in any order. Workers die with this process, whatever kills it."""
    if min(jobs, len(calls)) <= 1:
        yield from (function(*call) for call in calls)
        return
    from joblib import Parallel, delayed

    work = Parallel(n_jobs=min(jobs, len(calls)), backend="loky", return_as="generator_unordered", batch_size=1,
                    pre_dispatch="2*n_jobs")  # fmt: skip
    yield from work(delayed(_as_child)(os.getpid(), function, call) for call in calls)


_adopted = False


def _as_child(parent: int, function: Callable[..., T], call: tuple[Any, ...]) -> T:
    global _adopted
    if not _adopted:
        from hil.backends.lifecycle import die_with_parent

        die_with_parent(parent)
        _adopted = True
    return function(*call)


def on_cluster(function: Callable[..., T], calls: Iterable[tuple[Any, ...]], address: str) -> Iterator[T]:
    """The same on the workers of a Dask scheduler. Raises UserError when there is none at ``address``."""
    from distributed import Client, as_completed

    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise UserError(f"--cluster {address}: no Dask scheduler answers ({error})") from None
    with client:
        futures = [client.submit(function, *call, pure=False) for call in calls]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            client.cancel(futures)
