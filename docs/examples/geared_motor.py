"""An actuator of one's own in one file: a geared motor whose teeth have play.

Named in a robot's description as ``kind = "geared_motor.py:GearedMotor"`` (docs/examples/geared_motor.toml):

    hil bus up lab
    hil joint --robot docs/examples/geared_motor.toml --joint wrist --can hil:lab
"""

import casadi as ca

from plant.actuators import motor
from plant.actuators.friction import slide
from plant.actuators.model import ActuatorModel, Sensed
from robots.actuators import Actuator, Motor


class GearedMotor(Actuator):
    """What stands in the TOML file, and what firmware asks of every actuator."""

    motor: Motor
    gear_ratio: float
    torque_constant: float  # N m/A at the motor
    motor_inertia: float  # kg m² at the motor
    viscous: float  # N m s/rad at the joint
    coulomb: float  # N m at the joint
    play: float  # rad at the joint, from tooth to tooth
    stiffness: float  # N m/rad, of teeth and shaft in contact
    damping: float  # N m s/rad, in contact

    @property
    def rotor_inertia(self) -> float:
        return self.motor_inertia * self.gear_ratio**2

    @property
    def torque_per_ampere(self) -> float:
        return self.torque_constant * self.gear_ratio


class GearedMotorModel(ActuatorModel, describes=GearedMotor):
    """Rotor at theta, joint at q: the teeth press with k (d ∓ play/2) once d = theta − q has used up the play."""

    friction = ("coulomb",)  # what world.friction_scale scales

    def parameters(self):
        a = self.actuator
        return {
            "stiffness": a.stiffness,
            "damping": a.damping,
            "play": a.play,
            "inertia": a.rotor_inertia,
            "torque_per_ampere": a.torque_per_ampere,
            "viscous": a.viscous,
            "coulomb": a.coulomb,
            **motor.parameters(a),
        }

    def rest(self, q):
        return {"theta": q, "dtheta": 0.0, **motor.rest()}

    def step(self, x, u, p, dt):
        teeth = self.teeth(x, u, p)
        flow = motor.flow(x, u, p, x.dtheta, teeth, dt)  # voltage, current limit, heat
        net = p.torque_per_ampere * flow.current - teeth
        dtheta = slide(x.dtheta, net, p.inertia, dt, p.coulomb, p.coulomb, p.viscous)
        after = {"theta": x.theta + dt * dtheta, "dtheta": dtheta, "current": flow.current}
        return {**after, **motor.warm(x, p, flow.heat, dt)}, teeth

    def sense(self, x, u, p):
        teeth = self.teeth(x, u, p)
        return Sensed(
            motor=x.theta, motor_velocity=x.dtheta, deflection=x.theta - u.q, effort=teeth, torque=teeth,
            current=x.current, temperature=x.winding, supply=u.supply,
        )  # fmt: skip

    @staticmethod
    def teeth(x, u, p):
        d = x.theta - u.q
        pressed = d - ca.fmin(ca.fmax(d, -p.play / 2), p.play / 2)
        return p.stiffness * pressed + ca.if_else(pressed == 0, 0, p.damping * (x.dtheta - u.dq))
