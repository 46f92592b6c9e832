"""Keys of watermarks and signatures, from files."""

from __future__ import annotations

import hmac
from codecs import BOM_UTF8
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geoscene.errors import need, reason_of
from lidar.errors import InputError

_SHORTEST = 16
"""Bytes of a secret at least; an attacker tries 2^127 of them on average."""


@dataclass(frozen=True)
class Hmac:
    """HMAC-SHA-256 with a shared secret: who can verify can also sign.

    algorithm : name in signed documents
    """

    secret: bytes
    algorithm: str = "hmac-sha256"

    def sign(self, message: bytes) -> bytes:
        """The message's authentication code, 32 bytes."""
        return hmac.digest(self.secret, message, "sha256")

    def verifies(self, message: bytes, signature: bytes) -> bool:
        """Whether the code is of this message and secret."""
        return hmac.compare_digest(self.sign(message), signature)


@dataclass(frozen=True)
class Ed25519:
    """Ed25519 (RFC 8032): the private key signs, the public one only verifies."""

    public: Any
    private: Any = None
    algorithm: str = "ed25519"

    def sign(self, message: bytes) -> bytes:
        """The message's signature, 64 bytes; raises InputError for a public key."""
        if self.private is None:
            raise InputError("a public key cannot sign; give the private one")
        signature: bytes = self.private.sign(message)
        return signature

    def verifies(self, message: bytes, signature: bytes) -> bool:
        """Whether the signature is of this message and key."""
        invalid = need("cryptography.exceptions", "security").InvalidSignature
        try:
            self.public.verify(signature, message)
        except invalid:
            return False
        return True


Signer = Hmac | Ed25519
"""A key that signs, or only verifies."""


def read_secret(path: Path) -> bytes:
    """The secret in a file: hexadecimal digits, or bytes as they are.

    Raises InputError for a file that cannot be read, or a secret of fewer than 16 bytes.
    """
    data = _contents(path)
    try:
        secret = bytes.fromhex(data.removeprefix(BOM_UTF8).decode("ascii"))
    except ValueError:
        secret = data
    if len(secret) < _SHORTEST:
        raise InputError(
            f"{path}: a key of {len(secret)} bytes; give {_SHORTEST} or more, as of: openssl rand -hex 32"
        )
    return secret


def read_signer(path: Path) -> Signer:
    """The key in a file: a PEM file of Ed25519, private or public, or a secret for HMAC-SHA-256.

    Raises InputError for a file that holds neither, and MissingExtraError for PEM without ``cryptography``.
    """
    data = _contents(path).removeprefix(BOM_UTF8)
    if not data.lstrip().startswith(b"-----BEGIN"):
        return Hmac(read_secret(path))
    serialization = need("cryptography.hazmat.primitives.serialization", "security")
    ed25519 = need("cryptography.hazmat.primitives.asymmetric.ed25519", "security")
    try:
        if b"PRIVATE KEY" in data:
            private = serialization.load_pem_private_key(data, password=None)
            if isinstance(private, ed25519.Ed25519PrivateKey):
                return Ed25519(private.public_key(), private)
        else:
            public = serialization.load_pem_public_key(data)
            if isinstance(public, ed25519.Ed25519PublicKey):
                return Ed25519(public)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as a key ({reason_of(error)})") from None
    raise InputError(f"{path}: is not an Ed25519 key; make one by: openssl genpkey -algorithm ed25519")


def _contents(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a key ({error.strerror})") from None
