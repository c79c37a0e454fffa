"""The motion capture system: where the cameras see the LEDs at an exposure, with noise, and with some hidden."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from plant.config import MotionCaptureConfig, SensorConfig
from plant.visuals import led_site
from robots import motion_capture
from robots.description import MotionCapture
from robots.motion_capture import Frame


class MotionCaptureSystem:
    """Cameras that see every LED but those that are hidden. Occlusion is drawn, not computed from where things are.

    Each LED is off its described place by a constant error; each position has white noise.
    """

    def __init__(
        self,
        description: MotionCapture,
        config: MotionCaptureConfig,
        sensors: SensorConfig,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        streams: Callable[[str], Any],
    ) -> None:
        self._description, self._model, self._data = description, model, data
        n = len(description.leds)
        self._sites = [model.site(led_site(name)).id for name in description.names]
        place = sensors.bias * description.placement * streams("plant.motion_capture.placement").normal(3 * n)
        self._off = place.reshape(n, 3)  # in the frames of the links
        self._deviation = sensors.noise * description.noise
        self._noise = streams("plant.motion_capture.noise")
        self._chance = streams("plant.motion_capture.occlusion")
        self._hidden = [False] * n  # by the chains
        self._values = {key: getattr(config, key) for key in MotionCaptureConfig.model_fields if key != "enabled"}
        self._number = 0
        self._velocity, self._turned = np.zeros(6), np.zeros(3)
        # what the last frame said, for the record: 1 or 0 per LED, then x, y, z of each
        self.row_fields = [f"seen.{name}" for name in description.names]
        self.row_fields += [f"{name}.{axis}" for name in description.names for axis in "xyz"]
        self.row = np.zeros(4 * n)

    def set(self, key: str, value: Any) -> None:
        """Change one value of the configuration, in SI units. Raises KeyError for one that it has not."""
        if key not in self._values:
            raise KeyError(key)
        self._values[key] = value

    def expose(self, exposure_ns: int, since: float) -> bytes:
        """The frame of an exposure ``since`` seconds before the physics' present state."""
        n = len(self._sites)
        self._hide()
        noise = self._noise.normal(3 * n).reshape(n, 3)
        seen, positions = self.row[:n], self.row[n:].reshape(n, 3)
        for i, site in enumerate(self._sites):
            seen[i] = not (self._hidden[i] or self._values["occluded"])
            positions[i] = (self._position(i, site, since) + self._deviation * noise[i]) * seen[i]
        payload = motion_capture.encode(Frame(exposure_ns, self._number, seen, positions), self._description)
        self._number += 1
        return payload

    def _position(self, i: int, site: int, since: float) -> np.ndarray:
        """Where LED ``i`` was: its present place less its present velocity over that time, which is a few
        micrometres off after a third of a millisecond."""
        model, data = self._model, self._data
        mujoco.mju_mulMatVec3(self._turned, data.site_xmat[site], self._off[i])
        position = data.site_xpos[site] + self._turned
        if since:
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, self._velocity, 0)
            position -= since * self._velocity[3:]
        return position

    def _hide(self) -> None:
        """One step of every chain: hidden for ``occlusion_time`` in the mean, and for a share ``occlusion`` of all."""
        share = self._values["occlusion"]
        if not share:
            self._hidden = [False] * len(self._hidden)
            return
        exposures = max(self._values["occlusion_time"] * self._description.rate, 1.0)
        leave = min(1.0 / exposures, 1.0 - share)  # pieces are not shorter than where each exposure is by itself
        enter = leave * share / (1.0 - share) if share < 1.0 else 1.0
        for i, hidden in enumerate(self._hidden):
            change = leave if hidden else enter
            if self._chance.uniform() < change:
                self._hidden[i] = not hidden

    def snapshot(self) -> dict[str, Any]:
        return {
            "hidden": list(self._hidden),
            "values": dict(self._values),
            "number": self._number,
            "row": self.row.copy(),
            "streams": (self._noise.snapshot(), self._chance.snapshot()),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._hidden, self._values = list(state["hidden"]), dict(state["values"])
        self._number = state["number"]
        self.row[:] = state["row"]
        for stream, own in zip((self._noise, self._chance), state["streams"], strict=True):
            stream.restore(own)
