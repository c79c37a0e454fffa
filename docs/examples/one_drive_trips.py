"""What becomes of a standing Hume when the protection of one drive trips.

    python docs/examples/one_drive_trips.py

In `hil run` the run ends at the fault; here it goes on for two seconds. Each row is one fault of one drive of the left
leg at 3 s: a jump of the motor's encoder (power off at once) or of the joint's encoder (half a second of braking, then
power off). The controller goes on as if nothing had happened.
"""

from __future__ import annotations

from hil.run import Request, assemble
from hil.scenario import load

FAULT_S, WATCHED_S = 3.0, 2.0


def main() -> None:
    with assemble(Request(load("stand"), 1, "inline", report=False)) as assembly:
        system, world = assembly.system, assembly.world
        system.monitor = None  # it would end the run
        system.run_until(round(FAULT_S * 1e9))
        start = system.snapshot()
        names = list(world.truth_fields)
        height, tilts = names.index("com.z"), [names.index("base.roll"), names.index("base.pitch")]
        stood = float(world.truth()[height])
        print("drive            reaction    CoM after 0.5 s  1 s    2 s      tilt after 1 s  torso on the ground after")
        for joint in ("left_abduction", "left_hip", "left_knee"):
            for key, reaction in (("encoder", "power off"), ("joint_encoder", "brakes")):
                system.restore(start)
                system.inject(f"joint.{joint}.{key}", "jump")
                heights, tilt, fallen = {}, 0.0, None
                for step in range(1, round(100 * WATCHED_S) + 1):
                    system.run_until(round((FAULT_S + 0.01 * step) * 1e9))
                    row = world.truth()
                    heights[step] = 1e3 * (float(row[height]) - stood)
                    if step == 100:
                        tilt = max(abs(float(row[i])) for i in tilts)
                    if fallen is None and world.fallen():
                        fallen = 0.01 * step
                ground = "no" if fallen is None else f"{fallen:.2f} s"
                print(
                    f"{joint:15}  {reaction:10}  {heights[50]:+8.0f} mm {heights[100]:+8.0f} {heights[200]:+6.0f} mm"
                    f"  {57.2958 * tilt:10.1f}°      {ground}"
                )


if __name__ == "__main__":
    main()
