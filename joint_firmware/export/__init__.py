"""A drive's control law as source code: C99 for the processor that it will run on, plain Python to compare with."""
