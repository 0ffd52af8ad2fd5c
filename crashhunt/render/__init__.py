"""Pictures: the scene from above, panels that an agent may show of itself, and films of both.

Needs Pillow, and for MP4 PyAV: ``pip install 'crashhunt[video]'``. Panels themselves need neither: an agent can make
them where they are not drawn.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
