"""Parse the command line's arguments and print results."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run `slatprep`; the entry point of the console script."""
    from slatprep.cli.process import ignore_stops, prepare_stop, prepare_streams

    prepare_stop()
    prepare_streams()
    if sys.flags.optimize > 1:
        sys.stderr.write(
            "slatprep: error: commands are made of docstrings, which `python -OO` and "
            "PYTHONOPTIMIZE=2 leave out; expected -O at most\n"
        )
        raise SystemExit(2)
    try:
        from slatprep.workers.local import THREAD_VARIABLES

        # Each process computes on one thread: only `--jobs` decides how many cores are used, and
        # no result depends on a thread count. Libraries read these variables when they are loaded;
        # workers inherit them.
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
        # All pictures are files, and matplotlib fails at other names.
        os.environ["MPLBACKEND"] = "Agg"
        from slatprep.cli.commands import slatprep

        slatprep(prog_name="slatprep")
    except KeyboardInterrupt:  # While modules were imported.
        sys.stderr.write("slatprep: stopped; nothing was replaced\n")
        raise SystemExit(130) from None
    finally:
        ignore_stops()
