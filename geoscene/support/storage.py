"""Scenes and datasets in object storage: s3://, gs://, file:// and other protocols of fsspec.

Programs work on local files. What is read is fetched into a cache when it is needed; what is written is
made in a local folder and then published, so that a folder in storage is complete or none.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from geoscene.errors import GeosceneError, InputError, MissingExtraError, StorageError, need
from geoscene.support.digests import digest, file_digest
from geoscene.support.files import atomic_path, exclusive
from geoscene.support.progress import Progress, silent
from geoscene.support.urls import without_secrets

_URL = re.compile(r"([a-z][a-z0-9+.-]+):(?:/+(.*))?")
_PACKAGES = {"gs": "gcsfs", "gcs": "gcsfs"}
"""Packages of protocols that the extra does not bring."""

_AT_ONCE = 8
"""Files that are transferred at once: small ones wait for answers most of the time."""

_fetching = threading.Lock()


def url_of(path: str | os.PathLike[str]) -> str:
    """The URL of a folder, mended where `pathlib` has collapsed ``s3://``; empty for a local path.

    Raises InputError for a URL that ends after its protocol.
    """
    found = _URL.fullmatch(os.fspath(path))
    if not found:
        return ""
    scheme, rest = found.groups()
    if not rest:
        raise InputError(f"{scheme}://: names no folder; give one, such as {scheme}://BUCKET/NAME")
    return f"{scheme}://{'/' if scheme == 'file' else ''}{rest}".rstrip("/")


def shown(path: str | os.PathLike[str]) -> str:
    """A path or URL as it is given on the command line, without secrets."""
    return without_secrets(url_of(path) or os.fspath(path))


def cache_folder() -> Path:
    """Folder of fetched files and of files to be published, in the user's home."""
    return Path.home() / ".cache" / "geoscene"


