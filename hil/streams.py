"""Named random streams: counter-based (Philox), keyed by (seed, name), so that no consumer can disturb another."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

_BLOCK = 1024


class Stream:
    """Random numbers of one consumer. Drawn in blocks: the block's index is Philox's counter, so the whole state
    is two positions, and a snapshot costs nothing."""

    def __init__(self, seed: int, name: str) -> None:
        digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=16).digest()
        self._key = np.frombuffer(digest, dtype=np.uint64)
        self._normal = np.empty(0)
        self._uniform: list[float] = []
        self._normal_at = 0  # numbers drawn so far
        self._uniform_at = 0

    def _generator(self, kind: int, block: int) -> np.random.Generator:
        counter = np.array([0, block, kind, 0], dtype=np.uint64)
        return np.random.Generator(np.random.Philox(key=self._key, counter=counter))

    def normal(self, n: int) -> np.ndarray:
        """``n`` standard normals (n ≤ 1024); the result may be a view and must not be written to."""
        offset = self._normal_at % _BLOCK
        if offset + n > _BLOCK:  # start a new block rather than join two
            self._normal_at += _BLOCK - offset
            offset = 0
        if offset == 0 or not len(self._normal):
            self._normal = self._generator(0, self._normal_at // _BLOCK).standard_normal(_BLOCK)
        self._normal_at += n
        return self._normal[offset : offset + n]

    def uniform(self) -> float:
        """One number in [0, 1)."""
        offset = self._uniform_at % _BLOCK
        if offset == 0 or not self._uniform:
            self._uniform = self._generator(1, self._uniform_at // _BLOCK).random(_BLOCK).tolist()
        self._uniform_at += 1
        return self._uniform[offset]

    def snapshot(self) -> tuple[int, int]:
        return self._normal_at, self._uniform_at

    def restore(self, state: tuple[int, int]) -> None:
        self._normal_at, self._uniform_at = state
        self._normal = np.empty(0)
        self._uniform = []


StreamFactory = Callable[[str], Stream]


def streams(seed: int) -> StreamFactory:
    """A factory of the streams of one run."""
    return lambda name: Stream(seed, name)
