"""The versions of highway-env that the accelerator knows. Nothing is imported here, so a descriptor may ask."""

from __future__ import annotations

ACCELERATED = {"1.12.1": "c2c34aaddeb8f4c7"}
"""The digest of the modules in which the accelerator replaces something, by version of highway-env."""


def reason_against_version(version: str) -> str:
    """Return why the accelerator must not be used with a version of highway-env; empty if it knows the version."""
    return (
        ""
        if version in ACCELERATED
        else f"highway-env {version} is not supported (supported: {', '.join(ACCELERATED)})"
    )
