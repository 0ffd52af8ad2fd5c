"""The ledger of a hunt: facts about its trials in one SQLite file, with schema, migrations, writer and reader."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
