"""Configuration of the central controller."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from central_controller.planning.config import OpenLoopConfig
from central_controller.stepping_config import StepConfig
from central_controller.task_gains import TaskGains
from robots.quantities import Config, Gain, Hertz, Metres, Newtons, Probability, Seconds
from robots.terrain import Block


class TaskSetConfig(Config):
    """Gains of the double-support task set [CoM_x, CoM_z, pitch, roll] (Kim 2018 §5.1.2)."""

    com_x: TaskGains = TaskGains(kp=150.0, kd=20.0, ki=30.0)
    com_z: TaskGains = TaskGains(kp=250.0, kd=25.0, ki=30.0)
    pitch: TaskGains = TaskGains(kp=250.0, kd=25.0, ki=30.0)
    roll: TaskGains = TaskGains(kp=150.0, kd=20.0, ki=10.0)


class InternalForceConfig(Config):
    """Internal force between the feet, W_int F_r of Kim 2018 (5.4)–(5.7): positive pushes the feet apart."""

    reference: Newtons = 0.0
    feedback: bool = True  # (5.2); false: feed-forward only (5.1)
    gain: Gain = 3.0  # K_F of (5.2)
    cutoff: Hertz = 5.0  # of the sensed force that is fed back; the loop follows up to (1 + K_F) times that


class PathConfig(Config):
    """Reference of the centre of mass about where it starts."""

    kind: Literal["hold", "ellipse"] = "hold"
    semi_x: Metres = 0.0
    semi_z: Metres = 0.0
    period: Seconds = 4.0
    start: Seconds = 2.5  # from the start of the run


class MotionCaptureFilterConfig(Config):
    """Orientation from motion capture and gyro (Kim 2018, Appendix E)."""

    trust: Annotated[float, Field(gt=0)] = 2.0  # λ of (E.4), m²: of what is integrated against what is seen
    bias_gain: Gain = 1.0  # 1/s, from the turn that frames bring to the gyro's bias; 0: none, as in the source
    delay_compensated: bool = True  # false: frames are taken for what is seen when they arrive
    gate: Annotated[Metres, Field(gt=0)] = 0.01  # error of a distance between two LEDs from which one is not believed


class ContactForceConfig(Config):
    """Contact felt in the joints' torques (``estimation/contact.py``)."""

    cutoff: Annotated[Hertz, Field(gt=0)] = 90.0  # each of two poles, of torques and velocities
    press: Newtons = 20.0  # from which a foot touches the ground; Hume's legs feel up to 9 N that are not there
    release: Probability = 0.5  # share of that below which it no longer does


class ControllerConfig(Config):
    """The central controller: timing, model, tasks."""

    behaviour: Literal["stand", "step", "open_loop"] = "stand"
    rate: Hertz = 1500.0
    phase: Seconds = 270e-6  # of its tick behind the joints' sample: all drive states have arrived by then
    compute_time: Seconds = 200e-6  # from its tick to its commands (Kim 2018 §7.1.1: 0.2 ms for WBOSC)
    variant: str | None = None  # masses of the controller's model, if not the robot's description
    velocity_cutoff: Hertz = 60.0  # of joint velocities
    orientation_time_constant: Seconds = 2.0  # of the accelerometer's correction of the integrated gyro
    orientation: Literal["complementary", "motion_capture"] = "complementary"  # the filter that tells it
    motion_capture: MotionCaptureFilterConfig = MotionCaptureFilterConfig()
    contact: Literal["switch", "force", "both"] = "switch"  # what tells that a foot touches the ground; both must
    contact_force: ContactForceConfig = ContactForceConfig()
    stand_at: Seconds = 0.6  # the robot hangs still until then, its joints held by the drives
    weight_ramp: Seconds = 0.2  # torques grow from nothing over this time
    tasks: TaskSetConfig = TaskSetConfig()
    internal_force: InternalForceConfig = InternalForceConfig()
    path: PathConfig = PathConfig()
    blocks: tuple[Block, ...] | None = None  # that it believes to be on the ground; not given: those of the terrain
    open_loop: OpenLoopConfig = OpenLoopConfig()
    stepping: StepConfig = StepConfig()
