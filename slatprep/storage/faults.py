"""A seam at which tests stop or kill a build, or make it fail.

Each step of a build calls `reached` with its name, and with the asset or file
that it concerns. Where the environment variable ``SLATPREP_FAULTS`` is
``module:function``, that function is called with both; whatever it does, raise
an error or end the process, is what happens at that step. Without the variable
nothing is called. The variable is inherited by worker processes, so the module
must be importable there too.

Steps, in the order of a build: ``work folder made``, ``work folder locked``, ``asset
compared``, ``asset begun``, ``asset read``, ``asset aligned`` (or ``asset
reused``), ``asset spooled``, ``store created``, ``shard begun``, ``shard
filled`` (and not yet renamed), ``shard written``, ``records written``,
``directory flushed``, ``directory exchanged``, ``store replaced``, ``manifests
written`` (and not yet renamed), ``manifests published``, ``pointer replaced``.
"""

from __future__ import annotations

import os
from importlib import import_module

VARIABLE = "SLATPREP_FAULTS"


def reached(step: str, name: str = "") -> None:
    """Say that a build reached a step, for the asset or file of that name."""
    place = os.environ.get(VARIABLE)
    if place:
        module, _, function = place.partition(":")
        getattr(import_module(module), function)(step, name)
