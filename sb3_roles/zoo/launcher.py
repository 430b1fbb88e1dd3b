"""Settings of the process that training is faster with, made before torch is imported."""

from __future__ import annotations

import atexit
import ctypes
import gc
import os
import platform

# Parameters of glibc's mallopt(3): up to which size blocks come from the heap (32 MiB, the most
# that it takes), what is kept free at its top, and what is asked for beyond.
_MALLOPT = {"M_MMAP_THRESHOLD": (-3, 1 << 25), "M_TRIM_THRESHOLD": (-1, 2**31 - 1),
            "M_TOP_PAD": (-2, 1 << 26)}  # fmt: skip
_PASSIVE = "OMP_WAIT_POLICY"
_done: dict[str, str] = {}


def prepare_process() -> None:
    """Make the settings, once; what the user has set in the environment stands.

    * ``OMP_WAIT_POLICY=PASSIVE``: threads that spin between operations steal time from others.
    * Of glibc: memory of tensors that are gone is kept for the next ones, instead of being given
      back to the system and taken, page by page, again. ``GLIBC_TUNABLES`` or a variable
      ``MALLOC_..._`` of the user's leaves the allocator alone.
    * At the end the interpreter does not go through all objects of torch and numba, for a second.
    """
    if _done:
        return
    atexit.register(gc.freeze)
    os.environ.setdefault(_PASSIVE, "PASSIVE")
    _done["malloc"] = _keep_memory()


def process_settings() -> str:
    """Return what the process runs with, as a line for logs."""
    policy = os.environ.get(_PASSIVE, "unset")
    return f"{_PASSIVE}={policy}, malloc: {_done.get('malloc', 'as the system has it')}"


def _keep_memory() -> str:
    own = [name for name in os.environ if name == "GLIBC_TUNABLES" or name.startswith("MALLOC_")]
    if own:
        return f"{own[0]}={os.environ[own[0]]}"
    if platform.libc_ver()[0] != "glibc":
        return "as the system has it"
    mallopt = ctypes.CDLL(None).mallopt
    kept = [mallopt(ctypes.c_int(key), ctypes.c_int(value)) for key, value in _MALLOPT.values()]
    return "keeps freed memory" if all(kept) else "as the system has it"
