"""A timeline with other delays, gains and latencies than it was built with.

Building one anew for each configuration that a search tries would cost more than filtering. Delays and gains change
the input of each axis; latencies change when measurements are valid, and so perhaps their order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from ..arrays import IntArray
from ..fusion.components import Components
from ..fusion.config import FusionConfig
from ..fusion.segments import AxisInput, Timeline
from ..model.drive import drive

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class Retimed:
    """A timeline under another configuration.

    Attributes:
        timeline: The timeline.
        order: The index that each of its components had before, (m,); None where the order is the same.
    """

    timeline: Timeline
    order: IntArray | None

    def reordered(self, values: npt.NDArray[T]) -> npt.NDArray[T]:
        """Values of the components in this order, from the order before, (m,)."""
        return values if self.order is None else values[self.order]

    def restored(self, values: npt.NDArray[T]) -> npt.NDArray[T]:
        """Values of the components in the order before, from this one, (m,)."""
        if self.order is None:
            return values
        found = np.empty_like(values)
        found[self.order] = values
        return found


def retimed(timeline: Timeline, built: FusionConfig, config: FusionConfig) -> Retimed:
    """A timeline under another configuration than it was built with.

    Args:
        timeline: Only with components that a filter decides on.
        built: The configuration it was built with.
        config: The same arm and sensors with other numbers.
    """
    axes = tuple(_driven(axis, built, config) for axis in timeline.axes)
    components, order = timeline.components, None
    late = np.array(
        [round(config.sensors[n].latency * 1e9) - round(built.sensors[n].latency * 1e9) for n in components.sensors]
    )
    if late.any():
        valid = components.valid - late[components.sensor]
        order = np.lexsort((components.row, components.sensor, valid))
        components = replace(subset(components, order), valid=valid[order])
    return Retimed(replace(timeline, axes=axes, components=components), order)


def subset(components: Components, places: IntArray) -> Components:
    """Some of the components, in the order of ``places`` (k,)."""
    return Components(
        components.valid[places],
        components.stamp[places],
        components.sensor[places],
        components.axis[places],
        components.value[places],
        components.row[places],
        None if components.spread is None else components.spread[places],
        components.outcome[places],
        components.sensors,
    )


def _driven(axis: AxisInput, built: FusionConfig, config: FusionConfig) -> AxisInput:
    """The input of an axis under ``config``; made anew only where the gain differs."""
    before, now = built.arm.axes[axis.name], config.arm.axes[axis.name]
    delay = round(config.arm.delay_of(axis.name) * 1e9)
    if (before.gain, before.gain_recovery) == (now.gain, now.gain_recovery):
        return axis if delay == axis.delay else replace(axis, delay=delay)
    driven = drive(now, axis.given, axis.command, axis.start, config.arm.update_period)
    return replace(axis, drive=driven, delay=delay)
