"""Results on disk: a file or a folder holds its old content or its new one, whole, whenever the program is killed.

All writers of results write beside the place and then rename.  Names beside are unique, so that two programs may write
to one place: the one that comes last stays.  A temporary file of a killed program is removed by a later writer.
"""

from __future__ import annotations

import bz2
import csv
import ctypes
import errno
import glob
import gzip
import io
import math
import os
import shutil
import time
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np

from kalmark.errors import KalmarkError

STALE_S = 3600.0  # older than this, what is beside a result was left by a program that was killed
POLL_S = 0.05  # between two tests of a lock
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of Linux
DEEPEST = 12  # levels of a YAML file: a configuration has 5
MOST_NODES = 1_000_000  # of a YAML file, its aliases counted as what they stand for
PIECE = 1 << 20  # bytes that are unpacked at once
FREE_BYTES = 1 << 26  # of an archive: what it may unpack to, whatever its own size
MOST_PACKED = 100  # times its own size that it may unpack to beyond that: results stay below


def write(path: Path, text: str) -> None:
    """Write a text file so that it is there completely or not at all."""
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def csv_text(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return the text of a CSV file; numbers have as many digits as they need to be read back as they are."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([header, *rows])
    return out.getvalue()


def replace_file(path: Path, writer: Callable[[Path], Any]) -> None:
    """Let `writer` write a temporary file beside `path`, then put it in its place, on the disk when this returns."""
    path = Path(os.path.realpath(path))
    with _unused_name(path) as temporary:
        writer(temporary)
        _sync(temporary)
        temporary.replace(path)
        _sync(path.parent)


def replace_folder(folder: Path, writer: Callable[[Path], Any], own: Sequence[str], last: str) -> None:
    """Let `writer` write a new folder beside `folder`, then exchange the two; what the old one holds besides stays.

    `own` are the patterns of the names that a writer may write, of which those of the old content go.  Where folders
    cannot be exchanged (no Linux, a mount point, the working folder, no right to write beside) the files are put in
    place one by one: the file `last` goes first and comes last, and a folder that has it is complete.
    """
    folder = Path(os.path.realpath(folder))
    folder.parent.mkdir(parents=True, exist_ok=True)
    stays = folder.is_dir() and (folder.is_mount() or folder.samefile(Path.cwd()))
    stays = stays or not os.access(folder.parent, os.W_OK)
    with _unused_name(folder / folder.name if stays else folder) as made:
        made.mkdir()
        writer(made)
        for path in made.rglob("*"):
            _sync(path)
        if not folder.exists():
            with suppress(OSError):  # another program was faster
                made.rename(folder)
                _sync(folder.parent)
                return
        with hold_lock(folder):
            if stays or not _exchanged(made, folder, own):
                _put_in_place(made, folder, own, last)
        _sync(folder.parent)


def _exchanged(made: Path, folder: Path, own: Sequence[str]) -> bool:
    """Exchange two folders, the other content of the old one carried over; return whether that could be done."""
    try:
        shutil.copymode(folder, made)
        _carry_over(folder, made, own, partial(os.link, follow_symlinks=False))
        _exchange(made, folder)
    except (OSError, NotImplementedError):
        return False
    _carry_over(made, folder, own, os.rename)  # what came into the old one meanwhile
    return True


def _carry_over(old: Path, new: Path, own: Sequence[str], carry: Callable[[Path, Path], Any]) -> None:
    """Bring all of a folder that is not its writer's into another, where that is not there yet."""
    for top, folders, names in os.walk(old):
        place = new / Path(top).relative_to(old)
        if top == str(old):
            folders[:] = [name for name in folders if not _is(name, own)]
            names = [name for name in names if not _is(name, own)]  # noqa: PLW2901 - of the top alone
        for name in [*names, *(name for name in folders if Path(top, name).is_symlink())]:
            if not os.path.lexists(place / name):
                carry(Path(top, name), place / name)
        for name in folders:
            if not os.path.lexists(place / name):
                (place / name).mkdir()
                shutil.copymode(Path(top, name), place / name)


def _exchange(one: Path, other: Path) -> None:
    """Exchange two names of the file system in one step.  Raises OSError where the system cannot."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if os.name == "posix" else None
    if call is None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    if call(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _put_in_place(made: Path, folder: Path, own: Sequence[str], last: str) -> None:
    """Replace a folder's files by those of another folder, one by one."""
    (folder / last).unlink(missing_ok=True)
    for path in [path for path in folder.iterdir() if _is(path.name, own)]:
        _remove(path)
    for path in sorted(made.rglob("*"), key=lambda path: (path.name == last, path)):
        place = folder / path.relative_to(made)
        if path.is_dir() and not path.is_symlink():
            place.mkdir(exist_ok=True)
        else:
            path.replace(place)


def _is(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(name, pattern) for pattern in patterns)


@contextmanager
def _unused_name(path: Path) -> Iterator[Path]:
    """Give an unused name beside a path, of its suffix; what is there at the end is removed."""
    head, tail = f".{path.stem[:40]}.", f".part{path.suffix}"  # names have 255 bytes at most
    for left in path.parent.glob(f"{glob.escape(head)}*{glob.escape(tail)}"):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > STALE_S:
                _remove(left)
    temporary = path.with_name(f"{head}{token_hex(4)}{tail}")
    try:
        yield temporary
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Have a file, or the names in a folder, on the disk: it survives a power cut from here on."""
    with suppress(OSError):  # a system that cannot, of a folder or at all
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


@contextmanager
def hold_lock(path: Path, shared: bool = False, wait_s: float | None = None) -> Iterator[bool]:
    """Hold the lock of a folder, or of a file NAME.lock, which is made if it is missing; yield whether it was got.

    Waits for other programs, for at most `wait_s`.  Goes on without where the system has no locks or cannot open it.
    """
    handle = -1
    try:
        handle = _locked(path, shared, wait_s)
        yield handle >= 0
    finally:
        if handle >= 0:
            os.close(handle)


def _locked(path: Path, shared: bool, wait_s: float | None) -> int:
    try:
        import fcntl
    except ImportError:  # Windows
        return -1
    until = None if wait_s is None else time.monotonic() + wait_s
    how = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    while True:
        handle = -1
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT if path.suffix == ".lock" else os.O_RDONLY)
            fcntl.flock(handle, how if until is None else how | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except BlockingIOError:
            if until is not None and time.monotonic() > until:
                os.close(handle)
                return -1
            time.sleep(POLL_S)
        except OSError:  # nothing there, a file system without locks, or one that cannot be written
            if handle >= 0:
                os.close(handle)
            return -1
        if handle >= 0:
            os.close(handle)


def read_arrays(path: Path, error: type[KalmarkError]) -> dict[str, Any]:
    """Read the arrays of an .npz file, each of the length in its header.  Raises `error`, ValueError or OSError."""
    arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            refuse_bomb(archive, path, error)
            for name in archive.namelist():
                arrays[name.removesuffix(".npy")] = _array(archive.read(name))
    except (zipfile.BadZipFile, zlib.error, EOFError) as damage:
        raise error(f"{path}: {damage}, expected a whole file of arrays") from None
    return arrays


def _array(data: bytes) -> Any:
    """Return the array that the content of an .npy file is.  Raises ValueError."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError(f"an array {shape} of {dtype} in {len(data)} bytes")
    array = np.frombuffer(data, dtype, offset=file.tell()) if dtype.itemsize else np.zeros(math.prod(shape), dtype)
    return array.reshape(shape, order="F" if fortran else "C").copy()


def refuse_aliases(content: Any, where: str, error: type[KalmarkError]) -> None:
    """Refuse the content of a YAML file that is nested too deeply, or whose aliases make far more of it than it has."""
    waiting, count = [(content, 0)], 0
    while waiting:
        node, depth = waiting.pop()
        count += 1
        if depth > DEEPEST:  # an alias to what it is in has no end
            raise error(f"{where}: nested deeper than {DEEPEST} levels, expected fewer")
        if count > MOST_NODES:
            raise error(f"{where}: its aliases make more than {MOST_NODES} values of it, expected fewer")
        below = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        waiting += [(each, depth + 1) for each in below]


def unpack_file(path: Path, error: type[KalmarkError]) -> Iterator[bytes]:
    """Yield a .gz or .bz2 file unpacked, piece by piece.  Raises `error` if it is damaged or unpacks to too much."""
    try:
        most = unpacked_limit(path)
        with (bz2.open if path.suffix == ".bz2" else gzip.open)(path) as file:
            while piece := file.read(PIECE):
                if file.tell() > most:
                    raise error(f"{path}: unpacks to more than {most} bytes, expected at most that for its size")
                yield piece
    except (OSError, EOFError, zlib.error) as damage:
        raise error(f"{path}: cannot be unpacked ({damage}), expected a complete file") from None


def unpacked_limit(path: Path) -> int:
    """Return how many bytes a compressed file of this size may unpack to."""
    return FREE_BYTES + MOST_PACKED * path.stat().st_size


def refuse_bomb(archive: zipfile.ZipFile, path: Path, error: type[KalmarkError]) -> None:
    """Refuse an archive whose members have sizes far larger than the file, before any of them is unpacked."""
    size, most = sum(member.file_size for member in archive.infolist()), unpacked_limit(path)
    if size > most:
        raise error(f"{path}: {size} bytes in a file of {path.stat().st_size}, expected at most {most}")
