"""What a video shows beside the robot."""

import numpy as np

from hil.report.video import planned_places
from tests.support.stepping import FIRST, PLAN, PLANNED, STEP, stepping_run


def test_planned_places_are_shown_from_the_plan_until_the_next_one_of_that_foot() -> None:
    tables = stepping_run([(0.0, 0.0)] * 3)
    tables["world"]["foot.left_foot.z"][:] = 0.025
    tables["world"]["foot.left_foot.x"][: FIRST + STEP] += 1.0  # the stance foot of the first step stood elsewhere
    planned = [(FIRST + n * STEP + PLAN) / 1000 + 0.001 for n in range(3)]
    before, first, second, third = planned_places(tables, np.array([0.0, *planned]))
    (right_x, right_y), left = PLANNED["right_foot"], [*PLANNED["left_foot"], 0.0]
    first_right = [right_x + 1.0, right_y, 0.025]
    assert before == [] and len(first) == 1 and len(second) == len(third) == 2
    np.testing.assert_allclose(first, [first_right])
    np.testing.assert_allclose(second, [first_right, left])
    np.testing.assert_allclose(third, [[right_x, right_y, 0.025], left])
