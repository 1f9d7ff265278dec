"""Which further test would separate models that fit equally well: optimal design."""
