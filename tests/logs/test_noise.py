"""Rows that say how noisy they are: the noise of a sensor, row by row."""

from pathlib import Path

import numpy as np
import pytest

import pumafuse as pf
from pumafuse.errors import ConfigError
from pumafuse.logs.save import save

ARM = pf.ArmModel(
    name="slide", update_period=0.02, delay=0.03, axes={"x": pf.AxisModel(plant=pf.FirstOrder(time_constant=0.05))}
)
GIVEN, SEEN = 0.02 * np.arange(100), 0.013 + 0.01 * np.arange(190)
FACTOR = np.resize([1.0, 3.0, 1.0, 0.5], len(SEEN))
MEASURED = 0.1 * np.cos(np.maximum(SEEN - 0.08, 0.0)) + 2e-4 * FACTOR * np.random.default_rng(3).standard_normal(
    len(SEEN)
)
COMMAND = {"x": 0.1 * np.cos(GIVEN)}
RUN = """
[command]
file = "command.csv"
time = "t_s"
x = "x_mm"
[sensors.camera]
file = "camera.csv"
time = "t_s"
x = "x_mm"
noise = {}
"""


def fused(measured: dict[str, tuple[np.ndarray, dict[str, np.ndarray]]], sd: dict[str, float]) -> object:
    """Position and its standard deviation."""
    config = pf.FusionConfig(arm=ARM, sensors={name: pf.Sensor(sd=one, gate=0.0) for name, one in sd.items()})
    est = pf.fuse(pf.Run.from_arrays(GIVEN, COMMAND, measured), config)
    return np.column_stack([est["x"].position, est["x"].position_sd])


def test_rows_of_each_noise_are_a_sensor_of_their_own() -> None:
    """One sensor whose rows have three noises is three sensors of one noise each."""
    one = fused({"camera": (SEEN, {"x": MEASURED, "noise": FACTOR})}, {"camera": 2e-4})
    parts = {f"camera{factor}": factor == FACTOR for factor in (0.5, 1.0, 3.0)}
    apart = fused(
        {name: (SEEN[rows], {"x": MEASURED[rows]}) for name, rows in parts.items()},
        {f"camera{factor}": 2e-4 * factor for factor in (0.5, 1.0, 3.0)},
    )
    even = fused({"camera": (SEEN, {"x": MEASURED})}, {"camera": 2e-4})
    assert one == pytest.approx(apart, rel=1e-9)
    assert even != pytest.approx(apart, rel=1e-2)


def written(folder: Path, noise: str, column: np.ndarray) -> Path:
    (folder / "run.toml").write_text(RUN.format(noise))
    table = np.column_stack([GIVEN, 1e3 * COMMAND["x"]])
    np.savetxt(folder / "command.csv", table, "%.6f", ",", header="t_s,x_mm", comments="")
    rows = ["t_s,x_mm,told"]
    for stamp, value, told in zip(SEEN, 1e3 * MEASURED, column, strict=True):
        rows.append(f"{stamp:.3f},{value:.6f},{'' if np.isnan(told) else told}")
    (folder / "camera.csv").write_text("\n".join(rows) + "\n")
    return folder


def test_columns_of_deviations_and_of_variances(tmp_path: Path) -> None:
    """Relative to what is typical; a row that does not know has the noise of fusion.toml."""
    told = np.where(FACTOR == 0.5, np.nan, np.where(FACTOR == 3.0, 0.75, 0.25))
    told[0] = 0.0
    expected = np.where(FACTOR == 3.0, 3.0, 1.0)
    for noise, column in (("sd", told), ("variance", told**2)):
        typical = 0.25 if noise == "sd" else 0.0625
        folder = written(tmp_path, f"{{ {noise} = 'told', typical = {typical} }}", column)
        assert pf.Run.read(folder).sensors["camera"].noise == pytest.approx(expected)


def test_it_is_saved_with_the_run(tmp_path: Path) -> None:
    """And read back as it was; a part of the run has its rows of it."""
    run = pf.Run.from_arrays(GIVEN, COMMAND, {"camera": (SEEN, {"x": MEASURED, "noise": FACTOR})})
    save(run, tmp_path)
    again = pf.Run.read(tmp_path).sensors["camera"]
    assert again.noise.tolist() == FACTOR.tolist()
    assert again.rows(SEEN > 1.0).noise.tolist() == FACTOR[SEEN > 1.0].tolist()


@pytest.mark.parametrize(
    ("noise", "words"),
    [
        ("{ sd = 'told', variance = 'told', typical = 1.0 }", "expected one of sd = .* and variance"),
        ("{ sd = 'told', typical = 0.0 }", "noise.typical"),
        ("{ sd = 'told' }", "typical"),
    ],
)
def test_what_says_too_much_or_too_little_is_refused(noise: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        pf.Run.read(written(tmp_path, noise, FACTOR))
