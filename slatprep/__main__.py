"""Allow `python -m slatprep`."""

from slatprep.cli import main

main()
