"""Requests to map servers: refusals as exceptions, the reason of a failure in a few words."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

BUSY = frozenset({429, 502, 503, 504})
"""HTTP statuses of a server that may answer the same request later."""


class RefusedError(Exception):
    """An answer that is not the data.

    status      : HTTP status
    retry_after : seconds to wait before a retry (header ``Retry-After``), infinite if not stated
    """

    def __init__(self, status: int, reason: str, *, retry_after: float = math.inf) -> None:
        super().__init__(f"HTTP {status}, {reason}" if reason else f"HTTP {status}")
        self.status = status
        self.retry_after = retry_after


@contextmanager
def open_session(user_agent: str) -> Iterator[Any]:
    """A `requests.Session` that raises RefusedError for every HTTP error."""
    import requests  # noqa: PLC0415 - heavy

    with requests.Session() as session:
        session.headers.update({"User-Agent": user_agent, "Accept-Language": "en"})
        session.hooks["response"].append(_raise_refusal)
        yield session


def _raise_refusal(response: Any, *_: Any, **__: Any) -> None:
    if response.status_code >= 400:
        stated = response.headers.get("Retry-After", "")
        wait = float(stated) if stated.isdigit() else math.inf
        raise RefusedError(response.status_code, response.reason or "", retry_after=wait)


def cause(error: BaseException) -> str:
    """The innermost reason of a failed request, at most 120 characters."""
    while (inner := error.__cause__ or error.__context__) is not None:
        error = inner
    text = " ".join(str(getattr(error, "strerror", None) or error).split())
    return text[:120] or type(error).__name__
