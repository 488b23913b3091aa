"""Published logs: their list, and downloads from their public repositories, every file checked by its hash.

`KALMARK_DATA_URL` is a mirror: a URL with any of {repo}, {commit}, {path} and {file}, or the URL of a folder laid out
as `KALMARK_DATA` is.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from textwrap import shorten
from typing import NamedTuple
from urllib.parse import quote, urlsplit

from kalmark.errors import DataError
from kalmark.files import hold_lock, refuse_bomb, unpack_file
from kalmark.logs.places import cache_folder
from kalmark.logs.source import spelling_hint

ORIGIN = "https://raw.githubusercontent.com/{repo}/{commit}/{path}"
ELSEWHERE = "set KALMARK_DATA to a folder that has it or KALMARK_DATA_URL to a mirror"
Progress = Callable[[str, int, int], None]
"""Called with a file's name, the bytes that are there and the bytes there will be, of the whole dataset."""


@dataclass(frozen=True)
class DataFile:
    """Name one file of a dataset: where it goes (`file`, below the data folder), its hash and size, its origin."""

    file: str
    sha256: str
    bytes: int
    repo: str
    commit: str
    path: str
    unpack: bool = False


@dataclass(frozen=True)
class Dataset:
    """Describe a dataset that can be fetched; `log` is its path below the data folder.

    >>> [(one.name, one.log) for one in list_data() if isinstance(one, Dataset)][:1]
    [('lost_in_the_woods', 'lost_in_the_woods')]
    """

    name: str
    what: str
    official: str
    licence: str
    log: str
    files: tuple[DataFile, ...]

    @property
    def bytes(self) -> int:
        """The size of all its files."""
        return sum(file.bytes for file in self.files)


class OwnCopy(NamedTuple):
    """Describe a dataset that kalmark reads and does not fetch: `put` is the place for the user's own copy."""

    name: str
    what: str
    put: str


OWN_COPIES = (
    OwnCopy("plaza1", "a robot lawn mower ranging to four radio beacons, true path and beacons",
            "Plaza1_DR.txt, Plaza1_TD.txt and Plaza1_.mat of the package gtsam (gtsam/Data) into KALMARK_DATA/plaza1"),
    OwnCopy("starry_night", "a stereo camera above 20 reflectors, rates, known ids, true poses and map",
            "vincentive_dataset3.mat into KALMARK_DATA/starry_night (its source: docs/datasets3d.md)"),
    OwnCopy("slamtb", "recordings of the Matlab SLAM toolbox: cameras seeing points or segments, its own figures",
            "NAME.json.gz and NAME.npz into KALMARK_ORACLE (docs/datasets3d.md)"),
    OwnCopy("tum_rgbd", "a colour and depth camera held by hand, true poses (CC BY 4.0)",
            "rgbd_dataset_freiburg1_xyz of https://cvg.cit.tum.de/data/datasets/rgbd-dataset anywhere: --log FOLDER"),
    OwnCopy("euroc", "a drone with cameras and an inertial unit, true states",
            "V1_01_easy of https://projects.asl.ethz.ch/datasets/doku.php?id=kmavvisualinertialdatasets anywhere: "
            "--log FOLDER"),
    OwnCopy("kitti_odometry", "a car with cameras in towns, true poses (CC BY-NC-SA 3.0)",
            "its images, calibration and poses of https://www.cvlibs.net/datasets/kitti/eval_odometry.php anywhere: "
            "--log FOLDER"),
)  # fmt: skip


@cache
def list_data() -> tuple[Dataset, ...]:
    """Return the datasets that `fetch` downloads.

    >>> from kalmark.logs import list_data
    >>> [one.name for one in list_data()][:3]
    ['lost_in_the_woods', 'mrclam/MRCLAM_Dataset6', 'mrclam/MRCLAM_Dataset8']
    """
    text = resources.files("kalmark.datasets").joinpath("datasets.json").read_text(encoding="utf-8")
    return tuple(
        Dataset(**{**entry, "files": tuple(DataFile(**file) for file in entry["files"])}) for entry in json.loads(text)
    )


def fetch(name: str, progress: Progress | None = None) -> Path:
    """Return the folder of a dataset, or of all whose name starts with `name/`, downloading what is not there.

    Files in `KALMARK_DATA` are used without the network.  A dataset appears in the cache only once all its files
    have come and fit their hashes.  Raises DataError.

    >>> fetch("lost_in_the_woods").name  # doctest: +SKIP
    'lost_in_the_woods'
    """
    plain = name.strip("/")
    wanted = [dataset for dataset in list_data() if f"{dataset.name}/".startswith(f"{plain}/")]
    if not wanted:
        raise _not_fetched(name)
    roots = {fetch_one(dataset, progress) for dataset in wanted}
    root = roots.pop() if len(roots) == 1 else cache_folder()
    return root / (wanted[0].log if len(wanted) == 1 else plain)


def _not_fetched(name: str) -> DataError:
    """Return the error of a name that no dataset has, naming those that begin like it, or else the nearest."""
    plain, names, own = name.strip("/"), [dataset.name for dataset in list_data()], {o.name: o.put for o in OWN_COPIES}
    if plain in own:
        return DataError(f"dataset {plain!r} cannot be fetched, expected a copy of your own: put {own[plain]}")
    near = [one for one in (*names, *own) if name and one.lower().startswith(plain.lower())]
    hint = f"; did you mean {' or '.join(map(repr, near))}?" if near else spelling_hint(name, (*names, *own))
    return DataError(
        f"dataset {name!r} is unknown, expected one of {', '.join(names)}, or, as a copy of your own, "
        f"{', '.join(own)}{hint}"
    )


