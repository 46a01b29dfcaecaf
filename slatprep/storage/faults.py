"""A seam at which tests stop or kill a build, or make it fail.

Each step of a build calls `reached` with its name, and the asset or file that it concerns. If the
environment variable ``SLATPREP_FAULTS`` is ``module:function``, `reached` calls that function
with both. The function may raise an error or end the process. Without the variable nothing is
called. Worker processes inherit the variable, so the module must be importable there too.

Steps, in the order of a build: ``work folder made``, ``work folder locked``, ``asset compared``,
``asset begun``, ``asset read``, ``asset aligned`` (or ``asset reused``), ``asset spooled``, ``store
created``, ``shard begun``, ``shard filled`` (and not yet renamed), ``shard written``, ``records
written``, ``directory flushed``, ``directory exchanged``, ``store replaced``, ``manifests written``
(and not yet renamed), ``manifests published``, ``pointer replaced``.
"""

from __future__ import annotations

import os
from importlib import import_module

VARIABLE = "SLATPREP_FAULTS"


def reached(step: str, name: str = "") -> None:
    """Report that a build reached a step, with the name of the asset or file."""
    if place := os.environ.get(VARIABLE):
        module, _, function = place.partition(":")
        getattr(import_module(module), function)(step, name)
