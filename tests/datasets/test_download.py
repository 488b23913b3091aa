"""Datasets from a local server: good files, wrong hashes, missing files; nothing half done is left behind."""

from __future__ import annotations

import bz2
import functools
import gzip
import hashlib
import http.server
import json
import logging
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import requests
from urllib3.exceptions import MaxRetryError, NewConnectionError, ReadTimeoutError

from kalmark.datasets import download
from kalmark.datasets.download import DataFile, Dataset
from kalmark.errors import DataError, LogError
from kalmark.logs import cache_folder, fetch, find_data, list_data

FILES = {"toy/one/a.csv": b"a" * 200_000, "toy/one/deep/b.csv": b"b" * 1000, "toy/two/c.csv": b"c" * 10}


def described(name: str, **unpack: bool) -> DataFile:
    content = FILES[name]
    sha256 = hashlib.sha256(content).hexdigest()
    return DataFile(name, sha256, len(content), "owner/name", "abc1234", f"some folder/{Path(name).name}", **unpack)


class Server(http.server.ThreadingHTTPServer):
    asked: list[str]


class Handler(http.server.SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        assert isinstance(self.server, Server)
        self.server.asked.append(self.path)
        super().do_GET()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def mirror(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    for name, content in FILES.items():
        (tmp_path / "mirror" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "mirror" / name).write_bytes(content)
    server = Server(("127.0.0.1", 0), functools.partial(Handler, directory=str(tmp_path / "mirror")))
    server.asked = []
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    sets = tuple(
        Dataset(f"toy/{name}", "toy", "here", "MIT", f"toy/{name}", tuple(map(described, files)))
        for name, files in (("one", ["toy/one/a.csv", "toy/one/deep/b.csv"]), ("two", ["toy/two/c.csv"]))
    )
    monkeypatch.setattr(download, "list_data", lambda: sets)
    monkeypatch.setenv("KALMARK_DATA_URL", f"http://127.0.0.1:{server.server_port}/")
    monkeypatch.setenv("KALMARK_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("KALMARK_DATA", raising=False)
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def left_behind(tmp_path: Path) -> list[str]:
    return sorted(path.name for path in (tmp_path / "cache").rglob("*") if path.is_file())


def test_a_dataset_is_fetched_once_and_checked(mirror: Server, tmp_path: Path) -> None:
    folder = fetch("toy/one")
    assert folder == tmp_path / "cache" / "toy" / "one"
    assert (folder / "a.csv").read_bytes() == FILES["toy/one/a.csv"]
    assert (folder / "deep" / "b.csv").read_bytes() == FILES["toy/one/deep/b.csv"]
    assert mirror.asked == ["/toy/one/a.csv", "/toy/one/deep/b.csv"]
    assert fetch("toy/one") == folder
    assert len(mirror.asked) == 2


def test_a_family_of_datasets_is_fetched_by_its_common_name(mirror: Server, tmp_path: Path) -> None:
    assert fetch("toy") == tmp_path / "cache" / "toy"
    assert left_behind(tmp_path) == ["a.csv", "b.csv", "c.csv"]


def test_a_name_that_is_nearly_one_is_answered_with_the_right_ones() -> None:
    for name, meant in (
        ("plaza", "'plaza1'"),
        ("Kitti", "'kitti_stereo_features' or 'kitti_odometry'"),
        ("mrclam/MRCLAM_Data", " or ".join(f"'mrclam/MRCLAM_Dataset{n}'" for n in (6, 8, 9))),
        ("dlrr", "'dlr'"),
        ("stary_nigth", "'starry_night'"),
    ):
        with pytest.raises(DataError, match=f"'{name}' is unknown, expected one of .*, or, .* plaza1, .*; did") as no:
            fetch(name)
        assert str(no.value).endswith(f"; did you mean {meant}?")
    with pytest.raises(DataError, match=r"kitti_odometry$"):
        fetch("zzz")


def test_a_file_damaged_in_the_cache_is_fetched_again(mirror: Server, tmp_path: Path) -> None:
    folder = fetch("toy/one")
    (folder / "a.csv").write_bytes(b"damaged")
    assert (fetch("toy/one") / "a.csv").read_bytes() == FILES["toy/one/a.csv"]


def test_a_wrong_hash_names_file_found_and_expected_and_leaves_nothing(mirror: Server, tmp_path: Path) -> None:
    wrong = b"b" * 999 + b"x"
    (tmp_path / "mirror" / "toy/one/deep/b.csv").write_bytes(wrong)
    with pytest.raises(DataError) as refused:
        fetch("toy/one")
    found, expected = (hashlib.sha256(text).hexdigest() for text in (wrong, FILES["toy/one/deep/b.csv"]))
    assert str(refused.value) == f"toy/one/deep/b.csv: sha256 is {found}, expected {expected}"
    assert left_behind(tmp_path) == []


def test_a_missing_file_is_named_with_its_url_and_leaves_nothing(mirror: Server, tmp_path: Path) -> None:
    (tmp_path / "mirror" / "toy/one/deep/b.csv").unlink()
    with pytest.raises(DataError, match=r"^toy/one/deep/b\.csv: cannot be fetched .*404.*/toy/one/deep/b\.csv$"):
        fetch("toy/one")
    assert left_behind(tmp_path) == []


def test_a_download_that_breaks_off_leaves_nothing(
    mirror: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: Handler) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "200000")
        self.end_headers()
        self.wfile.write(b"a" * 1000)

    monkeypatch.setattr(Handler, "do_GET", broken)
    with pytest.raises(DataError, match=r"^toy/one/a\.csv: "):
        fetch("toy/one")
    assert left_behind(tmp_path) == []


def test_a_server_that_is_not_there_is_one_clear_line(mirror: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KALMARK_DATA_URL", "http://127.0.0.1:9")
    with pytest.raises(DataError) as refused:
        fetch("toy/two")
    assert str(refused.value) == (
        "cannot reach 127.0.0.1:9 (connection refused); "
        "set KALMARK_DATA to a folder that has it or KALMARK_DATA_URL to a mirror"
    )


def test_a_name_that_is_not_resolved_and_a_server_that_is_silent_are_told_in_a_few_words() -> None:
    lost = requests.ConnectionError(MaxRetryError(None, "/", NewConnectionError(None, "Failed to resolve")))  # type: ignore[arg-type]
    lost.args[0].reason.__cause__ = OSError(-2, "Name not known")
    assert download.innermost_reason(lost) == "name not known"
    assert download.innermost_reason(requests.ReadTimeout(ReadTimeoutError(None, "/", "Read timed out."))) == (  # type: ignore[arg-type]
        "no answer in time"
    )


def test_a_log_not_found_says_how_to_name_a_folder_that_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("KALMARK_DATA", raising=False)
    with pytest.raises(LogError, match="`kalmark data fetch dlr` downloads it; KALMARK_DATA can name a folder"):
        find_data("dlr/nowhere")


def test_progress_counts_the_bytes_of_the_whole_dataset(mirror: Server) -> None:
    calls: list[tuple[str, int, int]] = []
    fetch("toy/one", progress=lambda *call: calls.append(call))
    counts = [done for _, done, _ in calls]
    assert counts == sorted(counts) and counts[-1] == 201_000
    assert {total for *_, total in calls} == {201_000}
    assert [name for name in dict.fromkeys(name for name, *_ in calls)] == ["toy/one/a.csv", "toy/one/deep/b.csv"]


def test_the_library_prints_and_logs_nothing(
    mirror: Server, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        fetch("toy/one")
    out, err = capfd.readouterr()
    assert (out, err, caplog.text) == ("", "", "")


def test_data_on_disk_is_used_without_the_network(
    mirror: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KALMARK_DATA", str(tmp_path / "mirror"))
    assert fetch("toy/one") == tmp_path / "mirror" / "toy" / "one"
    assert mirror.asked == []
    (tmp_path / "mirror" / "toy/one/a.csv").write_bytes(b"other")
    with pytest.raises(DataError, match=r"toy/one/a\.csv: sha256 is .*, expected "):
        fetch("toy/one")


def test_data_that_is_not_on_disk_is_fetched(mirror: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KALMARK_DATA", str(tmp_path / "elsewhere"))
    assert fetch("toy/two") == tmp_path / "cache" / "toy" / "two"


def test_a_mirror_may_be_laid_out_as_the_origin(mirror: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    base = f"http://127.0.0.1:{mirror.server_port}"
    monkeypatch.setenv("KALMARK_DATA_URL", base + "/{repo}/{commit}/{path}")
    with pytest.raises(DataError, match="404"):
        fetch("toy/two")
    assert mirror.asked == ["/owner/name/abc1234/some%20folder/c.csv"]
    monkeypatch.setenv("KALMARK_DATA_URL", base + "/{comit}")
    with pytest.raises(DataError, match="KALMARK_DATA_URL is"):
        fetch("toy/two")


def test_an_unknown_dataset_names_those_there_are(mirror: Server) -> None:
    with pytest.raises(DataError, match=r"'toy/tow' is unknown, expected one of toy/one, toy/two, .*; did you mean"):
        fetch("toy/tow")


def packed(kind: str, content: bytes, folder: Path) -> Path:
    path = folder / f"text.csv{kind}"
    if kind == ".zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("text.csv", content)
            archive.writestr("../outside.csv", content)
    else:
        path.write_bytes({".gz": gzip.compress, ".bz2": bz2.compress}[kind](content))
    return path


@pytest.mark.parametrize("kind", [".zip", ".gz", ".bz2"])
def test_archives_are_unpacked_beside_themselves_and_nowhere_else(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    download.unpack(packed(kind, b"1,2\n", folder))
    assert (folder / "text.csv").read_bytes() == b"1,2\n"
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("kind", [".zip", ".gz", ".bz2"])
def test_a_damaged_archive_is_refused(kind: str, tmp_path: Path) -> None:
    path = packed(kind, bytes(range(256)) * 100, tmp_path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"cannot be unpacked .*expected a complete (archive|file)"):
        download.unpack(path)


def test_a_zip_in_a_dataset_is_unpacked(mirror: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = packed(".zip", b"1,2\n", tmp_path / "mirror" / "toy").read_bytes()
    file = DataFile("toy/text.csv.zip", hashlib.sha256(archive).hexdigest(), len(archive), "o/n", "abc", "x", True)
    monkeypatch.setattr(download, "list_data", lambda: (Dataset("toy", "", "", "", "toy", (file,)),))
    assert (fetch("toy") / "text.csv").read_bytes() == b"1,2\n"


def test_a_log_is_looked_for_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    places = {name: tmp_path / name for name in ("base", "data", "oracle", "cache")}
    for name in ("data", "oracle", "cache"):
        monkeypatch.setenv(f"KALMARK_{name.upper()}", str(places[name]))
    monkeypatch.chdir(tmp_path)
    for name in reversed(places):
        (places[name] / "some" / "log").mkdir(parents=True)
        assert find_data("some/log", base=places["base"]) == places[name] / "some" / "log"
    assert find_data(places["oracle"] / "some", base=places["base"]) == places["oracle"] / "some"
    with pytest.raises(LogError, match="log 'another' not found, expected it at "):
        find_data("another")
    assert cache_folder() == places["cache"]


def test_every_known_dataset_says_where_it_is_from() -> None:
    for dataset in list_data():
        assert dataset.files and dataset.what and dataset.licence and dataset.bytes > 0
        for file in dataset.files:
            assert file.file.startswith(f"{dataset.log}/")
            assert len(file.sha256) == 64 and file.repo.count("/") == 1
            assert download.url_of(file).startswith("https://raw.githubusercontent.com/")


def test_hashes_are_those_of_the_real_files(data: object) -> None:
    known = {}
    for line in data("SHA256SUMS").read_text().splitlines():  # type: ignore[operator]
        sha256, name = line.split(maxsplit=1)
        known[name] = sha256
    files = [file for dataset in list_data() for file in dataset.files]
    assert {file.file: file.sha256 for file in files} == {file.file: known[file.file] for file in files}
    for file in files:
        assert data(file.file).stat().st_size == file.bytes  # type: ignore[operator]


def test_the_real_datasets_are_found_on_disk_without_the_network(data: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KALMARK_DATA_URL", "http://127.0.0.1:9")
    for name in ("dlr", "mrclam", "mrclam/MRCLAM_Dataset9", "victoria_park"):
        folder = data(name)  # type: ignore[operator]
        assert fetch(name) == folder


def test_the_list_of_datasets_is_plain_json() -> None:
    path = Path(download.__file__).with_name("datasets.json")
    assert [entry["name"] for entry in json.loads(path.read_text())] == [dataset.name for dataset in list_data()]