@dataclass(frozen=True)
class StoredFolder:
    """A folder in object storage; its methods raise StorageError, which names it.

    url     : such as s3://bucket/name, without a slash at the end
    digests : of files in it by name, which `local` verifies
    """

    url: str
    digests: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The URL without secrets, for messages and records."""
        return without_secrets(self.url)

    def read(self, name: str) -> bytes:
        """Contents of a file."""
        with self._reached() as (system, root):
            data: bytes = system.cat_file(f"{root}/{name}")
        return data

    def listed(self, *, depth: int | None = None) -> dict[str, dict[str, Any]]:
        """Names of files, with their metadata in the storage.

        depth : of the folders, 1 for the files in the folder itself; all by default
        """
        with self._reached() as (system, root):
            system.invalidate_cache()
            try:
                found = system.find(root, maxdepth=depth, detail=True)
            except FileNotFoundError:
                return {}
        start = f"{root.strip('/')}/"
        names = {path.strip("/"): about for path, about in found.items()}
        return {name.removeprefix(start): about for name, about in names.items() if name.startswith(start)}

    def fetch(self, name: str, path: Path) -> None:
        """Write a file of the folder to ``path``, atomically; it must have its digest, if one is stated."""
        with atomic_path(path) as part:
            with self._reached() as (system, root):
                system.get_file(f"{root}/{name}", str(part))
            if self.digests.get(name) not in (None, file_digest(part)):
                raise StorageError(f"{self.name}/{name}: differs from what the build wrote; publish it again")

    def local(self, name: str, folder: Path) -> Path:
        """Path of a file in a cache folder, fetched if it is one of the `digests` and not there yet.

        Raises StorageError if it is not the file of which the digest was stated.
        """
        path = folder / name
        if name in self.digests and not path.exists():
            with _fetching:
                if not path.exists():
                    self.fetch(name, path)
        return path

    def check_writable(self) -> None:
        """Write and remove a file."""
        name = f"{secrets.token_hex(8)}.part"
        with self._reached() as (system, root):
            system.pipe_file(f"{root}/{name}", b"probe")
            system.rm_file(f"{root}/{name}")

    def mirror(self, folder: Path, *, depth: int | None = None, progress: Progress = silent) -> None:
        """Fetch all files that are missing in a local folder or differ there, and remove others from it.

        depth : of the folders, 1 for the files in the folder itself; all by default
        """
        listed = self.listed(depth=depth)
        for path in list(folder.rglob("*")):
            place = path.relative_to(folder)
            within = depth is None or len(place.parts) <= depth
            if within and path.is_file() and place.as_posix() not in listed:
                path.unlink()
        wanted = [
            name for name, about in listed.items() if not self._same(folder / name, name=name, about=about)
        ]
        self._each(lambda name: self.fetch(name, folder / name), wanted, stage="fetching", progress=progress)

    def publish(
        self, folder: Path, *, last: str, before: Sequence[str] = (), progress: Progress = silent
    ) -> None:
        """Make the folder in storage that of local files; files that are the same already are kept.

        last   : name of the file that marks a complete folder; removed first, written last
        before : names of files in storage that are removed if they are not among the local ones
        """
        names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        listed, mark = self.listed(), f"{last}.part"
        former = set(before) | (set(json.loads(self.read(mark))) if mark in listed else set())
        stale = sorted((former & set(listed)) - names)
        same = {
            name for name in names & set(listed) if self._same(folder / name, name=name, about=listed[name])
        }
        changed = sorted(names - same - {last})
        if changed or stale or last not in same:
            with self._reached() as (system, root):
                system.pipe_file(f"{root}/{mark}", json.dumps(sorted(former | names)).encode())
                if last in listed:
                    system.rm_file(f"{root}/{last}")
            self._each(
                lambda name: self._put(name, folder / name), changed, stage="uploading", progress=progress
            )
            self._each(self._remove, stale, stage="removing", progress=progress)
            self._put(last, folder / last)
            self._remove(mark)
        elif mark in listed:
            self._remove(mark)

    def _put(self, name: str, path: Path) -> None:
        with self._reached() as (system, root):
            system.put_file(str(path), f"{root}/{name}")

    def _remove(self, name: str) -> None:
        with self._reached() as (system, root):
            system.rm_file(f"{root}/{name}")

    def _same(self, path: Path, *, name: str, about: Mapping[str, Any]) -> bool:
        """Whether a file in storage has the contents of a local one."""
        if not path.is_file() or about.get("size") != path.stat().st_size:
            return False
        stated = str(about.get("ETag", "")).strip('"')
        if "md5Hash" in about:
            stated = base64.b64decode(about["md5Hash"]).hex()
        if re.fullmatch("[0-9a-f]{32}", stated):
            with path.open("rb") as file:
                return hashlib.file_digest(file, "md5").hexdigest() == stated
        return digest(self.read(name)) == file_digest(path)

    def _each(
        self, work: Callable[[str], None], names: Sequence[str], *, stage: str, progress: Progress
    ) -> None:
        """Do some work for many files at once; the first error ends it."""
        pool = ThreadPoolExecutor(_AT_ONCE)
        try:
            running = [pool.submit(work, name) for name in names]
            for done, future in enumerate(as_completed(running), 1):
                future.result()
                progress(stage, done, total=len(names))
        finally:
            pool.shutdown(cancel_futures=True)

    @contextmanager
    def _reached(self) -> Iterator[tuple[Any, str]]:
        """Yield the file system and the path of the folder in it; name the URL in errors of the block."""
        scheme = self.url.partition(":")[0]
        core = need("fsspec.core", "cloud")
        try:
            options = {"auto_mkdir": True} if scheme == "file" else {}
            yield core.url_to_fs(self.url, use_listings_cache=False, **options)
        except ImportError as error:
            install = _PACKAGES.get(scheme, "'geoscene[cloud]'")
            raise MissingExtraError(
                f"{self.name}: {scheme}:// needs a package that is not installed; pip install {install}"
            ) from error
        except (GeosceneError, MemoryError):
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise
            if isinstance(error, ValueError) and "Protocol not known" in str(error):
                raise InputError(
                    f"{self.name}: unknown storage; there are s3://, gs:// and file://"
                ) from error
            text = without_secrets(" ".join(str(error).split()))[:160] or type(error).__name__
            if isinstance(error, FileNotFoundError):
                raise StorageError(f"{self.name}: is not there ({text})") from error
            raise StorageError(
                f"{self.name}: cannot be reached ({text}); check the address, the network and the credentials"
            ) from error


@contextmanager
def publish(
    out: Path,
    *,
    last: str,
    replaces: bool,
    bar: Callable[[], AbstractContextManager[Progress]] = lambda: nullcontext(silent),
) -> Iterator[Path]:
    """Yield a local folder to write; for a URL, its files are published there unless the block raises.

    Files that are already in storage are downloaded first. After the block, new and changed files are
    uploaded, and files that the block deleted are deleted there. After an error a folder that was not in
    storage is kept, for the same command to resume.

    out      : path of this machine, which is yielded, or URL
    last     : name of the file that marks a complete folder and is written last
    replaces : whether a complete folder in storage may be changed
    bar      : gives what transfers before and after the block report their progress to

    Raises InputError for a folder in storage that is complete and must not be changed, or holds other files,
    and StorageError if the storage cannot be written.
    """
    if not (url := url_of(out)):
        yield out
        return
    stored = StoredFolder(url)
    folder = cache_folder() / "spool" / digest(url.encode()) / url.rsplit("/", 1)[-1]
    stored.check_writable()
    with exclusive(folder.parent):
        listed = stored.listed()
        if last in listed and not replaces:
            raise InputError(f"{stored.name}: holds {last}; set `overwrite` to replace it")
        if listed and not {last, f"{last}.part"} & set(listed):
            raise InputError(f"{stored.name}: is not empty and holds no {last}; give another folder")
        before: list[str] = []
        if last in listed:
            before = [name for name in listed if name != f"{last}.part"]
            with bar() as progress:
                stored.mirror(folder, progress=progress)
        try:
            yield folder
        except Exception as error:
            if before:  # it will be fetched again
                shutil.rmtree(folder.parent, ignore_errors=True)
            error.args = tuple(
                a.replace(str(folder), stored.name) if isinstance(a, str) else a for a in error.args
            )
            raise
        with bar() as progress:
            stored.publish(folder, last=last, before=before, progress=progress)
        shutil.rmtree(folder.parent)
