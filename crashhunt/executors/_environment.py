"""The environment variables of every worker: hashes that are fixed, one thread a library."""

from __future__ import annotations

__all__ = ["worker_environment"]


def worker_environment() -> dict[str, str]:
    """Return the environment variables that make a worker's results depend on its trial alone.

    Hashes of strings are fixed, and every library that would start a thread a core keeps to one: with a worker on
    every core, more would only get in each other's way, and sums in parallel are not reproducible to the bit.
    """
    names = (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    )
    return {"PYTHONHASHSEED": "0", **dict.fromkeys(names, "1")}
