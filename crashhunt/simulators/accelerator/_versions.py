"""The versions of highway-env that the accelerator knows. Nothing here imports it."""

__all__ = ["ACCELERATED"]

ACCELERATED = {"1.12.1": "863e3d3e122c46ec"}
"""Version to the digest of the modules in which something is replaced."""
