from __future__ import annotations

from crashhunt.snapshots._sources import find_sources


def test_crashhunt_comes_along_without_the_pages_of_its_guide():
    kept = find_sources([]).files
    assert {"code/crashhunt/__init__.py", "code/crashhunt/guide/__init__.py", "code/crashhunt/py.typed"} <= set(kept)
    pages = "code/crashhunt/guide/"
    assert not [place for place in kept if place.startswith(pages) and place.endswith(".md")]
