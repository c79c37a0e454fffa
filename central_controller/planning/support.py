"""What carries a planned motion in the plane: which feet stand, where the ground's force comes from, whether it can."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

BOTH = -1  # feet stand; otherwise the index of the one that does
_EDGE = 2e-3  # m, by which the centre of pressure may be beyond a foot's centre: the foot is a ball of rubber


def stance(times: np.ndarray, alone: Iterable[tuple[float, float, int]]) -> np.ndarray:
    """Index of the foot that stands alone at each of ``times`` [s], or ``BOTH``.

    ``alone``: from when [s] until when which foot stands alone, both ends excluded.
    """
    feet = np.full(len(times), BOTH)
    for begin, end, foot in alone:
        feet[(times > begin) & (times < end)] = foot
    return feet


def supported(
    com: np.ndarray, force: np.ndarray, spin: np.ndarray, feet: np.ndarray, standing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Share of the load on foot 0, (n,), and x of the centre of pressure [m], (n,).

    The ground's force f acts at a place p with (p − c) × f = dL/dt about the centre of mass c, L the angular momentum:
    where that line meets the one from foot 1 to foot 0, or the level of the foot that stands alone.

    Args:
        com: x, z [m], (n, 2).
        force: on the robot; x, z [N], (n, 2).
        spin: dL/dt about +y [N m], (n,).
        feet: x, z [m], (n, 2, 2).
        standing: from ``stance``, (n,).
    """
    alone = standing != BOTH
    base = np.where((standing == 0)[:, None], feet[:, 0], feet[:, 1])
    along = np.where(alone[:, None], (1.0, 0.0), feet[:, 0] - feet[:, 1])
    share = (_cross(com - base, force) - spin) / _cross(along, force)
    return np.where(alone, standing == 0, np.clip(share, 0.0, 1.0)), base[:, 0] + share * along[:, 0]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def check_pressed(times: np.ndarray, vertical: np.ndarray) -> None:
    """Raise ValueError where the ground would have to pull; ``vertical``: its force on the robot [N]."""
    lowest = int(np.argmin(vertical))
    if vertical[lowest] <= 0.0:
        raise ValueError(
            f"the centre of mass would fall faster than freely {times[lowest]:.2f} s after the start: "
            "lower drop, rise or apex_speed, or raise last_landing"
        )


def check_between(times: np.ndarray, pressure: np.ndarray, feet: np.ndarray, standing: np.ndarray) -> None:
    """Raise ValueError where, on both feet, the centre of pressure (x [m]) is not between them."""
    behind, before = feet[:, :, 0].min(axis=1) - pressure, pressure - feet[:, :, 0].max(axis=1)
    for outside, where, remedy in (
        (behind, "behind the rear foot", "the start needs another push_time, wind_up or lift_off"),
        (before, "in front of the front foot", "the end needs a greater stop_time or a smaller last_landing"),
    ):
        beyond = np.where(standing == BOTH, outside, -math.inf)
        worst = int(np.argmax(beyond))
        if beyond[worst] > _EDGE:
            raise ValueError(
                f"the centre of pressure would be {1e3 * beyond[worst]:.0f} mm {where} {times[worst]:.2f} s after the "
                f"start: {remedy}"
            )
