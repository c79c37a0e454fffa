"""Pins and commands of every drive in the first second of a real run, and what its law made of them."""

import pytest

from hil.record.law_recording import LawRecording, record_laws
from hil.scenario import load


@pytest.fixture(scope="session")
def recorded() -> dict[str, LawRecording]:
    return record_laws(load("split-terrain"), 1.0, seed=3)
