"""Pictures: the scene from above, panels that an agent provides, and films of both.

Drawing needs Pillow, and MP4 needs PyAV: ``pip install 'crashhunt[video]'``. Panels themselves need neither, so an
agent can create panels that are not drawn.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
