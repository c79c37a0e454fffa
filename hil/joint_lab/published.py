"""Gains that the sources print, as a drive is set to them.

VLCA (Kim 2018 §5.3.2): K_p = 4, K_d,m = 15, K_i = 300, a disturbance observer of 15 Hz. They are of the screw, the
damping per metre of its travel and ampere-free: in the joint's coordinates kd = K_d,m N_m r0². PD_f's filter is not
printed. 60 Hz, the one other cutoff of that section (of Q_τd in the experiment of §5.3.4), is taken.

Hydraulic joint: the source (Rotella 2018 §II.1) prints no gains. ASSUMED: kp = 0.5 alone, half of what a drive bears at
3 kHz.

Hume (Tables 2.1 and 7.1): K_P,τ and K_I,τ of Meka's passivity-based controller (§7.3.1), a PI from torque error to the
motor's velocity. Table 7.1's unit, "N m rad/s" for both, is of no quantity in that loop; the gains are READ AS rad/s,
and rad/s², of the motor per N m at the joint. The inner loop's gain is in no source: it is the firmware's kd.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from joint_firmware.config import TorqueGains
from robots.actuators import Hydraulic, SeriesElastic, Viscoelastic
from robots.description import Joint

_VALVE = ("kp=0.5", "ki=0", "kd=0")
_KP, _KI, _KD_M, _OBSERVER_HZ, _TORQUE_RATE_HZ = 4.0, 300.0, 15.0, 15.0, 60.0


def settings(joint: Joint) -> list[str]:
    """KEY=VALUE of what the sources say of ``joint``'s torque loops, as ``--set`` takes it; nothing where none does."""
    actuator = joint.actuator
    if isinstance(actuator, Hydraulic):
        return [f"firmware.{which}.{name}" for which in ("stance", "swing") for name in _VALVE]
    if not isinstance(actuator, Viscoelastic):
        return []
    kd = _KD_M * actuator.reduction * actuator.nominal_arm**2
    gains = {"kp": f"{_KP}", "ki": f"{_KI}", "kd": f"{kd!r} N m s/rad"}
    return [
        *(f"firmware.{which}.{name}={value}" for which in ("stance", "swing") for name, value in gains.items()),
        f"firmware.observer_cutoff={_OBSERVER_HZ} Hz",
        f"firmware.torque_rate_cutoff={_TORQUE_RATE_HZ} Hz",
    ]


class MekaGains(NamedTuple):
    """Of one joint: rad/s and rad/s² of the motor per N m at the joint."""

    proportional: float
    integral: float

    def of_cascade(self, joint: Joint, kd: float) -> TorqueGains:
        """For ``joint_firmware.laws.cascade`` with the inner loop's gain ``kd`` [N m s/rad].

        Raises ValueError for an actuator without a gear.
        """
        if not isinstance(joint.actuator, SeriesElastic):
            raise ValueError(f"{joint.name} is no series elastic actuator: the tables are Hume's")
        at_joint = kd / joint.actuator.gear_ratio
        return TorqueGains(kp=at_joint * self.proportional, ki=at_joint * self.integral, kd=f"{kd!r} N m s/rad")  # type: ignore[arg-type]


def _both_sides(abduction: MekaGains, hip: MekaGains, knee: MekaGains) -> dict[str, MekaGains]:
    of = {"abduction": abduction, "hip": hip, "knee": knee}
    return {f"{side}_{name}": gains for side in ("right", "left") for name, gains in of.items()}


_DEFAULT_2_1 = MekaGains(65.0, 0.0)  # "Every Joint"
_SWING_ABDUCTION = MekaGains(3.09, 0.19)

# Kim 2018: table → gain set → joint
HUME: Mapping[str, Mapping[str, Mapping[str, MekaGains]]] = {
    "2.1": {
        "stance": _both_sides(_DEFAULT_2_1, _DEFAULT_2_1, _DEFAULT_2_1),
        "swing": {
            **_both_sides(_DEFAULT_2_1, _DEFAULT_2_1, _DEFAULT_2_1),
            "right_hip": MekaGains(200.0, 22.0),
            "left_hip": MekaGains(180.0, 15.0),
            "right_knee": MekaGains(260.0, 35.0),
            "left_knee": MekaGains(255.0, 30.0),
        },
    },
    "7.1": {
        "stance": _both_sides(MekaGains(2.84, 0.15), MekaGains(43.0, 0.0), MekaGains(22.0, 0.0)),
        "swing": {
            "right_abduction": _SWING_ABDUCTION,
            "left_abduction": _SWING_ABDUCTION,
            "right_hip": MekaGains(58.57, 5.86),
            "left_hip": MekaGains(32.70, 3.48),
            "right_knee": MekaGains(49.75, 6.85),
            "left_knee": MekaGains(26.1, 4.15),
        },
    },
}
