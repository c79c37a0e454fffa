"""The push that `balance` survives, in each direction, while it steps.

    python docs/examples/push_margin.py [SEEDS, 3]

A push of 0.1 s on the torso's centre of mass from 4 s on, wherever in a step that is. It is survived when the robot is
still within the scenario's limits 2.5 s later, about six steps. The force is bisected, each time from the same moment.
"""

from __future__ import annotations

import sys

import numpy as np

from hil.lab.running import Running
from hil.scenario import load

AT, DURATION, WATCHED = 4.0, 0.1, 2.5  # s
LARGEST, RESOLUTION = 160.0, 10.0  # N
DIRECTIONS = {"forwards": (1, 0), "backwards": (-1, 0), "left": (0, 1), "right": (0, -1)}


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    for seed in range(seeds):
        with Running(load("balance", ["duration=7s"]), seed) as running:
            start = running.until(AT).snapshot()
            if not survives(running, start, np.zeros(2)):
                print(f"seed {seed} falls without a push")
                continue
            for name, direction in DIRECTIONS.items():
                low, high = 0.0, LARGEST
                while high - low > RESOLUTION:
                    force = 0.5 * (low + high)
                    if survives(running, start, force * np.array(direction)):
                        low = force
                    else:
                        high = force
                print(f"seed {seed} {name:9} survives {low * DURATION:.1f} N s, falls with {high * DURATION:.1f}")


def survives(running: Running, start: dict, force: np.ndarray) -> bool:
    """Whether the robot goes on stepping after being pushed by ``force`` (x, y) [N]."""
    running.restore(start)
    world = running.system.world
    push = world.data.body(world.robot.base.name).xfrc_applied
    push[:2] = force
    running.until(AT + DURATION)
    push[:2] = 0.0
    return running.until(AT + DURATION + WATCHED).stopped is None


if __name__ == "__main__":
    main()
