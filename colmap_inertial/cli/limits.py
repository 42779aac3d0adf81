"""Limits: of files, as options of every command; of the process, which are said before the work or where reached.

Libraries that are out of memory or of files end the process without one: OpenBLAS, COLMAP's threads, the loader.
"""

from __future__ import annotations

from colmap_inertial.core.errors import InertialError

#: Address space to begin with, and for each thread: its stack, and what the allocator keeps for it. A reconstruction of
#: small pictures takes 1.3 GB on two processors.
LEAST_BYTES, THREAD_BYTES = 2 << 30, 128 << 20
#: Arguments are read with numpy. With less than this, and as much for each thread, it ends in OpenBLAS's words.
LOADING_BYTES = 256 << 20
#: A reconstruction has 9 open at a time, a batch some for each process; systems allow 256 or more.
LEAST_FILES = 64


def require_limits(*, to_load: bool = False) -> None:
    """Refuse to begin with less than any command takes.

    Parameters
    ----------
    to_load
        Only where it is less than reading the arguments takes.

    Raises
    ------
    InertialError
        That says which limit, and how to raise it.
    """
    try:
        import resource
    except ImportError:  # Windows has none
        return
    from colmap_inertial.core.threads import usable_processors

    least = LEAST_BYTES + THREAD_BYTES * usable_processors()
    loaded = LOADING_BYTES + THREAD_BYTES * usable_processors()
    space, files = (resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_NOFILE))
    if to_load and (space == resource.RLIM_INFINITY or space >= loaded):
        return
    if space != resource.RLIM_INFINITY and space < least:
        raise InertialError(
            f"only {space / 1e9:.2g} GB of memory are allowed to a process here, and {least / 1e9:.2g} GB are needed: "
            f"raise the limit (ulimit -v {least >> 10})"
        )
    if files != resource.RLIM_INFINITY and files < LEAST_FILES:
        raise InertialError(
            f"only {files} files may be open at a time here, and {LEAST_FILES} are needed: raise the limit (ulimit -n "
            f"{LEAST_FILES})"
        )
