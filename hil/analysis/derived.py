"""What metrics, verdict and plots all need: errors, foot displacement and friction, derived from the recorded signals.

The controller's row of a tick comes less than a millisecond after the world's: both are joined by taking, for each
controller row, the latest world row before it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cached_property

import numpy as np

from hil.record.signals import Signals
from plant.config import TerrainConfig

LOADED = 5.0  # N; a foot that presses less counts as lifted


class Derived:
    """Derived signals of one run.

    Args:
        tables: channels ``controller``, ``world``, ``drives`` and ``bus`` by name.
        terrain: ground under the feet, for the contact normals.
        settle: errors are judged from this time on, s.
    """

    def __init__(self, tables: Mapping[str, Signals], terrain: TerrainConfig, settle: float) -> None:
        self.controller = tables["controller"]
        self.world = tables["world"]
        self.drives = tables["drives"]
        self.bus = tables["bus"]
        self.terrain = terrain
        self.settle = settle
        self.feet = [name[:-2] for name in self.world.members("foot") if name.endswith(".x")]

    def settled(self, table: Signals) -> np.ndarray:
        """Which rows of ``table`` come after settling, (n,) bool."""
        return table.times >= round(self.settle * 1e9)

    @cached_property
    def world_index(self) -> np.ndarray:
        """World row of each controller row, (n,)."""
        return self.world.latest_before(self.controller.times)

    def _world_at(self, *names: str) -> np.ndarray:
        if not len(self.world):
            return np.full((len(self.controller), len(names)), np.nan)
        return self.world.vector(*names)[self.world_index]

    @cached_property
    def com_reference(self) -> np.ndarray:
        """Reference of the CoM in the sagittal plane (x, z), (n, 2), m; NaN until the controller has one."""
        reference = self.controller.vector("com_reference.x", "com_reference.z")
        reference[self.controller["phase"] == 0] = np.nan
        return reference

    @cached_property
    def com_true(self) -> np.ndarray:
        """True CoM (x, z) at the controller's rows, (n, 2), m, from the midpoint of the feet when they began to carry
        the robot alone: the origin that the controller knows. Until then they may still find their place."""
        row = self.released or 0
        feet = [self.world.vector(f"foot.{foot}.x", f"foot.{foot}.z")[row] for foot in self.feet if len(self.world)]
        return self._world_at("com.x", "com.z") - (np.mean(feet, axis=0) if feet else 0.0)

    @cached_property
    def com_error(self) -> np.ndarray:
        """True CoM less reference (x, z), (n, 2), m."""
        return self.com_true - self.com_reference

    @cached_property
    def com_distance(self) -> np.ndarray:
        """Distance of the true CoM from its reference in the sagittal plane, (n,), m."""
        return np.hypot(self.com_error[:, 0], self.com_error[:, 1])

    @cached_property
    def com_distance_estimated(self) -> np.ndarray:
        """Distance of the estimated CoM from its reference, (n,), m."""
        error = self.controller.vector("com.x", "com.z") - self.com_reference
        return np.hypot(error[:, 0], error[:, 1])

    @cached_property
    def orientation_error(self) -> np.ndarray:
        """True roll and pitch of the torso less their references, (n, 2), rad, in (−π, π]."""
        error = self._world_at("base.roll", "base.pitch") - self.controller.vector("roll_reference", "pitch_reference")
        return np.pi - np.mod(np.pi - error, 2 * np.pi)

    @cached_property
    def internal_force_true(self) -> np.ndarray:
        """The world's internal force at the controller's rows, (n,), N."""
        return self._world_at("internal_force")[:, 0]

    @cached_property
    def push(self) -> np.ndarray:
        """Force on the torso (x, z) at the controller's rows, (n, 2), N."""
        return self._world_at("push.x", "push.z")

    @cached_property
    def released(self) -> int | None:
        """First world row without any support by the hoist; None if the run ended before."""
        supported = np.flatnonzero(self.world["hoist"] > 1e-9)
        first = int(supported[-1]) + 1 if len(supported) else 0
        return first if first < len(self.world) else None

    def contact_force(self, foot: str) -> np.ndarray:
        """Force of the robot on the ground under ``foot``, (n, 3), N."""
        return self.world.group(f"contact.{foot}")

    @cached_property
    def loaded(self) -> dict[str, np.ndarray]:
        """Whether each foot presses on the ground, (n,) bool over the world's rows."""
        return {foot: np.linalg.norm(self.contact_force(foot), axis=1) >= LOADED for foot in self.feet}

    @cached_property
    def foot_displacement(self) -> dict[str, np.ndarray]:
        """Distance of each foot's centre from where it was at the hoist's release, (n,), m.

        NaN before the release and while the foot is lifted: a loaded foot can only be displaced along the ground.
        """
        result = {}
        for foot in self.feet:
            displacement = np.full(len(self.world), np.nan)
            if self.released is not None:
                centre = self.world.group(f"foot.{foot}")
                displacement = np.linalg.norm(centre - centre[self.released], axis=1)
                displacement[: self.released] = np.nan
                displacement[~self.loaded[foot]] = np.nan
            result[foot] = displacement
        return result

    @cached_property
    def lifted_time(self) -> dict[str, np.ndarray]:
        """For how long each foot has been without load since the release, (n,), s; 0 while it is loaded."""
        seconds = self.world.seconds
        result = {}
        for foot in self.feet:
            on_ground = self.loaded[foot].copy()
            on_ground[: len(on_ground) if self.released is None else self.released + 1] = True
            last = np.maximum.accumulate(np.where(on_ground, np.arange(len(on_ground)), 0))
            result[foot] = seconds - seconds[last]
        return result

    @cached_property
    def normals(self) -> dict[str, np.ndarray]:
        """Normal of the ground under each foot, (3,), out of the ground. The two panels of split terrain face
        each other: each leans towards the middle between the feet."""
        angle = self.terrain.panel_angle if self.terrain.kind == "split" else 0.0
        result = {}
        for foot in self.feet:
            x = self.world[f"foot.{foot}.x"]
            side = math.copysign(1.0, x[0]) if len(x) else 1.0
            result[foot] = np.array([-side * math.sin(angle), 0.0, math.cos(angle)])
        return result

    @cached_property
    def friction_ratio(self) -> dict[str, np.ndarray]:
        """Tangential over normal contact force of each foot, (n,); NaN while the foot is not loaded."""
        result = {}
        for foot, normal in self.normals.items():
            force = self.contact_force(foot)
            pressure = -force @ normal
            tangential = np.linalg.norm(force + pressure[:, None] * normal, axis=1)
            pressed = pressure >= LOADED
            result[foot] = np.where(pressed, tangential / np.where(pressed, pressure, 1.0), np.nan)
        return result
