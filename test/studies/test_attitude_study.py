"""A small run of study_attitude writes its page, tables and plots, and its figures are what they say."""

import re

import numpy as np
import pytest

from attitude_estimator.rivals import RIVALS
from studies import attitude

RUNS = 2
NOISE_PART = 0.02  # of a standard deviation, from 12 000 draws: 3 sigma
SECTIONS = ("Figures 2 to 12", "Its claims", "Tilt RMS beside the bound", "NEES/2", "Far-off starts",
            "Loops through", "Biases of", "Ways to hold the norm", "Sample rate", "Speed")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as short:
        short.setattr(attitude, "DURATION", 60.0)
        short.setattr(attitude, "START_ERRORS_DEG", (30,))
        short.setattr(attitude, "RATES", (50.0,))
        attitude.main(["--out", str(out), "--runs", str(RUNS), "--motions", "turn"])
    return out


def _table(text, title):
    """Return the rows of the table below a heading, the header first."""
    lines = text.split(f"## {title}")[1].split("\n## ")[0].splitlines()
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines if line.startswith("| ")]


def test_the_page_has_every_section_and_every_figure_of_the_paper(page):
    text = (page / "attitude.md").read_text(encoding="utf-8")
    for title in SECTIONS:
        assert f"## {title}" in text
    assert [row[0] for row in _table(text, "Figures 2 to 12")[1:]] == [str(k) for k in range(2, 13)]
    assert "nan" not in text


def test_the_plots_that_the_page_shows_are_there(page):
    text = (page / "attitude.md").read_text(encoding="utf-8")
    shown = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert len(shown) == 4
    for name in shown:
        assert (page / name).stat().st_size > 10_000


def test_every_claim_has_a_verdict(page):
    rows = _table((page / "attitude.md").read_text(encoding="utf-8"), "Its claims")
    assert len(rows) == 11
    assert all(len(row) == 3 and all(row) for row in rows)


def test_the_table_has_a_figure_for_every_motion_and_filter(page):
    rows = _table((page / "attitude.md").read_text(encoding="utf-8"), "Tilt RMS beside the bound")
    assert [row[0] for row in rows] == ["motion", attitude.MOTIONS[0], "turn"]
    assert rows[0][2:] == list(attitude.FILTERS)
    for row in rows[1:]:
        assert len(row) == len(rows[0])
        linear = float(row[2 + list(attitude.FILTERS).index(attitude.LINEAR)])
        assert 0.5 < linear / float(row[1]) < 2.0  # two runs


def test_the_study_runs_every_rival():
    used = {chosen.estimator for chosen in attitude.FILTERS.values()}
    assert used == {"dcm_row5", *RIVALS} - {"dcm_row5_gamma"}  # that one has a table of its own


def test_the_noise_is_the_papers_and_the_bias_what_is_asked_for():
    motion = attitude.sample_motion("turn")
    imu, altitude, _ = attitude.noisy(motion, 0)
    gyro, accel = imu.gyro_b - motion.sampled.imu.gyro_b, imu.accel_b - motion.sampled.imu.accel_b
    height = altitude.altitude + motion.sampled.position_n[:, 2]
    for noise, std in ((gyro, np.radians(0.5)), (accel, 0.1), (height, 2.0)):
        assert noise.std() == pytest.approx(std, rel=NOISE_PART)
        assert abs(noise.mean()) < 2 * NOISE_PART * std
    biased, _, _ = attitude.noisy(motion, 0, biases=(0.1, 0.0))
    shift = biased.gyro_b - imu.gyro_b
    assert np.ptp(shift, axis=0) == pytest.approx(0.0, abs=1e-12) and np.all(np.abs(shift[0]) > 1e-3)
    np.testing.assert_array_equal(biased.accel_b, imu.accel_b)
