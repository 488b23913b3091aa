"""`python -m kalmark`: the command line."""

import sys

from kalmark.cli import main

sys.exit(main())
