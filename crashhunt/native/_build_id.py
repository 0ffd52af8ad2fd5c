"""The check whether compiled modules were built from the C++ sources of the checkout.

Reason: ``git pull`` changes the sources of an editable installation, but not the compiled modules. They can still be
loaded, but compute the results of the older sources. Therefore the linker stores a digest of the sources as the build
id of each module.

This file imports only the standard library, because scripts/build_core.py runs it by its path.
"""

from __future__ import annotations

import hashlib
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Final

HOW_TO_REBUILD: Final = "pip install --no-deps --editable ."
_MODULES: Final = {
    "_crashhunt_core": "native",
    "_crashhunt_link_order": "native",
    "_crashhunt_highway": "highway/accelerator",
    "_crashhunt_native_stack": "executors",
}
"""Compiled module to the folder of its sources in crashhunt."""


def build_id(folder: Path) -> str:
    """Return the digest of the C++ sources in a folder, as hexadecimal digits; empty if there are no sources.

    Headers of other folders that they include belong to the sources.
    """
    contents = {source: source.read_bytes() for source in sorted(folder.glob("*.?pp"))}
    elsewhere = sorted({name for content in contents.values() for name in re.findall(rb'"(\.\./[^"]+)"', content)})
    sources = contents | {folder / name.decode(): (folder / name.decode()).read_bytes() for name in elsewhere}
    digest = hashlib.blake2b(digest_size=20)
    for source, content in sources.items():
        digest.update(f"{source.name} {len(content)}\n".encode() + content)
    return digest.hexdigest() if sources else ""


def outdated_modules(package: Path = Path(__file__).parents[1]) -> list[str]:
    """Return the installed compiled modules that were built from other sources than those of the package.

    A package without sources, such as a snapshot, has no outdated modules.
    """
    outdated = []
    for module, folder in _MODULES.items():
        wanted, found = bytes.fromhex(build_id(package / folder)), find_spec(module)
        if wanted and found is not None and found.origin is not None and wanted not in Path(found.origin).read_bytes():
            outdated.append(module)
    return outdated
