"""The command line: it parses and prints, and leaves the work to the stages."""

from __future__ import annotations

import os
import signal

from slatprep.workers.local import THREAD_VARIABLES


def main() -> None:
    """Run `slatprep`; the entry point of the console script."""
    # One process is one job and computes on one thread: `--jobs` alone decides how
    # many cores are busy, and the numbers do not depend on a thread count. The
    # libraries read these once, when they are loaded; workers inherit them.
    for variable in THREAD_VARIABLES:
        os.environ[variable] = "1"
    # A batch system's request to stop is as good as Ctrl-C: clean up, then go.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    from slatprep.cli.commands import slatprep

    slatprep(prog_name="slatprep")
