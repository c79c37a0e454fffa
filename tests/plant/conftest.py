"""MuJoCo chooses its OpenGL when it is first imported, here before any test module does so."""

import plant  # noqa: F401
