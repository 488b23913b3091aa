"""`kalmark live`: events as lines of JSON in, estimates out."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from kalmark.cli.shared import Overrides, limit_blas_threads, say, slam_of, writable
from kalmark.errors import DivergedError, KalmarkError

if TYPE_CHECKING:
    from kalmark.results.live import Live
    from kalmark.slam.slam import Slam

HERE = "127.0.0.1"
ENDS = [number for number in signal.Signals if number.name in ("SIGINT", "SIGTERM", "SIGHUP")]
BUSY = 0.05  # of the time may be spent on saving


class SignalledError(Exception):
    """A signal asks the program to end."""


class Signals:
    """Signals that end the program: at once, or at the end of the context if one came inside.

    Within it the map changes, or is saved.
    """

    def __init__(self) -> None:
        self.inside, self.came, self.before = False, 0, {}  # type: ignore[var-annotated]

    def listen(self) -> None:
        """Take the signals from now on, in the main thread."""
        if threading.current_thread() is threading.main_thread():
            self.before = {number: signal.signal(number, self._take) for number in ENDS}

    def leave(self) -> None:
        """Take no signal any more."""
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def _take(self, number: int, _: FrameType | None) -> None:
        again, self.came = self.came, self.came or number
        if not again:
            self._end()

    def _end(self) -> None:
        if self.came and not self.inside:
            raise SignalledError(signal.Signals(self.came).name)

    def __enter__(self) -> Self:
        self.inside = True
        return self

    def __exit__(self, *_: object) -> None:
        self.inside = False
        self._end()


class Checkpoints:
    """A map that is saved every so often while it changes, for a twentieth of the time at most."""

    def __init__(self, slam: Slam, out: Path | None, every_s: float, signals: Signals) -> None:
        self.slam, self.out, self.every_s, self.signals = slam, out, every_s, signals
        self.due, self.saved, self.failed = time.monotonic() + every_s, slam.state.t_ns, False

    def look(self) -> None:
        """Save the map if it is time; a failure is printed once, and the conversation goes on."""
        if self.out is None or not self.every_s or time.monotonic() < self.due or self.saved == self.slam.state.t_ns:
            return
        begin = time.monotonic()
        with self.signals:
            try:
                self.slam.save(self.out)
                self.saved = self.slam.state.t_ns
            except KalmarkError as error:
                if not self.failed:
                    say(f"kalmark: warning: {error}", err=True)
                self.failed = True
        now = time.monotonic()
        self.due = now + max(self.every_s, (now - begin) / BUSY)

    def end(self, told: Live) -> None:
        """Save the map at the end, once, unless the filter is lost; no signal interrupts it."""
        self.signals.inside = True
        out, self.out = self.out, None
        if out is not None and not told.lost:
            self.slam.save(out)


def live(
    config: Annotated[
        str, typer.Argument(metavar="CONFIG", help="A YAML file, a shipped name, or a saved map, .kmk, to go on with.")
    ],
    listen: Annotated[
        int | None, typer.Option(metavar="PORT", min=0, max=65535, help="Answer on this port of this machine instead.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="MAP", help="Save the map here at the end and at signals, .kmk.")
    ] = None,
    checkpoint_every: Annotated[
        float, typer.Option(metavar="S", min=0, help="Save it every so many seconds, too; 0: only at the end.")
    ] = 60.0,
    timeout: Annotated[
        float, typer.Option(metavar="S", min=0, help="With --listen: leave a program silent for so long; 0: never.")
    ] = 60.0,
    overrides: Overrides = None,
) -> None:
    """Take events as lines of JSON on standard input or a socket; answer each with the estimate after it."""
    from kalmark.results.live import LineStream, Live, converse
    from kalmark.slam.slam import Slam

    if out is not None:
        writable(out.parent)
    with limit_blas_threads():
        if Path(config).suffix == ".kmk":
            if overrides:
                raise KalmarkError("--set changes a configuration, and a saved map has its own")
            slam = Slam.load(config)
        else:
            slam = slam_of(config, overrides or ())
        slam.warm_up()
        signals = Signals()
        told, kept = Live(slam, signals), Checkpoints(slam, out, checkpoint_every, signals)
        try:
            try:
                signals.listen()
                idle_s = checkpoint_every or None
                if listen is None:
                    incoming, outgoing = (typer.get_text_stream(n, "utf-8", "replace") for n in ("stdin", "stdout"))
                    handle = _descriptor(incoming)
                    source = incoming if handle is None else LineStream(handle, kept.look, idle_s)
                    converse(told, source, outgoing, kept.look)
                else:
                    serve(told, listen, timeout, kept.look, idle_s)
            finally:
                kept.end(told)
        except SignalledError as error:
            kept.end(told)
            if signals.came == signal.SIGINT:
                raise KeyboardInterrupt from None
            say(f"kalmark: ended by {error}", err=True)
        finally:
            signals.leave()
    if told.lost:
        raise DivergedError(told.lost)


def _descriptor(stream: Any) -> int | None:
    """Return the descriptor of a stream, None of one that has none."""
    try:
        return int(stream.fileno())
    except (OSError, AttributeError):
        return None


def serve(told: Live, port: int, silent_s: float, look: Callable[[], object], idle_s: float | None) -> None:
    """Answer one program after the other on a port of this machine, until the filter is lost.

    A connection is closed if it sends nothing for `silent_s` (0: no limit), reads no answers, or uses another protocol.
    `look` is called after each answer, and whenever there was none for `idle_s`.
    """
    from kalmark.results.live import LineStream, converse

    try:
        server = socket.create_server((HERE, port))
    except OSError as error:
        raise KalmarkError(f"--listen {port}: {error.strerror}, expected a free port") from None
    with server:
        say(f"listening on {HERE}:{server.getsockname()[1]}", err=True)
        server.settimeout(idle_s)
        while not told.lost:
            try:
                connection, _ = server.accept()
            except TimeoutError:
                look()
                continue
            try:
                connection.settimeout(silent_s or None)
                with connection, connection.makefile("w", encoding="utf-8", newline="\n") as outgoing:
                    incoming = LineStream(connection, look, idle_s, silent_s or None, stranger=True)
                    converse(told, incoming, outgoing, look)
            except OSError:  # the program is gone; the map stays for the next one
                continue
