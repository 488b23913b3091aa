"""The command line: each verb is a thin shell over a function that returns a result.

Exit status 0; 2 for bad input or configuration (one line, no traceback); 1 for a bug (with its traceback).
"""

from kalmark.cli.app import main

__all__ = ["main"]
