"""What everything else stands on: errors, names of plugins, files, processes, text. It knows nothing of traffic.

Its modules have nothing to do with each other, so each is imported by its own name; every other package is entered by
its door, the names that its ``__init__`` offers.
"""

__all__: list[str] = []
