"""Importing this module has crashhunt imported as it is installed, and not with its assertions rewritten.

pytest rewrites the assertions of every package that has a plugin. In a fresh clone, each worker of pytest-xdist would
compile 400 modules of crashhunt for this, which are compiled for commands and workers of hunts anyway. The exception is
`crashhunt.testing`: the assertions of its contract suites are what users read when a contract is broken.
"""

from __future__ import annotations

import sys

for finder in sys.meta_path:
    marked = getattr(finder, "_must_rewrite", set())  # of pytest's hook; there is no public way to take a name back
    if "crashhunt" in marked:
        marked.remove("crashhunt")
        finder.mark_rewrite("crashhunt.testing")  # type: ignore[attr-defined] - which forgets earlier answers as well
