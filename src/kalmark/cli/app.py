"""`kalmark`: the verbs, and the one place where errors become lines and exit statuses."""

from __future__ import annotations

import errno
import gc
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Annotated

import typer

from kalmark.cli.campaign import campaign
from kalmark.cli.check import check
from kalmark.cli.convert import convert
from kalmark.cli.folders import compare, evaluate, explain, report, view
from kalmark.cli.live import live
from kalmark.cli.logs import config, simulate, worlds
from kalmark.cli.run import demo, run, warm_up
from kalmark.cli.shared import say
from kalmark.errors import KalmarkError, PluginError
from kalmark.plugins import load_all

USAGE: type[Exception] = typer.BadParameter.__mro__[2]  # typer's base of all mistakes on the command line
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # no place for a file
INTERRUPTED = 130
ANY_ARGUMENTS = {"ignore_unknown_options": True, "allow_extra_args": True}
GARBAGE = 10_000  # objects between two collections of garbage: at Python's 700 they take an eighth of a short run


def _refused(failure: PluginError) -> Callable[[], None]:
    """Return the verb of a plug-in that cannot be loaded."""

    def verb() -> None:
        raise failure

    return verb


app = typer.Typer(
    name="kalmark",
    help="EKF-SLAM with a consistent covariance.",
    epilog="CONFIG and WORLD are paths of YAML files or shipped names.  Start with: kalmark demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for verb in (
    demo,
    run,
    simulate,
    evaluate,
    report,
    view,
    compare,
    explain,
    campaign,
    config,
    worlds,
    convert,
    check,
    warm_up,
    live,
):
    app.command()(verb)
verbs, missing = load_all("verbs")
for name, entry in verbs.items():
    if isinstance(entry, typer.Typer):
        app.add_typer(entry, name=name)
    else:
        app.command(name)(entry)
for name, failure in missing.items():
    app.command(name, help=f"Missing: {failure}.", context_settings=ANY_ARGUMENTS)(_refused(failure))


def _show_version(wanted: bool) -> None:
    if wanted:
        say(f"kalmark {version('kalmark')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_show_version, is_eager=True)
    ] = False,
) -> None:
    pass


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    gc.set_threshold(GARBAGE)
    try:
        return int(
            app(args=None if arguments is None else list(arguments), prog_name="kalmark", standalone_mode=False) or 0
        )
    except KalmarkError as error:
        return _refuse(str(error))
    except USAGE as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            error.show()  # type: ignore[attr-defined]
            return 2
        return _refuse(f"{error.format_message().rstrip('.')}; see kalmark --help")  # type: ignore[attr-defined]
    except (KeyboardInterrupt, typer.Abort):
        sys.stderr.write("kalmark: interrupted\n")
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        if error.errno in FULL:
            return _refuse(f"{error.strerror}; what was being written is not complete")
        if error.filename is None:
            raise
        return _refuse(f"{error.filename}: {error.strerror}")


def _refuse(line: str) -> int:
    say(f"kalmark: {line}", err=True)
    return 2
