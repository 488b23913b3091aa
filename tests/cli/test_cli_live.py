"""`kalmark live`: lines of JSON in, estimates out; what is wrong with a line is answered, and changes nothing."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kalmark as km
from command_line import Kalmark
from kalmark.cli.live import Checkpoints, Signals, serve
from kalmark.logs.json_lines import KEYS, LONGEST_LINE, event_of_object, line_of_event, mapping_of
from kalmark.results.live import LineStream, Live, converse

CONFIG = """robots:
  rover:
    motion: {type: unicycle, sigma_v_mps: 0.05}
    sensors: {lidar: {type: range_bearing, sigma_range_m: 0.1, sigma_bearing_rad: 0.02}}
"""
CONTROL: dict[str, Any] = {"type": "control", "t_s": 1.0, "robot": "rover", "u": [0.5, 0.1]}
SCAN: dict[str, Any] = {"type": "scan", "t_s": 2.0, "robot": "rover", "sensor": "lidar", "y": [[3.0, 0.2]], "ids": [7]}
FIX: dict[str, Any] = {"type": "fix", "t_s": 2.5, "robot": "rover", "y": [0.5, 0.0], "cov": [[1, 0], [0, 1]]}


def a_live(tmp_path: Path) -> Live:
    (tmp_path / "rover.yaml").write_text(CONFIG)
    return Live(km.Slam.from_config(tmp_path / "rover.yaml"))


def talk(live: Live, *lines: Any) -> list[dict[str, Any]]:
    """Return the answers to lines, the first being that it is ready."""
    out = io.StringIO()
    converse(live, io.StringIO("".join(f"{x if isinstance(x, str) else json.dumps(x)}\n" for x in lines)), out)
    return [json.loads(line) for line in out.getvalue().splitlines()]


def test_each_event_is_answered_with_the_estimate_after_it(tmp_path: Path) -> None:
    live = a_live(tmp_path)
    ready, moved, seen, fixed, again, told = talk(live, CONTROL, "", SCAN, FIX, SCAN | {"t_s": 3.0}, {"type": "map"})
    assert ready["robots"]["rover"] == {"u": ["v_mps", "w_radps"], "sensors": {"lidar": ["range_m", "bearing_rad"]}}
    assert moved["t_ns"] == 10**9 and moved["mean"] == [0, 0, 0] and "observations" not in moved
    assert seen["observations"] == [{"index": 0, "id": 7, "outcome": "new", "landmark": 7}]
    assert fixed["observations"][0]["outcome"] == "associated" and again["line"] == 4
    (landmark,) = told["landmarks"]
    assert (landmark["id"], landmark["observations"]) == (7, 2)
    assert again["mean"] == live.slam.mean("rover").tolist()
    assert again["covariance"] == live.slam.covariance("rover").tolist()


def test_the_answers_are_those_of_the_loop_in_python(tmp_path: Path) -> None:
    """Lines written from events give the same map to the last bit."""
    random, live = np.random.default_rng(1), a_live(tmp_path)
    other = km.Slam.from_config(tmp_path / "rover.yaml")
    events: list[Any] = []
    for k in range(20):
        t_ns = 1_700_000_000_123_456_789 + k * 10**8
        events.append(km.Control(t_ns=t_ns, robot="rover", u=random.normal(0.5, 0.1, 2)))
        y = np.column_stack([random.normal(4, 0.1, 3), random.normal([-1, 0, 1], 0.02)])
        cov = None if k % 2 else np.diag([0.01, 0.001])
        events.append(km.Scan(t_ns=t_ns + 1, robot="rover", sensor="lidar", y=y, ids=[1, "b", 2**70], cov=cov))
    events.append(km.Fix(t_ns=t_ns + 2, robot="rover", y=[1, 2], cov=np.eye(2)))
    answers = talk(live, *map(line_of_event, events))
    for event in events:
        other.process(event)
    names = ["rover", 1, "b", 2**70]
    assert live.slam.covariance(*names).tobytes() == other.covariance(*names).tobytes()
    assert answers[-1]["mean"] == other.mean("rover").tolist()


BAD = [
    ("{", "is no JSON"),
    ("[" * 100_000, "nested too deeply"),
    ("[1]", "is no object"),
    ("9" * 5000, "is no JSON"),
    ('{"type": "scan", "type": "fix"}', "the key 'type' twice"),
    ({}, "type is None, expected one of control, scan, fix"),
    ({"type": "scn"}, "type is 'scn', expected one of control, scan, fix; did you mean 'scan'?"),
    (SCAN | {"idz": [1]}, "unknown key 'idz' of a scan, expected t_s, t_ns, robot, sensor, y, ids, cov"),
    (SCAN | {"t_s": "2"}, "t_s is '2', expected a finite number of seconds"),
    (SCAN | {"t_s": 1e15}, "expected a time within 292 years"),
    ({"type": "scan"}, "expected exactly one of t_s and t_ns"),
    (SCAN | {"t_s": 3.0, "robot": "ghost"}, "ghost"),
    (SCAN | {"t_s": 3.0, "sensor": "lidr"}, "lidr"),
    (SCAN | {"t_s": 3.0, "y": [[-1.0, 0.2]]}, "range"),
    (json.dumps(SCAN | {"t_s": 3.0}).replace("0.2", "NaN"), "expected finite numbers"),
    (SCAN | {"t_s": 3.0, "y": [[1.0, 0.2], [2.0, 0.1]], "ids": [7, 7]}, "id 7 appears twice"),
    (SCAN | {"t_s": 3.0, "y": {"a": 1}}, "expected numbers"),
    (SCAN, "scan at t=2 s: a second one of 'rover' by 'lidar' at this time, expected each event once"),
    (SCAN | {"t_s": 1.5}, "1.5"),
    (CONTROL | {"t_s": 1.5}, "1.5"),
    ("\N{SNOWMAN}\0", "is no JSON"),
    ("x" * (LONGEST_LINE + 50), "a line of more than 10000000 characters"),
]


def test_a_bad_a_late_and_a_repeated_line_get_one_line_and_change_nothing(tmp_path: Path) -> None:
    live, clean = a_live(tmp_path), a_live(tmp_path)
    answers = talk(live, CONTROL, SCAN, *(line for line, _ in BAD), FIX)
    talk(clean, CONTROL, SCAN, FIX)
    assert len(answers) == 1 + 2 + len(BAD) + 1
    for k, ((_, said), answer) in enumerate(zip(BAD, answers[3:], strict=False)):
        assert {*answer} == {"line", "error"} and answer["line"] == 3 + k
        assert said in answer["error"] and "\n" not in answer["error"] and len(answer["error"]) < 400
    names = ["rover", 7]
    assert live.slam.covariance(*names).tobytes() == clean.slam.covariance(*names).tobytes()


def test_a_filter_that_is_lost_ends_the_talk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(event: Any) -> Any:
        raise km.errors.DivergedError("robot 'rover' is lost")

    live = a_live(tmp_path)
    monkeypatch.setattr(live.slam, "process", lost)
    assert talk(live, CONTROL, SCAN)[1:] == [{"line": 1, "error": "robot 'rover' is lost"}]


def test_a_map_is_saved_and_gone_on_with(kalmark: Kalmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rover.yaml").write_text(CONFIG)

    def typed(*lines: Any) -> None:
        text = "\n".join(json.dumps(line) for line in lines).encode()
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text + b"\n\xff\xfe")))

    typed(CONTROL, SCAN)
    done = kalmark("live", "rover.yaml", "--out", "map.kmk")
    assert done.status == 0 and "is no JSON" in done.out.splitlines()[-1]
    typed({"type": "map"})
    assert json.loads(kalmark("live", "map.kmk").out.splitlines()[1])["landmarks"][0]["id"] == 7


def test_a_program_talks_through_a_socket_and_the_next_one_goes_on(tmp_path: Path) -> None:
    (tmp_path / "rover.yaml").write_text(CONFIG)
    command = [sys.executable, "-m", "kalmark", "live", str(tmp_path / "rover.yaml"), "--listen", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            line = next(line for line in process.stderr if line.startswith("listening"))
            port = int(line.rpartition(":")[2])
            for lines in ([CONTROL, SCAN], [{"type": "map"}]):
                with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
                    connection.sendall("".join(json.dumps(each) + "\n" for each in lines).encode() + b'{"cut')
                    connection.shutdown(socket.SHUT_WR)
                    with connection.makefile() as answers:
                        last = [json.loads(each) for each in answers][-2]
            assert last["landmarks"][0]["id"] == 7
        finally:
            process.kill()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_one_program_waits_for_the_other_and_none_that_is_gone_stops_the_next(tmp_path: Path) -> None:
    live, port = a_live(tmp_path), free_port()
    threading.Thread(target=serve, args=(live, port, 60.0, lambda: None, None), daemon=True).start()

    def connected() -> socket.socket:
        for _ in range(200):
            with suppress(OSError):
                return socket.create_connection(("127.0.0.1", port), timeout=60)
            time.sleep(0.05)
        raise AssertionError("nobody listens")

    def control(t_s: float) -> bytes:
        return json.dumps(CONTROL | {"t_s": t_s}).encode() + b"\n"

    def answers(connection: socket.socket, count: int) -> list[dict[str, Any]]:
        with connection.makefile() as lines:
            return [json.loads(lines.readline()) for _ in range(count)]

    one = connected()
    one.sendall(control(1.0))
    assert answers(one, 2)[1]["t_s"] == 1.0
    other = connected()  # waits for its turn
    other.sendall(control(2.0)[:20])
    one.sendall(control(1.5) + control(1.8)[:30])  # half a line, and gone
    one.close()
    other.sendall(control(2.0)[20:])
    assert answers(other, 2)[1]["t_s"] == 2.0
    other.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    other.close()  # resets the connection
    deaf = connected()
    deaf.sendall(b"".join(control(3.0 + k / 1000) for k in range(3000)))  # never reads an answer
    deaf.close()
    last = connected()
    last.sendall(control(100.0))
    assert answers(last, 2)[1]["t_s"] == 100.0
    last.close()


def test_a_silent_program_and_one_of_another_protocol_are_told_so_and_left(tmp_path: Path) -> None:
    live, port = a_live(tmp_path), free_port()
    threading.Thread(target=serve, args=(live, port, 1.0, lambda: None, None), daemon=True).start()

    def said(*pieces: bytes) -> list[dict[str, Any]]:
        for _ in range(200):
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
                for piece in pieces:
                    connection.sendall(piece)
                    time.sleep(0.01)
                with connection.makefile() as lines:
                    return [json.loads(line) for line in lines]
            time.sleep(0.05)
        raise AssertionError("nobody listens")

    whole = json.dumps(CONTROL).encode() + b"\n"
    ready, refused = said(b"GET / HTTP/1.1\r\n")
    assert ready["ready"]
    assert refused == {"error": "'GET / HTTP/1.1' is no object of JSON, expected events as docs/live.md has them"}
    assert "is no object of JSON" in said(b"\x16\x03\x01")[1]["error"]
    silent = "no line for 1 s, expected one sooner; the map is kept: connect again"
    assert said()[1] == {"error": silent}
    taken, left = said(whole, b'{"type"')[1:]
    assert (taken["t_s"], left) == (1.0, {"error": silent})
    assert said(b"\n \n", json.dumps(SCAN).encode()[:9], json.dumps(SCAN).encode()[9:], b"\n[1]\n")[1]["t_s"] == 2.0


def test_an_event_that_is_sent_again_after_a_restart_is_not_taken_twice(tmp_path: Path) -> None:
    live = a_live(tmp_path)
    talk(live, CONTROL, SCAN)
    live.slam.save(tmp_path / "map.kmk")
    again = Live(km.Slam.load(tmp_path / "map.kmk"))
    twice, late, new = talk(again, SCAN, CONTROL, FIX)[1:]
    assert twice["error"] == "scan at t=2 s: a second one of 'rover' by 'lidar' at this time, expected each event once"
    assert late["error"] == "control at t=1 s comes after one at t=2 s"
    talk(live, FIX)
    assert new["mean"] == live.slam.mean("rover").tolist()


def test_lines_come_out_of_pieces_whole_and_long_ones_cut(tmp_path: Path) -> None:
    here, there = os.pipe()
    incoming = LineStream(here)
    os.write(there, b"one\ntw")
    assert incoming.readline(10) == "one\n"
    os.write(there, b"o\n" + b"x" * 25 + b"\n\xff")
    os.close(there)
    read = [incoming.readline(10) for _ in range(6)]
    assert read == ["two\n", "x" * 10, "x" * 10, "xxxxx\n", "\N{REPLACEMENT CHARACTER}", ""]
    os.close(here)


def test_the_map_is_saved_while_events_come_and_only_then(tmp_path: Path) -> None:
    live, out = a_live(tmp_path), tmp_path / "map.kmk"
    kept = Checkpoints(live.slam, out, 1e-9, Signals())
    kept.look()
    assert not out.exists()
    talk(live, CONTROL)
    kept.look()
    assert km.Slam.load(out).state.t_ns == 10**9
    out.unlink()
    kept.due = 0.0
    kept.look()
    assert not out.exists()
    talk(live, SCAN)
    kept.out = tmp_path / "nowhere" / "map.kmk"
    kept.look()  # a warning
    assert kept.failed


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="of POSIX")
def test_signals_end_it_between_events_and_the_map_is_saved(
    kalmark: Kalmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rover.yaml").write_text(CONFIG)
    taken = Live.process
    monkeypatch.setattr(km.Slam, "warm_up", lambda slam: None)
    for number, status in ((signal.SIGTERM, 0), (signal.SIGHUP, 0), (signal.SIGINT, 130)):

        def signalled(live: Live, event: Any, number: signal.Signals = number) -> Any:
            if live.number == 2:
                os.kill(os.getpid(), number)
                os.kill(os.getpid(), number)
            return taken(live, event)

        text = "\n".join(json.dumps(line) for line in (CONTROL, SCAN, FIX))
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
        monkeypatch.setattr(Live, "process", signalled)
        before = signal.getsignal(number)
        done = kalmark("live", "rover.yaml", "--out", "map.kmk")
        assert done.status == status
        assert km.Slam.load(tmp_path / "map.kmk").state.t_ns == 2 * 10**9
        assert len(done.out.splitlines()) == 2  # ready, and the answer to the first event
        assert signal.getsignal(number) is before
        (tmp_path / "map.kmk").unlink()


def test_events_come_back_from_their_lines() -> None:
    for given in (CONTROL, SCAN, FIX):
        event = event_of_object(mapping_of(json.dumps(given)))
        assert (
            line_of_event(event_of_object(mapping_of(line_of_event(event)))) == line_of_event(event)
            and type(event) is KEYS[given["type"]][0]
        )
    with pytest.raises(km.errors.EventError, match="a frame is not written as a line"):
        line_of_event(km.Frame(t_s=1.0, robot="a", sensor="b", image=np.zeros((2, 2), np.uint8)))
