"""A value that is made at its first use."""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Lazy(Generic[Value]):
    """A value that is made once, by the thread that asks for it first; the others wait for it.

    ``functools.cached_property`` is not used: up to Python 3.11 all its objects share a lock, and a fork while one of them
    computes leaves that lock closed for ever in the new process.
    """

    def __init__(self) -> None:
        self._value: Value | None = None
        self._lock, self._process = Lock(), os.getpid()

    def get(self, make: Callable[[], Value]) -> Value:
        """The value; ``make`` gives it where there is none yet."""
        if self._value is None:
            if self._process != os.getpid():
                # The thread that held the lock when this process was forked is not here to open it.
                self._lock, self._process = Lock(), os.getpid()
            with self._lock:
                if self._value is None:
                    self._value = make()
        return self._value
