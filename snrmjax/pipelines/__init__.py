"""What each command does, as verbs with plain results; `snrmjax.write_results` writes these."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
