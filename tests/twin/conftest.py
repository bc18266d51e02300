"""Small twins, and the statistics by which pictures are compared."""

from hypothesis import settings

# The first call of a kernel compiles it: a deadline would measure the machine.
settings.register_profile("twin", deadline=None, max_examples=30)
settings.load_profile("twin")
