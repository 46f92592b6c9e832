"""Data of a scene that all worlds of a process share and read once."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Hashable, Iterable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Shared(Generic[Value]):
    """Values by key: made once, and known while anyone holds them.

    Those last kept are held here, until others are: a drive is planned, sees satellites and is recorded in
    worlds one after the other, at first in the same place.
    """

    def __init__(self) -> None:
        self._known: weakref.WeakValueDictionary[Hashable, Value] = weakref.WeakValueDictionary()
        self._kept: tuple[Value, ...] = ()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """The value of a key, made if it is not known; threads that want it meanwhile wait."""
        with self._lock:
            found = self._known.get(key)
            if found is None:
                found = self._known[key] = make()
            return found

    def keep(self, values: Iterable[Value]) -> None:
        """Hold values, instead of those kept before."""
        self._kept = tuple(values)
