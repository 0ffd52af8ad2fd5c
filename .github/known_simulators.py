"""Fails if the compiled parts do not know the installed libsumo or highway-env, and then adds the version to the code.

A scheduled workflow calls it before the tests, which so show whether the compiled parts fit the new version.

usage: known_simulators.py libsumo | highway-env
"""

import sys
from importlib import metadata
from pathlib import Path

from crashhunt.native import why_no_link_order, why_not

ROOT = Path(__file__).parents[1] / "crashhunt"


def add(entry: str, after: str, *files: str) -> None:
    """Write an entry into the tuple or dictionary that begins in each file with the given text."""
    for file in (ROOT / name for name in files):
        text = file.read_text(encoding="utf-8")
        file.write_text(text.replace(after, f"{after}{entry}, ", 1), encoding="utf-8")


version = metadata.version(sys.argv[1])
if sys.argv[1] == "libsumo":
    reasons = [reason for reason in (why_not(version), why_no_link_order(version)) if reason]
    files = [f"native/{name}.py" for name in ("_core", "_generators", "_link_order")]
    entry, after = f'"{version}"', "_CHECKED_VERSIONS = ("
else:
    try:
        from crashhunt.highway.accelerator._supported import installed_digest, reason_against

        reasons = [f"not accelerated: {reason}" for reason in (reason_against(),) if reason]
    except ImportError as error:
        sys.exit(
            f"highway-env {version}: the accelerator cannot be imported ({error}); to do: write it for this version"
        )
    files = ["highway/accelerator/_known_versions.py"]
    entry, after = f'"{version}": "{installed_digest()}"', "ACCELERATED = {"
print(f"{sys.argv[1]} {version}: {'; '.join(reasons) or 'known'}")
if reasons:
    add(entry, after, *files)
    sys.exit(f"to do: if the tests below pass with it, add {entry} to {after[:-1].rstrip(' =')} in {', '.join(files)}")
