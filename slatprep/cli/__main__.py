"""Allow `python -m slatprep.cli`."""

from slatprep.cli import main

main()
