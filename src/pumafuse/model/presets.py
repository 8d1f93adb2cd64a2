"""Arms by name. The PUMA 560 is the paper's Table II, "The Combined Model"."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from .arm import ArmModel, AxisModel, Gain, Validity
from .plants import FirstOrder, SecondOrder

# The paper has no recovery; without one its gains would put a 300 mm scan 15 mm off. 100 ms is a compromise between
# the axes, found on a simulated scan.
_RECOVERY = 0.100

_INTERNAL = ArmModel(
    name="PUMA 560, internal ALTER",
    update_period=0.028,
    delay=0.06045,
    validity=Validity(max_speed=0.5, max_radius=0.7),
    axes={
        "tangential": AxisModel(
            plant=SecondOrder(natural_frequency=53.9, damping=0.864),
            gain=Gain(slope=0.0518, intercept=1.010),
            gain_recovery=_RECOVERY,
        ),
        "radial": AxisModel(
            plant=FirstOrder(time_constant=0.0425),
            gain=Gain(slope=0.0818, intercept=0.933),
            gain_recovery=_RECOVERY,
        ),
        "vertical": AxisModel(
            plant=FirstOrder(time_constant=0.0356),
            gain=Gain(slope=0.134, intercept=0.941),
            gain_recovery=_RECOVERY,
        ),
    },
    provenance={"source": "A Practical Dynamic Model of a Puma 560 Manipulator for Aircraft Maintenance, Table II"},
)

PRESETS: Mapping[str, ArmModel] = {
    "puma560-internal": _INTERNAL,
    # 38.5 ms count from when the controller asks for data: there the tick of a command is the request.
    "puma560-external": msgspec.structs.replace(_INTERNAL, name="PUMA 560, external ALTER", delay=0.0385),
}
