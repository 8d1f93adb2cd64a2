"""Arms by name, as the text of their ``arm.toml``. The PUMA 560 is the paper's Table II, "The Combined Model"."""

from __future__ import annotations

from collections.abc import Mapping

# The paper has no recovery; without one its gains would put a 300 mm scan 15 mm off. 100 ms is a compromise between
# the axes, from a simulated scan.
_PUMA560 = """\
name = "PUMA 560, {mode} ALTER"
update_period_ms = 28.0
delay_ms = {delay_ms}

[validity]
max_speed_m_s = 0.5
max_radius_mm = 700.0

[axes.tangential]
plant = "second-order"
natural_frequency_rad_s = 53.9
damping = 0.864
gain = {{ slope_s_m = 0.0518, intercept = 1.010 }}
gain_recovery_ms = 100.0

[axes.radial]
plant = "first-order"
time_constant_ms = 42.5
gain = {{ slope_s_m = 0.0818, intercept = 0.933 }}
gain_recovery_ms = 100.0

[axes.vertical]
plant = "first-order"
time_constant_ms = 35.6
gain = {{ slope_s_m = 0.134, intercept = 0.941 }}
gain_recovery_ms = 100.0

[provenance]
source = "A Practical Dynamic Model of a Puma 560 Manipulator for Aircraft Maintenance, Table II"
"""

PRESETS: Mapping[str, str] = {
    "puma560-internal": _PUMA560.format(mode="internal", delay_ms=60.45),
    # 38.5 ms count from when the controller asks for data: there the tick of a command is the request.
    "puma560-external": _PUMA560.format(mode="external", delay_ms=38.5),
}
