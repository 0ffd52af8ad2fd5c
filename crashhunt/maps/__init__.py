"""From a map to a scenario: a network for SUMO, traffic that flows on it, and the folder that a hunt takes.

netconvert, netgenerate and randomTrips of the distribution eclipse-sumo do the work (extra ``maps``), each in its own
process. What they say no to is an error of one line.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
