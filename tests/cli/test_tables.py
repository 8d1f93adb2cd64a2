"""Tables on the screen: whole, however narrow it is."""

from io import StringIO

import pytest

from pumafuse.cli.tables import print_tables, table

HEADINGS = ["axis", "sensor", "measurements,\nof both", "RMSE [mm]", "verdict"]
ROWS = [
    ["x", "camera of the cell", "17997", "-600.392 ± 0.013", "NIS 0.97, expected 0.96 to 1.04: consistent in size"],
    ["yaw", "lidar :key:", "5", "+0.1", "NIS 12345.678, expected 0.99 to 1.01: follows the velocity"],
]


class Terminal(StringIO):
    """A stream that calls itself a terminal."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("width", [10, 80])
def test_no_number_and_no_name_is_cut(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A digit that is cut off makes another number: rather the lines are longer than the screen."""
    monkeypatch.setenv("COLUMNS", str(width))
    screen = Terminal()
    monkeypatch.setattr("sys.stdout", screen)
    print_tables([table(HEADINGS, ROWS)])
    shown = screen.getvalue()
    for row in ROWS:
        for cell in row[:4]:
            assert f" {cell} " in shown
        for word in row[4].split():
            assert f" {word}" in shown
    assert all(line.strip() in shown for heading in HEADINGS for line in heading.splitlines())


def test_a_log_file_gets_whole_tables_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """120 columns are taken where it is no terminal, more where they do not suffice."""
    file = StringIO()
    monkeypatch.setattr("sys.stderr", file)
    print_tables([table([f"number {place}" for place in range(20)], [["12345.6789"] * 20])], "stderr")
    assert file.getvalue().count("12345.6789") == 20
