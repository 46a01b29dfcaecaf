"""The options that `slatprep train` and `slatprep evaluate` share."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from slatprep.cli.options import STORE

if TYPE_CHECKING:
    from slatprep.learn.splits import Shares

__all__ = ["STORE", "shares_of", "shares_option"]

shares_option = click.option(
    "--shares",
    default="0.8,0.1,0.1",
    show_default=True,
    metavar="TRAIN,VAL,TEST",
    help="Shares of the objects; a hash of the id decides where one goes.",
)


def shares_of(text: str) -> Shares:
    """Return the shares that ``--shares`` gives; they must be three numbers."""
    from slatprep.learn.splits import Shares

    try:
        train, val, test = (float(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter(
            f"{text!r} is not three numbers such as 0.8,0.1,0.1", param_hint="--shares"
        ) from error
    return Shares(train, val, test)
