"""`pumafuse export`: what it says and refuses; the header itself is tested in test_controller.py."""

from pathlib import Path

import pytest

from executable import DATA, FUSION, names, pumafuse, refused

SCAN = DATA / "scan" / "fusion.toml"


def test_a_header_is_written_once(tmp_path: Path) -> None:
    """It says what it was made from; only --force replaces it, and nothing replaces what is no header of ours."""
    path, own = tmp_path / "filter.h", tmp_path / "own.h"
    done = pumafuse("export", "-c", SCAN, "-o", path)
    assert done.stderr == ""
    assert done.stdout == f"filter_model, of x, y, z measured by tracker, vision, range, written to {path}\n"
    version = pumafuse("--version").stdout.strip()
    assert path.read_text().startswith(f"/* Made by {version} from {SCAN}: ")
    assert refused("export", "-c", FUSION, "-o", path) == f"pumafuse: {path}: exists; --force replaces it"
    assert str(SCAN) in path.read_text()
    pumafuse("export", "-c", FUSION, "-o", path, "--force")
    assert str(FUSION) in path.read_text()
    own.write_text("int x;\n")
    for other in (own, tmp_path):
        assert "is no header of pumafuse export" in refused("export", "-c", SCAN, "-o", other, "--force")
    assert own.read_text() == "int x;\n"


def test_axes_of_a_frame_are_the_arms(tmp_path: Path) -> None:
    """Who gives x, y, z to `live` is told that the header is in the arm's axes, here and in the header."""
    config = tmp_path / "fusion.toml"
    config.write_text('arm = "puma560-internal"\nframe = { kind = "cylindrical" }\n[sensors.tracker]\nsd_mm = 0.05\n')
    done = pumafuse("export", "-c", config, "-o", tmp_path / "filter.h")
    _, line = done.stdout.splitlines()
    assert line.startswith("it is in the arm's axes: turning x, y, z into tangential, radial, vertical")
    assert "in the axes of the arm: its [frame] is not in here" in (tmp_path / "filter.h").read_text()


@pytest.mark.parametrize(
    ("text", "name", "words"),
    [
        ("[sensors.tracker]\nsd_mm = -1.0\n", "filter.h", "fusion.toml: sensors.tracker.sd_mm"),
        ("[sensors.tracker]\nsd_mm = 1.0\n", "pumafuse.h", "pumafuse.h: its names would be those of pumafuse.h"),
        ("[sensors.tracker]\nsd_mm = 1.0\n", "fusion.toml/filter.h", "cannot be written"),
    ],
)
def test_what_cannot_be_exported_is_one_line(text: str, name: str, words: str, tmp_path: Path) -> None:
    """Nothing is written then."""
    config = tmp_path / "fusion.toml"
    config.write_text(f'arm = "puma560-internal"\n{text}')
    assert words in refused("export", "-c", config, "-o", tmp_path / name)
    assert names(tmp_path) == {"fusion.toml"}


def test_a_model_with_too_many_states_is_refused(tmp_path: Path) -> None:
    """As `live` refuses it: by the core's own reason, with what is to be done."""
    config = tmp_path / "fusion.toml"
    sensors = "".join(f"[sensors.s{n}]\nsd_mm = 1.0\nbias_sd_mm = 1.0\n" for n in range(70))
    config.write_text(f'arm = "puma560-internal"\n{sensors}')
    said = refused("export", "-c", config, "-o", tmp_path / "filter.h")
    assert "too many sensors have biases; set bias_sd and bias_drift_sd of some to 0" in said
