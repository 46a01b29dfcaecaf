"""A process to whom the permissions of files apply, also where tests run as root."""

BOUND_BY_PERMISSIONS = """
import ctypes, os
if os.geteuid() == 0:
    libc = ctypes.CDLL(None, use_errno=True)
    override, read_search, drop_bounding = 1, 2, 24  # CAP_DAC_OVERRIDE and so on, PR_CAPBSET_DROP
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3 of the structures, this process
    held = (ctypes.c_uint32 * 6)()
    if libc.capget(header, held):
        raise OSError(ctypes.get_errno(), "capget")
    for kind in (0, 1):  # effective and permitted
        held[kind] &= ~(1 << override | 1 << read_search)
    # Of the bounding set as well, where that is allowed, or what it starts would hold them again.
    for one in (override, read_search):
        libc.prctl(drop_bounding, one, 0, 0, 0)
    if libc.capset(header, held):
        raise OSError(ctypes.get_errno(), "capset")
"""
"""Statements to begin a process with. It stays its user, so that it can read what that owns."""
