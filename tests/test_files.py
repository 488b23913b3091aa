"""Files and folders of results: old or new, whole, after errors, kills and with two writers."""

from __future__ import annotations

import bz2
import gzip
import io
import itertools
import multiprocessing as mp
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

from kalmark import files
from kalmark.errors import RunError
from kalmark.files import (
    hold_lock,
    read_arrays,
    refuse_aliases,
    refuse_bomb,
    replace_file,
    replace_folder,
    unpack_file,
    write,
)

OWN = ("summary.json", "map_*.csv", "cells")


def fill(text: str, *names: str) -> Callable[[Path], None]:
    """Return a writer of files of one content, the summary first."""

    def filled(folder: Path) -> None:
        for name in ("summary.json", *names):
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)

    return filled


def content(folder: Path) -> dict[str, str]:
    """Return the text of each file of a folder."""
    return {str(p.relative_to(folder)): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def save(folder: Path, text: str, *names: str) -> None:
    """Write a result into a folder."""
    replace_folder(folder, fill(text, *names), OWN, "summary.json")


NO_EXCHANGE: list[str] = ["exchanged", "one by one"]


@pytest.fixture(params=NO_EXCHANGE)
def _way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have folders exchanged, or their files put in place one by one."""

    def refused(*_: object) -> None:
        raise OSError("this system cannot exchange folders")

    if request.param != NO_EXCHANGE[0]:
        monkeypatch.setattr(files, "_exchange", refused)


@pytest.mark.usefixtures("_way")
def test_a_folder_is_replaced_with_all_that_was_its_own_and_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    save(out, "old", "map_a.csv", "map_b.csv", "cells/1", "cells/2")
    (out / "notes").mkdir()
    (out / "notes" / "mine.txt").write_text("mine")
    (out / "scan.png").write_text("mine")
    (out / "link").symlink_to("notes")
    save(out, "new", "map_a.csv", "cells/1")
    told = {"summary.json": "new", "map_a.csv": "new", "cells/1": "new", "scan.png": "mine", "notes/mine.txt": "mine"}
    assert content(out) == told
    assert (out / "link").readlink() == Path("notes")
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.usefixtures("_way")
def test_a_writer_that_fails_changes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"

    def fails(folder: Path) -> None:
        fill("half")(folder)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replace_folder(out, fails, OWN, "summary.json")
    assert not out.exists()
    save(out, "old", "map_a.csv")
    with pytest.raises(KeyboardInterrupt):
        replace_folder(out, fails, OWN, "summary.json")
    assert content(out) == {"summary.json": "old", "map_a.csv": "old"}
    assert os.listdir(tmp_path) == ["out"]


def test_the_working_folder_stays_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save(Path(), "old", "map_a.csv")
    before = tmp_path.stat().st_ino
    save(Path(), "new")
    assert content(Path()) == {"summary.json": "new"}
    assert tmp_path.stat().st_ino == before
    assert os.listdir() == ["summary.json"]


def test_a_link_to_a_file_or_a_folder_stays_one(tmp_path: Path) -> None:
    save(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to("real")
    save(tmp_path / "link", "new")
    write(tmp_path / "link" / "b.txt", "b")
    (tmp_path / "c.txt").symlink_to("real/b.txt")
    write(tmp_path / "c.txt", "c")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "c.txt").is_symlink()
    assert content(tmp_path / "real") == {"summary.json": "new", "b.txt": "c"}


def _dies(folder: Path) -> None:
    """Write half of a result and end as a killed program does, without a word."""
    fill("half")(folder)
    os._exit(9)


def _dies_in_a_file(path: Path) -> None:
    path.write_text("half")
    os._exit(9)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="programs are forked")
def test_a_killed_program_leaves_the_old_result_and_a_later_one_clears_up(tmp_path: Path) -> None:
    out = tmp_path / "out"
    save(out, "old")
    for target, writer in ((out, _dies), (out / "summary.json", _dies_in_a_file)):
        how = (out, writer, OWN, "summary.json") if target == out else (target, writer)
        child = mp.get_context("fork").Process(target=replace_folder if target == out else replace_file, args=how)
        child.start()
        child.join()
        assert child.exitcode == 9
    assert (out / "summary.json").read_text() == "old"
    left = [path for path in (*tmp_path.iterdir(), *out.iterdir()) if path.name.startswith(".")]
    assert len(left) == 2
    save(out, "new")
    assert left[0].exists()  # another program may still be at work there
    for path in left:
        if path.exists():
            os.utime(path, (0, 0))
    save(out, "newer")
    write(out / "summary.json", "newest")
    assert content(tmp_path) == {"out/summary.json": "newest"}


def _many(folder: Path, text: str) -> None:
    for _ in range(30):
        save(folder, text, *(f"map_{k}.csv" for k in range(5)))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="programs are forked")
@pytest.mark.usefixtures("_way")
def test_of_two_writers_a_reader_finds_one_result_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    save(out, "a", *(f"map_{k}.csv" for k in range(5)))
    fork = mp.get_context("fork")
    writers = [fork.Process(target=_many, args=(out, text)) for text in "ab"]
    for writer in writers:
        writer.start()
    reads = 0
    while any(writer.is_alive() for writer in writers) or not reads:
        with hold_lock(out, shared=True) as got:
            found = content(out)
        assert got
        assert len(found) == 6
        assert len(set(found.values())) == 1
        reads += 1
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert os.listdir(tmp_path) == ["out"]


def test_a_lock_that_another_has_is_waited_for_only_so_long(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    with hold_lock(tmp_path / "a.lock") as first, hold_lock(tmp_path / "a.lock", wait_s=0.0) as second:
        assert first
        assert not second
    with hold_lock(tmp_path / "a.lock", wait_s=0.0) as again:
        assert again
    with hold_lock(tmp_path / "nowhere" / "a.lock") as without:
        assert not without


def test_an_archive_that_says_that_it_unpacks_to_far_more_is_refused_before_it_is(tmp_path: Path) -> None:
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(100):
            archive.writestr(str(k), bytes(1_000_000))
    with zipfile.ZipFile(path) as archive, pytest.raises(RunError, match=r"100000000 bytes in a file of \d+, expected"):
        refuse_bomb(archive, path, RunError)


@pytest.mark.parametrize(("ending", "compress"), [("gz", gzip.compress), ("bz2", bz2.compress)])
def test_a_compressed_file_is_read_to_its_limit_and_no_further(
    ending: str, compress: Callable[[bytes], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "FREE_BYTES", 10_000)
    monkeypatch.setattr(files, "PIECE", 1000)
    path, content = tmp_path / f"a.{ending}", bytes(10_000)
    path.write_bytes(compress(content))
    assert b"".join(unpack_file(path, RunError)) == content
    path.write_bytes(compress(bytes(1_000_000)))
    read = 0
    with pytest.raises(RunError, match=rf"a\.{ending}: unpacks to more than \d+ bytes, expected at most that"):
        for piece in unpack_file(path, RunError):
            read += len(piece)
    assert read <= files.unpacked_limit(path) < 1_000_000
    path.write_bytes(compress(content)[:-8])
    with pytest.raises(RunError, match=r"cannot be unpacked .*, expected a complete file"):
        list(unpack_file(path, RunError))


def test_arrays_come_back_and_no_longer_than_their_file_is(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array(["x", "yy"]), "c": np.zeros((0, 4)), "d": np.array("")}
    arrays |= {"e": np.asfortranarray(arrays["a"]), "f": np.array(True)}
    np.savez_compressed(path, **arrays)
    read = read_arrays(path, RunError)
    assert {*read} == {*arrays}
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"shape": (10**13,), "fortran_order": False, "descr": "<f8"})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header.getvalue() + bytes(8))
    with pytest.raises(ValueError, match=r"an array \(10000000000000,\) of float64 in 136 bytes"):
        read_arrays(path, RunError)
    path.write_bytes(b"PK")
    with pytest.raises(RunError, match="expected a whole file of arrays"):
        read_arrays(path, RunError)


def test_yaml_whose_aliases_multiply_is_refused() -> None:
    text = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    for one, other in itertools.pairwise("abcdefgh"):
        text += f"{other}: &{other} [{', '.join([f'*{one}'] * 10)}]\n"
    with pytest.raises(RunError, match=r"x.yaml: its aliases make more than 1000000 values of it"):
        refuse_aliases(YAML(typ="safe", pure=True).load(text), "x.yaml", RunError)
    refuse_aliases(YAML(typ="safe", pure=True).load("a: &a [1]\nb: [*a, *a]\n"), "x.yaml", RunError)
