"""Ready-made studies: a question of a source, the sweeps and linear loops that answer it, and what the numbers say."""

from __future__ import annotations

from hil.errors import UserError
from hil.schema import nearest
from hil.studies import bandwidth
from hil.studies.study import Study

STUDIES: dict[str, Study] = {study.name: study for study in (bandwidth.STUDY,)}


def named(name: str) -> Study:
    """Raises UserError, with the nearest name, when there is none."""
    if name not in STUDIES:
        raise UserError(f"study {name}: there is none of that name{nearest(name, [*STUDIES, 'list'])}")
    return STUDIES[name]