def fetch_one(dataset: Dataset, progress: Progress | None) -> Path:
    """Return the data folder that has this dataset, downloading it into the cache if none does."""
    provided = os.environ.get("KALMARK_DATA")
    if provided and all((Path(provided) / file.file).is_file() for file in dataset.files):
        for file in dataset.files:
            check(Path(provided) / file.file, file)
        return Path(provided)
    root = cache_folder()
    with suppress(OSError):  # `download` reports it
        root.mkdir(parents=True, exist_ok=True)
    with hold_lock(root):  # of two programs one downloads
        there = ((root / file.file, file.sha256) for file in dataset.files)
        if not all(path.is_file() and sha256(path) == wanted for path, wanted in there):
            download(dataset, root, progress)
    return root


def download(dataset: Dataset, root: Path, progress: Progress | None) -> None:
    """Download a dataset into a folder aside, and move it to its place when it is complete."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=root, prefix=".fetching-") as aside:
            done = 0
            for file in dataset.files:
                retrieve(file, Path(aside) / file.file, Transfer(file, done, dataset.bytes, progress))
                done += file.bytes
                if file.unpack:
                    unpack(Path(aside) / file.file)
            target = root / dataset.log
            shutil.rmtree(target, ignore_errors=True)
            target.parent.mkdir(parents=True, exist_ok=True)
            (Path(aside) / dataset.log).rename(target)
    except OSError as error:
        raise DataError(f"{root}: {error.strerror or error}, expected a cache that can be written") from None


def retrieve(file: DataFile, place: Path, transfer: Transfer) -> None:
    """Download one file to its place and check its hash.  Raises DataError."""
    import pooch
    import requests

    where = url_of(file)
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        pooch.HTTPDownloader(progressbar=transfer, timeout=30)(where, str(place), None)
    except (requests.ConnectionError, requests.Timeout) as error:
        raise DataError(f"cannot reach {urlsplit(where).netloc} ({innermost_reason(error)}); {ELSEWHERE}") from None
    except (requests.RequestException, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{file.file}: cannot be fetched ({reason}), expected it at {where}") from None
    check(place, file)


def innermost_reason(error: BaseException) -> str:
    """Return in a few words what is at the bottom of an error of the network."""
    seen = [error]
    while True:
        last = seen[-1]
        arguments = [a for a in (getattr(last, "reason", None), *last.args) if isinstance(a, BaseException)]
        below = [e for e in (*arguments, last.__cause__, last.__context__) if e is not None and e not in seen]
        if not below:
            break
        seen.append(below[0])
    if any("timeout" in type(e).__name__.lower() for e in seen):
        return "no answer in time"
    words = getattr(last, "strerror", None) or str(last) or type(last).__name__
    return shorten(words[0].lower() + words[1:], 80, placeholder=" ...")


def url_of(file: DataFile) -> str:
    """Return the URL of a file at its origin, or at the mirror in KALMARK_DATA_URL."""
    template = os.environ.get("KALMARK_DATA_URL") or ORIGIN
    if "{" not in template:
        template = template.rstrip("/") + "/{file}"
    try:
        return template.format(repo=file.repo, commit=file.commit, path=quote(file.path), file=quote(file.file))
    except (KeyError, IndexError, ValueError):
        raise DataError(
            f"KALMARK_DATA_URL is {template!r}, expected {{repo}}, {{commit}}, {{path}} or {{file}}"
        ) from None


@dataclass
class Transfer:
    """Turn pooch's progress calls for one file into calls about the whole dataset."""

    file: DataFile
    before: int
    dataset_bytes: int
    progress: Progress | None
    total: int = 0
    here: int = 0

    def update(self, count: int) -> None:
        """Report `count` more bytes (the last chunk is counted as a full one)."""
        self.here = min(self.here + count, self.file.bytes)
        if self.progress is not None:
            self.progress(self.file.file, self.before + self.here, self.dataset_bytes)

    def reset(self) -> None:
        """Do nothing at the end of a file: the dataset may go on."""

    close = reset


def sha256(path: Path) -> str:
    """Return the hash of a file as hexadecimal text."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check(path: Path, file: DataFile) -> None:
    """Raise DataError if a file does not have its hash."""
    found = sha256(path)
    if found != file.sha256:
        raise DataError(f"{file.file}: sha256 is {found}, expected {file.sha256}")


def unpack(path: Path) -> None:
    """Unpack a .zip, .gz or .bz2 beside itself.  Raises DataError if it is damaged."""
    try:
        if path.suffix == ".zip":
            with zipfile.ZipFile(path) as archive:
                refuse_bomb(archive, path, DataError)
                archive.extractall(path.parent)  # strips absolute paths and ".."
            return
        with path.with_suffix("").open("wb") as plain:
            plain.writelines(unpack_file(path, DataError))
    except (zipfile.BadZipFile, EOFError, OSError) as error:
        raise DataError(f"{path.name}: cannot be unpacked ({error}), expected a complete archive") from None


def how_to_get(path: Path) -> str:
    """Return how a log that is not found at a relative path can be had, "" if it is none of these datasets."""
    known = [one.name for one in list_data() if f"{path.as_posix()}/".startswith(f"{one.name.split('/')[0]}/")]
    if known:
        return f"`kalmark data fetch {known[0]}` downloads it"
    return next((f"put {copy.put}" for copy in OWN_COPIES if path.parts[:1] == (copy.name,)), "")
