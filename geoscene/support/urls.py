"""Addresses as they may be shown and recorded: without passwords, keys and tokens."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_USER = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]*:/{1,3})[^/?#\s\"'<>]*@")
_PARAMETER = re.compile(r"([?&;])([^=&;#\s\"'<>]+)=([^&;#\s\"'<>)]*)")
_SECRET = re.compile(
    r"key|token|secret|sig$|signature|pass|pwd|auth|credential|session|access|^x-amz-|^x-goog-", re.IGNORECASE
)
"""Names of parameters whose values are secrets: keys of services, tokens, parts of signed addresses."""


def without_secrets(text: str) -> str:
    """A text in which addresses have no user and password, and ``***`` for the values of secret parameters.

    ``https://me:pw@host/tiles?key=1&style=2`` becomes ``https://host/tiles?key=***&style=2``. A path of this
    machine is returned as it is.
    """
    return _PARAMETER.sub(_hidden, _USER.sub(r"\1", text))


def _hidden(found: re.Match[str]) -> str:
    """A parameter, with ``***`` for a secret value."""
    return f"{found[1]}{found[2]}=***" if _SECRET.search(found[2]) else found[0]


def redacted(document: Any) -> Any:
    """A document of dictionaries, lists and texts, in which no text has a secret of an address."""
    if isinstance(document, str):
        return without_secrets(document)
    if isinstance(document, Mapping):
        return {key: redacted(value) for key, value in document.items()}
    if isinstance(document, list | tuple):
        return [redacted(value) for value in document]
    return document
