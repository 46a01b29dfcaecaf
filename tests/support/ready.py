"""All that a build imports, looks up and loads once: after this, it builds as a second time."""

import pydantic.dataclasses  # noqa: F401
import threadpoolctl  # noqa: F401
import zarr.storage  # noqa: F401

import slatprep.pipeline.dataset
import slatprep.readers.pixieverse  # noqa: F401
from slatprep.pipeline.asset import compile_kernels
from slatprep.pipeline.fingerprint import code_fingerprint, packing_fingerprint

compile_kernels()
code_fingerprint()
packing_fingerprint()
