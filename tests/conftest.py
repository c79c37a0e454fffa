"""Settings of all tests."""

from hypothesis import settings

# A busy machine is not a defect of what is tested: no time limit per example.
settings.register_profile("hil", deadline=None, print_blob=True)
settings.load_profile("hil")
