"""Conversion of a map to a scenario: a network for SUMO, traffic on this network, and the folder for a hunt.

netconvert, netgenerate and randomTrips of the distribution eclipse-sumo do the work (extra ``maps``), each in its own
process. If a program refuses its input, crashhunt reports an error of one line.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
