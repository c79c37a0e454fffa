"""Settings of all tests: no deadline for hypothesis, whose examples share two busy cores with processes under test."""

from hypothesis import settings

settings.register_profile("hil", deadline=None, print_blob=True)
settings.load_profile("hil")
