"""The open chain of two joints on which Kim 2018 §6.2.1 compares foot estimators, with its errors.

The chain moves by pinocchio's forward dynamics under a known torque and an unknown disturbance; the filters' model of
it is another one (central_controller.estimation.chain), with links of wrong length. The source states lengths and
biases; masses, motion, noise and the pattern of occlusions are ASSUMED here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from central_controller.estimation.chain import Chain, ChainLink
from central_controller.estimation.foot_models import FootNoise
from hil.streams import Stream, streams

RATE = 1500.0  # Hz, of encoders and filters
MOCAP_RATE = 480.0  # Hz (Kim 2018 §6.2)
LENGTH, MASS = 0.3, 1.0  # m, kg of either link, a thin rod
GRAVITY = 9.81
_SUBSTEPS = 2  # of physics per sample
_SEEN, _HIDDEN = (0.5, 1.5), (0.2, 0.8)  # s: how long motion capture sees the foot, and does not
_CENTRE, _AMPLITUDE, _FREQUENCY = (-1.9, 0.9), (0.5, 0.6), (0.6, 0.9)  # rad, rad, Hz of the joints' motion
_STIFFNESS, _DAMPING = 100.0, 20.0  # 1/s², 1/s: what holds the chain to its motion


class Errors(NamedTuple):
    """What the filters' model does not know: of lengths [m] (model − truth) and of encoders [rad] (read − truth)."""

    lengths: tuple[float, float]
    biases: tuple[float, float]


SOURCE = Errors((0.01, -0.02), (0.03, -0.05))  # Kim 2018 §6.2.1
NONE = Errors((0.0, 0.0), (0.0, 0.0))


def model(errors: Errors) -> Chain:
    """The chain as the filters know it: wrong lengths, true masses."""
    inertia = MASS * LENGTH**2 / 12
    return Chain([ChainLink(LENGTH + error, MASS, LENGTH / 2, inertia) for error in errors.lengths], GRAVITY)


@dataclass(frozen=True)
class Recording:
    """A run of the bench, a row per sample: the truth, what drove it, and what the sensors said."""

    seconds: np.ndarray
    q: np.ndarray  # (samples, 2) rad
    dq: np.ndarray  # rad/s
    p: np.ndarray  # m, of the end effector
    torque: np.ndarray  # N m, from the sample before to this one
    encoders: np.ndarray  # (samples, 4): angles and rates
    mocap: np.ndarray  # (samples, 2) m, or nan without a new one
    hidden: np.ndarray  # (samples,) bool: the end effector is occluded


def _physics() -> tuple[pin.Model, pin.Data]:
    chain, joint = pin.Model(), 0
    for k in range(2):
        offset = np.array([LENGTH if k else 0.0, 0.0, 0.0])
        joint = chain.addJoint(joint, pin.JointModelRZ(), pin.SE3(np.eye(3), offset), f"joint{k}")
        across = MASS * LENGTH**2 / 12
        inertia = pin.Inertia(MASS, np.array([LENGTH / 2, 0.0, 0.0]), np.diag([1e-9, across, across]))
        chain.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    chain.addFrame(pin.Frame("end", joint, 0, pin.SE3(np.eye(3), np.array([LENGTH, 0.0, 0.0])), pin.FrameType.OP_FRAME))
    chain.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
    return chain, chain.createData()


def _occlusions(stream: Stream, ticks: int) -> np.ndarray:
    hidden, at, now = np.zeros(ticks, bool), 0, False
    while at < ticks:
        low, high = _HIDDEN if now else _SEEN
        until = at + round((low + (high - low) * stream.uniform()) * RATE)
        hidden[at:until] = now
        at, now = until, not now
    return hidden


def record(seed: int, duration: float, errors: Errors, noise: FootNoise, occluded: bool = True) -> Recording:
    """``duration`` seconds of the chain's motion with sensors of ``noise`` and ``errors``. The acceleration that
    disturbs it is as the noise states. Equal seeds give equal truths, whatever the errors."""
    draw = streams(seed)
    disturbance, encoder, camera = (draw(f"chain.{name}") for name in ("disturbance", "encoders", "mocap"))
    chain, data = _physics()
    end, ticks, dt = chain.getFrameId("end"), round(duration * RATE), 1.0 / RATE
    result = Recording(
        seconds=np.arange(ticks) * dt, q=np.zeros((ticks, 2)), dq=np.zeros((ticks, 2)), p=np.zeros((ticks, 2)),
        torque=np.zeros((ticks, 2)), encoders=np.zeros((ticks, 4)), mocap=np.full((ticks, 2), np.nan),
        hidden=_occlusions(draw("chain.occlusions"), ticks) & occluded,
    )  # fmt: skip
    centre, amplitude, omega = np.array(_CENTRE), np.array(_AMPLITUDE), 2 * math.pi * np.array(_FREQUENCY)
    deviations = np.repeat([noise.encoder, noise.rate], 2)
    biases = np.array([*errors.biases, 0.0, 0.0])
    q, dq, torque = centre + 0.0, amplitude * omega, np.zeros(2)
    for k in range(ticks):
        pin.framesForwardKinematics(chain, data, q)
        p = data.oMf[end].translation[:2]
        result.q[k], result.dq[k], result.p[k], result.torque[k] = q, dq, p, torque
        result.encoders[k] = np.concatenate([q, dq]) + biases + deviations * encoder.normal(4)
        if int(k * MOCAP_RATE / RATE) != int((k - 1) * MOCAP_RATE / RATE) and not result.hidden[k]:
            result.mocap[k] = p + noise.mocap * camera.normal(2)
        phase = omega * k * dt
        off, rate_off = centre + amplitude * np.sin(phase) - q, amplitude * omega * np.cos(phase) - dq
        wanted = -amplitude * omega**2 * np.sin(phase) + _STIFFNESS * off + _DAMPING * rate_off
        torque = pin.rnea(chain, data, q, dq, wanted)
        kick = noise.acceleration * math.sqrt(dt) * disturbance.normal(2)
        for _ in range(_SUBSTEPS):  # midpoint rule
            h = dt / _SUBSTEPS
            half = dq + h / 2 * pin.aba(chain, data, q, dq, torque)
            change = h * pin.aba(chain, data, q + h / 2 * dq, half, torque) + kick / _SUBSTEPS
            q, dq = q + h * (dq + change / 2), dq + change
    return result
